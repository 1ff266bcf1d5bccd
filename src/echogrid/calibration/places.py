"""Where the sonars sit, and the scale of the ranges: what makes all echoes touch the walls best.

Walls are fitted together with the places (Gauss-Newton; the three numbers of each wall are eliminated). Echoes off
the axis are weaker, and a weak echo is read late: by a share of the distance that grows from the axis outward, alike
to both sides, and is fitted too. Left out, it passes for places aside and for a scale.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import sparse

from echogrid.calibration.readings import Readings
from echogrid.calibration.walls import Walls
from echogrid.geometry import compose, wrap

PLACE_M, SCALE, LATE, RADIUS_M = 0.03, 0.04, 0.01, 0.05
"""How far a place and the scale may be off before a log is looked at, how late echoes at the beam's edge are (a share
of the distance), and how round points are: standard deviations."""

OUTWARD_M = 0.001
"""How far out along their axes the sonars sit in the mean is left as it was given (standard deviation), for no log
tells: if all sat farther out, all walls would lie farther out. An offset of all ranges does the same."""

ROUNDS, LEAST_MISS_M = 6, 0.005


def spread_at(distance: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """How far echoes of a distance (m) miss their walls, beside those of 1 m: the error of a range grows with it."""
    return 0.4 + 0.6 * distance


@dataclass(frozen=True)
class Places:
    """What a log says of places and scale."""

    mounts: Float[ndarray, "sonars 3"]
    """x, y, m; the axis (rad) as it came."""
    scale: float
    """What the ranges read of a metre."""
    late: Float[ndarray, "2"]
    """By what share of the distance echoes at the beam's edge are read late: the part that grows with the square of
    the angle off the axis, and that with its fourth power."""
    covariance: Float[ndarray, "n n"]
    """Of x and y of each sonar, m, then the scale."""
    walls: Walls
    """As fitted."""
    miss_m: float
    """How far echoes at 1 m are off their walls, m (robust standard deviation)."""

    @property
    def place_sd(self) -> Float[ndarray, "sonars 2"]:
        """Standard deviations of x and y, m."""
        return np.sqrt(np.diag(self.covariance)[:-1]).reshape(-1, 2)

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the scale."""
        return float(np.sqrt(self.covariance[-1, -1]))


class Axes(NamedTuple):
    """What is known of axes and beam while places are fitted."""

    yaw_sd: Float[ndarray, "sonars"]
    """Standard deviation of each axis, rad."""
    half: float
    """Half the beam's width, rad: echoes farther off the axis are not of the wall's nearest point, and left out."""


class _Numbers(NamedTuple):
    mounts: Float[ndarray, "sonars 3"]
    scale: float
    late: Float[ndarray, "2"]
    walls: Walls

    def moved(self, step: Float[ndarray, "n"], walls: Float[ndarray, "walls 3"]) -> "_Numbers":
        n = len(self.mounts)
        aside = np.column_stack([step[: 2 * n].reshape(-1, 2), step[2 * n : 3 * n]])
        place, radius = self.walls.place + walls[:, :2], self.walls.radius + walls[:, 2]
        changed = replace(self.walls, place=place, radius=radius)
        return _Numbers(self.mounts + aside, self.scale + float(step[3 * n]), self.late + step[3 * n + 1 :], changed)

    def off(self, given: Float[ndarray, "sonars 3"]) -> Float[ndarray, "n"]:
        """From what is expected."""
        aside = self.mounts - given
        return np.concatenate([aside[:, :2].ravel(), wrap(aside[:, 2]), [self.scale - 1.0], self.late])


class _System(NamedTuple):
    """Misses, in units of their spread at that distance, and what they depend on, to first order."""

    wall: Int[ndarray, "echoes"]
    miss: Float[ndarray, "echoes"]
    weight: Float[ndarray, "echoes"]
    by: sparse.csr_array
    """By places, axes, scale and lateness, [echoes, n]."""
    own: Float[ndarray, "echoes 3"]
    """By the numbers of the wall."""
    sigma: float

    def blocks(self, walls: int) -> tuple[Float[ndarray, "walls 3 3"], Float[ndarray, "walls 3 n"]]:
        """The inverse of each wall's own block, and how it hangs together with the rest."""
        sums, weighted = self.sums(walls), self.weight[:, None] * self.own
        own = np.stack([sums @ (weighted[:, [i]] * self.own) for i in range(3)], axis=1)
        cross = np.stack([(sums @ self.by.multiply(weighted[:, [i]])).toarray() for i in range(3)], axis=1)
        return np.linalg.inv(own + np.diag([1e-4, 1e-4, self.round])), cross

    def sums(self, walls: int) -> sparse.csr_array:
        """What adds up the echoes of each wall, [walls, echoes]."""
        echoes = np.arange(len(self.wall))
        return sparse.csr_array((np.ones(len(echoes)), (self.wall, echoes)), (walls, len(echoes)))

    @property
    def round(self) -> float:
        """The weight of a radius of 0."""
        return (self.sigma / RADIUS_M) ** 2


