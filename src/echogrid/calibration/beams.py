"""Which way the sonars look, and how wide they hear: how walls are heard, by their bearing.

A wall that stands before a sonar is heard at its distance within the beam; outside a smooth one is not heard, a rough
one from the beam's edge, and so a little too far away. However that goes on, it is alike to both sides of the axis
and for all sonars of an array: the axis of each is where its readings are likeliest by those of all the others.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.optimize import minimize

from echogrid.calibration.places import spread_at
from echogrid.calibration.readings import Readings
from echogrid.calibration.walls import Walls
from echogrid.geometry import compose, wrap

ASIDE_RAD, NEAREST_M = np.deg2rad(60.0), 0.1
"""Walls farther off the axis, or nearer, are not looked at."""

SEEN_FRAMES = 6
"""From where no sonar hears a wall so many frames before or after, something may hide it."""

GRID_RAD = np.deg2rad(np.arange(-24.0, 24.01, 0.5))
"""How far off the axis may be."""

YAW_RAD = np.deg2rad(6.0)
"""How far it may be off before a log is looked at: a standard deviation."""

LEAST_CHANCES = 30
"""Of fewer walls before it a sonar's axis is left as it was given."""

KINDS = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
"""Readings are told apart by how much longer they are than the wall is far, in spreads; beyond, no echo of it."""

BIN_RAD, FEW = np.deg2rad(1.5), 2.0
"""Steps off the axis in which readings are counted; so many beside those counted are taken to be of any kind."""

ODD = 0.1
"""Share of readings that may be of any kind wherever the wall is: not all walls are what they seem."""

ALIKE = 0.15
"""How far two readings of one wall by one sonar at one bearing err alike (correlation)."""

LEAST_MISS_M = 1e-3
"""Echoes are taken to be so far off their walls at least (standard deviation at 1 m)."""

ROUNDS = 4


class Chances(NamedTuple):
    """Walls that sonars could have heard."""

    sonar: Int[ndarray, "chances"]
    wall: Int[ndarray, "chances"]
    bearing: Float[ndarray, "chances"]
    """Of the wall on the robot, rad."""
    miss: Float[ndarray, "chances"]
    """How much longer the reading is, in spreads at that distance; inf without an echo."""

    @property
    def heard(self) -> ndarray:
        """Whether the reading is the wall's distance."""
        return self.miss < KINDS[0]


@dataclass(frozen=True)
class Beams:
    """What a log says of axes and beam."""

    yaw: Float[ndarray, "sonars"]
    """On the robot, rad."""
    yaw_sd: Float[ndarray, "sonars"]
    """Standard deviation, rad."""
    told: Float[ndarray, "sonars grid"]
    """Log-likelihood of each axis at GRID_RAD from the one found."""
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


def chances(
    readings: Readings, mounts: Float[ndarray, "sonars 3"], scale: float, walls: Walls, miss_m: float
) -> Chances:
    """Every wall that stood before a sonar, heard or not; not those before which something else was heard.

    Args:
        readings: of the drive.
        mounts: m, m, rad.
        scale: of the ranges.
        walls: of the drive.
        miss_m: how far echoes at 1 m are off their walls, m (standard deviation).
    """
    out, fresh = [np.zeros((4, 0))], readings.fresh & ~np.isnan(readings.ranges)
    sonars, near = compose(readings.poses, mounts), walls.near(len(readings.poses), SEEN_FRAMES)
    for first, last, which in walls.parts():
        many = np.meshgrid(np.arange(first, last), np.arange(readings.sonars), which, indexing="ij")
        f, s, w = (each.ravel() for each in many)
        distance, to, along = walls.seen(w, sonars[f, s, :2])
        bearing = wrap(np.arctan2(to[:, 1], to[:, 0]) - readings.poses[f, s, 2])
        spread = max(miss_m, LEAST_MISS_M) * spread_at(np.maximum(distance, 0.0))
        miss = (readings.ranges[f, s] / scale - distance) / spread
        ok = walls.faces(w, along) & near[w, f]
        ok &= (distance > NEAREST_M) & fresh[f, s] & (miss > -3)
        ok &= np.abs(wrap(bearing - mounts[s, 2])) < ASIDE_RAD
        out.append(np.stack([each[ok] for each in (s, w, bearing, miss)]))
    s, w, bearing, miss = np.concatenate(out, axis=1)
    return Chances(s.astype(int), w.astype(int), bearing, miss)


