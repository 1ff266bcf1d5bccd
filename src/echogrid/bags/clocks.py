"""Clocks of a bag: the stamps of its messages beside the time when they were recorded, source by source.

Who has a clock of its own (a board that counts from its start, a computer that nobody set) stamps its messages
elsewhere than those that were recorded in the same moments; who fills in its stamps wrongly stamps them all over.
"""

from collections.abc import Collection, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.bags.bag_file import Message
from echogrid.ros.messages import ODOMETRY, RANGE, TF, TF_OLD, few, is_static, seconds

Source = tuple[str, str]
"""A topic, and the frame of a sonar, the frame that moves, or nothing where a message holds all sonars."""

APART_S = 0.5
"""Clocks are two if they are farther apart."""

_STEADY_S = 0.3
"""Clocks that stay so near to a distance are told apart from messages that come late."""

_STEP_S, _STEPS = 0.3, 3
"""Stamps step where they do not go on with the time of recording, by as much, and so often."""

_SAMPLES, _SOURCES, _FEWEST = 512, 4_000, 5
"""Samples kept of a source; sources kept; samples of which nothing is said."""


class Fix(NamedTuple):
    """What makes good stamps of a source's."""

    by: float
    """Added, s."""
    recorded: bool
    """To the time of recording, not to the stamp."""

    def of(self, stamp: float, received: float) -> float:
        """The stamp (s) that takes the place of one; 0 if it says none, and is wanted."""
        if self.recorded:
            return received + self.by
        return stamp + self.by if stamp else stamp


class Samples[T]:
    """Some of what comes one by one, evenly of all of it, in bounded number."""

    def __init__(self) -> None:
        self._kept: list[T] = []
        self._stride, self._count = 1, 0

    def add(self, sample: T) -> None:
        """Keep one, or not."""
        if self._count % self._stride == 0:
            self._kept.append(sample)
            if len(self._kept) == _SAMPLES:
                del self._kept[1::2]
                self._stride *= 2
        self._count += 1

    def array(self) -> Float[ndarray, "n *fields"]:
        """Those that were kept."""
        return np.array(self._kept, dtype=float)


class Clocks:
    """The stamps heard in a bag."""

    def __init__(self) -> None:
        self._samples: dict[Source, Samples[tuple[float, float]]] = {}
        """When messages were recorded, and what their stamps say."""

    def hear(self, message: Message) -> None:
        """Take a message's stamps, where it says any."""
        for source, stamp in _said(message):
            if not stamp:
                continue
            samples = self._samples.get(source)
            if samples is None:
                if len(self._samples) >= _SOURCES:
                    continue
                samples = self._samples[source] = Samples()
            samples.add((message.received, stamp))

    def sources(self) -> list[Source]:
        """All that stamp."""
        return list(self._samples)

    def of(self, sources: Collection[Source]) -> Float[ndarray, "n 2"]:
        """Times of recording and stamps (s) of sources, in the order of recording."""
        parts = [self._samples[source].array() for source in sources if source in self._samples]
        both = np.concatenate(parts) if parts else np.empty((0, 2))
        return both[np.argsort(both[:, 0], kind="stable")]

    def offsets(self) -> dict[str, float]:
        """How far the stamps of each topic lie from the time of recording, s: the median."""
        topics: dict[str, list[Source]] = {}
        for source in self._samples:
            topics.setdefault(source[0], []).append(source)
        both = {topic: self.of(sources) for topic, sources in topics.items()}
        return {topic: float(np.median(each[:, 1] - each[:, 0])) for topic, each in both.items()}


def _said(message: Message) -> list[tuple[Source, float]]:
    content, topic = message.content, message.topic
    if message.type == RANGE:
        return [((topic, content.frame), content.stamp)]
    if message.type in (TF, TF_OLD):
        if is_static(topic):  # what holds at all times may have any
            return []
        return [((topic, each.child_frame_id.lstrip("/")), seconds(each.header.stamp)) for each in content.transforms]
    frame = (content.child_frame_id or "base_link").lstrip("/") if message.type == ODOMETRY else ""
    return [((topic, frame), seconds(content.header.stamp))]


