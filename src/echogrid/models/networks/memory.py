"""What the mapper remembers of a drive when it reads the next scan with the set network.

Where it has looked from: what disturbs a sonar's view of smooth walls is decided by the pose and comes again in the
next scan from there, so a robot that stands for a minute has looked once, not six hundred times. What the
surroundings are like: whether readings of neighbours agree or jump tells mirrors from rough walls. And what the
sonars heard that do not fire in this scan but did just before: one alone is read with less certainty than beside
its neighbours.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid import _core
from echogrid.frame import Frame
from echogrid.geometry import wrap

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
        sonars = max(1, int(np.sum(~np.isnan(mounts[:, 2]))))
        first, second, near = neighbours(mounts)
        pairs = np.column_stack([first, second]).astype(np.int32)
        self._core = _core.Memory(
            pairs, near, sonars, PLACE_M, TURN_RAD, FAR_M, SAME_M, fade=FADE, prior=PRIOR, half_life=half_life
        )

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
        stamps = np.zeros(len(poses)) if stamps is None else stamps
        return Recalled(*self._core.take(poses, ranges, stamps, np.full(len(poses), new)))


class Recent:
    """The last scans of a drive, from which those are completed in which only a part of the sonars fired."""

    def __init__(self, mounts: Float[ndarray, "sonars 3"]):
        """A new drive of a robot with its sonars at mounts (m and rad; nan: no such sonar)."""
        self._core = _core.Recent(mounts, RECENT_M, RECENT_RAD, RECENT_S, RECENT_FRAMES)

    def completed(self, frames: Sequence[Frame]) -> tuple[Sequence[Frame], Float[ndarray, "scans"]]:
        """Scans that follow, completed with what their silent sonars heard last and from where that was.

        Returns:
            The scans, and what share of the readings of each is new.
        """
        whole, new = list(frames), np.ones(len(frames))
        for i, frame in enumerate(frames):
            found = self._core.complete(frame.stamp, frame.pose, frame.ranges, frame.mounts)
            if found is not None:
                ranges, mounts, new[i] = found
                whole[i] = replace(frame, ranges=ranges, mounts=mounts)
        return whole, new
