"""What is heard of a robot: ranges, transforms and odometry of ROS, whoever sends them.

Whoever may send these messages is a stranger: nothing in them raises, and what is kept of them is bounded. What is
not taken is counted by reason.
"""

from collections import Counter, deque
from enum import Enum
from itertools import islice
from math import inf, isfinite, nan
from typing import Any

from echogrid.live.sonar_array import SonarArray, SonarSaid
from echogrid.robot import MAX_SONARS
from echogrid.ros.messages import seconds
from echogrid.ros.sonars import beam_width, reading
from echogrid.ros.transforms import Transforms

SETTLE_S, LONGEST_S = 2.0, 10.0
"""Mapping begins when no further sonar was heard for so long, and after so long anyhow, by the readings' stamps."""

LEAP_S = 10.0
"""A stamp farther than this from the newest is not of the same clock."""

LEAPS = 20
"""Messages in a row with stamps of another clock, after which that one is taken for the robot's."""

MAX_WAITING = 50_000
"""Readings kept until the array is known."""

MAX_MOVES = 200_000
"""Transforms kept until the array is known."""

MAX_TRANSFORMS = 2_000
"""Transforms that are read from one message."""

MAX_NAME = 200
"""Letters in the name of a frame."""

FAR_STAMP = "a stamp far from those of the others"


class Heard(Enum):
    """Kinds of messages."""

    RANGE = "sensor_msgs/Range"
    TF = "tf2_msgs/TFMessage on /tf"
    STATIC = "tf2_msgs/TFMessage on /tf_static"
    ODOMETRY = "nav_msgs/Odometry"


class _Refusal(Exception):  # noqa: N818 - no error of the user's
    """A message is not taken; the text says why."""


class _Clock:
    """Tells stamps of the robot's clock from others."""

    def __init__(self) -> None:
        self.newest = nan
        """Stamp, s; nan: none yet."""
        self._other, self._apart = nan, 0

    def admit(self, stamp: float) -> bool:
        """Whether a stamp (s) is of a clock that has jumped.

        Raises:
            _Refusal: it is far from the others.
        """
        if not isfinite(self.newest) or abs(stamp - self.newest) <= LEAP_S:
            self.newest = stamp if not isfinite(self.newest) else max(self.newest, stamp)
            self._apart = 0
            return False
        self._apart = self._apart + 1 if abs(stamp - self._other) <= LEAP_S else 1
        self._other = stamp
        if self._apart < LEAPS:
            raise _Refusal(FAR_STAMP)
        self.newest, self._apart = stamp, 0
        return True


