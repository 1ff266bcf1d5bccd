"""How good a map is: its scores against a grid that says what is really there."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int8
from numpy import ndarray

from echogrid.grid import Grid

FREE, SURFACE, HIDDEN = 0, 1, 2
"""What a cell of a truth grid can hold."""

OCCUPIED_ABOVE, FREE_BELOW = 0.65, 0.35
"""Probabilities past which a map claims a cell to be occupied or free."""

FALSE_DISTANCE_CELLS = 2.0
"""A claimed surface at most this far from a true one is inexact, not false."""

P_FLOOR = 0.001
"""The log-likelihood takes no probability to be nearer to 0 or 1 than this, or one cell would decide it."""

ECE_BINS = 15


@dataclass(frozen=True)
class Truth:
    """What is really there, as far as it can be seen from a path.

    Indexed ``[row, col]``; row 0 is the lowest y, col 0 the lowest x.
    """

    cells: Int8[ndarray, "rows cols"]
    """1 = surface, 0 = free, 2 = hidden (left out of every score)."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """World x, y of the lower left corner of cell [0, 0], m."""


@dataclass(frozen=True)
class Scores:
    """A map against a truth, in the order in which they are shown; nan where there is no cell to count.

    p is the map's probability at the centre of a truth cell, 0.5 outside the map. A neighbourhood is the 3x3
    truth cells round a cell; it takes in hidden cells, and reaches past the truth's border.
    """

    found: float
    """Share of surface cells with p > 0.65 somewhere in their neighbourhood."""
    wiped: float
    """Share of surface cells with p < 0.35 and no p > 0.65 in their neighbourhood: walls to drive into."""
    free: float
    """Share of free cells with p < 0.35."""
    false: float
    """Share with p > 0.65 of the free cells more than 2 cells (Euclid, by centres) from any surface."""
    auc: float
    """Area under the ROC curve, surface against free; a tie counts half."""
    nll: float
    """Mean of the two classes' mean negative log-likelihoods, nat; p clipped to [0.001, 0.999]."""
    brier: float
    """Mean of (p - y)^2 over surface (y = 1) and free (y = 0) cells, each cell with the same weight."""
    ece: float
    """Expected calibration error over the same cells: 15 equal bins of p, each weighted by its cells."""
    surface_cells: int
    """Number of surface cells."""
    free_cells: int
    """Number of free cells."""


def score(grid: Grid, truth: Truth) -> Scores:
    """The scores of a map against a truth; the two may differ in cell size and extent."""
    # scipy takes 0.6 s to import, which only scoring should cost: Truth is used wherever maps are written.
    from scipy.ndimage import maximum_filter

    padded = _sample(grid, truth, border=1)
    p = padded[1:-1, 1:-1]
    surface, free = truth.cells == SURFACE, truth.cells == FREE
    claimed_near = maximum_filter(padded, size=3)[1:-1, 1:-1] > OCCUPIED_ABOVE
    p_surface, p_free = p[surface], p[free]
    p_both = np.concatenate([p_surface, p_free])
    y_both = np.repeat([1.0, 0.0], [p_surface.size, p_free.size])
    return Scores(
        found=_mean(claimed_near[surface]),
        wiped=_mean((p_surface < FREE_BELOW) & ~claimed_near[surface]),
        free=_mean(p_free < FREE_BELOW),
        false=_mean(p[free & _far_from(surface)] > OCCUPIED_ABOVE),
        auc=_roc_area(p_surface, p_free),
        nll=_balanced_nll(p_surface, p_free),
        brier=_mean((p_both - y_both) ** 2),
        ece=_calibration_error(p_both, y_both),
        surface_cells=p_surface.size,
        free_cells=p_free.size,
    )


def _sample(grid: Grid, truth: Truth, border: int) -> Float[ndarray, "rows cols"]:
    """``grid.probability_at`` the centres of the truth's cells and of ``border`` cells beyond, row by column.

    A cell's row depends on y alone and its column on x alone, so two lines of points do for the whole grid.
    """
    rows, cols = truth.cells.shape
    x = truth.origin[0] + (np.arange(-border, cols + border) + 0.5) * truth.resolution
    y = truth.origin[1] + (np.arange(-border, rows + border) + 0.5) * truth.resolution
    row = grid.index_of(np.stack([np.full_like(y, grid.origin[0]), y], axis=-1))[:, 0]
    col = grid.index_of(np.stack([x, np.full_like(x, grid.origin[1])], axis=-1))[:, 1]
    framed = np.pad(grid.probability().astype(float), 1, constant_values=0.5)
    return framed[np.ix_(np.clip(row, -1, grid.shape[0]) + 1, np.clip(col, -1, grid.shape[1]) + 1)]


def _far_from(surface: Bool[ndarray, "rows cols"]) -> Bool[ndarray, "rows cols"]:
    """Cells more than FALSE_DISTANCE_CELLS from any surface; all of them where there is none."""
    from scipy.ndimage import distance_transform_edt

    if not surface.any():
        return np.ones_like(surface)
    return distance_transform_edt(~surface) > FALSE_DISTANCE_CELLS


def _mean(values: ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def _roc_area(p_surface: Float[ndarray, "n"], p_free: Float[ndarray, "m"]) -> float:
    """Chance that a surface cell outranks a free one, by the rank sum of Mann and Whitney (1947)."""
    from scipy.stats import rankdata

    n, m = p_surface.size, p_free.size
    if not n or not m:
        return float("nan")
    ranks = rankdata(np.concatenate([p_surface, p_free]))
    return float((ranks[:n].sum() - n * (n + 1) / 2) / (n * m))


def _balanced_nll(p_surface: Float[ndarray, "n"], p_free: Float[ndarray, "m"]) -> float:
    surface = _mean(-np.log(np.clip(p_surface, P_FLOOR, 1 - P_FLOOR)))
    free = _mean(-np.log1p(-np.clip(p_free, P_FLOOR, 1 - P_FLOOR)))
    return (surface + free) / 2


def _calibration_error(p: Float[ndarray, "n"], y: Float[ndarray, "n"]) -> float:
    """Sum over the bins of n_bin/n |mean y - mean p| (Naeini, Cooper & Hauskrecht 2015)."""
    if not p.size:
        return float("nan")
    bins = np.minimum((p * ECE_BINS).astype(int), ECE_BINS - 1)
    gap = np.bincount(bins, weights=y - p, minlength=ECE_BINS)
    return float(np.sum(np.abs(gap)) / p.size)
