"""What the mapper remembers of a drive when it reads the next scan with the set network.

Where it has looked from: what disturbs a sonar's view of smooth walls is decided by the pose and comes again in the
next scan from there, so a robot that stands for a minute has looked once, not six hundred times. What the
surroundings are like: whether readings of neighbours agree or jump tells mirrors from rough walls. And what the
sonars heard that do not fire in this scan but did just before: one alone is read with less certainty than beside
its neighbours.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap

PLACE_M, TURN_RAD = 0.1, np.deg2rad(15.0)
"""Poses in the same cell of this lattice see the same."""

NEIGHBOUR_RAD = 0.35
"""Readings of sonars are compared whose axes lie about so near to each other."""

FAR_M = 4.0
"""Readings beyond are all alike, no echo among them."""

SAME_M = 0.08
"""Readings farther apart do not agree."""

FADE = 0.95
"""What an earlier scan counts, for each scan since, in what the surroundings are like."""

_LEAST = 0.01
"""Neighbours that count less are none."""

PRIOR = 1e-3
"""What counts for one half from the beginning."""

RECENT_M, RECENT_RAD, RECENT_S = 0.4, np.deg2rad(30.0), 2.0
"""A sonar that does not fire is taken to hear what it last heard no farther off and no longer ago, among
RECENT_FRAMES."""

RECENT_FRAMES = 16

TRAITS = 4
"""Numbers that say what the surroundings are like."""


class Recalled(NamedTuple):
    """What scans are read with."""

    weight: Float[ndarray, "scans"]
    """What each counts: the n-th from one place and heading counts 1/n. A scan in which a part of the sonars fired is
    so much of one, and counts so much as it has readings that are new."""
    traits: Float[ndarray, "scans traits"]
    """Of the surroundings, each from 0 to 1: share of no echo, how far neighbours agree, how far apart they are,
    how far all things are. 0.5 where nothing is known."""


def neighbours(
    mounts: Float[ndarray, "sonars 3"],
) -> tuple[Int[ndarray, "pairs"], Int[ndarray, "pairs"], Float[ndarray, "pairs"]]:
    """Pairs of sonars (m, m, rad) that look about the same way: the first of each, the second, and how nearly."""
    first, second = np.triu_indices(len(mounts), 1)
    near = np.exp(-((wrap(mounts[first, 2] - mounts[second, 2]) / NEIGHBOUR_RAD) ** 2))
    kept = near > _LEAST
    return first[kept], second[kept], near[kept]


class Memory:
    """Memory of one drive of one robot."""

    def __init__(self, mounts: Float[ndarray, "sonars 3"], half_life: float | None = None):
        """A new drive.

        Args:
            mounts: of the sonars, m and rad.
            half_life: time in which a look comes to count half, s; None: a look counts for ever.
        """
        self._half_life = half_life
        self._count: dict[tuple[int, int, int], tuple[float, float]] = {}
        self._sonars = max(1, int(np.sum(~np.isnan(mounts[:, 2]))))
        *self._pairs, self._near = neighbours(mounts)
        self._sums, self._counts = np.zeros(TRAITS), np.zeros(TRAITS)

    def take(
        self,
        poses: Float[ndarray, "scans 3"],
        ranges: Float[ndarray, "scans sonars"],
        stamps: Float[ndarray, "scans"] | None = None,
        new: Float[ndarray, "scans"] | float = 1.0,
    ) -> Recalled:
        """Add scans (m; inf = no echo, nan = not fired) at poses (m, rad), and say what they are to be read with.

        ``stamps`` (s) are needed where looks fade. ``new``: share of the readings that no scan before had, see
        ``Recent``.
        """
        cell = np.column_stack([poses[:, :2] / PLACE_M, np.mod(poses[:, 2], 2 * np.pi) / TURN_RAD])
        weight = np.empty(len(poses), dtype=np.float32)
        times = np.zeros(len(poses)) if stamps is None or self._half_life is None else stamps / self._half_life
        fired, echo = ~np.isnan(ranges), np.isfinite(ranges)
        new = np.broadcast_to(new, len(poses))
        shares = new * np.sum(fired, axis=1) / self._sonars
        for i, (x, y, turn) in enumerate(np.floor(cell).astype(np.int64).tolist()):
            count, time = self._count.get((x, y, turn), (0.0, 0.0))
            count = shares[i] + (count * 2 ** min(time - times[i], 0.0) if count else 0.0)
            self._count[x, y, turn] = count, times[i]
            weight[i] = new[i] / max(count, 1.0)
        reading = np.where(fired, np.minimum(ranges, FAR_M), 0.0)
        first, second = self._pairs
        apart = np.abs(reading[:, first] - reading[:, second])
        both = fired[:, first] & fired[:, second]
        heard = echo[:, first] & echo[:, second]
        counts = np.stack([fired.sum(axis=1), heard @ self._near, both @ self._near, fired.sum(axis=1)], axis=1)
        sums = [
            np.sum(fired & ~echo, axis=1),
            (heard * np.maximum(1 - apart / SAME_M, 0.0)) @ self._near,
            (both * np.minimum(apart, 1.0)) @ self._near,
            np.sum(reading, axis=1) / FAR_M,
        ]
        traits = np.empty((len(poses), TRAITS), dtype=np.float32)
        for i, (total, count) in enumerate(zip(np.stack(sums, axis=1), counts, strict=True)):
            self._sums = FADE * self._sums + total
            self._counts = FADE * self._counts + count
            traits[i] = (self._sums + 0.5 * PRIOR) / (self._counts + PRIOR)
        return Recalled(weight, traits)


class Recent:
    """The last scans of a drive, from which those are completed in which only a part of the sonars fired."""

    def __init__(self, mounts: Float[ndarray, "sonars 3"]):
        """A new drive of a robot with its sonars at mounts (m and rad; nan: no such sonar)."""
        self._mounts, self._there = mounts, ~np.isnan(mounts[:, 2])
        self._frames: deque[Frame] = deque(maxlen=RECENT_FRAMES)

    def completed(self, frames: Sequence[Frame]) -> tuple[Sequence[Frame], Float[ndarray, "scans"]]:
        """Scans that follow, completed with what their silent sonars heard last and from where that was.

        Returns:
            The scans, and what share of the readings of each is new.
        """
        new = np.ones(len(frames))
        silent = np.isnan(np.array([frame.ranges for frame in frames])) & self._there
        whole = list(frames)
        for i in range(len(frames)):
            if silent[i].any():
                whole[i], new[i] = self._completed(frames[i], silent[i])
            self._frames.append(frames[i])
        return whole, new

    def _completed(self, frame: Frame, silent: Bool[ndarray, "sonars"]) -> tuple[Frame, float]:
        ranges = frame.ranges.copy()
        mounts = (self._mounts if frame.mounts is None else frame.mounts).copy()
        missing = silent
        for before in reversed(self._frames):
            heard = missing & ~np.isnan(before.ranges)
            if not heard.any():
                continue
            moved = compose(inverse(frame.pose), before.pose)
            near = np.hypot(*moved[:2]) <= RECENT_M and abs(moved[2]) <= RECENT_RAD
            if near and abs(frame.stamp - before.stamp) <= RECENT_S:
                looked = self._mounts if before.mounts is None else before.mounts
                ranges[heard], mounts[heard] = before.ranges[heard], compose(moved, looked[heard])
                missing = missing & ~heard
                if not missing.any():
                    break
        taken = np.sum(silent) - np.sum(missing)
        if not taken:
            return frame, 1.0
        fired = np.sum(self._there) - np.sum(silent)
        return replace(frame, ranges=ranges, mounts=mounts), float(fired / (fired + taken))
