"""What stays the same in a log though it cannot: sonars that repeat one value, poses of odometry that has died."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import inf, nan, ndarray

LEAST_REPEATS, LEAST_S, LEAST_WAY_M, LEAST_TURN_RAD, LEAST_STRAIGHT_M = 50, 5.0, 1.0, 0.5, 5.0
"""A sonar is stuck if so many readings in a row, for so long, are the same to the last bit while the robot gets so
far and turns so much; all are, if it goes so far straight on, where a wall beside it may stay as far."""

STUCK = 0.5
"""Share of the sonars from which it is told."""

DEAD_S, DEAD_FRAMES = 15.0, 50
"""Poses that stay the same for shorter are of a robot that stands."""

_CHUNK, _MOST = 48, 4096
"""Frames that are looked at together, fewer than DEAD_FRAMES; and frames of one stand that are kept at most."""

_SPREAD_M, _STEADY, _DWELLS, _BAND_M, _MOST_SONARS = 0.3, 0.5, 0.4, 0.3, 0.6
"""Ranges of a sonar that moves are spread so far (standard deviation), change little from one to the next (mean
square of the steps / variance; 2 for noise), and no more than a share of them lies in any band so wide: who stands
has the same before each sonar again when people have passed. So many of the sonars have to."""


class Stuck(NamedTuple):
    """Sonars that repeat one value each."""

    sonars: list[int]
    since: float
    """Stamp, s."""
    till: float
    """Stamp, s."""
    value: float
    """Of the first of them, m."""


class Stillness:
    """Sees the frames of one log, in bounded memory."""

    def __init__(self) -> None:
        self.dead: tuple[float, float] | None = None
        """First and last stamp (s) at which the pose stayed though the robot moved, when it first did so."""
        self.dead_again = 0
        """How often it did so later."""
        self.last = nan
        """Stamp of the last frame, s."""
        self._dead = (nan, nan)
        self._values = np.zeros(0)
        self._held: list[tuple[ndarray, ndarray]] = []
        self._held_frames = 0

    def see(self, rows: Float[ndarray, "frames 4"], ranges: Float[ndarray, "frames sonars"]) -> None:
        """Take frames in their order: stamp (s), x, y (m), heading (rad), and ranges (m)."""
        if self._values.size != ranges.shape[1]:
            self._begin(ranges.shape[1])
        self.last = float(rows[-1, 0])
        for first in range(0, len(rows), _CHUNK):
            part, heard = rows[first : first + _CHUNK], ranges[first : first + _CHUNK]
            self._see_repeats(part, heard)
            self._see_stand(part, heard)

    def _begin(self, sonars: int) -> None:
        self._values = np.full(sonars, nan)
        self._count = np.zeros(sonars, dtype=int)
        # Stamp, place, and cosine and sine of the heading at the least and at the most while a value repeats.
        self._low, self._high = np.full((sonars, 5), inf), np.full((sonars, 5), -inf)
        self._stuck = np.full((sonars, 3), nan)

    def _see_repeats(self, rows: ndarray, ranges: ndarray) -> None:
        last = ranges[-1]
        repeats = ((ranges[0] == last) | (ranges[-2:][0] == last)) & (last < inf)
        if not repeats.any() and not (np.isnan(ranges[0]) | np.isnan(last)).any():
            # As nearly always where every sonar fires each time: no echo repeats through to the last.
            if self._count.any():
                self._count[:], self._low[:], self._high[:] = 0, inf, -inf
            self._values = last.copy()
            return
        low, high = np.fmin.reduce(ranges), np.fmax.reduce(ranges)
        unheard = np.isnan(low)
        same = (low == high) & (low == self._values) | unheard
        if not same.all():
            new = ~same
            constant = new & (low == high)
            # Of the others a new run may begin with the last reading.
            begun = new & ~constant & (ranges[-1] == ranges[-2:][0])
            self._count[new], self._low[new], self._high[new] = 0, inf, -inf
            self._values[new] = np.where(constant, low, ranges[-1])[new]
            for sonar in np.flatnonzero(begun):
                others = np.flatnonzero(ranges[:, sonar] != ranges[-1, sonar])
                self._add(np.array([sonar]), rows[others[-1] + 1 :], len(rows) - 1 - int(others[-1]))
            same |= constant
        on = np.flatnonzero(same & ~unheard)
        if not on.size:
            return
        self._values[on] = low[on]
        fired = np.isfinite(ranges[:, on]).sum(axis=0) if np.isnan(ranges).any() else len(rows)
        self._add(on, rows, fired)
        if (self._count[on] >= LEAST_REPEATS).any():
            self._mark(on)

    def _add(self, sonars: ndarray, rows: ndarray, fired: ndarray | int) -> None:
        """Add readings that repeat the value of these sonars."""
        heading = rows[:, 3]
        seen = np.column_stack([rows[:, :3], np.cos(heading), np.sin(heading)])
        self._count[sonars] += fired
        self._low[sonars] = np.minimum(self._low[sonars], seen.min(axis=0))
        self._high[sonars] = np.maximum(self._high[sonars], seen.max(axis=0))

    def _mark(self, on: ndarray) -> None:
        """Remember the sonars whose value repeats for too long."""
        found = np.zeros(len(self._count), dtype=bool)
        found[on] = np.isfinite(self._values[on]) & (self._count[on] >= LEAST_REPEATS)
        took, *way_and_turn = np.where(found, (self._high - self._low).T, 0.0)
        way, turn = np.hypot(*way_and_turn[:2]), np.hypot(*way_and_turn[2:])
        bent, straight = (way >= LEAST_WAY_M) & (turn >= LEAST_TURN_RAD), (way >= LEAST_STRAIGHT_M).all()
        for sonar in np.flatnonzero((took >= LEAST_S) & (bent | straight)):
            stuck, since = self._stuck[sonar], self._low[sonar, 0]
            if np.isnan(stuck[0]) or stuck[0] == since:
                stuck[:] = since, self._high[sonar, 0], self._values[sonar]

    def stuck(self, low: float, high: float) -> Stuck | None:
        """Sonars that repeat a value from ``low`` to below ``high`` (m), if they are as many as to be told."""
        if not self._values.size:
            return None
        value = self._stuck[:, 2]
        sonars = np.flatnonzero((value >= low) & (value < high) & (value > 0))
        if not sonars.size or sonars.size < STUCK * len(value):
            return None
        since, till = float(self._stuck[sonars, 0].min()), float(self._stuck[sonars, 1].max())
        return Stuck(sonars.tolist(), since, till, float(value[sonars[0]]))

    def _see_stand(self, rows: ndarray, ranges: ndarray) -> None:
        if self._held and len(rows) > 1 and rows[0, 1] != self._held[-1][0][-1, 1] and rows[-1, 1] != rows[-2, 1]:
            self._judge_stand()  # as nearly always while it drives
            self._held, self._held_frames = [(rows[-1:].copy(), ranges[-1:].copy())], 1
            return
        if self._held:
            before = self._held[-1][0][-1:]
            moved = (rows[:, 1:] != np.concatenate([before, rows[:-1]])[:, 1:]).any(axis=1)
        else:
            moved = np.concatenate([[True], (rows[1:, 1:] != rows[:-1, 1:]).any(axis=1)])
        if moved.all():
            first, last = 0, len(rows) - 1
        else:
            at = np.flatnonzero(moved)
            first, last = (int(at[0]), int(at[-1])) if at.size else (len(rows), 0)
        if first:
            self._held.append((rows[:first], ranges[:first]))
            self._held_frames += first
        if first < len(rows):
            self._judge_stand()
            self._held, self._held_frames = [(rows[last:].copy(), ranges[last:].copy())], len(rows) - last
        elif self._held_frames > _MOST or self._held[-1][0][-1, 0] - self._held[0][0][0, 0] > 2 * DEAD_S:
            self._judge_stand()
            self._held, self._held_frames = [(rows[-1:].copy(), ranges[-1:].copy())], 1

    def _judge_stand(self) -> None:
        """Judge the frames that were kept, all of one pose."""
        if self._held_frames < DEAD_FRAMES:
            return
        since, till = float(self._held[0][0][0, 0]), float(self._held[-1][0][-1, 0])
        if till - since >= DEAD_S and moves(np.concatenate([ranges for _, ranges in self._held])):
            if since in self._dead:  # it goes on, or is judged again
                since = self._dead[0]
            elif self.dead is not None:
                self.dead_again += 1
            self._dead = since, till
            if self.dead is None or self.dead[0] == since:
                self.dead = self._dead

    def end(self) -> None:
        """Judge what was kept last; more may come."""
        self._judge_stand()


def moves(ranges: Float[ndarray, "frames sonars"]) -> bool:
    """Whether most sonars that hear anything (m) change as those of a robot that moves."""
    heard = moving = 0
    for sonar in ranges.T:
        echoes = sonar[np.isfinite(sonar)]
        if len(echoes) < DEAD_FRAMES / 2:
            continue
        heard += 1
        spread = float(np.var(echoes))
        if spread < _SPREAD_M**2 or np.mean(np.diff(echoes) ** 2) > _STEADY * spread:
            continue
        ordered = np.sort(echoes)
        within = np.searchsorted(ordered, ordered + _BAND_M, side="right") - np.arange(len(ordered))
        moving += int(within.max() <= _DWELLS * len(ordered))
    return moving >= max(_MOST_SONARS * heard, 2)
