"""The map of a store, or of a part of it: sums of logs are added tile by tile, and read out with their surroundings.

What was added is kept beside the sums of the logs, with the set of those that are in it: it is brought up to date
when that set has changed, and made anew when a log was taken out.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from echogrid.errors import InputError, UsageError
from echogrid.fleet.lattice import TILE, Region, Tile, joined
from echogrid.fleet.store import Record, Store, model_of_stores
from echogrid.fleet.sums import Writer, opened
from echogrid.grid import MAX_CELLS, Grid, GrowingGrid
from echogrid.models.networks.surroundings import PACK, REACH
from echogrid.robot import Robot, parse_robot

MARGIN = REACH + 2 * PACK
"""Cells round a part that its read-out needs."""

BLOCK = 4
"""Tiles along the side of a block that is read out at once."""

_FARTHEST = 2.0**40
"""Cells; no part begins or ends farther off."""

Sums = Int[ndarray, "layers side side"]


@dataclass(frozen=True)
class Reading:
    """What counted in a store when it was looked at."""

    store: Store
    records: Sequence[Record]

    @staticmethod
    def of(store: Store) -> "Reading":
        """All of a store as it is.

        Raises:
            InputError: no log counts, or a record is damaged.
        """
        records = store.records()
        if not any(record.tiles for record in records):
            raise InputError(store.path, "no logs", "at least one: echogrid fleet adds them")
        return Reading(store, records)

    @cached_property
    def by_tile(self) -> dict[Tile, list[Record]]:
        """The logs that have seen each tile."""
        found: dict[Tile, list[Record]] = {}
        for record in self.records:
            for tile in record.tiles:
                found.setdefault(tile, []).append(record)
        return found

    @cached_property
    def extent(self) -> Region:
        """The smallest rectangle of tiles that holds all that was seen."""
        region = Region.of(self.by_tile)
        assert region is not None
        return region

    @cached_property
    def robots(self) -> Counter[str]:
        """Scans of each kind of robot (YAML), the most first."""
        scans: Counter[str] = Counter()
        for record in self.records:
            scans[record.robot] += record.frames
        return Counter(dict(sorted(scans.items(), key=lambda item: (-item[1], item[0]))))

    @cached_property
    def robot(self) -> Robot:
        """The robot whose array the cells are read out for: the one with the most scans."""
        return parse_robot(next(iter(self.robots)), f"{self.store.path}: robot")

    def region(self, x0: float, y0: float, x1: float, y1: float) -> Region:
        """The cells that a box (m, world) touches, as far as the extent goes.

        Raises:
            UsageError: no tile of the store touches it.
        """
        cell = model_of_stores().cell_m
        low, high = (np.clip(np.array([y, x]) / cell, -_FARTHEST, _FARTHEST) for x, y in ((x0, y0), (x1, y1)))
        asked = Region(np.floor(low + 1e-6).astype(np.int64), np.ceil(high - 1e-6).astype(np.int64))
        if not any(map(asked.holds, self.by_tile)):
            x, y = self.extent.low[::-1] * cell, self.extent.high[::-1] * cell
            raise UsageError(
                f"--region: found {x0:g},{y0:g},{x1:g},{y1:g}, where no log has seen anything, expected a part of "
                f"{x[0]:g},{x[1]:g},{y[0]:g},{y[1]:g}"
            )
        return Region(np.maximum(asked.low, self.extent.low), np.minimum(asked.high, self.extent.high))

    def grid(self, region: Region | None = None, progress: Callable[[int, int], object] | None = None) -> Grid:
        """The map of a part; of all.

        Args:
            region: its cells.
            progress: is told how many blocks are done, and of how many.

        Raises:
            InputError: sums that are damaged.
            UsageError: more cells than a map may have.
        """
        region = region or self.extent
        rows, cols = region.shape
        if rows * cols > MAX_CELLS:
            cell = model_of_stores().cell_m
            found = f"a map of {cols * cell:g} x {rows * cell:g} m"
            expected = f"a part of at most {MAX_CELLS:.0e} cells of {cell:g} m: see --region"
            raise UsageError(f"{self.store.path}: found {found}, expected {expected}")
        log_odds, observed = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), bool)
        views = np.zeros((rows, cols), np.int32)
        blocks = list(self.blocks(region))
        for done, block in enumerate(blocks):
            part = self._read_out(block)
            to = tuple(slice(int(a), int(b)) for a, b in zip(*(end - region.low for end in block), strict=True))
            log_odds[to], observed[to] = part.log_odds, part.observed
            views[to] = 0 if part.views is None else part.views
            if progress:
                progress(done + 1, len(blocks))
        return _grid(region, log_odds, observed, views)

    def blocks(self, region: Region, tiles: int = BLOCK) -> Iterator[Region]:
        """The parts of a region, of so many tiles to a side, that hold anything."""
        side = tiles * TILE
        first, last = region.low // side, -(-region.high // side)
        for index in np.ndindex(*(int(n) for n in last - first)):
            low = (first + index) * side
            block = Region(np.maximum(low, region.low), np.minimum(low + side, region.high))
            first_tile, last_tile = block.tiles()
            if any((int(r), int(c)) in self.by_tile for r, c in _span(first_tile, last_tile)):
                yield block

    def _read_out(self, block: Region) -> Grid:
        """The map of a block, with what lies round it in mind."""
        held = block.grown(MARGIN)
        cells = joined(held, self.tiles(_span(*held.tiles())))
        model = model_of_stores()
        fusion = model.fusion(self.robot, model.cell_m)
        grown = GrowingGrid(model.cell_m, fusion.blank, model.p_min, chosen=False)
        grown.reserve(*held)
        for name, layer in grown.window(held.low, held.shape).items():
            if name in cells:
                layer[:] = cells[name]
        fusion.changed(*held)
        fusion.read_out(grown, block.low, block.shape)
        told = grown.window(block.low, block.shape)
        return _grid(block, told["log_odds"], told["observed"], told["views"])

    def tiles(self, wanted: Iterable[Tile]) -> Iterator[tuple[Tile, Sums]]:
        """What all logs together say of tiles; those that none has seen are left out."""
        for tile in wanted:
            if records := self.by_tile.get(tile):
                yield tile, self._merged(tile, {record.sums for record in records})

    def _merged(self, tile: Tile, keys: set[str]) -> Sums:
        """The sums of a tile over logs, by the keys of their sums."""
        total, have = self._kept(tile)
        if total is None or not have <= keys:
            total, have = np.zeros((), np.int64), set()
        if have == keys:
            return total
        for key in sorted(keys - have):
            with opened(self.store.sums_at(key)) as reader:
                total = total + reader.tile(tile)
        writer = Writer("int64")
        writer.add(tile, total)
        with suppress(UsageError):  # a store that cannot be written is read all the same
            writer.write(self.store.merged_at(tile), of=sorted(keys))
        return total

    def _kept(self, tile: Tile) -> tuple[Sums | None, set[str]]:
        """What is kept of the sums of a tile, and of which logs."""
        path = self.store.merged_at(tile)
        if not path.exists():
            return None, set()
        with suppress(InputError), opened(path) as reader:  # one that is damaged is made anew
            return reader.tile(tile), set(reader.facts.get("of", ()))
        return None, set()


def _span(first: Int[ndarray, "2"], last: Int[ndarray, "2"]) -> list[Tile]:
    return [(row, col) for row in range(int(first[0]), int(last[0])) for col in range(int(first[1]), int(last[1]))]


def _grid(region: Region, log_odds: ndarray, observed: ndarray, views: ndarray) -> Grid:
    model = model_of_stores()
    x, y = (region.low[::-1] * model.cell_m).tolist()
    return Grid(log_odds, observed, model.cell_m, (x, y), views, model.p_min)
