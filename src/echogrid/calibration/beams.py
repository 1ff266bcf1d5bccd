"""Which way the sonars look, and how wide they hear: how often a wall is heard where it stands, by its bearing.

A wall that stands before a sonar is heard at its distance within the beam, and not outside. Where the share heard
falls to half on both sides are the beam's edges; halfway between them is the axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.optimize import minimize

from echogrid.calibration.readings import Readings
from echogrid.calibration.walls import Walls
from echogrid.geometry import compose, wrap

ASIDE_RAD, NEAREST_M = np.deg2rad(60.0), 0.1
"""Walls farther off the axis, or nearer, are not looked at."""

GRID_RAD = np.deg2rad(np.arange(-24.0, 24.01, 0.5))
"""How far off the axis may be."""

YAW_RAD = np.deg2rad(6.0)
"""How far it may be off before a log is looked at: a standard deviation."""

LEAST_CHANCES = 30
"""Of fewer walls before it a sonar's axis is left as it was given."""


class Chances(NamedTuple):
    """Walls that sonars could have heard."""

    sonar: Int[ndarray, "chances"]
    wall: Int[ndarray, "chances"]
    bearing: Float[ndarray, "chances"]
    """Of the wall on the robot, rad."""
    heard: Bool[ndarray, "chances"]
    """Whether the reading is the wall's distance; else it is longer."""


