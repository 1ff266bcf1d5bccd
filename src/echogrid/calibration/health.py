"""What is amiss with single sonars, told without a map: dead, stuck, repeating old values, hearing other sonars."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.calibration.readings import Readings
from echogrid.geometry import wrap

LEAST_READINGS = 50
"""Of fewer nothing is concluded."""

OTHERS_HEAR = 0.2
"""A sonar without an echo is dead if the median sonar has one in so many of its readings."""

STUCK, STUCK_M, STUCK_RAD = 0.5, 1.0, 1.0
"""A sonar is stuck if one value, over so long a way and so much turning, is such a share of its echoes."""

STALE, OVER_CHANCE = 0.2, 3.0
"""Echoes that repeat the one before while the robot moves are old ones from such a share on, if there are so many
times as many as of the next values of its steps."""

SPIKE_M, STEADY_M, CROSS_TALK = 0.3, 0.1, 0.03
"""Of readings between two that agree so well such a share is shorter than both by so much: pulses of others."""

MOVED_M, MOVED_RAD = 0.01, 0.01


@dataclass(frozen=True)
class Health:
    """What was found of each sonar. Shares are of all its echoes; nan where there are too few."""

    echoes: Float[ndarray, "sonars"]
    """Share of the valid readings that are an echo."""
    dead: Bool[ndarray, "sonars"]
    """Which never hear, though others do."""
    silent: Bool[ndarray, "sonars"]
    """Of those, which have no valid reading at all."""
    stuck: Bool[ndarray, "sonars"]
    """Which say one value."""
    value: Float[ndarray, "sonars"]
    """The commonest value of each, m."""
    repeats: Float[ndarray, "sonars"]
    """Share that repeats the one before to the last bit while the robot moves."""
    stale: Bool[ndarray, "sonars"]
    """Which repeat old values."""
    spikes: Float[ndarray, "sonars"]
    """Share of readings that are too short between two that agree."""
    cross_talk: Bool[ndarray, "sonars"]
    """Which have many of them."""

    @property
    def useless(self) -> list[int]:
        """Sonars that say nothing of the room."""
        return np.flatnonzero(self.dead | self.stuck).tolist()


def examine(readings: Readings) -> Health:
    """Look at each sonar by itself."""
    ranges = readings.ranges
    valid, echo = ~np.isnan(ranges), np.isfinite(ranges)
    count = valid.sum(axis=0)
    share = np.where(count >= LEAST_READINGS, echo.sum(axis=0) / np.maximum(count, 1), np.nan)
    others = float(np.median(np.nan_to_num(share)))
    enough = len(ranges) >= LEAST_READINGS
    dead = enough & (echo.sum(axis=0) == 0) & (others > OTHERS_HEAR)
    place = readings.poses[:, :, :2]
    stuck, value, repeats, stale, spikes = (np.full(readings.sonars, np.nan) for _ in range(5))
    for i in range(readings.sonars):
        heard = np.flatnonzero(echo[:, i])
        if len(heard) < LEAST_READINGS:
            continue
        values, of, counts = np.unique(ranges[heard, i], return_inverse=True, return_counts=True)
        most = int(np.argmax(counts))
        way = np.ptp(place[heard[of == most], i], axis=0)
        heading = np.unwrap(readings.poses[heard[of == most], i, 2])
        value[i], often = values[most], counts[most] > STUCK * len(heard)
        stuck[i] = often and np.hypot(*way) > STUCK_M and np.ptp(heading) > STUCK_RAD
        stuck[i] = stuck[i] and _kept(ranges[:, i], readings.poses[:, i, 2]) > STUCK
        repeats[i], stale[i] = _repeats(ranges[:, i], readings.poses[:, i])
        spikes[i] = _spikes(ranges[heard, i])
    flags = [np.nan_to_num(each) > 0 for each in (stuck, stale)]
    return Health(
        share, dead, dead & (count == 0), flags[0], value, repeats, flags[1] & ~flags[0], spikes,
        np.nan_to_num(spikes) > CROSS_TALK,
    )  # fmt: skip


def _kept(ranges: Float[ndarray, "frames"], heading: Float[ndarray, "frames"]) -> float:
    """Share of echoes that stay the same to the last bit while the robot turns; 1 if it never does.

    Beside a wall along which the robot drives, a sonar may hear the same all day; not while it turns.
    """
    asked = (np.abs(wrap(np.diff(heading))) > MOVED_RAD) & np.isfinite(ranges[1:]) & np.isfinite(ranges[:-1])
    return float(np.mean(ranges[1:][asked] == ranges[:-1][asked])) if asked.any() else 1.0


def _repeats(ranges: Float[ndarray, "frames"], poses: Float[ndarray, "frames 3"]) -> tuple[float, bool]:
    """Share of echoes that are the same as before though the robot moved, and whether chance explains it.

    Only after a change are they counted: a robot that drives beside a wall may hear the same for long.
    """
    step = np.diff(poses, axis=0)
    moved = (np.hypot(step[:, 0], step[:, 1]) > MOVED_M) | (np.abs(wrap(step[:, 2])) > MOVED_RAD)
    finite = np.isfinite(ranges)
    change = np.abs(np.diff(np.where(finite, ranges, 0.0)))
    both = finite[1:] & finite[:-1] & moved
    asked = both[1:] & both[:-1] & (change[:-1] > 0)
    if asked.sum() < LEAST_READINGS:
        return float("nan"), False
    share = float(np.mean(change[1:][asked] == 0))
    # Ranges that come in steps (1 cm, say) are the same by chance: as often as one step off, or always where a step
    # is long beside what the robot drives from scan to scan.
    steps = change[both & (change > 1e-9)]
    quantum = float(np.min(steps)) if len(steps) else np.inf
    chance = float(np.mean(np.abs(change[1:][asked] - quantum) < 0.1 * quantum)) / 2
    way = float(np.median(np.hypot(step[:, 0], step[:, 1])[both]))
    return share, quantum < way and share > STALE and share > OVER_CHANCE * chance


def _spikes(ranges: Float[ndarray, "echoes"]) -> float:
    """Share of echoes that are much shorter than those before and after, which agree."""
    before, here, after = ranges[:-2], ranges[1:-1], ranges[2:]
    steady = np.abs(before - after) < STEADY_M
    if steady.sum() < LEAST_READINGS:
        return float("nan")
    return float(np.mean(here[steady] < np.minimum(before, after)[steady] - SPIKE_M))
