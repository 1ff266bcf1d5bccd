"""The tiles that all maps of a store share, and the whole numbers that their cells hold.

Tiles lie on the multiples of their side from the world's origin. What a cell holds is counted in whole units, so that
sums of many logs are the same whatever the order in which they are added, and taking one out leaves no trace.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Integer
from numpy import ndarray

from echogrid.grid import Layers
from echogrid.models.networks.set_network import SUMS

TILE = 256
"""Cells along the side of a tile: 10 m of the set network's, and an even number, as its squares need."""

LAYERS = (*SUMS, "stood", "views")
"""What is kept of a cell, in this order."""

UNIT = 2.0**-16
"""Of the evidence that is kept; what is not 0 is one unit at least, for it says that a cell was seen."""

Tile = tuple[int, int]
"""Row and column of a tile."""


class Region(NamedTuple):
    """Cells ``low <= [row, col] < high``, counted from the world's origin."""

    low: Int[ndarray, "2"]
    high: Int[ndarray, "2"]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = (int(n) for n in self.high - self.low)
        return rows, cols

    def tiles(self) -> tuple[Int[ndarray, "2"], Int[ndarray, "2"]]:
        """First tile that the cells touch, and that behind the last."""
        return self.low // TILE, -(-self.high // TILE)

    def holds(self, tile: Tile) -> bool:
        """Whether a tile has some of the cells."""
        first, last = self.tiles()
        return bool(np.all(first <= tile) and np.all(np.array(tile) < last))

    def grown(self, cells: int) -> "Region":
        """With so many cells more on each side."""
        return Region(self.low - cells, self.high + cells)

    @staticmethod
    def of(tiles: Iterable[Tile]) -> "Region | None":
        """All cells of tiles; None: of no tile."""
        each = np.array(sorted(tiles), dtype=np.int64).reshape(-1, 2)
        return Region(TILE * each.min(axis=0), TILE * (each.max(axis=0) + 1)) if len(each) else None


def counted(values: Float[ndarray, "*n"]) -> Int[ndarray, "*n"]:
    """Evidence in units."""
    units = np.rint(values * values.dtype.type(1 / UNIT))  # a power of two: exact, whatever the precision
    units[(units == 0) & (values != 0)] = 1
    return units.astype(np.int64)


def cut(corner: Int[ndarray, "2"], cells: Layers) -> Iterator[tuple[Tile, Int[ndarray, "layers side side"]]]:
    """The tiles of a rectangle of cells that hold anything.

    Args:
        corner: its first cell [row, col], counted from the world's origin.
        cells: its layers, see ``LAYERS``.
    """
    region = Region(corner, corner + np.array(cells["views"].shape))
    first, last = region.tiles()
    for row, col in np.ndindex(*(int(n) for n in last - first)):
        tile = first + np.array([row, col])
        low, high = np.maximum(region.low, TILE * tile), np.minimum(region.high, TILE * (tile + 1))
        source, target = (_slices(low - begin, high - begin) for begin in (corner, TILE * tile))
        kept = np.zeros((len(LAYERS), TILE, TILE), dtype=np.int64)
        for i, name in enumerate(LAYERS):
            held = cells[name][source]
            kept[i][target] = held if held.dtype.kind == "i" else counted(held)
        if kept.any():
            yield (int(tile[0]), int(tile[1])), kept


def joined(region: Region, tiles: Iterable[tuple[Tile, Integer[ndarray, "layers side side"]]]) -> Layers:
    """The layers of a rectangle of cells as the set network reads them; cells of no tile are blank."""
    cells: Layers = {
        name: np.zeros(region.shape, dtype=np.int32 if name == "views" else np.float32) for name in LAYERS
    }
    for tile, kept in tiles:
        at = TILE * np.array(tile)
        low, high = np.maximum(region.low, at), np.minimum(region.high, at + TILE)
        if np.any(high <= low):
            continue
        source, target = (_slices(low - begin, high - begin) for begin in (at, region.low))
        for i, name in enumerate(LAYERS):
            held = kept[i][source]
            cells[name][target] = np.minimum(held, np.iinfo(np.int32).max) if name == "views" else held * UNIT
    return cells


def _slices(low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> tuple[slice, slice]:
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
