"""Whose clock a stamp is of: the robot's, one that is off by seconds, or one that is of no use.

Poses tell the robot's clock. Topics are compared by how far their stamps lie from the time when they come, so that it
does not matter what clock the robot's is: of the world, of a simulation, or of a bag that is played back.
"""

from collections import deque
from math import inf, isfinite, nan
from statistics import median
from typing import Any

from echogrid.robot import MAX_SONARS

LEAP_S = 10.0
"""A stamp farther than this from the newest is not of the same clock."""

LEAPS = 20
"""Messages in a row with stamps of another clock, after which that one is taken for the robot's, or a topic's stamps
for useless."""

APART_S = 0.7
"""Clocks farther apart than this are told of."""

_WINDOW_S, _WINDOWS, _ENOUGH = 1.0, 10, 4
"""Delays are looked at for so long at a time; how many times are remembered, and how many are needed."""

_STEADY_S = 0.3
"""Clocks that stay so near to a distance are two; otherwise messages may come late."""

_FAR_S = 2.0
"""A topic's stamps are far off for so long before they are useless: the robot's clock may have jumped."""

_LAST = 32
"""Stamps of a topic that are remembered."""

_UNUSED_NS = 10**6
"""If all nanoseconds are fewer they are counted in another unit, or not at all."""

FAR_STAMP = "a stamp far from those of the others"
NO_STAMP = "a stamp that cannot be"


class Clock:
    """Tells stamps of the robot's clock from others."""

    def __init__(self) -> None:
        self.newest = nan
        """Stamp, s; nan: none yet."""
        self.posed = False
        """Whether a pose has told the clock."""
        self._other, self._apart, self._poses = nan, 0, False

    def near(self, stamp: float) -> bool:
        """Whether a stamp (s) may be of this clock."""
        return not isfinite(self.newest) or abs(stamp - self.newest) <= LEAP_S

    def admit(self, stamp: float, pose: bool) -> bool | None:
        """Take a stamp (s), of a pose or of a reading: True if the clock has jumped there, None if it is of another
        clock.
        """
        first, self.posed = pose and not self.posed, self.posed or pose
        if self.near(stamp):
            self.newest = stamp if not isfinite(self.newest) else max(self.newest, stamp)
            self._apart, self._poses = 0, False
            return False
        self._apart = self._apart + 1 if abs(stamp - self._other) <= LEAP_S else 1
        self._poses = pose or (self._poses and self._apart > 1)
        self._other = stamp
        # Sonars may have a clock of their own; where the robot is tells what its clock is.
        if not first and (self._apart < LEAPS or not self._poses):
            return None
        self.newest, self._apart, self._poses = stamp, 0, False
        return True


