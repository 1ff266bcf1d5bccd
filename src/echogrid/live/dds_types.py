"""Messages of ROS 2 as DDS carries them: what a network can send is decoded in bounded size and never raises.

The names are those by which ROS 2 puts its types on DDS: ``nav_msgs/msg/OccupancyGrid`` is
``nav_msgs::msg::dds_::OccupancyGrid_``, all structs are final.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from math import cos, sin
from struct import Struct
from typing import Any

import numpy as np
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint8, uint32
from jaxtyping import Float
from numpy import ndarray

from echogrid.live.driving import Goal, Velocity
from echogrid.live.live_map import Picture
from echogrid.live.placing import Correction, RobotPose
from echogrid.robot import Robot

MAX_MESSAGE_BYTES = 256 * 1024
"""A longer message is refused: room for about 2,000 transforms."""


_PLAIN = b"\0\1"
"""How messages begin in CDR as ROS writes it; numbers lie on multiples of their size from the 4th byte on."""

_STAMP, _LENGTH, _LIMITS, _PLACE = Struct("<iI"), Struct("<I"), Struct("<4f"), Struct("<7d")
_INFO = Struct("<iIfII")


class Refused:
    """Stands for a message that was not even decoded."""

    sample_info: Any = None

    def __init__(self, reason: str):
        self.reason = reason


def _message(name: str, **fields: Any) -> Any:
    """A message of ROS as a final struct of DDS; made by a call, for tools that read hints choke on such classes."""
    package, kind = name.split("/")
    return make_idl_struct(kind, f"{package}.msg.dds_.{kind}_", fields)


def _bounded(kind: Any, quick: Callable[[bytes], Any] | None = None) -> Any:
    """Have a type's decoding refuse, not raise, so that one bad message takes no other with it.

    ``quick`` decodes what comes most, as Cyclone DDS itself would, which takes ten times as long; where it raises
    Cyclone DDS is to judge.
    """
    decode = kind.deserialize

    def deserialize(data: bytes, *args: Any, **kwargs: Any) -> Any:
        if len(data) > MAX_MESSAGE_BYTES:
            return Refused("a message that is too long")
        if quick is not None and data[:2] == _PLAIN and not args and not kwargs:
            with suppress(Exception):
                return quick(data)
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


def _text(data: bytes, at: int) -> tuple[str, int]:
    """The text at a place, or behind the gap there, and the place behind it."""
    at = (at + 3) & -4
    (length,) = _LENGTH.unpack_from(data, at)
    end = at + 4 + length
    if not length or end > len(data):
        raise ValueError("no text")
    return data[at + 4 : end - 1].decode(), end


def _transforms(data: bytes) -> Any:
    (count,), at, found = _LENGTH.unpack_from(data, 4), 8, []
    for _ in range(count):
        at = (at + 3) & -4
        stamp = Time(*_STAMP.unpack_from(data, at))
        parent, at = _text(data, at + 8)
        child, at = _text(data, at)
        at = (at + 3 & -8) + 4
        x, y, z, *turn = _PLACE.unpack_from(data, at)
        at += _PLACE.size
        found.append(TransformStamped(Header(stamp, parent), child, Transform(Vector3(x, y, z), Quaternion(*turn))))
    return TFMessage(found)


def _range(data: bytes) -> Any:
    stamp = Time(*_STAMP.unpack_from(data, 4))
    frame, at = _text(data, 12)
    return Range(Header(stamp, frame), data[at], *_LIMITS.unpack_from(data, (at + 4) & -4))


TFMessage = _bounded(_message("tf2_msgs/TFMessage", transforms=sequence[TransformStamped]), _transforms)
Pose = _message("geometry_msgs/Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = _message("geometry_msgs/PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
PoseWithCovarianceStamped = _bounded(
    _message("geometry_msgs/PoseWithCovarianceStamped", header=Header, pose=PoseWithCovariance)
)
PoseStamped = _message("geometry_msgs/PoseStamped", header=Header, pose=Pose)
Twist = _bounded(_message("geometry_msgs/Twist", linear=Vector3, angular=Vector3))
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

Range = _bounded(_message("sensor_msgs/Range", **_RANGE), _range)
"""As it was up to ROS 2 Humble. It reads the longer message of later releases as well, where the writer does not say
what its type looks like, and ROS 2's do not."""

