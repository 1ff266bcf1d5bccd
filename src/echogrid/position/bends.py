"""By how much odometry bends a drive: with the right heading bias what was seen along it lies together best."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.geometry import compose, inverse
from echogrid.position.motion import chained, corrected
from echogrid.position.pieces import Piece

BIASES = np.deg2rad(np.linspace(-8, 8, 33))
"""That are tried, rad/m."""

USUAL = np.deg2rad(2.5)
"""Standard deviation of the heading bias of a robot of which nothing is known, rad/m."""

WORTH, MOST_WORTH = 3.0, 100.0
"""Log-likelihood that the pairs of a window are worth, and those of all at most: they are far from independent."""

WINDOW, WINDOWS = 12, 60
"""Pieces whose points are laid together, and how many times along a drive at most."""

CELL_M = 0.12
"""Points in the same cell lie together."""

MOST_POINTS = 100
"""That each piece is to bring at most."""


def heading_bias(
    step: Float[ndarray, "steps 3"], cut: Sequence[Piece], points: Sequence[Float[ndarray, "_ 2"]]
) -> float:
    """The heading bias of odometry, rad/m, that makes surface points of different pieces fall together most often.

    Windows of some metres of the drive are laid together with each bias and the pairs of points of different pieces
    that share a cell are counted; what comes of it is smooth in the bias and has one peak, with walls and without.

    Args:
        step: of the odometry, m, m, rad.
        cut: the pieces of the drive.
        points: surface points that each piece saw, in its own frame, m.
    """
    begins = range(0, max(1, len(cut) - WINDOW), max(WINDOW // 2, len(cut) // WINDOWS))
    middles = [piece.middle for piece in cut]
    pairs = np.zeros(len(BIASES))
    for i, bias in enumerate(BIASES):
        poses = chained(np.zeros(3), corrected(step, np.array([0.0, bias, 0.0])))[middles]
        pairs[i] = sum(sharpness(poses[m : m + WINDOW], points[m : m + WINDOW]) for m in begins)
    if not pairs.any():
        return 0.0
    held = min(WORTH * len(begins), MOST_WORTH) * pairs / pairs.max() - 0.5 * (BIASES / USUAL) ** 2
    weight = np.exp(held - held.max())
    return float(weight @ BIASES / weight.sum())


def sharpness(poses: Float[ndarray, "pieces 3"], points: Sequence[Float[ndarray, "_ 2"]], alike: int = 1) -> float:
    """How well what was seen lies together: pairs of points of different pieces that share a cell.

    Args:
        poses: of the pieces, m, m, rad.
        points: surface points that each saw, in its own frame, m.
        alike: of so many pieces after each other the points are not compared.
    """
    count = [len(own) for own in points]
    if not any(count):
        return 0.0
    piece = np.repeat(np.arange(len(points)), count)
    local = np.concatenate(list(points))
    at = compose(compose(inverse(poses[0]), poses)[piece], np.column_stack([local, np.zeros(len(local))]))[:, :2]
    cell = np.floor(at / CELL_M).astype(np.int64)
    cell -= cell.min(axis=0)
    key = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    group = piece // alike
    both, own = (np.unique(each, return_counts=True)[1] for each in (key, key * (group[-1] + 1) + group))
    return float(np.sum(both.astype(float) ** 2) - np.sum(own.astype(float) ** 2))
