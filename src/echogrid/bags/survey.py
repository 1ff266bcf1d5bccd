"""What is heard in a bag, or in its beginning: sonars, transforms, and which topics say a time."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from math import inf, isnan, nan
from pathlib import Path

from jaxtyping import Float
from numpy import ndarray

from echogrid.bags.bag_file import BagFile, Message
from echogrid.bags.clocks import Clocks, Samples
from echogrid.bags.events import BEGIN_S, Event, events, stamp_of
from echogrid.bags.topics import choose
from echogrid.errors import InputError
from echogrid.robot import MAX_SONARS, Robot
from echogrid.ros.messages import ODOMETRY, Choice, Sonar, is_static
from echogrid.ros.sonars import reading
from echogrid.ros.transforms import Transforms

SURVEY_S, SURVEY_MESSAGES = 5.0, 300_000
"""A bag is surveyed until so long after all topics of sonars were heard, and for so many messages at most."""


@dataclass
class Heard:
    """What a bag says of one sonar."""

    readings: int = 0
    no_echo: int = 0
    not_valid: int = 0
    zeros: int = 0
    """Readings of 0, or less."""
    finite: int = 0
    """Ranges that are positive numbers."""
    below: int = 0
    """Of these, below the minimum."""
    ranges: Samples[float] = field(default_factory=Samples)
    """Some of them, m."""
    first: float = nan
    """Stamp of the first reading, s."""
    last: float = nan
    field_of_view: float = nan
    """Of the first message, rad, as it stands there; nan if the type has none."""
    limits: tuple[float, float] = (nan, nan)
    """Minimum and maximum range of the first message, m, as they stand there."""
    mount: Float[ndarray, "3"] | None = None
    """Where it sits on the robot: m, m, rad."""
    amiss: str | None = None
    """Why it has no mount."""

    def count(self, event: Event) -> None:
        """Count a reading in."""
        if self.readings == 0:
            self.first, self.field_of_view, self.limits = event.stamp, event.field_of_view, event.limits
        self.readings += 1
        _, stamp, range_m, _, (low, high) = event
        self.first, self.last = min(self.first, stamp), stamp
        value = reading(range_m, low, high)
        self.no_echo += value == inf
        self.not_valid += isnan(value)
        self.zeros += -inf < range_m <= 0  # -inf is too close
        if 0 < range_m < inf:
            self.finite += 1
            self.below += range_m < low
            self.ranges.add(range_m)

    @property
    def rate(self) -> float:
        """Readings a second; 0 if there is one."""
        return (self.readings - 1) / (self.last - self.first) if self.last > self.first else 0.0


class Survey:
    """What is in a bag, or in its beginning."""

    def __init__(self, path: Path, robot: Robot | None, choice: Choice, whole: bool):
        """Go through a bag.

        Args:
            path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
            robot: what is known of it; None: what the bag says.
            choice: which topics are read.
            whole: whether all of the bag is gone through, or until the sonars are known.

        Raises:
            InputError: not a whole bag, no sonars in it or too many, or topics between which nothing decides.
        """
        self.robot, self.choice, self.transforms = robot, choice, Transforms()
        self.heard: dict[Sonar, Heard] = {}
        self.clocks = Clocks()
        self.base = self.fixed = ""
        """The frame of the robot, and the one to map in, once they are found."""
        self.posing: dict[str, set[str]] = {}
        """For each frame the topics of odometry that have its pose."""
        self.refused = Counter[str]()
        """What could not be taken, and how often."""
        self.from_zero = False
        """Whether 0 is a time as any other: the stamps begin there, though the time of recording does not."""
        self._seen: set[str] = set()
        self._stamped: set[str] = set()
        with BagFile(path) as bag:
            self.name, self.topics = bag.name, bag.topics()
            self.read = choose(self.name, self.topics, choice)
            self._go(bag.messages({topic.name for topics in self.read for topic in topics}), whole)

    def _go(self, messages: Iterable[Message], whole: bool) -> None:
        silent, until = {topic.name for topic in self.read.sonars}, inf
        for count, message in enumerate(messages, 1):
            self._take(message)
            if message.topic in silent:
                silent.discard(message.topic)
                until = inf if silent else message.received + SURVEY_S
            if not whole and (message.received > until or count > SURVEY_MESSAGES):
                return

    def _take(self, message: Message) -> None:
        self._seen.add(message.topic)
        self.clocks.hear(message)
        if message.topic not in self._stamped and ((stamp := stamp_of(message)) or message.received < BEGIN_S):
            self._stamped.add(message.topic)
            self.from_zero |= 0 < stamp < BEGIN_S and not is_static(message.topic)
        if message.type == ODOMETRY:
            child = message.content.child_frame_id.lstrip("/") or "base_link"
            self.posing.setdefault(child, set()).add(message.topic)
        for event in events(message, self.transforms, self.robot, self.refused):
            heard = self.heard.get(event.sonar)
            if heard is None:
                if len(self.heard) >= MAX_SONARS:
                    raise InputError(self.name, f"more than {MAX_SONARS} sonars", f"{MAX_SONARS} at most")
                heard = self.heard[event.sonar] = Heard()
            heard.count(event)

    @property
    def unstamped(self) -> frozenset[str]:
        """Topics whose messages never say a time."""
        return frozenset(self._seen - self._stamped)