class Judgement(NamedTuple):
    """What is to be done about the clocks of a bag."""

    fixes: dict[Source, Fix]
    """Of sonars."""
    recorded: frozenset[str]
    """Topics of poses whose time is that of recording."""
    notes: dict[str, int]


def judged(
    clocks: Clocks, sonars: Iterable[Source], poses: Collection[Source], unstamped: Collection[str]
) -> Judgement:
    """Compare the stamps of sonars with those of poses that were recorded in the same moments.

    Args:
        clocks: what was heard.
        sonars: all of the array.
        poses: where the robot's pose is from.
        unstamped: topics that say no time.
    """
    there = [source for source in poses if source in clocks.sources()]
    broken = {source: why for source in there if (why := _broken(clocks.of([source]), 0.0))}
    told = [source for source in there if source not in broken]
    base = clocks.of(told)
    notes = _broken_note(broken)
    fixes: dict[Source, Fix] = {}
    amiss: dict[Source, str] = {}
    apart: dict[Source, tuple[float, float]] = {}
    astray: dict[Source, tuple[float, float]] = {}
    bare: dict[Source, float] = {}
    for source in sonars:
        both = clocks.of([source])
        if not len(both) and source[0] in unstamped and (far := _far(base)):
            fixes[source], bare[source] = Fix(far, recorded=True), far
        reference = _reference(both[:, 0], base)
        near = np.isfinite(reference)
        off = (both[:, 1] - both[:, 0] - reference)[near]
        if len(off) < _FEWEST:
            continue
        middle = float(np.median(off))
        low, high = np.quantile(off, [0.1, 0.9])
        why = _broken(both[near], reference[near])
        if why:
            fixes[source], amiss[source] = Fix(float(np.median(reference[near])), recorded=True), why
        elif abs(middle) > APART_S and high - low < _STEADY_S:
            fixes[source] = Fix(-middle, recorded=False)
            apart[source] = middle, float(np.median(reference[near]))
        elif abs(middle) > APART_S:
            astray[source] = float(low), float(high)
    notes |= _broken_note(amiss) | _apart_note(apart, told) | _astray_note(astray) | _bare_note(bare, told)
    return Judgement(fixes, frozenset(topic for topic, _ in broken), notes)


def _reference(received: Float[ndarray, "n"], base: Float[ndarray, "m 2"]) -> Float[ndarray, "n"]:
    """How far poses that were recorded at some times (s) are stamped from that, s; nan where none was near."""
    if not len(base):
        return np.zeros(len(received))  # theirs is the time of recording
    off = np.interp(received, base[:, 0], base[:, 1] - base[:, 0])
    near = (received > base[0, 0] - 1.0) & (received < base[-1, 0] + 1.0)
    return np.where(near, off, np.nan)


def _far(base: Float[ndarray, "m 2"]) -> float:
    """How far the poses' clock steadily lies from the time of recording, s; 0 if it is that."""
    if len(base) < _FEWEST:
        return 0.0
    low, middle, high = np.quantile(base[:, 1] - base[:, 0], [0.1, 0.5, 0.9])
    return float(middle) if abs(middle) > APART_S and high - low < _STEADY_S else 0.0


