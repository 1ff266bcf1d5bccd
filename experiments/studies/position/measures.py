"""What poses are worth where the true ones are not known: whether hits come to lie on each other, or on walls."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from echogrid import Frame, Grid, Robot
from echogrid.geometry import compose
from echogrid.metrics import OCCUPIED_ABOVE

HIT_M, CELL_M = 2.0, 0.1
"""Farther hits than the first say little of where a thing is; they are counted in cells of the second."""


def poses_of(frames: Iterable[Frame]) -> Float[ndarray, "frames 3"]:
    """The poses of frames, m, m, rad."""
    return np.array([frame.pose for frame in frames])


def hits(
    frames: Sequence[Frame], robot: Robot, poses: Float[ndarray, "frames 3"], reach: float = HIT_M
) -> Float[ndarray, "hits 2"]:
    """Where readings below ``reach`` (m) lie on their sonars' axes, for poses other than the frames' own; m."""
    ranges = np.array([frame.ranges for frame in frames])
    sonars = compose(poses[:, None], robot.mounts[None])
    near = ranges < reach
    u = np.stack([np.cos(sonars[..., 2]), np.sin(sonars[..., 2])], axis=-1)
    return sonars[near][:, :2] + ranges[near][:, None] * u[near]


def entropy_of_hits(frames: Sequence[Frame], robot: Robot, poses: Float[ndarray, "frames 3"]) -> float:
    """Entropy (nat) of how hits nearer than HIT_M spread over cells of CELL_M: lower where walls are single."""
    cells = np.floor(hits(frames, robot, poses) / CELL_M).astype(int)
    share = np.unique(cells, axis=0, return_counts=True)[1] / max(1, len(cells))
    return float(-np.sum(share * np.log(share)))


def hit_to_wall(
    frames: Sequence[Frame], robot: Robot, poses: Float[ndarray, "frames 3"], plan: Grid, reach: float = 2.5
) -> float:
    """Mean distance (m) of hits nearer than ``reach`` (m) to the nearest occupied cell's centre of a plan."""
    walls = plan.centre_of(np.argwhere(plan.probability() > OCCUPIED_ABOVE))
    return float(np.mean(KDTree(walls).query(hits(frames, robot, poses, reach))[0]))
