"""Where the sonars sit, and the scale of the ranges: what makes all echoes touch the walls best.

Walls are fitted together with the places (Gauss-Newton; the two numbers of each wall are eliminated). The axes of the
sonars do not enter, so that this is the same for any beam.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.calibration.readings import Readings
from echogrid.calibration.walls import Walls
from echogrid.geometry import compose

PLACE_M, SCALE = 0.06, 0.04
"""How far a place and the scale may be off before a log is looked at: standard deviations."""

OUTWARD_M = 0.001
"""How far out along their axes the sonars sit in the mean is left as it was given (standard deviation), for no log
tells: if all sat farther out, all walls would lie farther out. An offset of all ranges does the same."""

ROUNDS, LEAST_MISS_M = 6, 0.005


@dataclass(frozen=True)
class Places:
    """What a log says of places and scale."""

    mounts: Float[ndarray, "sonars 3"]
    """x, y, m; the axis (rad) as it came."""
    scale: float
    """What the ranges read of a metre."""
    covariance: Float[ndarray, "n n"]
    """Of x and y of each sonar, m, then the scale."""
    walls: Walls
    """As fitted."""
    miss_m: float
    """How far echoes are off their walls, m (robust standard deviation)."""

    @property
    def place_sd(self) -> Float[ndarray, "sonars 2"]:
        """Standard deviations of x and y, m."""
        return np.sqrt(np.diag(self.covariance)[:-1]).reshape(-1, 2)

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the scale."""
        return float(np.sqrt(self.covariance[-1, -1]))


class _System(NamedTuple):
    """Misses and what they depend on, to first order."""

    wall: Int[ndarray, "echoes"]
    miss: Float[ndarray, "echoes"]
    weight: Float[ndarray, "echoes"]
    by: Float[ndarray, "echoes n"]
    """By places and scale."""
    own: Float[ndarray, "echoes 2"]
    """By the numbers of the wall."""
    sigma: float

    def blocks(self, walls: int) -> tuple[Float[ndarray, "walls 2 2"], Float[ndarray, "walls 2 n"]]:
        """The inverse of each wall's own block, and how it hangs together with the rest."""
        own, cross = np.zeros((walls, 2, 2)), np.zeros((walls, 2, self.by.shape[1]))
        weighted = self.weight[:, None, None] * self.own[:, :, None]
        np.add.at(own, self.wall, weighted * self.own[:, None, :])
        np.add.at(cross, self.wall, weighted * self.by[:, None, :])
        return np.linalg.inv(own + 1e-4 * np.eye(2)), cross


def fit(
    readings: Readings,
    mounts: Float[ndarray, "sonars 3"],
    given: Float[ndarray, "sonars 3"],
    walls: Walls,
    scale: float,
) -> Places:
    """Places, scale and walls that agree best with the ranges of the echoes that touch the walls.

    Args:
        readings: of the drive.
        mounts: where to begin, m, m, rad.
        given: what was said of them before the log, within PLACE_M.
        walls: found with these mounts and this scale.
        scale: where to begin.
    """
    prior, count = _prior(given), len(walls.place)
    system = _system(readings, mounts, walls, scale)
    H = prior
    for _ in range(ROUNDS):
        inverse, cross = system.blocks(count)
        c = np.zeros((count, 2))
        np.add.at(c, system.wall, (system.weight * system.miss)[:, None] * system.own)
        off = np.append((mounts[:, :2] - given[:, :2]).ravel(), scale - 1.0)
        by, weight = system.by, system.weight[:, None]
        H = ((by * weight).T @ by - np.einsum("wij,wik,wkl->jl", cross, inverse, cross)) / system.sigma**2 + prior
        g = by.T @ (system.weight * system.miss) - np.einsum("wij,wik,wk->j", cross, inverse, c)
        step = -np.linalg.solve(H, g / system.sigma**2 + prior @ off)
        mounts = np.column_stack([mounts[:, :2] + step[:-1].reshape(-1, 2), mounts[:, 2]])
        scale += float(step[-1])
        walls = replace(walls, place=walls.place - np.einsum("wik,wk->wi", inverse, c + cross @ step))
        system = _system(readings, mounts, walls, scale)
    return Places(mounts, scale, _covariance(system, H, prior, count), walls, _spread(system.miss))


def _prior(given: Float[ndarray, "sonars 3"]) -> Float[ndarray, "n n"]:
    """What is known before: the inverse of the covariance."""
    n = 2 * len(given)
    outward = np.append(np.stack([np.cos(given[:, 2]), np.sin(given[:, 2])], axis=1).ravel() / len(given), 0.0)
    return np.diag(np.append(np.full(n, PLACE_M**-2.0), SCALE**-2.0)) + np.outer(outward, outward) / OUTWARD_M**2


def _system(readings: Readings, mounts: Float[ndarray, "sonars 3"], walls: Walls, scale: float) -> _System:
    poses = readings.poses[walls.frame, walls.sonar]
    read = readings.ranges[walls.frame, walls.sonar]
    distance, to, along = walls.seen(walls.wall, compose(poses, mounts[walls.sonar])[:, :2])
    miss = read / scale - distance
    sigma = max(LEAST_MISS_M, _spread(miss))
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    by, rows = np.zeros((len(miss), 2 * len(mounts) + 1)), np.arange(len(miss))
    by[rows, 2 * walls.sonar] = to[:, 0] * cos + to[:, 1] * sin
    by[rows, 2 * walls.sonar + 1] = -to[:, 0] * sin + to[:, 1] * cos
    by[:, -1] = -read / scale**2
    own = np.where(walls.point[walls.wall][:, None], -to, np.stack([along, -np.ones_like(along)], axis=1))
    return _System(walls.wall, miss, 1 / (1 + (miss / (2 * sigma)) ** 2), by, own, sigma)


def _covariance(
    system: _System, H: Float[ndarray, "n n"], prior: Float[ndarray, "n n"], walls: int
) -> Float[ndarray, "n n"]:
    """What is left open, told by how far walls, not echoes, disagree: echoes of one wall err alike."""
    inverse, cross = system.blocks(walls)
    free = system.by - np.einsum("ei,eij->ej", system.own, (inverse @ cross)[system.wall])
    pull = np.zeros((walls, len(H)))
    np.add.at(pull, system.wall, free * (system.weight * system.miss / system.sigma**2)[:, None])
    covariance = np.linalg.inv(H)
    return covariance @ (pull.T @ pull + prior) @ covariance


def _spread(miss: Float[ndarray, "n"]) -> float:
    return 1.4826 * float(np.median(np.abs(miss))) if len(miss) else 0.0
