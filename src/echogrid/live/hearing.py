"""What is heard of a robot: ranges, transforms and odometry of ROS, whoever sends them.

Whoever may send these messages is a stranger: nothing in them raises, and what is kept of them is bounded. What is
not taken is counted by reason.
"""

from collections import Counter, deque
from collections.abc import Hashable
from enum import Enum
from itertools import islice
from math import inf, isfinite, isnan, sqrt
from operator import itemgetter
from typing import Any, NamedTuple

from echogrid.live.clocks import APART_S, FAR_STAMP, NO_STAMP, Clock, Stamps, whole
from echogrid.live.senders import Senders
from echogrid.live.sonar_array import SonarArray, SonarSaid
from echogrid.robot import MAX_SONARS
from echogrid.ros.rigid import Rigid, planar
from echogrid.ros.sonars import beam_width, reading
from echogrid.ros.transforms import Transforms, stands_still

SETTLE_S, LONGEST_S = 2.0, 10.0
"""Mapping begins when no further sonar was heard for so long, and after so long anyhow. By the caller's clock: a
robot's stamps may go faster, or stand."""

ROUNDS = 2
"""Mapping begins sooner where nothing is doubtful and each sonar has been heard so often since the last was new."""

SECONDS = 5
"""Readings of a second topic in the frame of a sonar, after which that is no frame of one sonar."""

MAX_WAITING = 50_000
"""Readings kept until the array is known."""

MAX_MOVES = 200_000
"""Transforms kept until the array is known."""

MAX_TRANSFORMS = 2_000
"""Transforms that are read from one message."""

MAX_NAME = 200
"""Letters in the name of a frame."""

_BEYOND = 1.2
"""How many times the maximum range is past it by far."""

NEW_SONAR = "a reading of a sonar that is new, or whose place is not known"
SECOND_TOPIC = "a reading of a second topic in the frame of another"


class Heard(Enum):
    """Kinds of messages."""

    RANGE = "sensor_msgs/Range"
    TF = "tf2_msgs/TFMessage on /tf"
    STATIC = "tf2_msgs/TFMessage on /tf_static"
    ODOMETRY = "nav_msgs/Odometry"
    INITIAL = "geometry_msgs/PoseWithCovarianceStamped"
    COMMAND = "geometry_msgs/Twist"


class _Refusal(Exception):  # noqa: N818 - no error of the user's
    """A message is not taken; the text says why."""


class Initial(NamedTuple):
    """Where somebody says that the robot is."""

    frame: str
    stamp: float
    """s; 0: now."""
    pose: tuple[float, float, float]
    """m, m, rad."""
    spread: tuple[float, float, float]
    """Standard deviations, m, m, rad."""