@dataclass(frozen=True)
class Beams:
    """What a log says of axes and beam."""

    yaw: Float[ndarray, "sonars"]
    """On the robot, rad."""
    yaw_sd: Float[ndarray, "sonars"]
    """Standard deviation, rad."""
    half: float
    """Half the beam's width, rad: off the axis a wall is heard half as often as on it."""
    half_sd: float
    """Standard deviation, rad."""
    soft: float
    """How soft the beam's edge is, rad: over twice that the share falls from 73 to 27 % of what it is on the axis."""
    heard: float
    """Share of the walls on the axis that are heard where they stand."""
    chance: float
    """Share of those far off the axis that seem to be."""

    def share(self, off: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
        """Share of walls heard at so many radians off the axis."""
        return _share(off, (self.half, self.soft, self.heard, self.chance))


_Numbers = tuple[float, float, float, float]


def _share(off: ndarray, numbers: _Numbers) -> ndarray:
    half, soft, heard, chance = numbers
    return chance + (heard - chance) / (1 + np.exp(np.clip((np.abs(off) - half) / soft, -50, 50)))


def _told(heard: ndarray, share: ndarray) -> ndarray:
    """Log-likelihoods."""
    share = np.clip(share, 1e-4, 1 - 1e-4)
    return np.where(heard, np.log(share), np.log1p(-share))


def chances(
    readings: Readings, mounts: Float[ndarray, "sonars 3"], scale: float, walls: Walls, miss_m: float
) -> Chances:
    """Every wall that stood before a sonar, heard or not; not those before which something else was heard.

    Args:
        readings: of the drive.
        mounts: m, m, rad.
        scale: of the ranges.
        walls: of the drive.
        miss_m: how far echoes are off their walls, m (standard deviation).
    """
    out, fresh = [np.zeros((4, 0))], readings.fresh & ~np.isnan(readings.ranges)
    sonars = compose(readings.poses, mounts)
    for first, last, which in walls.parts():
        spread = np.meshgrid(np.arange(first, last), np.arange(readings.sonars), which, indexing="ij")
        f, s, w = (each.ravel() for each in spread)
        distance, to, along = walls.seen(w, sonars[f, s, :2])
        bearing = wrap(np.arctan2(to[:, 1], to[:, 0]) - readings.poses[f, s, 2])
        miss = readings.ranges[f, s] / scale - distance
        ok = walls.faces(w, along)
        ok &= (distance > NEAREST_M) & fresh[f, s] & (miss > -3 * miss_m)
        ok &= np.abs(wrap(bearing - mounts[s, 2])) < ASIDE_RAD
        # A rough wall off the axis is heard at the beam's edge, longer by a share of its distance.
        near = miss < miss_m * (0.3 + 0.6 * distance)
        out.append(np.stack([s[ok], w[ok], bearing[ok], near[ok]]))
    s, w, bearing, heard = np.concatenate(out, axis=1)
    return Chances(s.astype(int), w.astype(int), bearing, heard > 0)


def fit(found: Chances, given: Float[ndarray, "sonars"], yaw: Float[ndarray, "sonars"], half: float) -> Beams:
    """Axes and beam that agree best with what was heard.

    Args:
        found: walls that were before the sonars.
        given: axes as they were said to be before the log, rad, within YAW_RAD.
        yaw: where to begin, rad.
        half: half the beam's width to begin with, rad.
    """
    yaw, sd = yaw.copy(), np.full(len(yaw), YAW_RAD)
    walls = int(found.wall.max(initial=-1)) + 1
    numbers: _Numbers = (half, np.deg2rad(2.0), 0.75, 0.05)
    for _ in range(2):
        numbers = _beam(wrap(found.bearing - yaw[found.sonar]), found.heard, numbers)
        for sonar in range(len(yaw)):
            mine = found.sonar == sonar
            if mine.sum() >= LEAST_CHANCES:
                bearing, heard = found.bearing[mine] - yaw[sonar], found.heard[mine]
                told = _axis(bearing, heard, found.wall[mine], numbers)
                # The log's word and what was said before, each by its weight.
                weight = YAW_RAD**2 / (YAW_RAD**2 + told[1] ** 2)
                yaw[sonar] = wrap(given[sonar] + weight * wrap(yaw[sonar] + told[0] - given[sonar]))
                sd[sonar] = np.sqrt(YAW_RAD**2 * (1 - weight))
    off = wrap(found.bearing - yaw[found.sonar])

    def by_wall(half: float) -> Float[ndarray, "walls"]:
        return np.bincount(found.wall, _told(found.heard, _share(off, (half, *numbers[1:]))), walls)

    _, half_sd = _peak(np.array([by_wall(numbers[0] + d) for d in _AROUND]), _STEP)
    return Beams(yaw, sd, numbers[0], half_sd, *numbers[1:])


_STEP = float(GRID_RAD[1] - GRID_RAD[0])
_AROUND = np.array([-2.0, 0.0, 2.0]) * _STEP


def _peak(curves: Float[ndarray, "three walls"], step: float) -> tuple[float, float]:
    """Where the sum of log-likelihoods of all walls, given around its peak, is highest, and its standard deviation.

    Readings of one wall err alike: how far walls disagree tells the spread. Inf where there is no peak.
    """
    low, middle, high = curves.sum(axis=1)
    bend = (high - 2 * middle + low) / (2 * step) ** 2
    if bend >= 0:
        return 0.0, np.inf
    slopes = (curves[2] - curves[0]) / (4 * step)
    off = float(np.clip(-slopes.sum() / bend, -step, step))
    return off, float(np.sqrt(np.sum(slopes**2) - bend) / -bend)


def _beam(off: Float[ndarray, "n"], heard: Bool[ndarray, "n"], begin: _Numbers) -> _Numbers:
    """The beam that makes what was heard likeliest."""

    def numbers(z: ndarray) -> _Numbers:
        return float(abs(z[0])), float(np.exp(z[1])), float(1 / (1 + np.exp(-z[2]))), float(1 / (1 + np.exp(-z[3])))

    def unlikely(z: ndarray) -> float:
        return -float(np.sum(_told(heard, _share(off, numbers(z)))))

    half, soft, share, chance = begin
    z = np.array([half, np.log(soft), np.log(share / (1 - share)), np.log(chance / (1 - chance))])
    simplex = z + np.vstack([np.zeros(4), np.diag([0.02, 0.2, 0.3, 0.3])])
    options = {"maxiter": 200, "xatol": 1e-4, "fatol": 0.05, "initial_simplex": simplex}
    return numbers(np.clip(minimize(unlikely, z, method="Nelder-Mead", options=options).x, -6, 6))


def _axis(
    off: Float[ndarray, "n"], heard: Bool[ndarray, "n"], wall: Int[ndarray, "n"], numbers: _Numbers
) -> tuple[float, float]:
    """How far an axis is off where it was taken to be, and the standard deviation, rad."""
    kinds, wall = np.unique(wall, return_inverse=True)

    def by_wall(aside: float) -> Float[ndarray, "walls"]:
        return np.bincount(wall, _told(heard, _share(wrap(off - aside), numbers)), len(kinds))

    total = [by_wall(aside).sum() for aside in GRID_RAD]
    top = float(GRID_RAD[int(np.argmax(total))])
    more, sd = _peak(np.array([by_wall(top + aside) for aside in _AROUND]), _STEP)
    return top + more, sd


def likelihood(found: Chances, beams: Beams, sonar: int) -> Callable[[Float[ndarray, "n"]], Float[ndarray, "n"]]:
    """How likely each axis (rad off the one found) makes what a sonar heard; 1 at the likeliest."""
    mine = found.sonar == sonar
    off, numbers = found.bearing[mine] - beams.yaw[sonar], (beams.half, beams.soft, beams.heard, beams.chance)

    def at(aside: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
        told = np.array([np.sum(_told(found.heard[mine], _share(wrap(off - a), numbers))) for a in aside])
        return np.exp(told - told.max(initial=-np.inf))

    return at