class Hearing:
    """Transforms and sonars heard so far; readings go on to the array of sonars as soon as there is one."""

    def __init__(self, refused: Counter[str]):
        """Nothing heard yet.

        Args:
            refused: where it is counted what is not taken, by reason.
        """
        self.transforms = Transforms()
        self.clock = _Clock()
        self.sonars: dict[str, SonarSaid] = {}
        """By their frames."""
        self.readings = 0
        """How many the array took."""
        self.newest = -inf
        """Stamp of the newest reading, s."""
        self.last_range = -inf
        """When the last one came by the caller's clock, s."""
        self._refused = refused
        self._moves = 0
        self._odometry: dict[str, str] = {}
        self._first, self._grew = inf, -inf
        self._waiting: deque[tuple[str, float, float]] = deque(maxlen=MAX_WAITING)
        self._array: SonarArray | None = None

    def take(self, heard: Heard, topic: str, message: Any, now: float) -> None:
        """Take a message; one that cannot be used is counted and does no harm.

        Args:
            heard: of which kind.
            topic: on which it came.
            message: it has the attributes of that kind, but anything may be in them.
            now: the caller's clock, s, which only has to go on.
        """
        try:
            if heard is Heard.RANGE:
                self._take_range(message, now)
            elif heard is Heard.ODOMETRY:
                self._take_odometry(topic, message)
            else:
                self._take_transforms(message, heard is Heard.STATIC)
        except _Refusal as refusal:
            self._refused[str(refusal)] += 1
        except Exception:  # strangers decide what is in it
            self._refused[f"a message that is no {heard.value}"] += 1

    @property
    def settled(self) -> bool:
        """Whether the sonars that were heard are likely to be all there are."""
        return self.newest - self._grew >= SETTLE_S or self.newest - self._first >= LONGEST_S

    def tidy(self) -> None:
        """Forget sonars of no place where there are too many: made-up names must not keep others out."""
        if len(self.sonars) >= MAX_SONARS:
            self.sonars = {name: each for name, each in self.sonars.items() if name in self.transforms}

    def begin(self, array: SonarArray) -> None:
        """Hand readings on to the array of sonars from now on, and first those that waited for it."""
        self._array = array
        while self._waiting:
            self._hand_on(array, *self._waiting.popleft())

    def _hand_on(self, array: SonarArray, frame: str, stamp: float, range_m: float) -> None:
        if frame not in array.numbers:
            self._refused["a reading of a sonar that is new, or whose place is not known"] += 1
        elif array.scans.add(array.numbers[frame], stamp, range_m) is None:
            self.readings += 1

    def _take_transforms(self, message: Any, static: bool) -> None:
        for each in islice(message.transforms, MAX_TRANSFORMS):
            try:
                parent, child = _name(each.header.frame_id), _name(each.child_frame_id)
                place, turn = each.transform.translation, each.transform.rotation
                self._put(parent, child, each.header, place, turn, static=static)
            except _Refusal as refusal:
                self._refused[str(refusal)] += 1

    def _take_odometry(self, topic: str, message: Any) -> None:
        parent, child = _name(message.header.frame_id or "odom"), _name(message.child_frame_id or "base_link")
        # Two that know better than each other would make the robot jump to and fro.
        if len(self._odometry) >= MAX_SONARS or topic != self._odometry.setdefault(child, topic):
            raise _Refusal("odometry on a second topic")
        pose = message.pose.pose
        self._put(parent, child, message.header, pose.position, pose.orientation, weak=True)

    def _put(self, parent: str, child: str, header: Any, place: Any, turn: Any, **kind: bool) -> None:
        stamp = 0.0
        if not kind.get("static"):
            if self._array is not None and child not in self._array.line:
                return  # of a joint or of somebody else
            stamp = _stamp(header)
            if self.clock.admit(stamp):
                self._leap(stamp)
            self._moves += 1
            if self._array is None and self._moves > MAX_MOVES:
                self.transforms, self._moves = self.transforms.still(), 0
        numbers = [[float(getattr(part, axis)) for axis in axes] for part, axes in ((place, "xyz"), (turn, "xyzw"))]
        reason = self.transforms.put(parent, child, stamp, numbers[0], numbers[1], **kind)
        if reason is not None:
            raise _Refusal(reason)

    def _take_range(self, message: Any, now: float) -> None:
        frame = _name(message.header.frame_id)
        limits = float(message.min_range), float(message.max_range)
        value = reading(float(message.range), *limits)
        stamp = _stamp(message.header)
        if stamp == 0.0:
            if not isfinite(self.clock.newest):
                raise _Refusal("a reading without a stamp before any transform")
            stamp = self.clock.newest
        if self.clock.admit(stamp):
            self._leap(stamp)
        self.last_range = now
        self.newest, self._first = max(self.newest, stamp), min(self._first, stamp)
        if frame not in self.sonars:
            if len(self.sonars) >= MAX_SONARS:
                raise _Refusal(f"a reading of sonar number {MAX_SONARS + 1}")
            self.sonars[frame] = SonarSaid(beam_width(float(message.field_of_view)), limits)
            self._grew = stamp
        if self._array is None:
            self._waiting.append((frame, stamp, value))
        else:
            self._hand_on(self._array, frame, stamp, value)

    def _leap(self, stamp: float) -> None:
        """The robot's clock has jumped to a stamp: nothing waits for what was before."""
        self._refused["a clock that jumped"] += 1
        self.transforms, self._moves = self.transforms.still(), 0
        self._waiting.clear()
        self.newest = self._grew = self._first = stamp
        if self._array is not None:
            self._refused.update(self._array.scans.dropped)
            self._array.begin(self.transforms)


def _stamp(header: Any) -> float:
    sec, nanosec = int(header.stamp.sec), int(header.stamp.nanosec)
    if sec < 0 or not 0 <= nanosec < 10**9 or sec > 2**32:
        raise _Refusal("a stamp that cannot be")
    return seconds(header.stamp)


def _name(name: str) -> str:
    if not isinstance(name, str) or not name.isprintable() or len(name) > MAX_NAME or not name.strip(" /"):
        raise _Refusal("a name of a frame that cannot be")
    return name.lstrip("/")
