"""What of a map a robot may drive on: how far each cell is from what is in the way, and what a metre in it costs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import KDTree

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.grid import FREE_THRESH, OCCUPIED_THRESH, Grid, logit

MARGIN_M = 0.03
"""Kept between the footprint and what is occupied: maps, poses and drives are exact to some centimetres."""

EASY_M, DEAR = 0.1, 1.0
"""Room beside the robot comes to be worth e times less with each so many metres more; with none a metre costs 1 + so
much."""

DEAF_COST = 6.0
"""Of a metre besides where the robot touches something, down to none at the shortest range of its sonars: nearer than
that it hears nothing, and what it has not heard there before, as the far side of a pillar, looks free."""

CORNER = 0.21
"""A corner of a cell is nearer than half a cell less than its middle, by so many cells at most."""

_NEAREST = 16
"""Of so many cells whose middles are near the side that is nearest is looked for."""

UNKNOWN_COST = 30.0
"""Of a metre in which the footprint covers ground that is not known, where such may be driven on."""

MOST_CELLS = 25_000_000
"""Of a map that is planned on; it takes some 50 bytes a cell."""


@dataclass(frozen=True)
class Floor:
    """The part of a map that was observed, with a rim of unknown cells, as a robot of some radius sees it."""

    grid: Grid
    radius_m: float
    """Of the footprint, a disc."""
    margin_m: float = MARGIN_M
    """Kept besides from what is occupied."""
    easy_m: float = EASY_M
    """As EASY_M, of this robot."""
    dear: float = DEAR
    """As DEAR."""
    free_p: float = FREE_THRESH
    """What is occupied with less than this probability counts as free."""
    deaf_m: float = 0.0
    """So far from its footprint it hears nothing; see DEAF_COST."""

    @staticmethod
    def of(
        grid: Grid,
        radius_m: float,
        rim_m: float = 0.0,
        margin_m: float = MARGIN_M,
        easy_m: float = EASY_M,
        dear: float = DEAR,
        free_p: float = FREE_THRESH,
        deaf_m: float = 0.0,
    ) -> "Floor":
        """The floor of a map.

        Args:
            grid: the map.
            radius_m: of the footprint.
            rim_m: how wide the rim of unknown cells is to be, at least.
            margin_m: kept besides from what is occupied.
            easy_m: see ``Floor``.
            dear: likewise.
            free_p: likewise.
            deaf_m: likewise.

        Raises:
            UsageError: the map has no cell that is known to be free, or too many cells.
        """
        part = grid.observed_part()
        if part is None or not np.any(part.observed & (part.probability() < FREE_THRESH)):
            raise UsageError(f"plan: found a map without free cells, expected cells of p < {FREE_THRESH}")
        if part.log_odds.size > MOST_CELLS:
            found = f"{part.log_odds.size} cells"
            raise UsageError(f"plan: found a map of {found}, expected at most {MOST_CELLS:.2g}; make them larger")
        rim = 1 + int(np.ceil(rim_m / grid.resolution))
        rimmed = part.part(np.array([-rim, -rim]), (part.shape[0] + 2 * rim, part.shape[1] + 2 * rim))
        return Floor(rimmed, radius_m, margin_m, easy_m, dear, free_p, deaf_m)

    def daring(self, free_p: float, margin_m: float | None = None) -> "Floor":
        """Likewise, but that what is occupied with less than another probability counts as free.

        Args:
            free_p: that.
            margin_m: kept besides from what is occupied; None: as here.
        """
        other = replace(self, free_p=free_p, margin_m=self.margin_m if margin_m is None else margin_m)
        # What is occupied is the same, and takes long: where it was worked out, it is kept as cached properties are.
        other.__dict__.update({name: self.__dict__[name] for name in ("occupied", "gap_m") if name in self.__dict__})
        return other

    @cached_property
    def occupied(self) -> Bool[ndarray, "rows cols"]:
        """Cells that were observed and have p > OCCUPIED_THRESH."""
        return self.above(OCCUPIED_THRESH)

    def above(self, p: float) -> Bool[ndarray, "rows cols"]:
        """Cells that were observed and are occupied with more than a probability."""
        return self.grid.observed & (self.grid.log_odds > logit(p))

    @cached_property
    def free(self) -> Bool[ndarray, "rows cols"]:
        """Cells that were observed and have p < free_p; what is neither free nor occupied is unknown."""
        return self.grid.observed & (self.grid.log_odds < logit(self.free_p))

    @cached_property
    def gap_m(self) -> Float32[ndarray, "rows cols"]:
        """From the middle of each cell to the nearest side of one that is occupied, m; 0 in one, inf without any."""
        return gap(self.occupied, self.grid.resolution)

    @cached_property
    def known_m(self) -> Float32[ndarray, "rows cols"]:
        """Likewise to the nearest cell that is not known to be free."""
        return gap(~self.free, self.grid.resolution)

    @cached_property
    def walls(self) -> "Sides":
        """The sides of what is occupied."""
        return Sides(self.grid, self.occupied)

    @property
    def body_m(self) -> float:
        """What the robot's middle keeps from what is in its way, m."""
        return self.radius_m + self.margin_m

    def short_m(self, cells: Int[ndarray, "n 2"], deaf_m: float) -> Float[ndarray, "n"]:
        """How much too near to what is not known to be free the robot is in cells to hear it, m.

        Args:
            cells: [row, col].
            deaf_m: so far from its footprint it hears nothing.
        """
        return np.maximum(self.radius_m + deaf_m - self.known_m[tuple(cells.T)], 0)

    @cached_property
    def known_costs(self) -> Float32[ndarray, "rows cols"]:
        """``costs`` where what is unknown is closed."""
        return self.costs()

    def costs(self, unknown: bool = False) -> Float32[ndarray, "rows cols"]:
        """What a metre costs the robot's middle in each cell; inf where it cannot be.

        It keeps its footprint and MARGIN_M from all that is occupied, and the footprint from what is unknown; the
        less room is beside it, the dearer.

        Args:
            unknown: whether the footprint may cover what is unknown, at UNKNOWN_COST a metre.
        """
        costs = np.full(self.grid.shape, np.inf, np.float32)
        known = self.known_m >= self.radius_m
        if unknown:
            costs[~known] = UNKNOWN_COST
        clear = self.gap_m >= self.body_m
        costs[~clear] = np.inf
        open_ = known & clear
        beside = np.minimum(
            self.gap_m[open_] - np.float32(self.body_m), self.known_m[open_] - np.float32(self.radius_m)
        )
        each = 1 + np.float32(self.dear) * np.exp(-np.maximum(beside, 0) / np.float32(self.easy_m))
        if self.deaf_m:
            each += np.float32(DEAF_COST) * np.clip(1 - beside / np.float32(self.deaf_m), 0, 1)
        costs[open_] = each
        return costs

    def cell(self, p_map: Float[ndarray, "2"] | Sequence[float]) -> tuple[int, int] | None:
        """The cell [row, col] that holds a point, m; None outside."""
        row, col = self.grid.index_of(np.asarray(p_map, float)).tolist()
        rows, cols = self.grid.shape
        return (row, col) if 0 <= row < rows and 0 <= col < cols else None

    def nearest(self, among: Bool[ndarray, "rows cols"], p_map: Float[ndarray, "2"]) -> tuple[int, int] | None:
        """Of some cells the one whose middle is nearest to a point, m; None of none."""
        cells: Int[ndarray, "n 2"] = np.argwhere(among)
        if not len(cells):
            return None
        row, col = cells[np.argmin(np.linalg.norm(self.grid.centre_of(cells) - p_map, axis=1))].tolist()
        return row, col

    def standing(
        self, costs: Float32[ndarray, "rows cols"], p_map: Float[ndarray, "2"]
    ) -> tuple[tuple[int, int] | None, float]:
        """The cell [row, col] in which the robot can stand nearest to a point, and how far its middle is off, m.

        It is 0 in the point's own cell; None and inf if there is none.

        Args:
            costs: as of ``costs``.
            p_map: the point, m.
        """
        open_ = np.isfinite(costs)
        cell = self.cell(p_map)
        if cell is not None and open_[cell]:
            return cell, 0.0
        near = self.nearest(open_, p_map)
        return near, np.inf if near is None else float(np.linalg.norm(self.grid.centre_of(np.array(near)) - p_map))


