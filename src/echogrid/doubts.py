"""What is doubtful about a log, judged from its frames while it is read, whoever reads it.

A doubt is one line: what was found, where, how much, the likely cause and the remedy. A faultless log has none.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import inf, nan, ndarray

from echogrid.geometry import wrap
from echogrid.robot import Robot
from echogrid.stillness import Stillness

FASTEST_M_S, FASTEST_RAD_S = 10.0, 10.0
"""No robot that maps with sonars drives or turns faster."""

SPUN_RAD_S = 6.0
"""A single step that turns faster is a jump of the heading."""

JUMP_M, JUMP_RAD = 0.5, 0.8
"""A step is no jump of the pose if it is shorter: where stamps are coarse the speed says little."""

SELDOM_S, SELDOM = 30.0, 0.5
"""If more than this share of the scans of a drive comes so long after the one before, stamps are in other units."""

OFTEN = 0.1
"""If more than this share of the steps is too fast it is no jump: the unit, or the clock, is another."""

LEAST_STEPS, LEAST_READINGS = 20, 100
"""Of fewer nothing is concluded."""

MOST_INVALID = 0.5
"""Share of the readings that measured something, but are too short, from which it is told."""

REPEATED = 0.05
"""Share of the echoes that have the very longest value from which that is taken for the sensor's no echo."""

_REPEATED_FEW, _FEW, _APART_M = 0.3, 4, 0.5
"""That share of an array of fewer sonars, whose longest value may be that of one wall; and how far apart the robot
was when the value came, at least: who stands hears the same again and again."""

HEARS, DUMB_WAY_M = 0.5, 5.0
"""A sonar that never hears an echo on a way so long is told of where most others hear one in such a share of their
readings."""

ZEROS = 0.2
"""Share of the readings that are 0 m from which that is taken for the sensor's no echo."""

_STOPS = 5
"""Jumps from which on they are hardly all starts anew."""

GLITCH_M = 500.0
"""A pose that lies farther than this from the last good one, though no robot can have got there, is left out."""

STAYS = 20
"""So many frames in a row at the far place, and the robot is taken to be there."""

LEFT_OUT = "a scan left out: its pose is where no robot can have got to"
NEVER_HEAR = "sonars never hear an echo"
STARTS_ANEW = "did the odometry start anew? cut the log there in two"
NO_ECHO_IS_LONGEST = "the longest range,"
_NO_ECHO, _TOO_SHORT, _PAST = "no sonar ever heard an echo", "not used: are the ranges in m", "past max_range"
_TOO_FAST, _IN_RADIANS = "of the steps are faster than", "it has to be in radians"
RANGES_MISREAD = (_NO_ECHO, _TOO_SHORT, _PAST)
"""Of notes: the ranges are not what the log says."""
POSES_MISREAD = (_TOO_FAST, _IN_RADIANS)
"""Of notes: nor are the poses."""

_WHOLE, _EVERY = 512, 8
"""After so many frames the ranges and headings of every so many-th batch alone are looked at: shares need no more."""

_SAME_M, _LEAST_S = 1e-6, 0.02
_LEAST_WAY_M = 0.01
_AROUND = 6
"""Steps before and after a heading that jumps, by which it is judged."""
_DEGREES = {"degrees": np.pi / 180, "tenths of a degree": np.pi / 1800}
_EVERY_WAY = 0.5
"""Mean resultant length of the ways driven, to and fro alike, below which a robot that does not turn is odd."""
_ALONG = 0.8
"""Mean resultant length from which headings agree with the way that is driven: 1 if all do, 0 if none."""


def first_of(notes: Iterable[str], kinds: Iterable[str]) -> str | None:
    """The first of some notes that is of one of some kinds, of RANGES_MISREAD and the like; None: there is none."""
    return next((note for note in notes if any(kind in note for kind in kinds)), None)


