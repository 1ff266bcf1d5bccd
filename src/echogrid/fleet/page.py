"""The map of a store, of any size, as a page to explore: ``map.html``, and beside it a pyramid of pictures.

``map_tiles/LEVEL/ROW_COL.png`` is a tile; of level 0 the store's own, counted from the lowest of the map, each of a
higher level four of the level below. A pixel is as occupied as the most occupied of its cells.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from echogrid.files import replacing
from echogrid.fleet.lattice import TILE, Region, Tile
from echogrid.fleet.reading import BLOCK, Reading
from echogrid.fleet.store import model_of_stores
from echogrid.grid import Grid
from echogrid.output.page import filled_page
from echogrid.temporary import beside

Codes = UInt8[ndarray, "rows cols"]
"""Pixels: 0 not seen, else 1 + 254 p."""

PAGE, PICTURES = "map.html", "map_tiles"


def write_tile_page(
    folder: Path, reading: Reading, title: str, progress: Callable[[int, int], object] | None = None
) -> None:
    """Write the page and its pictures; those of an older page give way when all of the new ones are there.

    Args:
        folder: where to.
        reading: of the store.
        title: heading of the page, any text.
        progress: is told how many blocks are done, and of how many.
    """
    first, last = reading.extent.tiles()
    with beside(folder / PICTURES, folder=True) as pictures:
        pyramid = _Pyramid(reading, first, pictures, progress)
        levels = int(np.ceil(np.log2(max(1, *(last - first))))) + 1
        pyramid.node(levels - 1, 0, 0)
        cell = model_of_stores().cell_m
        low, high = reading.extent.low[::-1] * cell, reading.extent.high[::-1] * cell
        facts: dict[str, Any] = {
            "cell": cell,
            "tile": TILE,
            "box": [*low.tolist(), *high.tolist()],
            "seen": [*(low + pyramid.low[::-1] * cell).tolist(), *(low + pyramid.high[::-1] * cell).tolist()],
            "levels": [pyramid.written.get(level, []) for level in range(levels)],
        }
        shutil.rmtree(folder / PICTURES, ignore_errors=True)
        pictures.rename(folder / PICTURES)
    with replacing(folder / PAGE) as new:
        page = filled_page("tiles.html", facts, title, images="'self' file: data:")
        new.write_bytes(page.encode("utf-8", "replace"))


@dataclass
class _Pyramid:
    """Pictures that are written from the lowest level up."""

    reading: Reading
    first: ndarray
    """The tile that is [0, 0] of level 0."""
    folder: Path
    progress: Callable[[int, int], object] | None
    written: dict[int, list[str]] = field(default_factory=dict)
    """Names of the pictures of each level."""
    low: ndarray = field(default_factory=lambda: np.full(2, np.iinfo(np.int64).max))
    """First row and column, from the lowest of the map, that anybody saw."""
    high: ndarray = field(default_factory=lambda: np.zeros(2, np.int64))
    """Likewise those after the last."""
    _done: int = 0
    _block: tuple[Tile, Grid | None] = ((-1, -1), None)
    """The block that was read last, for its tiles follow each other."""

    @cached_property
    def _blocks(self) -> int:
        """How many hold anything."""
        return len({tuple((np.array(tile) - self.first) // BLOCK) for tile in self.reading.by_tile})

    def node(self, level: int, row: int, col: int) -> Codes | None:
        """Write a picture and all below it; None where nothing was seen."""
        if not self._seen(level, row, col):
            return None
        if level == 0:
            codes = self._tile(row, col)
        else:
            codes = np.zeros((2 * TILE, 2 * TILE), np.uint8)
            for i, j in np.ndindex(2, 2):
                part = self.node(level - 1, 2 * row + i, 2 * col + j)
                if part is not None:
                    codes[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE] = part
            codes = codes.reshape(TILE, 2, TILE, 2).max(axis=(1, 3))
        name = f"{row}_{col}"
        (self.folder / str(level)).mkdir(exist_ok=True)
        _write_png(self.folder / str(level) / f"{name}.png", codes)
        self.written.setdefault(level, []).append(name)
        return codes

    def _seen(self, level: int, row: int, col: int) -> bool:
        low = self.first + np.array([row, col]) * 2**level
        inside = self.reading.by_tile
        if 4**level > len(inside):
            return any(np.all(low <= tile) and np.all(np.array(tile) < low + 2**level) for tile in inside)
        return any((int(low[0]) + i, int(low[1]) + j) in inside for i, j in np.ndindex(2**level, 2**level))

    def _tile(self, row: int, col: int) -> Codes:
        at = row // BLOCK, col // BLOCK
        if self._block[0] != at:
            low = TILE * (self.first + BLOCK * np.array(at))
            self._block = at, self.reading.grid(Region(low, low + BLOCK * TILE))
            self._done += 1
            if self.progress:
                self.progress(self._done, self._blocks)
        grid = self._block[1]
        assert grid is not None
        part = np.s_[(row % BLOCK) * TILE : (row % BLOCK + 1) * TILE, (col % BLOCK) * TILE : (col % BLOCK + 1) * TILE]
        if (seen := np.argwhere(grid.observed[part])).size:
            corner = TILE * np.array([row, col])
            self.low = np.minimum(self.low, corner + seen.min(axis=0))
            self.high = np.maximum(self.high, corner + seen.max(axis=0) + 1)
        codes = 1 + np.rint(254 * grid.probability()[part])
        return np.where(grid.observed[part], codes, 0).astype(np.uint8)


def _write_png(path: Path, codes: Codes) -> None:
    """A picture whose top row is the highest y: white free, black occupied, nothing where nobody looked."""
    from PIL import Image  # of matplotlib

    picture = Image.fromarray(np.ascontiguousarray(codes[::-1])).convert("P")
    picture.putpalette(np.repeat(255 - np.arange(256, dtype=np.uint8), 3).tobytes())
    picture.save(path, optimize=False, transparency=0)