class Sides:
    """The sides of some cells of a grid, to be near to."""

    def __init__(self, grid: Grid, cells: Bool[ndarray, "rows cols"]) -> None:
        self._grid, self._cells = grid, cells
        self._middles = grid.centre_of(np.argwhere(cells & ~ndimage.binary_erosion(cells)))
        self._tree = KDTree(self._middles)

    def room_m(self, points: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
        """From points (m) to the nearest of them, m, exactly; 0 in a cell, inf of none."""
        if not len(self._middles):
            return np.full(len(points), np.inf)
        _, near = self._tree.query(points, k=list(range(1, 1 + min(_NEAREST, len(self._middles)))))
        off = np.maximum(np.abs(points[:, None] - self._middles[near]) - self._grid.resolution / 2, 0)
        inside = self._cells[tuple(self._grid.index_of(points).T)]
        return np.where(inside, 0.0, np.min(np.hypot(*np.moveaxis(off, -1, 0)), axis=1))


def gap(cells: Bool[ndarray, "rows cols"], resolution: float) -> Float32[ndarray, "rows cols"]:
    """From the middle of each cell to the nearest of some, m: half a cell less than between their middles."""
    return np.maximum(_core.distance(cells) - np.float32(0.5), 0) * np.float32(resolution)


def swept(cells: Bool[ndarray, "rows cols"], radius_m: float, resolution: float) -> Bool[ndarray, "rows cols"]:
    """Where ``gap`` is less than a radius (m): for one of some cells several times faster than by ``gap``."""
    rows, cols = cells.shape
    by = int(radius_m / resolution + 1.5)
    off = np.arange(by + 1)
    apart = np.hypot(off[:, None], off).astype(np.float32)
    near = np.maximum(apart - np.float32(0.5), 0) * np.float32(resolution) < radius_m
    found = np.zeros_like(cells)
    rimmed = np.pad(cells, by)
    widths = np.count_nonzero(near, axis=1)
    for width in np.unique(widths[widths > 0]).tolist():  # its rows, from the middle on, that are equally wide
        wide = spread(rimmed, width - 1, 1)[:, by : by + cols]
        for aside in off[widths == width]:
            found |= wide[by + aside : by + aside + rows]
            found |= wide[by - aside : by - aside + rows]
    return found


def spread(cells: Bool[ndarray, "rows cols"], by: int, axis: int) -> Bool[ndarray, "rows cols"]:
    """Cells within some of a marked one along an axis."""
    grown = np.pad(cells, [(by, by) if each == axis else (0, 0) for each in range(2)])
    along = np.moveaxis(grown, axis, 0)
    span, size = 1, 2 * by + 1
    while span < size:  # of a window that is twice as long each time
        step = min(span, size - span)
        along[:-step] |= along[step:]
        span += step
    return np.moveaxis(along[: cells.shape[axis]], 0, axis)
