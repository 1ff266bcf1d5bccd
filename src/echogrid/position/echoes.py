"""Evidence beyond the reach of the network, from echoes as they are: coarse, for halls whose walls are far off."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid._core import add_rays
from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.position.matching import Field
from echogrid.robot import Robot

NEAR_M, FAR_M = 2.3, 5.0
"""Echoes between are taken: those nearer the network reads, those farther are seldom the first thing in the way."""

BEAM_SHARE = 0.8
"""Of half the beam width: where on its arc an echo's surface most likely is."""

SURFACE, FREE, MOST = 0.4, 0.1, 1.5
"""Log-odds that an echo adds to its arc and takes from the way to it, and the most that a cell comes to."""

_BEFORE_M = 0.25  # so much of the way before an echo is not told free
_RAYS = 7


class FarEchoes(NamedTuple):
    """Echoes of some scans from beyond the network's reach."""

    frame: Int[ndarray, "echoes"]
    """Which of the scans heard it."""
    mounts: Float[ndarray, "echoes 3"]
    """Of the sonars on the robot, m, m, rad."""
    ranges: Float[ndarray, "echoes"]
    """m"""

    def at(self, poses: Float[ndarray, "frames 3"]) -> Float[ndarray, "echoes 3"]:
        """Where the sonars were (m, m, rad) if the scans were made at poses."""
        return compose(poses[self.frame], self.mounts)


def far_echoes(frames: Sequence[Frame], robot: Robot) -> FarEchoes:
    """Those of scans of a robot."""
    ranges = np.array([frame.ranges for frame in frames])
    mounts = np.array([robot.mounts if frame.mounts is None else frame.mounts for frame in frames])
    frame, sonar = np.nonzero(np.isfinite(ranges) & (ranges > NEAR_M) & (ranges <= FAR_M))
    return FarEchoes(frame, mounts[frame, sonar], ranges[frame, sonar])


def with_far_echoes(
    field: Field, at: Float[ndarray, "echoes 3"], ranges: Float[ndarray, "echoes"], beam_width: float
) -> Field:
    """A local map, and round what it knows the evidence of far echoes.

    Args:
        field: the map.
        at: poses of the sonars in its frame, m, m, rad.
        ranges: m.
        beam_width: of the sonars, rad.
    """
    if not len(at):
        return field
    cell = field.cell_m
    half = max(beam_width / 2 * BEAM_SHARE, 0.02)
    arc = at[:, 2, None] + np.linspace(-half, half, max(3, int(2 * half * FAR_M / cell)))
    way = at[:, 2, None] + np.linspace(-half, half, _RAYS) * 0.7
    around, inner = _around(field, at[:, :2], arc, ranges + cell)
    log_odds, begin = around.b, np.full(len(ranges), NEAR_M - 0.5)
    free = np.ceil((ranges - _BEFORE_M - begin) / cell).astype(np.int64)
    for angles, first, counts, change in (
        (arc, ranges - cell, np.full(len(ranges), 3), SURFACE),
        (way, begin, free, -FREE),
    ):
        add_rays(at[:, :2], angles, first, cell, counts, change, around.origin, cell, log_odds)
    np.tanh(np.clip(log_odds, -MOST, MOST, out=log_odds) / 2, out=log_odds)
    log_odds[inner] = np.where(field.b != 0, field.b, log_odds[inner])
    return around


def _around(
    field: Field, at: Float[ndarray, "echoes 2"], arc: Float[ndarray, "echoes n"], radius: Float[ndarray, "echoes"]
) -> tuple[Field, tuple[slice, slice]]:
    """An empty map that holds arcs of echoes besides, and where in it the one that there is lies."""
    cell, origin = field.cell_m, np.array(field.origin)
    size = np.array(field.b.shape[::-1]) * cell
    ends = [at[:, axis] + radius * turned(arc).T for axis, turned in enumerate((np.cos, np.sin))]
    low = np.floor((np.minimum([each.min() for each in ends], origin) - origin) / cell).astype(int) - 1
    high = np.ceil((np.maximum([each.max() for each in ends], origin + size) - origin) / cell).astype(int) + 1
    cols, rows = high - low
    corner = origin + low * cell
    inner = np.s_[-low[1] : field.b.shape[0] - low[1], -low[0] : field.b.shape[1] - low[0]]
    return Field(np.zeros((rows, cols)), (float(corner[0]), float(corner[1])), cell), inner
