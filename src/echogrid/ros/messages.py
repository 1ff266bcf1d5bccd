"""What messages of ROS say, whatever carried them: readings of sonars, transforms, poses.

Messages are taken by their fields, as the definitions of sensor_msgs, nav_msgs and tf2_msgs name them, so that those
of a bag and those of a network are read alike. They may come from anyone: nothing in them raises.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.robot import MAX_SONARS
from echogrid.ros.transforms import Transforms

RANGE, SONAR_ARRAY = "sensor_msgs/msg/Range", "p2os_msgs/msg/SonarArray"
CLOUD, CLOUD2 = "sensor_msgs/msg/PointCloud", "sensor_msgs/msg/PointCloud2"
TF, TF_OLD, ODOMETRY = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage", "nav_msgs/msg/Odometry"

SONARS = (RANGE, SONAR_ARRAY, CLOUD, CLOUD2)
"""Types that carry readings of sonars, the best first."""


SHOWN = 6
"""Names that a message lists at most."""

_LONGEST = 100
"""Characters of a name that a message shows at most."""


@dataclass(frozen=True)
class Choice:
    """What to listen to, where there is more than one thing to choose from."""

    topics: tuple[str, ...] = ()
    """Names or patterns (``/front/*``) of the topics of sonars and odometry; none: all."""
    base: str | None = None
    """Frame of the robot; None: told from tf and odometry."""
    fixed: str | None = None
    """Frame to map in; None: map, else what stands highest above the robot."""
    odometry: bool = False
    """Whether the poses are to be odometry: odom is the frame to map in, where there is one and none is named."""

    @property
    def names(self) -> bool:
        """Whether topics or frames are named, which only bags have."""
        return (self.topics, self.base, self.fixed) != ((), None, None)

    def takes(self, topic: str) -> bool:
        """Whether a topic is among the chosen."""
        return not self.topics or any(fnmatchcase(topic, pattern) for pattern in self.topics)


class Sonar(NamedTuple):
    """Which sonar it is: one of a topic, by its frame, or by its place in messages that hold all."""

    topic: str
    frame: str

    def __str__(self) -> str:
        return f"{self.frame} on {self.topic}"

    @property
    def order(self) -> list[tuple[int, str]]:
        """What sonars are sorted by."""
        return natural(f"{self.topic} {self.frame}")


class RangeSaid(NamedTuple):
    """What a sensor_msgs/Range says."""

    stamp: float
    """s; 0 if it says none."""
    frame: str
    field_of_view: float
    """rad"""
    min_range_m: float
    max_range_m: float
    range_m: float

    @staticmethod
    def of(message: Any) -> "RangeSaid":
        """What a message with the fields of a Range says."""
        header = message.header
        limits = message.min_range, message.max_range
        return RangeSaid(seconds(header.stamp), header.frame_id, message.field_of_view, *limits, message.range)


def is_static(topic: str) -> bool:
    """Whether the transforms on a topic hold at all times."""
    return topic.rsplit("/", 1)[-1] == "tf_static"


def seconds(stamp: Any) -> float:
    """Seconds of a ``builtin_interfaces/Time``."""
    return stamp.sec + stamp.nanosec * 1e-9


def put_transforms(transforms: Transforms, message: Any, static: bool, stamp: float | None = None) -> Iterator[str]:
    """Take a TFMessage; says of each transform that was refused why. ``stamp`` (s) is taken in place of its own."""
    for each in message.transforms:
        at, turn = each.transform.translation, each.transform.rotation
        refused = transforms.put(
            each.header.frame_id,
            each.child_frame_id,
            seconds(each.header.stamp) if stamp is None else stamp,
            (at.x, at.y, at.z),
            (turn.x, turn.y, turn.z, turn.w),
            static=static,
        )
        if refused:
            yield refused


def put_odometry(transforms: Transforms, message: Any, stamp: float | None = None) -> str | None:
    """Take a nav_msgs/Odometry, which gives way to tf; why it was refused, if it was.

    ``stamp`` (s) is taken in place of its own.
    """
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    return transforms.put(
        message.header.frame_id or "odom",
        message.child_frame_id or "base_link",
        seconds(message.header.stamp) if stamp is None else stamp,
        (at.x, at.y, at.z),
        (turn.x, turn.y, turn.z, turn.w),
        weak=True,
    )


def ranges_of(message: Any) -> Float[ndarray, "sonars"] | None:
    """Ranges (m) of a SonarArray of p2os; None if it is no such message."""
    ranges = np.asarray(message.ranges, dtype=float)
    return ranges if ranges.ndim == 1 and 0 < len(ranges) <= MAX_SONARS else None


def points_of(message: Any) -> Float[ndarray, "points 2"] | None:
    """Points x, y (m, in the message's frame) of a PointCloud or PointCloud2; None if there are none to be read."""
    if hasattr(message, "points"):
        points = [(point.x, point.y) for point in message.points[: MAX_SONARS + 1]]
        return np.array(points, dtype=float) if 0 < len(points) <= MAX_SONARS else None
    count = message.width * message.height
    offsets = {field.name: field.offset for field in message.fields if field.datatype == _FLOAT32}
    if not 0 < count <= MAX_SONARS or not {"x", "y"} <= offsets.keys():
        return None
    data, step = bytes(message.data), message.point_step
    if max(offsets["x"], offsets["y"]) + 4 > step or len(data) < count * step or message.height != 1:
        return None
    kind = np.dtype(">f4" if message.is_bigendian else "<f4")
    x, y = (np.ndarray(count, kind, data, offsets[name], (step,)) for name in ("x", "y"))
    return np.column_stack([x, y]).astype(float)


_FLOAT32 = 7


def natural(name: str) -> list[tuple[int, str]]:
    """What names are sorted by for numbers to count as numbers: sonar_2 before sonar_10."""
    return [(int(part[:18]), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def short(name: str) -> str:
    """A name as a message shows it."""
    return name if len(name) <= _LONGEST else name[:_LONGEST] + "..."


def few(names: Iterable[object]) -> str:
    """Names, or what is told by name, for a message: those that differ by numbers alone are one, as a pattern of
    --topics.
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    for name in map(str, names):
        alike.setdefault(tuple(re.split(r"\d+", name)), []).append(name)
    parts: list[str] = []
    for each in alike.values():
        pieces = zip(*(re.split(r"(\d+)", name) for name in each), strict=True)
        pattern = "".join(piece[0] if len(set(piece)) == 1 else "*" for piece in pieces)
        parts += [f"{short(pattern)} ({len(each)} of them)"] if len(each) > 2 else map(short, each)
    shown = ", ".join(parts[:SHOWN]) or "nothing"
    return f"{shown} and {len(parts) - SHOWN} more" if len(parts) > SHOWN else shown