def _broken(both: Float[ndarray, "n 2"], reference: Float[ndarray, "n"] | float) -> str | None:
    """What is wrong with stamps that do not go on as the time of recording does, if anything is."""
    if len(both) < _FEWEST:
        return None
    received, stamps = both[:, 0] + reference, both[:, 1]
    long = np.ptp(received) > 1.0
    if long and np.ptp(stamps) == 0:
        return "the same in every message"
    off = stamps - received
    whole = np.all(stamps % 1 == 0)
    if whole and long and 0.1 < abs(np.median(off)) < 1.0 and np.mean(received % 1 == 0) < 0.5:
        return "whole seconds"
    # Messages that come in bursts are late; what is amiss with them is the time of recording.
    steps = np.sum(np.abs(np.diff(off)) > _STEP_S)
    rate = max(np.ptp(stamps) / np.ptp(received), 1.0)  # of a simulation
    if steps < _STEPS or _uneven(stamps) <= 2 * rate * _uneven(received) + 0.005:
        return None
    parts = stamps % 1
    if np.all(parts < 0.0011):
        return "whole seconds, with micro- or milliseconds for nanosec"
    return "steps (nanosec past a second, or of another unit?)"


def _uneven(times: Float[ndarray, "n"]) -> float:
    """How far the intervals between times lie from their median, s."""
    steps = np.diff(times)
    return float(np.mean(np.abs(steps - np.median(steps))))


def _topics(sources: Iterable[Source]) -> str:
    return few(dict.fromkeys(topic for topic, _ in sources))


def _broken_note(broken: dict[Source, str]) -> dict[str, int]:
    """A note on stamps that are none."""
    whys = "; ".join(dict.fromkeys(broken.values()))
    remedy = "the time of recording is taken; let the driver fill in header.stamp"
    return {f"stamps on {_topics(broken)} are no times ({whys}): {remedy}": 0} if broken else {}


def _apart_note(apart: dict[Source, tuple[float, float]], poses: Iterable[Source]) -> dict[str, int]:
    """A note on clocks of sonars that are not that of the poses."""
    if not apart:
        return {}
    offs = sorted(middle for middle, _ in apart.values())
    reference = float(np.median([own for _, own in apart.values()]))
    span = aside(offs[0]) if offs[-1] - offs[0] < 0.2 else f"{aside(offs[0])} to {aside(offs[-1])}"
    own = f", which lie {aside(reference)} the time of recording" if abs(reference) > APART_S else ""
    return {
        f"stamps on {_topics(apart)} lie {span} those of the poses on {_topics(poses) or 'no topic'}{own}, though"
        " recorded in the same moments: two clocks; brought together here by that much (set the clocks of all"
        " computers and boards by one, as with chrony)": 0
    }


def _astray_note(astray: dict[Source, tuple[float, float]]) -> dict[str, int]:
    """A note on stamps that stray from those of the poses."""
    if not astray:
        return {}
    low, high = min(each[0] for each in astray.values()), max(each[1] for each in astray.values())
    return {
        f"stamps on {_topics(astray)} lie from {aside(low)} to {aside(high)} those of poses recorded in the same"
        " moments: a clock of another speed, or messages that come late; taken as they are, so that walls may smear"
        " (set the clocks by one, as with chrony)": 0
    }


def _bare_note(bare: dict[Source, float], poses: Iterable[Source]) -> dict[str, int]:
    """A note on readings without stamps beside poses of a clock that is not that of the recording."""
    if not bare:
        return {}
    off = aside(next(iter(bare.values())))
    return {
        f"no stamps on {_topics(bare)}, and those of the poses on {_topics(poses)} lie {off} the time of recording:"
        " that is taken, brought to the clock of the poses (let the driver fill in header.stamp)": 0
    }


def apart(offsets: dict[str, float]) -> dict[str, list[str]]:
    """The topics whose stamps lie off the time of recording, by how far they do in words."""
    found: dict[str, list[str]] = {}
    for topic, off in offsets.items():
        if abs(off) > APART_S:
            found.setdefault(aside(off), []).append(topic)
    return found


def aside(off: float) -> str:
    """A distance in time (s) and its sign, for a message."""
    size = abs(off)
    for unit, name in ((365.25 * 86400, "years"), (86400, "days"), (3600, "hours")):
        if size >= 2 * unit:
            return f"{size / unit:.1f} {name} {'behind' if off < 0 else 'ahead of'}"
    return f"{size:.1f} s {'behind' if off < 0 else 'ahead of'}"
