"""What a piece of a drive saw, laid onto a map: where it fits, and how surely."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid._core import PoseScorer

SURE = 0.95
"""2 p - 1 of a map is believed no farther than this: one wrong cell must not forbid a pose."""

KNOWN, POINT = 0.2, 0.3
"""|2 p - 1| from which a cell of a map counts as known, and from which one of a piece is a point of it."""

FULL_CELLS = 400
"""Surface cells of a piece that is worth full belief; one with fewer is worth less in proportion."""

SHARPNESS = 100.0
"""Log-likelihood that one unit of mean agreement is worth: neighbouring cells say the same, so it is far less than
their number. With it the spread over poses is that of matches at true poses."""

FAIR = 0.9
"""Share of the agreement met on known ground that new ground is taken to have: at 0 a piece would rather slide back
over what the map knows."""

STEPS = np.array([[0.15, 0.15, np.deg2rad(3.0)], [0.08, 0.08, np.deg2rad(2.0)]])
MOST_STEPS = np.array([[41, 41, 25], [25, 25, 25]])
"""How far apart (m, m, rad) the poses of the first two levels of a wide search are, unless there were more of them
along an axis than the last."""

FEWER, COARSE = 3, 3
"""On these one point of so many is laid onto the map; on the first it is in cells of so many."""

LEAST_SPREAD = np.array([0.06, 0.06, np.deg2rad(4.0)])
"""Of the guess, m, m, rad: never is less than some multiples of it looked at."""

WINDOW = 2.5
"""Standard deviations of the guess to each side that are looked at."""

FLOOR = np.array([0.015, 0.015, np.deg2rad(2.5)])
"""Standard deviations, m, m, rad, that no match undercuts: mirror walls look turned in the same way for metres."""

TURNED = 1.5
"""What the spread of the heading is multiplied with, for the same reason."""

ROUND_M = 0.6
"""Poses no farther from the best are taken to be the same place."""

_COUNTED = 0.05  # sureness of points by which known cells are counted: log(1 + 0.05 k) is nearly proportional to k


class Seen(NamedTuple):
    """Points of a piece as seen from its pose: m, and 2 p - 1 of each."""

    surface: Float[ndarray, "surface 2"]
    surface_a: Float[ndarray, "surface"]
    free: Float[ndarray, "free 2"]
    free_a: Float[ndarray, "free"]
    strength: float
    """How far the piece is to be believed, 0 to 1: by the surfaces that it saw."""


class Field(NamedTuple):
    """2 p - 1 of the cells of a local map; 0 where nothing is known."""

    b: Float[ndarray, "rows cols"]
    origin: tuple[float, float]
    """Lower left corner, m."""
    cell_m: float

    def blocks(self, n: int) -> Float[ndarray, "rows n cols n"]:
        """The cells by blocks of n x n; beyond the last nothing is known."""
        rows, cols = (-(-size // n) for size in self.b.shape)
        whole = np.zeros((rows * n, cols * n))
        whole[: self.b.shape[0], : self.b.shape[1]] = self.b
        return whole.reshape(rows, n, cols, n)


def seen(field: Field, most: int, rng: np.random.Generator) -> Seen:
    """At most so many points of a local map, half of them surface where there is as much."""
    index = np.argwhere(np.abs(field.b) > POINT)
    value = field.b[index[:, 0], index[:, 1]]
    surface, free = np.flatnonzero(value > 0), np.flatnonzero(value < 0)
    strength = min(1.0, len(surface) / FULL_CELLS)
    if len(surface) > most // 2:
        surface = rng.choice(surface, most // 2, replace=False)
    if len(free) > most - len(surface):
        free = rng.choice(free, most - len(surface), replace=False)
    at = ((index[:, ::-1] + 0.5) * field.cell_m + field.origin).astype(np.float32)
    a = value.astype(np.float32)
    return Seen(at[surface], a[surface], at[free], a[free], strength)


class Agreement(NamedTuple):
    """How a piece agrees with a map, for each of some poses."""

    surface: Float[ndarray, "poses"]
    """Sum of log(1 + a b) over surface points, see ``PoseScorer``."""
    free: Float[ndarray, "poses"]
    surface_known: Float[ndarray, "poses"]
    """Surface points on ground that the map knows."""
    free_known: Float[ndarray, "poses"]


class Target:
    """A map that pieces are laid onto."""

    def __init__(self, field: Field):
        self._field = field
        b = field.b.astype(np.float32)
        self._b = PoseScorer(np.clip(b, -SURE, SURE), field.origin, field.cell_m)
        self._known = PoseScorer((np.abs(b) > KNOWN).astype(np.float32), field.origin, field.cell_m)

    @cached_property
    def coarse(self) -> "Target":
        """It in coarse cells; those that hold a surface anywhere are one."""
        field, n = self._field, COARSE
        blocks = field.blocks(n)
        most, least = blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3))
        return Target(Field(np.where(most > KNOWN, most, least), field.origin, n * field.cell_m))

    def agreement(self, what: Seen, poses: Float[ndarray, "poses 3"]) -> Agreement:
        """How what was seen agrees with the map if it was seen from poses (m, m, rad) in its frame."""
        one = np.log1p(_COUNTED)
        counts = (
            self._known.score(points, np.full(len(points), _COUNTED, np.float32), poses) / one
            for points in (what.surface, what.free)
        )
        return Agreement(
            self._b.score(what.surface, what.surface_a, poses), self._b.score(what.free, what.free_a, poses), *counts
        )


class Match(NamedTuple):
    """The pose of a piece in a map's frame, as a Gaussian, less what was held of it before."""

    pose: Float[ndarray, "3"]
    information: Float[ndarray, "3 3"]
    """In the frame of the pose."""
    share: float
    """Of the points that lie on known ground."""
    agreement: float
    """Mean over them; that of a point that agrees with a sure cell is up to log 2."""
    surface_agreement: float
    """Mean over surface points alone: free floor looks alike everywhere."""
    surface_share: float
    """Of surface points that lie on known ground."""
    unique: float
    """What the poses round the best are worth of all on the lattice that was looked at first."""


