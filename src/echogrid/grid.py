"""The occupancy grid in log-odds: index <-> metre, growth, fusion by Bayes' rule, refinement by a mask."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError

P_MIN, P_MAX = 0.02, 0.98
"""Read-out limits of a fused probability: no number of views makes a cell more certain than this."""

MAX_CELLS = 400_000_000
"""A map beyond this (1.6 GB of log-odds) is a broken pose, not a building."""


def logit(p: Float[ndarray, "*n"] | float) -> Float[ndarray, "*n"]:
    """Log-odds of a probability."""
    p = np.asarray(p)
    return np.asarray(np.log(p) - np.log1p(-p))


def sigmoid(log_odds: Float[ndarray, "*n"] | float) -> Float[ndarray, "*n"]:
    """Probability of log-odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * np.asarray(log_odds))))


@dataclass(frozen=True)
class Grid:
    """An occupancy grid. Arrays are indexed ``[row, col]``; row 0 is the lowest y, col 0 the lowest x."""

    log_odds: Float[ndarray, "rows cols"]
    """Sum of the evidence of all views, float32; 0 = the prior probability 0.5."""
    observed: Bool[ndarray, "rows cols"]
    """True where at least one view spoke of the cell."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """World x, y of the lower left corner of cell [0, 0], m."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.log_odds.shape
        return rows, cols

    def probability(self) -> Float[ndarray, "rows cols"]:
        """Occupancy probability of each cell, clamped to [P_MIN, P_MAX]; 0.5 where nothing is known."""
        return np.clip(sigmoid(self.log_odds), P_MIN, P_MAX)

    def index_of(self, p_world: Float[ndarray, "*n 2"]) -> Int[ndarray, "*n 2"]:
        """Cell ``[row, col]`` that holds each world point (m); it may lie outside the grid."""
        # A point on the border of two cells belongs to the upper one, whatever rounding makes of it.
        xy = np.floor((np.asarray(p_world, dtype=float) - self.origin) / self.resolution + 1e-9)
        return xy[..., ::-1].astype(np.int64)

    def centre_of(self, index: Int[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """World point (m) at the centre of each cell ``[row, col]``."""
        return (np.asarray(index)[..., ::-1] + 0.5) * self.resolution + self.origin

    def probability_at(self, p_world: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n"]:
        """Occupancy probability of the cell that holds each world point (m); 0.5 outside the grid."""
        row, col = np.moveaxis(self.index_of(p_world), -1, 0)
        if not self.log_odds.size:
            return np.full(row.shape, 0.5)
        rows, cols = self.shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
        p = self.probability()[np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)]
        return np.where(inside, p, 0.5)

    def refined(self) -> "Grid":
        """The final refinement by a 3x3 neighbourhood mask of the paper's earlier system.

        A cell with three or more of its eight neighbours above 0.5 becomes occupied (at least as certain as
        their mean); an occupied cell with at most one such neighbour is returned to the prior. Unobserved
        cells stay as they are. The mask of the source is lost; this one is ours (physics notes, section 8).
        """
        padded = np.pad(self.log_odds, 1)
        rows, cols = self.shape
        shifts = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
        around = np.stack([padded[i : i + rows, j : j + cols] for i, j in shifts])
        votes = np.sum(around > 0, axis=0)
        mean = np.sum(np.where(around > 0, around, 0), axis=0) / np.maximum(votes, 1)
        filled = np.where(votes >= 3, np.maximum(self.log_odds, mean), self.log_odds)
        cleared = np.where((votes <= 1) & (self.log_odds > 0), 0.0, filled)
        log_odds = np.where(self.observed, cleared, self.log_odds).astype(np.float32)
        return Grid(log_odds, self.observed, self.resolution, self.origin)


class GrowingGrid:
    """The global map while it is built: takes patches of evidence anywhere, grows to hold them.

    Cells lie on the multiples of the resolution, so that two maps of one place share their cells. Evidence
    is added unclamped, which makes the result independent of the order of the views.
    """

    _MARGIN = 64

    def __init__(self, resolution: float):
        self.resolution = resolution
        self._first = np.zeros(2, dtype=np.int64)
        self._log_odds = np.zeros((0, 0), dtype=np.float32)
        self._observed = np.zeros((0, 0), dtype=bool)
        self._low = np.full(2, np.iinfo(np.int64).max)
        self._high = np.full(2, np.iinfo(np.int64).min)

    def reserve(self, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> None:
        """Make room for the cells ``low <= [row, col] < high``, counted from the world's origin.

        Raises:
            UsageError: the map would pass MAX_CELLS.
        """
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)
        last = self._first + self._log_odds.shape
        if self._log_odds.size and np.all(low >= self._first) and np.all(high <= last):
            return
        if not self._log_odds.size:
            self._first, last = np.asarray(low), np.asarray(high)
        grown_first = np.where(low < self._first, low - self._MARGIN, self._first)
        grown_last = np.where(high > last, high + self._MARGIN, last)
        shape = grown_last - grown_first
        if float(shape[0]) * float(shape[1]) > MAX_CELLS:
            span = (self._high - self._low) * self.resolution
            raise UsageError(
                f"map: found a drive that spans {span[1]:.6g} x {span[0]:.6g} m at {self.resolution} m a cell, "
                f"expected at most {MAX_CELLS:.0e} cells (a broken pose, or a coarser --resolution is needed)"
            )
        offset = self._first - grown_first
        old = tuple(slice(o, o + n) for o, n in zip(offset, self._log_odds.shape, strict=True))
        log_odds, observed = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool)
        log_odds[old], observed[old] = self._log_odds, self._observed
        self._first, self._log_odds, self._observed = grown_first, log_odds, observed

    def fuse(
        self,
        corner: Int[ndarray, "2"],
        evidence: Float[ndarray, "rows cols"],
        spoken: Bool[ndarray, "rows cols"],
    ) -> None:
        """Add one view by Bayes' rule in log-odds.

        Args:
            corner: cell [row, col] of the patch's first cell, counted from the world's origin; the patch
                must lie inside what was reserved.
            evidence: log-odds to add, 0 where the view says nothing.
            spoken: where the view said something.
        """
        row, col = corner - self._first
        window = np.s_[row : row + evidence.shape[0], col : col + evidence.shape[1]]
        self._log_odds[window] += evidence
        self._observed[window] |= spoken

    def grid(self) -> Grid:
        """The part of the map that has been reserved so far, as views of the arrays (not copies)."""
        if not self._log_odds.size:
            return Grid(self._log_odds, self._observed, self.resolution, (0.0, 0.0))
        low, high = self._low - self._first, self._high - self._first
        window = np.s_[low[0] : high[0], low[1] : high[1]]
        origin = self._low[::-1] * self.resolution
        return Grid(
            self._log_odds[window],
            self._observed[window],
            self.resolution,
            (float(origin[0]), float(origin[1])),
        )
