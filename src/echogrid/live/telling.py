"""What is doubtful about what is heard, each kind of it once: clocks, units, limits, frames, poses."""

import re
from collections.abc import Iterable, Iterator
from math import isfinite

from echogrid.live.clocks import span
from echogrid.live.hearing import Hearing
from echogrid.live.sonar_array import SonarArray
from echogrid.ros.messages import few
from echogrid.ros.sonars import MAX_RANGE_M

LEAST_MAX_M, MOST_MIN_M, NO_LIMIT_M = 0.1, 1.0, 1e5
"""A sonar that sees no farther, or nothing nearer, has limits in another unit; one that sees so far says none."""

_REMEDIES = {
    r"cut that out of the log\b(, and start it anew)?": "start it anew",
    r"cut the log there in two|cut the log in two at that time": "start echogrid live anew",
    r"map with a robot file whose max_range_m is (\S+)": r"let its driver send max_range \1, or +inf",
}


class Telling:
    """What was told, and what is to be told as soon as it is the same at two looks: more of its kind may come."""

    def __init__(self) -> None:
        self._told: set[str] = set()
        self._seen: dict[str, str] = {}

    def told(self, texts: Iterable[tuple[str, str]], now: bool = False) -> list[str]:
        """What is to be said of doubts.

        Args:
            texts: their kinds and what they say.
            now: nothing more will come.
        """
        said = []
        for kind, text in texts:
            if kind not in self._told and (now or self._seen.get(kind) == text):
                self._told.add(kind)
                said.append(text)
            self._seen[kind] = text
        return said


def in_live(note: str) -> str:
    """A note on a log, with the remedy that there is while a robot drives."""
    for pattern, words in _REMEDIES.items():
        note = re.sub(pattern, words, note)
    return note


def kind_of(note: str) -> str:
    """What a note is about: how it begins, but for numbers."""
    return re.sub(r"[\d.]+(e[+-]\d+)?", "#", note)[:20]


def doubts(hearing: Hearing, array: SonarArray | None) -> Iterator[tuple[str, str]]:
    """What is doubtful about what was heard by now: of which kind, and what is to be said."""
    yield from _frames(hearing, array)
    yield from _clocks(hearing)
    if contested := hearing.senders.contested:
        yield (
            "senders",
            f"two programs at once tell {few(contested)}: stop one (a second robot, a bag that is played, a driver "
            "that was left running)",
        )
    if array is not None:
        yield from _limits(hearing, array)
        yield from _parents(hearing, array)


def _frames(hearing: Hearing, array: SonarArray | None) -> Iterator[tuple[str, str]]:
    shared = hearing.shared
    if not shared:
        return
    frame, topics = next(iter(shared.items()))
    more = f", and {len(shared) - 1} frames more like it" if len(shared) > 1 else ""
    mapped = array is not None and frame in array.numbers
    then = f"only {hearing.sonars[frame].topic} is mapped" if mapped and frame in hearing.sonars else "left out"
    yield (
        "frames",
        f"{len(topics)} topics in one frame, {frame} ({few(sorted(topics))}){more}: {then}; give each sonar a frame "
        "of its own, or choose the right topics with --topics",
    )


def _clocks(hearing: Hearing) -> Iterator[tuple[str, str]]:
    for why, topics in hearing.stamps.useless().items():
        yield (
            f"stamps {why[:10]}",
            f"{few(sorted(topics))}: stamps {why}; taken by the time of receipt: set the clock of its driver",
        )
    if apart := hearing.stamps.apart:
        middle = sorted(apart.values())[len(apart) // 2]
        yield (
            "clocks",
            f"{few(sorted(apart))}: stamps {span(middle)} those of tf that come in the same moments: two clocks; "
            "brought together here by that much: set the clocks of all computers and boards by one (chrony)",
        )
    if astray := hearing.stamps.astray:
        yield (
            "stray",
            f"{few(sorted(astray))}: stamps that lie now more, now less, off those of tf that come in the same "
            "moments: taken as they are, so that walls may smear; set the clocks by one (chrony)",
        )


def _limits(hearing: Hearing, array: SonarArray) -> Iterator[tuple[str, str]]:
    odd = {
        name: said.limits
        for name, said in hearing.sonars.items()
        if name in array.numbers and not _plausible(*said.limits)
    }
    if odd:
        low, high = next(iter(odd.values()))
        yield (
            "limits",
            f"{few(odd)}: min_range {low:g} and max_range {high:g} m, which no sonar has: are they in m? Readings "
            "at or past max_range count as no echo, those below min_range are not used",
        )


def _parents(hearing: Hearing, array: SonarArray) -> Iterator[tuple[str, str]]:
    turns = {child: turn for child, turn in hearing.transforms.in_turn.items() if child in array.line and turn[2] > 1}
    if turns:
        child, (one, other, _) = next(iter(turns.items()))
        more = f" (and {len(turns) - 1} frames more)" if len(turns) > 1 else ""
        yield (
            "parents",
            f"{child} is told in two frames in turn, {' and '.join(sorted((one, other)))}{more}, and known in "
            "neither for long: stop one of those who publish it (two localisers, or a driver beside one)",
        )


def _plausible(low: float, high: float) -> bool:
    """Whether limits (m) may be those of a sonar; one that is no positive number says nothing."""
    if isfinite(low) and low > MOST_MIN_M:
        return False
    return not 0 < high < NO_LIMIT_M or max(low, LEAST_MAX_M) < high <= MAX_RANGE_M