@dataclass
class Motion:
    """How a log says that the robot moved."""

    steps: int = 0
    fast: int = 0
    """Steps that no robot can have driven."""
    judged: int = 0
    """Steps whose turn was looked at."""
    turned: int = 0
    """Those of them in which no robot can have turned so far."""
    seldom: int = 0
    """Steps looked at in which the robot went on, and that took as long as no robot that maps waits."""
    first: tuple[float, float] = (nan, 0.0)
    """Stamp (s) and length (m) of the first jump."""
    longest_m: float = 0.0
    """Of all jumps."""
    spun: int = 0
    """Steps in which the heading jumped, though the place did not."""
    first_turn: tuple[float, float] = (nan, 0.0)
    """Stamp (s) and turn (rad) of the first of them."""


class Whereabouts:
    """Tells poses that a robot can have got to from glitches of its odometry, one after the other."""

    def __init__(self) -> None:
        self.left_out = 0
        """Poses that were not taken."""
        self._good: tuple[float, float, float] | None = None
        self._away = 0

    def near(self, rows: Float[ndarray, "poses _"]) -> bool:
        """Take poses (s, m, m, ..) at once, if all are so near that there can be no doubt; else none is taken."""
        if self._good is None or self._away or not len(rows):
            return not len(rows)
        if np.abs(rows[:, 1:3] - self._good[1:]).max() > GLITCH_M / 2:
            return False
        self._good = tuple(rows[-1, :3].tolist())
        return True

    def takes(self, stamp: float, x: float, y: float) -> bool:
        """Whether a pose (s, m) is taken: a robot can have got there, or stays there."""
        if self._good is not None:
            before, x0, y0 = self._good
            if max(abs(x - x0), abs(y - y0)) > max(GLITCH_M, FASTEST_M_S * (stamp - before)) and self._away < STAYS:
                self._away += 1
                self.left_out += 1
                return False
        self._good, self._away = (stamp, x, y), 0
        return True


class Speeds(NamedTuple):
    """Steps of a track."""

    way: Float[ndarray, "steps"]
    """m"""
    far: Bool[ndarray, "steps"]
    """Which are jumps: no robot can have got so far in the time."""
    round: Bool[ndarray, "steps"]
    """In which no robot can have turned so far."""
    fastest_m_s: float
    """Highest speed of a step that is no jump; nan if there is none."""
    fastest_rad_s: float
    """Highest turn rate, likewise."""


def speeds(track: Float[ndarray, "poses 4"], turns: bool = True) -> Speeds:
    """How fast a track of stamp (s), x, y (m) and heading (rad) goes; ``turns``: whether turns are looked at."""
    took, dx, dy, turn = (track[1:] - track[:-1]).T
    way = np.hypot(dx, dy)
    # Stamps that are equal, or rounded, make any speed of a short step.
    far = way > np.maximum(FASTEST_M_S * took, JUMP_M)
    if not turns or far.all():
        return Speeds(way, far, np.zeros(len(way), dtype=bool), nan, nan)
    turn = np.abs(wrap(turn))
    slow = np.maximum(took[~far], _LEAST_S)
    fastest = float(np.max(way[~far] / slow)), float(np.max(turn[~far] / slow))
    return Speeds(way, far, turn > np.maximum(FASTEST_RAD_S * took, JUMP_RAD), *fastest)


def _drove_on(track: Float[ndarray, "poses 4"], before: slice, after: slice) -> bool:
    """Whether a robot drives on with its heading as before some steps after them, as far as they tell.

    Then its way has turned with the heading: the robot did, and the log has nothing of how.
    """
    _, dx, dy, _ = (track[1:] - track[:-1]).T
    moves = np.hypot(dx, dy) > _LEAST_WAY_M
    off = np.exp(1j * (track[:-1, 3] - np.arctan2(dy, dx)))
    sides = [off[part][moves[part]] for part in (before, after)]
    if not any(map(len, sides)):
        return False  # it stands
    turned = np.angle(np.sum(sides[1]) * np.conj(np.sum(sides[0])))
    return min(map(len, sides)) < _AROUND // 2 or bool(abs(turned) < JUMP_RAD / 2)