def match(
    target: Target,
    what: Seen,
    guess: Float[ndarray, "3"],
    covariance: Float[ndarray, "3 3"],
    count: int = 11,
    wide: bool = False,
    at_first: float = FAIR,
) -> Match | None:
    """Lay what was seen onto a map, round a guess.

    The posterior over a lattice of poses is summed up as its mean and covariance, level by level on a narrower
    lattice (Olson, 2009), so that a corridor's long axis comes out as uncertain as it is; then the guess is taken out
    of it again.

    Args:
        target: the map.
        what: was seen.
        guess: pose in the map's frame, m, m, rad.
        covariance: of the guess, in the map's frame.
        count: of poses along an axis of each lattice, at least.
        wide: whether to look on a coarse lattice first, for the guess may be far off.
        at_first: in place of FAIR, on that.

    Returns:
        The match; None where hardly a surface was seen.
    """
    points = len(what.surface) + len(what.free)
    if what.strength < 0.05 or points < 20:
        return None
    fewer = Seen(*(each[::FEWER] for each in what[:4]), what.strength)
    levels = [(target.coarse, fewer), (target, fewer), (target, what)] if wide else [(target, what)] * 2
    spread = np.maximum(np.sqrt(np.diag(covariance)), LEAST_SPREAD)
    prior = np.linalg.inv(covariance + np.diag(LEAST_SPREAD**2 / 4))
    centre, half, usual, unique = guess, WINDOW * spread, None, 1.0
    for level, (ground, some) in enumerate(levels):
        counts = np.full(3, count)
        if some is fewer:
            counts = np.clip(np.ceil(2 * half / STEPS[level]).astype(int) + 1, count, MOST_STEPS[level])
        poses = centre + _lattice(half, counts)
        told = ground.agreement(some, poses)
        sharpness = SHARPNESS * what.strength / (len(some.surface) + len(some.free))
        off = poses - guess
        held = -0.5 * np.einsum("ni,ij,nj->n", off, prior, off)
        agreed = told.surface + told.free
        if usual is None:
            usual = _usual(told, int(np.argmax(agreed * sharpness + held)))
        new = usual[0] * told.surface_known + usual[1] * told.free_known
        posterior = (agreed - (at_first if ground is not target else FAIR) * new) * sharpness + held
        at, mean, found, alike = _summed_up(poses, posterior)
        unique = alike if level == 0 else unique
        step = 2 * half / (counts - 1)
        found += np.diag(step**2 / 12)
        centre, half = mean, np.minimum(half, 3 * np.sqrt(np.diag(found)) + step)
    pose, information = _without(mean, found, guess, prior, spread)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    known = told.surface_known[at] + told.free_known[at]
    surface, _ = _means(told, at)
    return Match(
        pose,
        turn @ information @ turn.T,
        float(known / points),
        float(agreed[at] / max(known, 1)),
        surface,
        float(told.surface_known[at] / max(len(what.surface), 1)),
        unique,
    )


def _lattice(half: Float[ndarray, "3"], counts: Int[ndarray, "3"]) -> Float[ndarray, "poses 3"]:
    """Poses round 0, so far to each side along each axis and so many."""
    axes = [np.linspace(-h, h, n) for h, n in zip(half, counts.tolist(), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _summed_up(
    poses: Float[ndarray, "poses 3"], posterior: Float[ndarray, "poses"]
) -> tuple[int, Float[ndarray, "3"], Float[ndarray, "3 3"], float]:
    """The best of some poses by the logarithm of what they are worth, their mean and covariance, and what those round
    the best are worth.
    """
    at = int(np.argmax(posterior))
    weight = np.exp(posterior - posterior[at])
    weight /= weight.sum()
    mean = weight @ poses
    apart = poses - mean
    near = np.hypot(*(poses - poses[at])[:, :2].T) < ROUND_M
    return at, mean, np.einsum("n,ni,nj->ij", weight, apart, apart), float(weight[near].sum())


def _means(told: Agreement, at: int) -> tuple[float, float]:
    """Mean agreement of surface and of free points on known ground."""
    return (
        float(told.surface[at] / max(told.surface_known[at], 1)),
        float(told.free[at] / max(told.free_known[at], 1)),
    )


def _usual(told: Agreement, at: int) -> tuple[float, float]:
    surface, free = _means(told, at)
    return max(surface, 0.0), max(free, 0.0)


def _without(
    mean: Float[ndarray, "3"],
    found: Float[ndarray, "3 3"],
    guess: Float[ndarray, "3"],
    prior: Float[ndarray, "3 3"],
    spread: Float[ndarray, "3"],
) -> tuple[Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """A posterior less the prior: what the match alone says, and its information with what no match undercuts."""
    told = np.linalg.inv(found) - prior
    values, vectors = np.linalg.eigh((told + told.T) / 2)
    told = (vectors * np.maximum(values, 1e-3)) @ vectors.T
    pose = guess + np.linalg.solve(told, (told + prior) @ (mean - guess))
    if np.any(np.abs(pose - mean) > 3 * spread):  # along an axis of which the match says nothing
        pose = mean
    times = np.array([1.0, 1.0, TURNED])
    return pose, np.linalg.inv(np.linalg.inv(told) * np.outer(times, times) + np.diag(FLOOR**2))