RangeWithVariance = _bounded(_message("sensor_msgs/Range", **_RANGE, variance=float32))
"""From ROS 2 Iron on."""

Clock = _message("rosgraph_msgs/Clock", clock=Time)

MapMetaData = _message(
    "nav_msgs/MapMetaData", map_load_time=Time, resolution=float32, width=uint32, height=uint32, origin=Pose
)
OccupancyGrid = _message("nav_msgs/OccupancyGrid", header=Header, info=MapMetaData, data=sequence[int8])


def _serialize(self: Any, use_version_2: bool | None = None) -> bytes:
    """As of any message, but for the cells, which would take a call each; in CDR, as the writers here have it."""
    assert not use_version_2
    cells, stamp, loaded = np.asarray(self.data, dtype=np.int8), self.header.stamp, self.info.map_load_time
    name, at, turn = self.header.frame_id.encode(), self.info.origin.position, self.info.origin.orientation
    text = _STAMP.pack(stamp.sec, stamp.nanosec) + _LENGTH.pack(len(name) + 1) + name + b"\0"
    info = _INFO.pack(loaded.sec, loaded.nanosec, self.info.resolution, self.info.width, self.info.height)
    head = text + bytes(-len(text) % 4) + info
    head += bytes(-len(head) % 8) + _PLACE.pack(at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w)
    return b"".join((_PLAIN, b"\0\0", head, _LENGTH.pack(cells.size), cells))


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


def goal_message(goal: Goal) -> Any:
    """The message that says where to go, as Nav2 takes it."""
    x, y, theta = goal.pose.tolist()
    return PoseStamped(Header(_time(goal.stamp), goal.frame), Pose(Point(x, y, 0.0), _turned(theta)))


def twist_message(velocity: Velocity) -> Any:
    """The message that says how fast to drive, as bases take it."""
    speed, turn = velocity
    return Twist(Vector3(speed, 0.0, 0.0), Vector3(0.0, 0.0, turn))


def pose_message(told: RobotPose) -> Any:
    """The message that says where the robot is."""
    x, y, theta = told.pose.tolist()
    covariance = np.zeros((6, 6))
    covariance[np.ix_(_PLANE, _PLANE)] = told.covariance
    pose = PoseWithCovariance(Pose(Point(x, y, 0.0), _turned(theta)), covariance.ravel().tolist())
    return PoseWithCovarianceStamped(Header(_time(told.stamp), told.frame), pose)


_PLANE = [0, 1, 5]
"""x, y and the heading among the six of a pose."""


def transform_message(stamp: float, parent: str, children: Mapping[str, Float[ndarray, "3"]]) -> Any:
    """The message that says where frames lie (m, m, rad) in another."""
    header = Header(_time(stamp), parent)
    return TFMessage([
        TransformStamped(header, child, Transform(Vector3(float(x), float(y), 0.0), _turned(float(theta))))
        for child, (x, y, theta) in children.items()
    ])  # fmt: skip


def odometry_message(
    stamp: float, parent: str, child: str, pose: Float[ndarray, "3"], velocity: Float[ndarray, "2"]
) -> Any:
    """The message that says what wheels count: a pose (m, m, rad), and a velocity (m/s, rad/s)."""
    (x, y, theta), (speed, turn) = pose.tolist(), velocity.tolist()
    nothing = [0.0] * 36
    return Odometry(
        Header(_time(stamp), parent),
        child,
        PoseWithCovariance(Pose(Point(x, y, 0.0), _turned(theta)), nothing),
        TwistWithCovariance(twist_message(Velocity(speed, turn)), nothing),
    )


def range_message(stamp: float, frame: str, robot: Robot, range_m: float) -> Any:
    """The message that says a reading (m), as of ROS 2 from Iron on; earlier ones read it too."""
    limits = robot.beam_width_rad, robot.min_range_m, robot.max_range_m
    return RangeWithVariance(Header(_time(stamp), frame), 0, *limits, range_m, 0.0)


def clock_message(stamp: float) -> Any:
    """The message that says what time it is in a simulation, s."""
    return Clock(_time(stamp))


def _time(seconds: float) -> Any:
    return Time(*divmod(round(seconds * 1e9), 10**9))


def _turned(theta: float) -> Any:
    return Quaternion(0.0, 0.0, sin(theta / 2), cos(theta / 2))