def fit(found: Chances, given: Float[ndarray, "sonars"], yaw: Float[ndarray, "sonars"], half: float) -> Beams:
    """Axes and beam that agree best with what was heard.

    Args:
        found: walls that were before the sonars.
        given: axes as they were said to be before the log, rad, within YAW_RAD.
        yaw: where to begin, rad.
        half: half the beam's width to begin with, rad.
    """
    yaw, n = yaw.copy(), len(yaw)
    sd, told = np.full(n, YAW_RAD), np.zeros((n, len(GRID_RAD)))
    kind = np.searchsorted(KINDS, found.miss)
    weight = _weights(found)
    mine = [np.flatnonzero(found.sonar == sonar) for sonar in range(n)]
    for _ in range(ROUNDS):
        counts = np.array([
            _counted(wrap(found.bearing[i] - yaw[s]), kind[i], weight[i]) for s, i in enumerate(mine)
        ])  # fmt: skip
        total, before = counts.sum(axis=0), yaw.copy()
        for s, i in enumerate(mine):
            if len(i) < LEAST_CHANCES:
                continue
            # By what the others hear: what a sonar has heard itself would bid it stay where it is.
            table = _likelihoods(total - counts[s])
            off = wrap(found.bearing[i] - before[s])
            told[s], aside, own_sd = _axis(off, kind[i], weight[i], found.wall[i], table)
            # The log's word and what was said before, each by its weight.
            share = YAW_RAD**2 / (YAW_RAD**2 + own_sd**2)
            yaw[s] = wrap(given[s] + share * wrap(before[s] + aside - given[s]))
            sd[s] = np.sqrt(YAW_RAD**2 * (1 - share))
        if np.abs(wrap(yaw - before)).max() < np.deg2rad(0.05):
            break
    numbers, half_sd = _beam(found, wrap(found.bearing - yaw[found.sonar]), weight, half)
    return Beams(yaw, sd, told, numbers[0], half_sd, *numbers[1:])


def _weights(found: Chances) -> Float[ndarray, "chances"]:
    """What each reading counts: of many of one wall by one sonar at one bearing each says less."""
    bins = np.floor(found.bearing / BIN_RAD).astype(int)
    keys = np.stack([found.sonar, found.wall, bins])
    _, of, count = np.unique(keys, axis=1, return_inverse=True, return_counts=True)
    return 1 / (1 + ALIKE * (count[np.ravel(of)] - 1))


_BINS, _KINDS = int(np.ceil((ASIDE_RAD + GRID_RAD[-1] + YAW_RAD) / BIN_RAD)) + 2, len(KINDS) + 1


def _between(off: Float[ndarray, "*n"]) -> tuple[Int[ndarray, "*n"], Float[ndarray, "*n"]]:
    """The bin below an angle off the axis, and how far it is on to the next."""
    at = np.minimum(np.abs(off) / BIN_RAD, _BINS - 1.001)
    low = at.astype(int)
    return low, at - low


def _counted(off: Float[ndarray, "n"], kind: Int[ndarray, "n"], weight: Float[ndarray, "n"]) -> ndarray:
    """How many readings of each kind there were, by how far off the axis the wall was; alike to both sides."""
    low, on = _between(off)
    out = np.bincount(low * _KINDS + kind, weight * (1 - on), _BINS * _KINDS)
    return (out + np.bincount((low + 1) * _KINDS + kind, weight * on, _BINS * _KINDS)).reshape(_BINS, _KINDS)


def _likelihoods(counts: ndarray) -> ndarray:
    """Log-likelihood of each kind in each bin."""
    base = counts.sum(axis=0) + 1.0
    base /= base.sum()
    smooth = counts + FEW * base
    return np.log((1 - ODD) * smooth / smooth.sum(axis=1, keepdims=True) + ODD * base)


