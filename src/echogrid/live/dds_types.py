"""Messages of ROS 2 as DDS carries them: what a network can send is decoded in bounded size and never raises.

The names are those by which ROS 2 puts its types on DDS: ``nav_msgs/msg/OccupancyGrid`` is
``nav_msgs::msg::dds_::OccupancyGrid_``, all structs are final.
"""

import struct
from dataclasses import replace
from math import cos, sin
from typing import Any

import numpy as np
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint8, uint32

from echogrid.live.live_map import Picture
from echogrid.live.placing import Correction

MAX_MESSAGE_BYTES = 256 * 1024
"""A longer message is refused: room for about 2,000 transforms."""


class Refused:
    """Stands for a message that was not even decoded."""

    sample_info: Any = None

    def __init__(self, reason: str):
        self.reason = reason


def _message(name: str, **fields: Any) -> Any:
    """A message of ROS as a final struct of DDS; made by a call, for tools that read hints choke on such classes."""
    package, kind = name.split("/")
    return make_idl_struct(kind, f"{package}.msg.dds_.{kind}_", fields)


def _bounded(kind: Any) -> Any:
    """Have a type's decoding refuse, not raise, so that one bad message takes no other with it."""
    decode = kind.deserialize

    def deserialize(data: bytes, *args: Any, **kwargs: Any) -> Any:
        if len(data) > MAX_MESSAGE_BYTES:
            return Refused("a message that is too long")
        try:
            return decode(data, *args, **kwargs)
        except Exception:  # strangers decide what is in it, and the decoder raises whatever its steps raise
            return Refused("a message that cannot be decoded")

    kind.deserialize = staticmethod(deserialize)
    return kind


Time = _message("builtin_interfaces/Time", sec=int32, nanosec=uint32)
Header = _message("std_msgs/Header", stamp=Time, frame_id=str)
Vector3 = _message("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
Point = _message("geometry_msgs/Point", x=float64, y=float64, z=float64)
Quaternion = _message("geometry_msgs/Quaternion", x=float64, y=float64, z=float64, w=float64)
Transform = _message("geometry_msgs/Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = _message("geometry_msgs/TransformStamped", header=Header, child_frame_id=str, transform=Transform)
TFMessage = _bounded(_message("tf2_msgs/TFMessage", transforms=sequence[TransformStamped]))
Pose = _message("geometry_msgs/Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = _message("geometry_msgs/PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
Twist = _message("geometry_msgs/Twist", linear=Vector3, angular=Vector3)
TwistWithCovariance = _message("geometry_msgs/TwistWithCovariance", twist=Twist, covariance=array[float64, 36])
Odometry = _bounded(
    _message(
        "nav_msgs/Odometry", header=Header, child_frame_id=str, pose=PoseWithCovariance, twist=TwistWithCovariance
    )
)

_RANGE = {
    "header": Header,
    "radiation_type": uint8,
    **dict.fromkeys(("field_of_view", "min_range", "max_range", "range"), float32),
}

Range = _bounded(_message("sensor_msgs/Range", **_RANGE))
"""As it was up to ROS 2 Humble. It reads the longer message of later releases as well, where the writer does not say
what its type looks like, and ROS 2's do not."""

RangeWithVariance = _bounded(_message("sensor_msgs/Range", **_RANGE, variance=float32))
"""From ROS 2 Iron on."""

MapMetaData = _message(
    "nav_msgs/MapMetaData", map_load_time=Time, resolution=float32, width=uint32, height=uint32, origin=Pose
)
OccupancyGrid = _message("nav_msgs/OccupancyGrid", header=Header, info=MapMetaData, data=sequence[int8])


def _serialize(self: Any, *args: Any, **kwargs: Any) -> bytes:
    """As of any message, but for the cells, which would take a call each."""
    cells = np.asarray(self.data, dtype=np.int8)
    bare = IdlStruct.serialize(replace(self, data=[]), *args, **kwargs)
    return bare[:-4] + struct.pack("=I", cells.size) + cells.tobytes()


OccupancyGrid.serialize = _serialize


def occupancy_grid(picture: Picture) -> Any:
    """The message that says a map."""
    rows, cols = picture.cells.shape
    stamp = _time(picture.stamp)
    origin = Pose(Point(*picture.origin, 0.0), _turned(0.0))
    info = MapMetaData(stamp, picture.resolution, cols, rows, origin)
    return OccupancyGrid(Header(stamp, picture.frame), info, picture.cells.ravel())


def tf_message(correction: Correction) -> Any:
    """The message that says where the frame of the odometry lies in that of the map."""
    x, y, theta = correction.pose.tolist()
    where = Transform(Vector3(x, y, 0.0), _turned(theta))
    header = Header(_time(correction.stamp), correction.parent)
    return TFMessage([TransformStamped(header, correction.child, where)])


def _time(seconds: float) -> Any:
    return Time(*divmod(round(seconds * 1e9), 10**9))


def _turned(theta: float) -> Any:
    return Quaternion(0.0, 0.0, sin(theta / 2), cos(theta / 2))
