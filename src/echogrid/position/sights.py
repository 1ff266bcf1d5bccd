"""What the last piece of a drive saw, as points round the robot that are laid onto a map."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from echogrid import _core
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import Grid, sigmoid
from echogrid.mapping.mapper import Mapper
from echogrid.models.model import Model
from echogrid.robot import Robot

_LEAST, _FEWEST, _WHOLE = 0.3, 20, 200
"""Cells of which less is known are no points (of 2 p - 1); fewer points are none; a sight with so many of walls
counts whole, one with fewer in proportion."""

_SUREST = 0.95
"""No cell of a map counts as surer (2 p - 1), whatever its file says: the world changes."""


class Sight(NamedTuple):
    """Points seen from the robot's last pose."""

    points: Float32[ndarray, "n 2"]
    """x forward, y left, m."""
    a: Float32[ndarray, "n"]
    """2 p - 1 of each: above 0 a wall, below it floor."""
    strength: float
    """How much of walls there is, 0 to 1."""


def sight(frames: Sequence[Frame], robot: Robot, model: Model, most: int, rng: np.random.Generator) -> Sight:
    """What frames saw together, as seen from the pose of the last of them.

    Args:
        frames: of a short way, with poses by odometry.
        robot: theirs.
        model: reads them into a local map.
        most: points; of more, some are drawn, walls and floor alike.
        rng: draws them.
    """
    poses = compose(inverse(frames[-1].pose), np.array([frame.pose for frame in frames]))
    mapper = Mapper(robot, model)
    mapper.add(replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True))
    grid = mapper.grid()
    b = np.where(grid.observed, 2 * sigmoid(grid.log_odds) - 1, 0)
    cells = np.argwhere(np.abs(b) > _LEAST)
    a = b[cells[:, 0], cells[:, 1]]
    walls, floor = np.flatnonzero(a > 0), np.flatnonzero(a < 0)
    strength = min(1.0, len(walls) / _WHOLE)
    taken = _some(walls, most // 2, rng)
    taken = np.concatenate([taken, _some(floor, most - len(taken), rng)])
    if len(taken) < _FEWEST:
        taken, strength = taken[:0], 0.0
    return Sight(grid.centre_of(cells[taken]).astype(np.float32), a[taken].astype(np.float32), strength)


def _some(of: ndarray, most: int, rng: np.random.Generator) -> ndarray:
    return of if len(of) <= most else rng.choice(of, most, replace=False)


class Ground:
    """A map that sights are laid onto."""

    def __init__(self, grid: Grid) -> None:
        b = np.where(grid.observed, 2 * sigmoid(grid.log_odds) - 1, 0)
        self._scorer = _core.PoseScorer(
            np.clip(b, -_SUREST, _SUREST).astype(np.float32), grid.origin, grid.resolution
        )

    def agreement(self, seen: Sight, poses: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Mean of log(1 + a b) over the points, as of ``PoseScorer``, times their strength.

        What the map does not know counts 0.
        """
        if not len(seen.a):
            return np.zeros(len(poses))
        return self._scorer.score(seen.points, seen.a, poses).astype(float) * (seen.strength / len(seen.a))