def _axis(
    off: ndarray, kind: ndarray, weight: ndarray, wall: ndarray, table: ndarray
) -> tuple[ndarray, float, float]:
    """Log-likelihood of axes at GRID_RAD from where they were; the likeliest, its standard deviation (rad)."""
    kinds, wall = np.unique(wall, return_inverse=True)
    # Readings whose bearings lie within half a step of the grid count as one.
    place = np.rint(off / _FINE_RAD).astype(int) - _FIRST
    count = np.bincount(place * _KINDS + kind, weight, _PLACES * _KINDS).reshape(_PLACES, _KINDS)
    some = np.flatnonzero(count.any(axis=1))
    low, on = _between((some + _FIRST) * _FINE_RAD - GRID_RAD[:, None])
    rows = table[low] * (1 - on)[..., None] + table[low + 1] * on[..., None]
    told = np.einsum("gok,ok->g", rows, count[some])
    # A sum of steps is rough: it is looked at as a whole, over some degrees round its top.
    top = float(GRID_RAD[int(np.argmax(np.convolve(told, np.ones(3) / 3, "same")[1:-1])) + 1])

    def by_wall(aside: float) -> Float[ndarray, "walls"]:
        low, on = _between(off - aside)
        return np.bincount(wall, weight * (table[low, kind] * (1 - on) + table[low + 1, kind] * on), len(kinds))

    more, sd = _peak(np.array([by_wall(top + aside) for aside in _AROUND]))
    return told - told.max(), top + more, sd


_FINE_RAD = GRID_RAD[1] - GRID_RAD[0]
_FIRST, _PLACES = -int(np.pi / _FINE_RAD) - 1, 2 * int(np.pi / _FINE_RAD) + 3

_AROUND = np.deg2rad([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0])


def _peak(curves: Float[ndarray, "around walls"]) -> tuple[float, float]:
    """Where the sum of log-likelihoods of all walls, given around its peak, is highest, and its standard deviation.

    Readings of one wall err alike: how far walls disagree tells the spread. Inf where there is no peak.
    """
    bend, slopes, _ = np.polyfit(_AROUND, curves, 2)
    if bend.sum() >= 0:
        return 0.0, np.inf
    off = float(np.clip(-slopes.sum() / (2 * bend.sum()), _AROUND[0], _AROUND[-1]))
    pulls = slopes + 2 * bend * off
    return off, float(np.sqrt(np.sum(pulls**2) - 2 * bend.sum()) / (-2 * bend.sum()))


_Numbers = tuple[float, float, float, float]


def _share(off: ndarray, numbers: _Numbers) -> ndarray:
    half, soft, heard, chance = numbers
    return chance + (heard - chance) / (1 + np.exp(np.clip((np.abs(off) - half) / soft, -50, 50)))


def _beam(
    found: Chances, off: Float[ndarray, "n"], weight: Float[ndarray, "n"], half: float
) -> tuple[_Numbers, float]:
    """The beam that makes what was heard likeliest, and the standard deviation of its half width, rad."""

    def numbers(z: ndarray) -> _Numbers:
        return float(abs(z[0])), float(np.exp(z[1])), float(1 / (1 + np.exp(-z[2]))), float(1 / (1 + np.exp(-z[3])))

    def told(z: ndarray) -> Float[ndarray, "n"]:
        share = np.clip(_share(off, numbers(z)), 1e-4, 1 - 1e-4)
        return weight * np.where(found.heard, np.log(share), np.log1p(-share))

    z = np.array([half, np.log(np.deg2rad(2.0)), 1.1, -3.0])
    simplex = z + np.vstack([np.zeros(4), np.diag([0.02, 0.2, 0.3, 0.3])])
    options = {"maxiter": 200, "xatol": 1e-4, "fatol": 0.05, "initial_simplex": simplex}
    best = np.clip(minimize(lambda z: -float(told(z).sum()), z, method="Nelder-Mead", options=options).x, -6, 6)
    around = best + np.outer(_AROUND, [1, 0, 0, 0])
    curves = np.array([np.bincount(found.wall, told(z), int(found.wall.max()) + 1) for z in around])
    return numbers(best), _peak(curves)[1]