class Hearing:
    """Transforms and sonars heard so far; readings go on to the array of sonars as soon as there is one."""

    def __init__(self, refused: Counter[str]):
        """Nothing heard yet.

        Args:
            refused: where it is counted what is not taken, by reason.
        """
        self.transforms = Transforms()
        self.clock = Clock()
        self.stamps = Stamps(self.clock)
        self.sonars: dict[str, SonarSaid] = {}
        """By their frames."""
        self.shared: dict[str, set[str]] = {}
        """Frames of sonars that readings come in on several topics, and those topics."""
        self._second: Counter[str] = Counter()
        self.readings = 0
        """How many the array took."""
        self.newest = -inf
        """Stamp of the newest reading, s."""
        self.last_range = -inf
        """When the last one came by the caller's clock, s."""
        self.initial: Initial | None = None
        """Where the robot is, as it was said last; whoever uses it takes it away."""
        self.senders = Senders()
        """Of what is told of the robot that is mapped."""
        self.commanded = -inf
        """When another program drove the robot last, by the caller's clock, s."""
        self._refused = refused
        self._moves = 0
        self._odometry: dict[str, str] = {}
        self._first, self._grew = inf, -inf
        self._rounds: Counter[str] = Counter()
        self._posed = -inf
        self._waiting: deque[tuple[str, float, float]] = deque(maxlen=MAX_WAITING)
        self._keeps = True
        self._array: SonarArray | None = None

    def take(self, heard: Heard, topic: str, message: Any, now: float, source: Hashable = None) -> None:
        """Take a message; one that cannot be used is counted and does no harm.

        Args:
            heard: of which kind.
            topic: on which it came.
            message: it has the attributes of that kind, but anything may be in them.
            now: the caller's clock, s, which only has to go on.
            source: who sent it, where that is known.
        """
        try:
            if heard is Heard.RANGE:
                self._take_range(topic, message, now, source)
            elif heard is Heard.ODOMETRY:
                self._take_odometry(topic, message, now, source)
            elif heard is Heard.INITIAL:
                self.initial = _initial(message)
            elif heard is Heard.COMMAND:
                if message.linear.x or message.angular.z:  # who only says stop disturbs nobody
                    self.commanded = now
            else:
                self._take_transforms(topic, message, heard is Heard.STATIC, now, source)
        except _Refusal as refusal:
            self._refused[str(refusal)] += 1
        except Exception:  # strangers decide what is in it
            self._refused[f"a message that is no {heard.value}"] += 1

    def settled(self, now: float) -> bool:
        """Whether the sonars that were heard are likely to be all there are, by the caller's clock (s)."""
        if now - self._first >= LONGEST_S:
            return True
        quiet = now - self._grew >= SETTLE_S or self._all_heard()
        return bool(self.sonars) and quiet and not self.stamps.doubtful

    def _all_heard(self) -> bool:
        """Whether each topic is that of a sonar, and a further one would have been heard by now."""
        all_taken = self.stamps.topics == len(self.sonars)
        return all_taken and all(self._rounds[name] >= ROUNDS for name in self.sonars)

    @property
    def apart(self) -> dict[str, SonarSaid]:
        """Sonars by their frames, but for those whose frame is that of several topics."""
        return {name: each for name, each in self.sonars.items() if name not in self.shared}

    def tidy(self) -> None:
        """Forget sonars of no place where there are too many: made-up names must not keep others out."""
        if len(self.sonars) >= MAX_SONARS:
            self.sonars = {name: each for name, each in self.sonars.items() if name in self.transforms}

    def begin(self, array: SonarArray) -> None:
        """Hand readings on to the array of sonars from now on, and first those that waited for it; they are kept for
        another until ``forget``.
        """
        self._array = array
        for each in self._waiting:
            self._hand_on(array, *each)

    def forget(self) -> None:
        """Keep no reading that an array had."""
        self._waiting.clear()
        self._keeps = False

    def halt(self) -> None:
        """Hand readings on to no array any more: those that are kept, and those that come, wait for the next."""
        self._array, self._keeps, self.readings = None, True, 0
        del self._refused[NEW_SONAR]

    def _hand_on(self, array: SonarArray, frame: str, stamp: float, range_m: float) -> None:
        if frame not in array.numbers:
            self._refused[NEW_SONAR] += 1
        elif array.scans.add(array.numbers[frame], stamp, range_m) is None:
            self.readings += 1

    def _take_transforms(self, topic: str, message: Any, static: bool, now: float, source: Hashable) -> None:
        for each in islice(message.transforms, MAX_TRANSFORMS):
            try:
                parent, child = _name(each.header.frame_id), _name(each.child_frame_id)
                place, turn = each.transform.translation, each.transform.rotation
                self._put(parent, child, each.header, place, turn, now, static=static)
                if not static and not stands_still(child) and self._array is not None and child in self._array.line:
                    self.senders.note(f"{child} on {topic}", source, whole(each.header.stamp), now)
            except _Refusal as refusal:
                self._refused[str(refusal)] += 1

    def _take_odometry(self, topic: str, message: Any, now: float, source: Hashable) -> None:
        parent, child = _name(message.header.frame_id or "odom"), _name(message.child_frame_id or "base_link")
        # Two that know better than each other would make the robot jump to and fro.
        if len(self._odometry) >= MAX_SONARS or topic != self._odometry.setdefault(child, topic):
            raise _Refusal("odometry on a second topic")
        pose = message.pose.pose
        self._put(parent, child, message.header, pose.position, pose.orientation, now, weak=True)
        if self._array is not None and child in self._array.line:
            self.senders.note(topic, source, whole(message.header.stamp), now)

    def _put(self, parent: str, child: str, header: Any, place: Any, turn: Any, now: float, **kind: bool) -> None:
        stamp = 0.0
        if not kind.get("static"):
            if self._array is not None and child not in self._array.line:
                return  # of a joint or of somebody else
            stamp = whole(header.stamp)
            self._admit(stamp, pose=not stands_still(child))
            if not stands_still(child):  # a correction, as of odom in map, may be dated ahead
                self.stamps.pose(child, stamp, now)
                self._posed = stamp
            self._moves += 1
            if self._array is None and self._moves > MAX_MOVES:
                self.transforms, self._moves = self.transforms.still(), 0
        numbers = [[float(getattr(part, axis)) for axis in axes] for part, axes in ((place, "xyz"), (turn, "xyzw"))]
        reason = self.transforms.put(parent, child, stamp, numbers[0], numbers[1], **kind)
        if reason is not None:
            raise _Refusal(reason)

    def _admit(self, stamp: float, pose: bool) -> None:
        if isnan(stamp):
            raise _Refusal(NO_STAMP)
        jumped = self.clock.admit(stamp, pose)
        if jumped is None:
            raise _Refusal(FAR_STAMP)
        if jumped:
            self._leap(stamp)

    def _take_range(self, topic: str, message: Any, now: float, source: Hashable) -> None:
        frame = _name(message.header.frame_id)
        limits = float(message.min_range), float(message.max_range)
        raw = float(message.range)
        value = reading(raw, *limits)
        if frame in self.sonars and topic != self.sonars[frame].topic:
            self._share(frame, topic)
            raise _Refusal(SECOND_TOPIC)
        stamp = self.stamps.reading(topic, frame, message.header.stamp, now)
        if stamp == 0.0:
            if not isfinite(self.clock.newest):
                raise _Refusal("a reading without a stamp before any transform")
            stamp = self.clock.newest
        self._admit(stamp, pose=False)
        self.last_range = now
        self.newest = max(self.newest, stamp)
        if self._first == inf:
            self._first = self._grew = now
        if frame not in self.sonars:
            if len(self.sonars) >= MAX_SONARS:
                raise _Refusal(f"a reading of sonar number {MAX_SONARS + 1}")
            self.sonars[frame] = SonarSaid(beam_width(float(message.field_of_view)), limits, topic)
            self._grew = now
            self._rounds.clear()
        # By two clocks it takes seconds to find how far they are apart.
        self._rounds[frame] = self._rounds[frame] + 1 if abs(stamp - self._posed) < APART_S else 0
        if limits == self.sonars[frame].limits and _outside(raw, *limits):
            value = raw  # the array has the same limits; whoever judges the readings wants to know
        if self._keeps:
            self._waiting.append((frame, stamp, value))
        if self._array is not None:
            self._hand_on(self._array, frame, stamp, value)
            if frame in self._array.numbers:
                self.senders.note(topic, source, whole(message.header.stamp), now)

    def bring_together(self) -> None:
        """Take readings by the robot's clock that are of another one, as far as that is known."""
        shifts = self.stamps.compare(self._array.line if self._array else None)
        if not shifts:
            return
        ahead = {name: shifts.get(said.topic, 0.0) for name, said in self.sonars.items()}
        waiting = [(name, stamp - ahead.get(name, 0.0), value) for name, stamp, value in self._waiting]
        self._waiting.clear()
        self._waiting.extend(sorted(waiting, key=itemgetter(1)))
        self.newest = min(self.newest, self.clock.newest)
        if self._array is not None:  # what it gathered, and when it heard them last, is by the other clock
            self._refused.update(self._array.scans.dropped)
            self._array.begin(self.transforms)

    def _share(self, frame: str, topic: str) -> None:
        """Take note that the frame of a sonar is that of another topic too."""
        self._second[frame] += 1
        if self._second[frame] >= SECONDS:  # one alone may be anybody's
            topics = self.shared.setdefault(frame, {self.sonars[frame].topic})
            if len(topics) < MAX_SONARS:
                topics.add(topic)

    def _leap(self, stamp: float) -> None:
        """The robot's clock has jumped to a stamp: nothing waits for what was before."""
        self._refused["a clock that jumped"] += 1
        self.transforms, self._moves = self.transforms.still(), 0
        self._waiting.clear()
        self.newest, self._first = stamp, inf
        if self._array is not None:
            self._refused.update(self._array.scans.dropped)
            self._array.begin(self.transforms)


def _outside(range_m: float, low: float, high: float) -> bool:
    """Whether something was measured well outside of a sonar's limits (all m); no echo may be sent as the maximum."""
    return 0 < range_m < low or 0 < high < range_m / _BEYOND < inf


def _initial(message: Any) -> Initial:
    where, turn = message.pose.pose.position, message.pose.pose.orientation
    x, y, theta = planar(Rigid((where.x, where.y, where.z), (turn.x, turn.y, turn.z, turn.w)))
    variances = [float(message.pose.covariance[at]) for at in (0, 7, 35)]
    stamp = whole(message.header.stamp)
    if not all(map(isfinite, (x, y, theta, stamp, *variances))) or min(variances) < 0:
        raise _Refusal("an initial pose that is not finite")
    a, b, c = map(sqrt, variances)
    return Initial(_name(message.header.frame_id), stamp, (x, y, theta), (a, b, c))


def _name(name: str) -> str:
    if not isinstance(name, str) or not name.isprintable() or len(name) > MAX_NAME or not name.strip(" /"):
        raise _Refusal("a name of a frame that cannot be")
    return name.lstrip("/")
