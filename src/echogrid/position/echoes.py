"""Evidence beyond the reach of the network, from echoes as they are: coarse, for halls whose walls are far off."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

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


def with_far_echoes(field: Field, frames: Sequence[Frame], poses: Float[ndarray, "frames 3"], robot: Robot) -> Field:
    """A local map, and round what it knows the evidence of far echoes of frames at poses (m, m, rad) in its frame."""
    ranges = np.array([frame.ranges for frame in frames])
    frame, sonar = np.nonzero(np.isfinite(ranges) & (ranges > NEAR_M) & (ranges <= FAR_M))
    if not len(frame):
        return field
    ranges, cell = ranges[frame, sonar], field.cell_m
    mounts = np.array([robot.mounts[k] if (own := frames[i].mounts) is None else own[k]
                       for i, k in zip(frame.tolist(), sonar.tolist(), strict=True)])  # fmt: skip
    at = compose(poses[frame], mounts)
    half = max(robot.beam_width_rad / 2 * BEAM_SHARE, 0.02)
    arc = np.linspace(-half, half, max(3, int(2 * half * FAR_M / cell)))
    surface = _polar(at, arc, ranges[:, None] + np.arange(-1, 2) * cell)
    way = np.broadcast_to(
        np.arange(NEAR_M - 0.5, FAR_M, cell), (len(ranges), int(np.ceil((FAR_M - NEAR_M + 0.5) / cell)))
    )
    free = _polar(at, np.linspace(-half, half, _RAYS) * 0.7, way)
    free = free[np.broadcast_to((way < ranges[:, None] - _BEFORE_M)[:, None], free.shape[:-1])]
    return _around(field, surface.reshape(-1, 2), free)


def _polar(
    at: Float[ndarray, "echoes 3"], bearing: Float[ndarray, "n"], radius: Float[ndarray, "echoes m"]
) -> Float[ndarray, "echoes n m 2"]:
    angle = (at[:, 2, None] + bearing)[..., None]
    radius = radius[:, None]
    return np.stack(
        [at[:, 0, None, None] + radius * np.cos(angle), at[:, 1, None, None] + radius * np.sin(angle)], -1
    )


def _around(field: Field, surface: Float[ndarray, "n 2"], free: Float[ndarray, "m 2"]) -> Field:
    cell, origin = field.cell_m, np.array(field.origin)
    rows, cols = field.b.shape
    low = np.floor((np.minimum(surface.min(axis=0), origin) - origin) / cell + 1e-6).astype(int) - 1
    high = np.maximum(surface.max(axis=0), origin + np.array([cols, rows]) * cell)
    size = np.ceil((high - origin) / cell).astype(int) + 2 - low
    corner = origin + low * cell
    log_odds = np.zeros(size[::-1])
    for points, change in ((surface, SURFACE), (free, -FREE)):
        x, y = ((points - corner) / cell).astype(int).T
        held = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1])
        np.add.at(log_odds, (y[held], x[held]), change)
    b = np.tanh(np.clip(log_odds, -MOST, MOST) / 2)
    inner = b[-low[1] : -low[1] + rows, -low[0] : -low[0] + cols]
    inner[...] = np.where(field.b != 0, field.b, inner)
    return Field(b, (float(corner[0]), float(corner[1])), cell)
