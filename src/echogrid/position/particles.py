"""Particles: many guesses of where a robot is, moved by its odometry and weighed by what it sees."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.geometry import compose, wrap
from echogrid.position.motion import Drift

BIN_M, BIN_RAD = 0.25, np.deg2rad(15.0)
"""Sides of the bins whose number says how many particles are wanted."""

_EPSILON, _QUANTILE = 0.02, 2.33
"""KLD sampling (Fox 2003): the error of the distribution stays below the first with a probability of 0.99."""


class Place(NamedTuple):
    """Where the particles of one heap are."""

    pose: Float[ndarray, "3"]
    """Their mean, m, m, rad."""
    covariance: Float[ndarray, "3 3"]
    """Theirs."""
    share: float
    """Of all weight."""


class Particles:
    """Guesses with weights, which sum to 1."""

    def __init__(self, poses: Float[ndarray, "n 3"], bias: Float[ndarray, "n"]) -> None:
        """Guesses of the same weight.

        Args:
            poses: in the map, m, m, rad.
            bias: by how much the odometry turns too little, rad a metre.
        """
        self.poses, self.bias = poses, bias
        self.weights = np.full(len(poses), 1 / len(poses))

    def __len__(self) -> int:
        return len(self.poses)

    def propagate(
        self, step: Float[ndarray, "3"], way: float, turn: float, drift: Drift, rng: np.random.Generator
    ) -> None:
        """Move on as the odometry says, and as far off it as it may be.

        Args:
            step: the pose seen from the one before, m, m, rad.
            way: length of the way between them, m; back is negative.
            turn: angle turned between them in all, rad.
            drift: how far odometry may be off.
            rng: numpy's.
        """
        n = len(self)
        root_m, root_rad = np.sqrt(abs(way)), np.sqrt(turn)
        off = rng.standard_normal((n, 3))
        heading = np.hypot(np.hypot(drift.heading * root_m, drift.turned * root_rad), drift.still[1])
        heading = np.hypot(heading, drift.turning * turn)
        along = np.hypot(drift.way * root_m, drift.still[0])
        aside = np.hypot(drift.side * root_m, drift.still[0])
        along = np.hypot(along, drift.scale * way)
        turned = self.bias * way + heading * off[:, 2]
        moved = np.empty((n, 3))
        # what is turned too far was turned all along
        cos, sin = np.cos(turned / 2), np.sin(turned / 2)
        moved[:, 0] = cos * step[0] - sin * step[1] + along * off[:, 0]
        moved[:, 1] = sin * step[0] + cos * step[1] + aside * off[:, 1]
        moved[:, 2] = step[2] + turned
        self.poses = compose(self.poses, moved)
        self.bias = self.bias + np.deg2rad(0.15) * root_m * rng.standard_normal(n)

    def joined(self, other: "Particles") -> "Particles":
        """These and others, with the weights that they have."""
        both = Particles(np.concatenate([self.poses, other.poses]), np.concatenate([self.bias, other.bias]))
        both.weights = np.concatenate([self.weights, other.weights])
        return both

    def reweight(self, log_likelihood: Float[ndarray, "n"]) -> None:
        """Weigh by what was seen."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.weights) + log_likelihood
        weights = np.exp(logs - logs.max())
        self.weights = weights / weights.sum()

    def effective(self) -> float:
        """How many particles of the same weight would say as much."""
        return float(1 / np.sum(self.weights**2))

    def resample(self, least: int, most: int, rng: np.random.Generator) -> None:
        """Draw particles anew by their weights, as many as the number of places they are at asks for."""
        n = self.wanted(least, most)
        at = np.minimum(np.searchsorted(np.cumsum(self.weights), (rng.random() + np.arange(n)) / n), len(self) - 1)
        self.poses, self.bias = self.poses[at], self.bias[at]
        self.weights = np.full(n, 1 / n)

    def wanted(self, least: int, most: int) -> int:
        """How many particles stand for where they are."""
        heavy = self.weights > 0.01 / len(self)
        bins = np.floor(self.poses[heavy] / (BIN_M, BIN_M, BIN_RAD)).astype(np.int64)
        k = len(np.unique(bins @ np.array([1 << 32, 1 << 8, 1]))) - 1
        if k < 1:
            return least
        part = 2 / (9 * k)
        n = k / (2 * _EPSILON) * (1 - part + np.sqrt(part) * _QUANTILE) ** 3
        return int(np.clip(n, least, most))

    def keep(self, place: Place, within: tuple[float, float]) -> None:
        """Leave out all but those within so far (m, rad) of a place, where there are any."""
        near = near_to(self.poses, place.pose, within)
        self.poses, self.bias, weights = self.poses[near], self.bias[near], self.weights[near]
        self.weights = weights / weights.sum()

    def about(self, pose: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
        """How all of them are spread about a pose, as a covariance (m, m, rad)."""
        off = self.poses - pose
        off[:, 2] = wrap(off[:, 2])
        return np.einsum("n,ni,nj->ij", self.weights, off, off)

    def place(self, within: tuple[float, float]) -> Place:
        """The heaviest heap: what lies within so far (m, rad) of its middle."""
        return self.places(within, 1, 0.0)[0]

    def places(self, within: tuple[float, float], most: int, least: float) -> list[Place]:
        """Heaps, the heaviest first: at most so many, each of at least so great a share.

        Args:
            within: what lies so far (m, rad) from the middle of a heap belongs to it.
            most: heaps.
            least: share of the weight; the heaviest is there whatever it has.
        """
        found, left = [], self.weights > 0
        while len(found) < most and left.any():
            place, near = _heaviest(self.poses[left], self.weights[left], within)
            if found and place.share < least:
                break
            found.append(place)
            left[np.flatnonzero(left)[near]] = False
        return found


def near_to(
    poses: Float[ndarray, "n 3"], middle: Float[ndarray, "3"], within: tuple[float, float]
) -> Bool[ndarray, "n"]:
    """Which poses lie within so far (m, rad) of one."""
    off = poses - middle
    return (np.hypot(off[:, 0], off[:, 1]) < within[0]) & (np.abs(wrap(off[:, 2])) < within[1])


def _mean(poses: Float[ndarray, "n 3"], weights: Float[ndarray, "n"]) -> Float[ndarray, "3"]:
    w = weights / weights.sum()
    x, y = w @ poses[:, :2]
    return np.array([x, y, np.arctan2(w @ np.sin(poses[:, 2]), w @ np.cos(poses[:, 2]))])


def _heaviest(
    poses: Float[ndarray, "n 3"], w: Float[ndarray, "n"], within: tuple[float, float]
) -> tuple[Place, Bool[ndarray, "n"]]:
    """The heaviest heap of particles, and which of them are of it."""
    bins = np.floor(poses / (2 * BIN_M, 2 * BIN_M, 2 * BIN_RAD)).astype(np.int64) @ np.array([1 << 32, 1 << 8, 1])
    _, which = np.unique(bins, return_inverse=True)
    heaviest = which == np.argmax(np.bincount(which, weights=w))
    middle, near = _mean(poses[heaviest], w[heaviest]), heaviest
    for _ in range(3):
        near = near_to(poses, middle, within)
        if not near.any():  # two heaps whose middle is at neither
            near = heaviest
        middle = _mean(poses[near], w[near])
    off = poses[near] - middle
    off[:, 2] = wrap(off[:, 2])
    share = float(w[near].sum())
    return Place(middle, np.einsum("n,ni,nj->ij", w[near] / share, off, off), share), near