class Judge:
    """Sees the frames of one log, in bounded memory and at next to no cost."""

    def __init__(self, robot: Robot | None = None):
        """A new log; ``robot``: whose limits the readings are compared with."""
        self.motion = Motion()
        self.readings = self.echoes = self.short = self.past = self.zeros = 0
        """Readings that were fired and valid; those with an echo, too short, past the maximum range though something
        was measured, or of 0 m."""
        self._robot = robot
        self._last: Float[ndarray, "4"] | None = None
        self._turning, self._unjudged = np.empty((0, 4)), 0
        self._where, self._batches, self._frames = Whereabouts(), 0, 0
        self._waiting: list[Float[ndarray, "frames 4"]] = []
        self._first_stamp = nan
        self._longest, self._at_longest, self._sonars_at = -inf, 0, np.zeros(0, dtype=bool)
        self._places_at = np.array([inf, inf, -inf, -inf])
        self._farthest = self._way = 0.0
        self._asked = self._heard = np.zeros(0, dtype=int)
        self._still = Stillness()
        self._along: dict[str, complex] = dict.fromkeys(("radians", *_DEGREES), 0j)
        self._driven = 0
        self._bearings, self._headings = 0j, (inf, -inf)

    def see(
        self,
        stamps: Float[ndarray, "frames"],
        poses: Float[ndarray, "frames 3"],
        ranges: Float[ndarray, "frames sonars"],
    ) -> None:
        """Take frames in their order.

        Args:
            stamps: s.
            poses: m, m, rad.
            ranges: m, before or after the robot's limits were applied; +inf no echo, nan not fired or not valid.
        """
        rows = np.empty((len(stamps), 4))
        rows[:, 0], rows[:, 1:] = stamps, poses
        if not self._where.near(rows):
            kept = [self._where.takes(*row) for row in rows[:, :3].tolist()]
            rows, ranges = rows[kept], ranges[kept]
        if not len(rows):
            return
        self._still.see(rows, ranges)
        low, high = self._headings
        if low >= high:  # until one has differed from another
            self._headings = min(low, float(rows[:, 3].min())), max(high, float(rows[:, 3].max()))
        self._batches += 1
        whole = self._frames < _WHOLE or self._batches % _EVERY == 0 or not self.echoes
        self._frames += len(rows)
        if whole:
            self._see_waiting()
            self._see_ranges(ranges, rows[:, 1:3])
            self._see_poses(rows, whole)
        else:
            self._waiting.append(rows)

    def _see_ranges(self, ranges: Float[ndarray, "frames sonars"], places: Float[ndarray, "frames 2"]) -> None:
        echo = np.isfinite(ranges)
        low, high = (self._robot.min_range_m, self._robot.max_range_m) if self._robot else (0.0, inf)
        past, short = ranges >= high, ranges < low
        unheard = int(np.count_nonzero(ranges == inf))
        self.past += int(np.count_nonzero(past)) - unheard
        self.short += int(np.count_nonzero(short))
        self.zeros += int(np.count_nonzero(ranges == 0))
        finite = int(np.count_nonzero(echo))
        self.readings += finite + unheard
        heard = echo & ~past & ~short
        self.echoes += int(np.count_nonzero(heard))
        if self._asked.size != ranges.shape[1]:
            self._asked = self._heard = np.zeros(ranges.shape[1], dtype=int)
        self._asked, self._heard = self._asked + np.sum(~np.isnan(ranges), axis=0), self._heard + np.sum(echo, axis=0)
        longest = float(np.max(ranges, where=heard, initial=-inf))
        if self._sonars_at.size != ranges.shape[1]:
            self._sonars_at = np.zeros(ranges.shape[1], dtype=bool)
        if longest > self._longest + _SAME_M:
            self._longest, self._at_longest = longest, 0
            self._sonars_at[:] = False
            self._places_at[:] = inf, inf, -inf, -inf
        if longest >= max(self._longest - _SAME_M, 0.0):
            same = heard & (ranges >= self._longest - _SAME_M)
            self._at_longest += int(np.count_nonzero(same))
            self._sonars_at |= same.any(axis=0)
            there = places[same.any(axis=1)]
            low, high = np.minimum(self._places_at[:2], there.min(0)), np.maximum(self._places_at[2:], there.max(0))
            self._places_at[:] = *low, *high
        self._farthest = max(self._farthest, float(np.max(ranges, where=echo, initial=0.0)))

    def _see_waiting(self) -> None:
        """Look at the poses of batches that were put by: all at once, which costs less."""
        if self._waiting:
            rows, self._waiting = np.concatenate(self._waiting), []
            self._see_poses(rows, whole=False)

    def _see_poses(self, rows: Float[ndarray, "frames 4"], whole: bool) -> None:
        """Rows of stamp, x, y, heading; unless they are to be looked at as a whole, for jumps alone."""
        track = rows if self._last is None else np.concatenate([self._last[None], rows])
        self._last = rows[-1]
        if np.isnan(self._first_stamp):
            self._first_stamp = float(rows[0, 0])
        found = speeds(track, turns=whole)
        self.motion.steps += len(found.way)
        self._way += float(np.sum(found.way, where=~found.far))
        self._count_jumps(track[1:, 0], found.way, found.far)
        self._count_turns(rows)
        if not whole or found.far.all():
            return
        motion, on = self.motion, ~found.far
        motion.judged += int(np.count_nonzero(on))
        motion.turned += int(np.count_nonzero(found.round[on]))
        motion.seldom += int(np.count_nonzero((np.diff(track[:, 0]) > SELDOM_S) & (found.way > 0)))
        way, (dx, dy) = found.way[on], (track[1:, 1:3] - track[:-1, 1:3])[on].T
        heading = track[1:, 3][on]
        drives = way > 0.02
        bearing, heading = np.arctan2(dy[drives], dx[drives]), heading[drives]
        self._driven += len(bearing)
        self._bearings += complex(np.sum(np.exp(2j * bearing)))
        for unit, scale in (("radians", 1.0), *_DEGREES.items()):
            # Twice the angle, for a robot may drive backwards.
            self._along[unit] += complex(np.sum(np.exp(2j * (bearing - scale * heading))))

    def _count_turns(self, rows: Float[ndarray, "poses 4"], last: bool = False) -> None:
        """Headings that jump where the place does not; the steps at the end wait for those that follow them."""
        track = np.concatenate([self._turning, rows])
        begin, self._unjudged = len(track) - 1 - len(rows) - self._unjudged, 0 if last else _AROUND
        self._turning = track[-2 * _AROUND - 1 :].copy()
        self._unjudged = max(min(self._unjudged, len(track) - 1 - max(begin, 0)), 0)
        turn = np.abs(wrap(track[1:, 3] - track[:-1, 3]))
        for at in np.flatnonzero(turn > JUMP_RAD):
            took, dx, dy, _ = track[at + 1] - track[at]
            slow = turn[at] <= SPUN_RAD_S * took or np.hypot(dx, dy) > max(FASTEST_M_S * took, JUMP_M)
            if slow or not begin <= at < len(turn) - self._unjudged:
                continue
            if _drove_on(track, slice(max(at - _AROUND, 0), at), slice(at + 1, at + 1 + _AROUND)):
                continue
            if not self.motion.spun:
                self.motion.first_turn = float(track[at + 1, 0]), float(turn[at])
            self.motion.spun += 1

    def _count_jumps(self, stamps: ndarray, way: ndarray, far: Bool[ndarray, "steps"]) -> None:
        if not far.any():
            return
        if not self.motion.fast:
            at = int(np.argmax(far))
            self.motion.first = float(stamps[at]), float(way[at])
        self.motion.fast += int(np.count_nonzero(far))
        self.motion.longest_m = max(self.motion.longest_m, float(np.max(way[far])))

    def notes(self) -> dict[str, int]:
        """What is doubtful: a line each, and how often; 0 where that says nothing."""
        self._see_waiting()
        self._count_turns(self._turning[:0], last=True)
        return self._of_ranges() | self._of_poses() | self._of_stillness()

    def _of_ranges(self) -> dict[str, int]:
        notes: dict[str, int] = {}
        limits = self._robot is not None and self._robot.max_range_m
        if self.readings >= LEAST_READINGS and not self.echoes and not self.short:
            cause = f"all {self.past} that measured something lie past max_range {limits:g} m (the farthest at "
            cause += f"{self._farthest:g}): is that cm or mm, or is max_range wrong?"
            why = cause if self.past else "are the ranges in m, is max_range right, do the sonars work?"
            notes[f"{_NO_ECHO}, all {self.readings} readings are no echo: {why}"] = 0
        elif self.past > 0.9 * (self.past + self.echoes) and self.past >= LEAST_READINGS:
            share = f"{self.past / (self.past + self.echoes):.0%} of the echoes lie {_PAST} {limits:g} m"
            farthest = f"(the farthest at {self._farthest:g}) and count as no echo"
            notes[f"{share} {farthest}: is that cm or mm, or is max_range wrong?"] = 0
        low = self._robot.min_range_m if self._robot else 0.0
        if self.zeros > ZEROS * self.readings and self.readings >= LEAST_READINGS:
            share = f"{self.zeros / self.readings:.0%} of the readings are 0 m, which is no range, and not used"
            notes[f"{share}: if that is how the sensor says no echo, it has to be inf"] = 0
        elif self.short > MOST_INVALID * (measured := self.short + self.past + self.echoes) >= LEAST_READINGS / 2:
            share = f"{self.short / measured:.0%} of the readings with an echo are below min_range {low:g} m"
            notes[f"{share} and {_TOO_SHORT}, is min_range right?"] = 0
        notes |= self._of_dumb()
        if self._longest_repeats():
            value, often = f"{self._longest:g}", f"comes {self._at_longest} times exactly, from most sonars"
            remedy = f"if that is how the sensor says no echo, map with a robot file whose max_range_m is {value}"
            notes[f"{NO_ECHO_IS_LONGEST} {value} m, {often}: {remedy}"] = 0
        return notes

    def _of_dumb(self) -> dict[str, int]:
        """A note on sonars that never hear an echo though the others do."""
        asked = self._asked >= LEAST_READINGS
        dumb = np.flatnonzero(asked & (self._heard == 0))
        others = asked & (self._heard > 0)
        if not dumb.size or not others.any() or self._way < DUMB_WAY_M:
            return {}
        share = float(np.median(self._heard[others] / self._asked[others]))
        if share < HEARS:
            return {}
        more = f" and {len(dumb) - _FEW} more" if len(dumb) > _FEW else ""
        names = ", ".join(f"r{i}" for i in dumb[:_FEW]) + more
        what = f"{len(dumb)} of {self._asked.size} {NEVER_HEAR} ({names})"
        why = f"the others do in {share:.0%} of their readings: are they dead? what they say counts as free floor"
        return {f"{what}, {why}; take them out of the log and the robot file": 0}

    def _of_stillness(self) -> dict[str, int]:
        notes: dict[str, int] = {}
        still = self._still
        low, high = (self._robot.min_range_m, self._robot.max_range_m) if self._robot else (0.0, inf)
        if found := still.stuck(low, self._longest - _SAME_M if self._longest_repeats() else high):
            array, first = self._sonars_at.size, found.sonars[0]
            which = f"{len(found.sonars)} of {array}" if len(found.sonars) < array else f"all {array}"
            what = f"{which} sonars repeat one value to the last bit (r{first} {found.value:g} m)"
            when = f"{_span(found.since, found.till, still.last)} while the robot drives"
            notes[f"{what} {when}: has their driver died? cut that out of the log, and start it anew"] = 0
        still.end()
        if still.dead is not None:
            again = f", and {still.dead_again} times more," if still.dead_again else ""
            what = f"the pose stays exactly the same {_span(*still.dead, still.last)}{again}"
            cause = "while most sonars hear the robot move: has the odometry died?"
            notes[f"{what} {cause} cut that out of the log"] = 0
        return notes

    def _longest_repeats(self) -> bool:
        share = REPEATED if self._sonars_at.size >= _FEW else _REPEATED_FEW
        if self._at_longest <= max(share * self.echoes, 30) or np.mean(self._sonars_at) < 0.5:
            return False
        return float(np.hypot(*(self._places_at[2:] - self._places_at[:2]))) >= _APART_M

    def _of_poses(self) -> dict[str, int]:
        notes: dict[str, int] = {}
        motion = self.motion
        if self._where.left_out:
            notes[LEFT_OUT] = self._where.left_out
        stamp, way = motion.first
        often = motion.fast > OFTEN * motion.steps and motion.steps >= LEAST_STEPS
        if often:
            share = f"{motion.fast / motion.steps:.0%} {_TOO_FAST} {FASTEST_M_S:g} m/s"
            notes[f"{share}: are the poses in mm or cm, or the stamps in other units than s?"] = 0
        elif motion.fast:
            what = f"the pose jumps by {way:.2f} m at {stamp:.2f} s"
            more = f" and {motion.fast - 1} times more (up to {motion.longest_m:.1f} m)" if motion.fast > 1 else ""
            why = STARTS_ANEW
            if motion.fast >= _STOPS:
                why = "was nothing recorded from stop to stop, or are the stamps wrong?"
            notes[f"{what}{more}, faster than any robot: {why}"] = 0
        if self._last is not None and self._last[0] == self._first_stamp and motion.steps >= LEAST_STEPS:
            notes[
                f"all stamps are {self._first_stamp:g} s: no speed can be told, and nothing fades; write the time"
            ] = 0
        if motion.seldom > SELDOM * motion.judged and motion.judged >= LEAST_STEPS:
            share = f"{motion.seldom / motion.judged:.0%} of the scans"
            what = f"{share} come more than {SELDOM_S:g} s after the one before, while the robot drives"
            notes[f"{what}: are the stamps in ms? they have to be in s"] = 0
        notes |= self._of_headings(often)
        return notes

    def _of_headings(self, fast: bool) -> dict[str, int]:
        motion = self.motion
        if self._driven >= 2 * LEAST_STEPS:
            along = {unit: abs(total) / self._driven for unit, total in self._along.items()}
            unit = max(_DEGREES, key=along.__getitem__)
            every_way = abs(self._bearings) < _EVERY_WAY * self._driven
            if every_way and self._headings[0] == self._headings[1]:
                what = f"theta is always {self._headings[0]:g}, though the robot drives every way"
                return {f"{what}: are the headings missing? each pose needs its own": 0}
            if along[unit] > _ALONG and along["radians"] < 0.5 * along[unit]:
                return {f"the headings agree with the way driven if theta is in {unit}: {_IN_RADIANS}": 0}
        if motion.turned > OFTEN * motion.judged and motion.judged >= LEAST_STEPS and not fast:
            share = f"{motion.turned / motion.judged:.0%} of the steps turn faster than {FASTEST_RAD_S:g} rad/s"
            return {f"{share}: is theta in degrees? {_IN_RADIANS}": 0}
        if 0 < motion.spun <= OFTEN * motion.steps and not fast:
            stamp, turn = motion.first_turn
            more = f" and {motion.spun - 1} times more" if motion.spun > 1 else ""
            what = f"the heading jumps by {np.rad2deg(turn):.0f} degrees at {stamp:.2f} s{more}"
            why = "more than any robot turns in a step: was the odometry reset? cut the log in two at that time"
            return {f"{what}, {why}": 0}
        return {}


def _span(since: float, till: float, end: float) -> str:
    """From when to when (s), in a log that ends then; what goes on has no end yet."""
    return f"since {since:.2f} s" if till >= end else f"from {since:.2f} to {till:.2f} s"