class Offset:
    """How far the stamps of a topic are ahead of a clock by which it comes.

    Those of its fastest messages are, for a pause delays the others.
    """

    def __init__(self) -> None:
        self._most: dict[int, float] = {}

    def add(self, stamp: float, now: float) -> None:
        """Take a message with a stamp that came at a time (both s)."""
        window = int(now // _WINDOW_S)
        if window not in self._most:
            self._most[window] = -inf
            if len(self._most) > _WINDOWS:
                del self._most[next(iter(self._most))]
        self._most[window] = max(self._most[window], stamp - now)

    def ahead_of(self, other: "Offset") -> list[float]:
        """How far ahead of those of another topic by the last few seconds, s: for each of them.

        It is compared within the same seconds, for a bag may be played back faster than it was recorded.
        """
        both = sorted(self._most.keys() & other._most.keys())[:-1]  # the last may not be complete
        return [self._most[at] - other._most[at] for at in both]


class _Topic:
    def __init__(self, frame: str, now: float):
        self.frame, self.far, self.since, self.why = frame, 0, now, ""
        self.stamps: deque[tuple[int, int]] = deque(maxlen=_LAST)
        self.offset = Offset()
        self.ahead = 0.0
        """How far its clock is ahead of the robot's, s, where that is known and steady."""
        self.strays = False


class Stamps:
    """The stamps of the topics of readings, and which topics have none that are of use."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._topics: dict[str, _Topic] = {}
        self._poses: dict[str, Offset] = {}

    def pose(self, frame: str, stamp: float, now: float) -> None:
        """Take the stamp (s) of the pose of a frame, and when it came (s)."""
        if frame in self._poses or len(self._poses) < MAX_SONARS:
            self._poses.setdefault(frame, Offset()).add(stamp, now)

    def reading(self, topic: str, frame: str, stamp: Any, now: float) -> float:
        """When a reading was taken, s, by its stamp (``builtin_interfaces/Time``).

        nan if that cannot be; 0 if it says none, or none that is of use.
        """
        if topic not in self._topics and len(self._topics) >= MAX_SONARS:
            return whole(stamp)
        if topic not in self._topics:
            self._topics[topic] = _Topic(frame, now)
        of = self._topics[topic]
        if of.why:
            return 0.0
        seconds = whole(stamp)
        if seconds and self._clock.posed:
            self._judge(of, frame, stamp, seconds, now)
        if seconds > 0 and self._clock.near(seconds):
            of.offset.add(seconds, now)
        return 0.0 if of.why or not seconds else seconds - of.ahead

    def _judge(self, of: _Topic, frame: str, stamp: Any, seconds: float, now: float) -> None:
        if self._clock.near(seconds):
            of.far, of.since = 0, now
        else:
            of.far += 1
        if of.far >= LEAPS and now - of.since >= _FAR_S:
            apart = seconds - self._clock.newest
            of.why = f"{span(apart)} those of tf" if isfinite(apart) else "that cannot be (nanosec past 999999999)"
        elif frame == of.frame:
            of.stamps.append((int(stamp.sec), int(stamp.nanosec)))
            if len(of.stamps) == _LAST:
                of.why = _useless(of.stamps)

    @property
    def topics(self) -> int:
        """How many topics of readings there are, whatever their stamps."""
        return len(self._topics)

    def useless(self) -> dict[str, list[str]]:
        """Topics whose stamps are of no use, by what is wrong with them."""
        found: dict[str, list[str]] = {}
        for name, topic in self._topics.items():
            if topic.why:
                found.setdefault(topic.why, []).append(name)
        return found

    def compare(self, frames: set[str] | None) -> dict[str, float]:
        """Compare the clocks of topics with that of the poses of some frames, or of all.

        Returns:
            Topics whose clock turned out to be another one, steadily, and how far it is ahead, s: from now on their
            stamps are taken by the robot's clock.
        """
        found: dict[str, float] = {}
        for name, topic in self._topics.items():
            if topic.why or topic.ahead or topic.strays:
                continue
            ahead = self._ahead(topic, frames)
            lately = ahead[-_ENOUGH:]
            if len(lately) < _ENOUGH or min(map(abs, lately)) <= APART_S:
                continue
            if max(lately) - min(lately) < _STEADY_S:
                found[name] = topic.ahead = median(lately)
            elif len(ahead) >= _WINDOWS - 1 and min(map(abs, ahead)) > APART_S:
                topic.strays = True
        return found

    def _ahead(self, topic: _Topic, frames: set[str] | None) -> list[float]:
        poses = [pose for frame, pose in self._poses.items() if frames is None or frame in frames]
        return max((topic.offset.ahead_of(pose) for pose in poses), key=len, default=[])

    @property
    def doubtful(self) -> bool:
        """Whether a topic seems to have a clock of its own, though it is not known yet."""
        topics = [topic for topic in self._topics.values() if not (topic.why or topic.ahead or topic.strays)]
        return any(abs(median(ahead)) > APART_S for topic in topics if (ahead := self._ahead(topic, None)))

    @property
    def apart(self) -> dict[str, float]:
        """Topics whose clock is another one, steadily, and how far it is ahead, s."""
        return {name: topic.ahead for name, topic in self._topics.items() if topic.ahead}

    @property
    def astray(self) -> list[str]:
        """Topics whose stamps lie far from those of poses, though not by the same each time."""
        return [name for name, topic in self._topics.items() if topic.strays]


def _useless(stamps: deque[tuple[int, int]]) -> str:
    """What is wrong with the stamps of a sonar; nothing if they tell its readings apart."""
    if len(set(stamps)) * 3 < len(stamps):
        return "that do not go on from one reading to the next"
    if all(nanosec < _UNUSED_NS for _, nanosec in stamps) and len({sec for sec, _ in stamps}) * 3 < 2 * len(stamps):
        return "whose nanosec are in another unit"
    return ""


def whole(stamp: Any) -> float:
    """Seconds of a ``builtin_interfaces/Time``; nan if it cannot be one."""
    sec, nanosec = int(stamp.sec), int(stamp.nanosec)
    return nan if not (0 <= sec <= 2**32 and 0 <= nanosec < 10**9) else sec + nanosec * 1e-9


def span(seconds: float) -> str:
    """How far stamps are ahead, in words."""
    return f"{abs(seconds):.3g} s {'ahead of' if seconds > 0 else 'behind'}"