def fit(
    readings: Readings,
    mounts: Float[ndarray, "sonars 3"],
    given: Float[ndarray, "sonars 3"],
    walls: Walls,
    scale: float,
    axes: Axes,
) -> Places:
    """Places, scale and walls that agree best with the ranges of the echoes that touch the walls.

    Args:
        readings: of the drive.
        mounts: where to begin, m, m, rad.
        given: what was said of them before the log, within PLACE_M.
        walls: found with these mounts and this scale.
        scale: where to begin.
        axes: how well they are known.
    """
    expected = np.column_stack([given[:, :2], mounts[:, 2]])
    prior, count = _prior(given, axes), len(walls.place)
    now = _Numbers(mounts, scale, np.zeros(2), walls)
    system, H = _system(readings, now, axes.half), prior
    for _ in range(ROUNDS):
        inverse, cross = system.blocks(count)
        c = system.sums(count) @ ((system.weight * system.miss)[:, None] * system.own)
        c[:, 2] += system.round * now.walls.radius
        by, weight = system.by, system.weight[:, None]
        flat = cross.reshape(3 * count, -1)
        own = (inverse @ cross).reshape(3 * count, -1)
        H = ((by.multiply(weight).T @ by).toarray() - flat.T @ own) / system.sigma**2 + prior
        g = by.T @ (system.weight * system.miss) - own.T @ c.ravel()
        step = -np.linalg.solve(H, g / system.sigma**2 + prior @ now.off(expected))
        now = now.moved(step, -np.einsum("wik,wk->wi", inverse, c + cross @ step))
        system = _system(readings, now, axes.half)
    n = len(mounts)
    told = np.r_[: 2 * n, 3 * n]
    covariance = _covariance(system, H, prior, count)[np.ix_(told, told)]
    placed = np.column_stack([now.mounts[:, :2], mounts[:, 2]])
    return Places(placed, now.scale, now.late, covariance, now.walls, _spread(system.miss[system.weight > 0]))


def _prior(given: Float[ndarray, "sonars 3"], axes: Axes) -> Float[ndarray, "n n"]:
    """What is known before: the inverse of the covariance."""
    n = len(given)
    outward = np.stack([np.cos(given[:, 2]), np.sin(given[:, 2])], axis=1).ravel() / n
    outward = np.append(outward, np.zeros(n + 3))
    sd = np.concatenate([np.full(2 * n, PLACE_M), axes.yaw_sd, [SCALE, LATE, LATE]])
    return np.diag(sd**-2.0) + np.outer(outward, outward) / OUTWARD_M**2


def _system(readings: Readings, now: _Numbers, half: float) -> _System:
    walls, mounts, scale = now.walls, now.mounts, now.scale
    poses, read = readings.poses[walls.frame, walls.sonar], readings.ranges[walls.frame, walls.sonar]
    at = compose(poses, mounts[walls.sonar])
    distance, to, along = walls.seen(walls.wall, at[:, :2])
    off = wrap(np.arctan2(to[:, 1], to[:, 0]) - at[:, 2])
    within = np.abs(off) < half
    u = np.minimum((off / half) ** 2, 1.0)
    powers = np.stack([u, u**2], axis=1)
    spread = spread_at(np.maximum(distance, 0.0))
    miss = (read / scale - distance * (1 + powers @ now.late)) / spread
    sigma = max(LEAST_MISS_M, _spread(miss[within]))
    cos, sin, n = np.cos(poses[:, 2]), np.sin(poses[:, 2]), len(mounts)
    values = [
        to[:, 0] * cos + to[:, 1] * sin,
        -to[:, 0] * sin + to[:, 1] * cos,
        distance * (2 * now.late[0] * off + 4 * now.late[1] * off * u) / half**2,
        # Posts and edges send back the less the farther they are, and are read the later: that is no scale.
        np.where(walls.point[walls.wall], 0.0, -read / scale**2),
        -distance * u,
        -distance * u**2,
    ]
    first = 2 * walls.sonar
    columns = [first, first + 1, 2 * n + walls.sonar, *(np.full(len(miss), 3 * n + i) for i in range(3))]
    places = (np.tile(np.arange(len(miss)), 6), np.concatenate(columns))
    by = sparse.csr_array((np.concatenate(values) / np.tile(spread, 6), places), (len(miss), 3 * n + 3))
    point = walls.point[walls.wall]
    own = np.column_stack(
        [np.where(point[:, None], -to, np.stack([along, -np.ones_like(along)], axis=1)), np.where(point, 1.0, 0.0)]
    )
    weight = within / (1 + (miss / (2 * sigma)) ** 2)
    return _System(walls.wall, miss, weight, by, own / spread[:, None], sigma)


def _covariance(
    system: _System, H: Float[ndarray, "n n"], prior: Float[ndarray, "n n"], walls: int
) -> Float[ndarray, "n n"]:
    """What is left open, told by how far walls, not echoes, disagree: echoes of one wall err alike."""
    inverse, cross = system.blocks(walls)
    free = system.by.toarray() - np.squeeze(system.own[:, None] @ (inverse @ cross)[system.wall], axis=1)
    pull = system.sums(walls) @ (free * (system.weight * system.miss / system.sigma**2)[:, None])
    covariance = np.linalg.inv(H)
    return covariance @ (pull.T @ pull + prior) @ covariance


def _spread(miss: Float[ndarray, "n"]) -> float:
    return 1.4826 * float(np.median(np.abs(miss))) if len(miss) else 0.0
