"""The occupancy grid in log-odds: index <-> metre, growth, fusion by Bayes' rule, refinement by a mask."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError

P_MIN, P_MAX = 0.02, 0.98
"""Read-out limits of a fused probability: no number of views makes a cell more certain than this, unless the model
that fuses them knows better (``Grid.p_min``)."""

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.25
"""A cell above the first is occupied to who drives by a map, one below the second free: the defaults of Nav2's
map_saver."""

MAX_CELLS = 400_000_000
"""A map beyond this (1.6 GB of log-odds) is a broken pose, not a building."""

MAX_BYTES = 4_000_000_000
"""Likewise of a map that grows, over all that its cells hold."""

MAX_FILE_BYTES = 10 * MAX_CELLS
"""No map or truth of MAX_CELLS cells needs more; a longer file is something else."""


def logit(p: Float[ndarray, "*n"] | float) -> Float[ndarray, "*n"]:
    """Log-odds of a probability."""
    p = np.asarray(p)
    return np.asarray(np.log(p) - np.log1p(-p))


def sigmoid(log_odds: Float[ndarray, "*n"] | float) -> Float[ndarray, "*n"]:
    """Probability of log-odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * np.asarray(log_odds))))


def span(marked: Bool[ndarray, "n"]) -> slice:
    """From the first that is marked to the last; empty if none is."""
    at = np.flatnonzero(marked)
    return slice(int(at[0]), int(at[-1]) + 1) if at.size else slice(0, 0)


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
    views: Int[ndarray, "rows cols"] | None = None
    """Scans that spoke of each cell, where they were counted."""
    p_min: float = P_MIN
    """No cell is read out as more certain than this or 1 - this."""

    def __repr__(self) -> str:
        rows, cols = np.shape(self.log_odds)
        x, y = self.origin
        share = f"{np.mean(self.observed):.0%}" if rows * cols else "none"
        return f"Grid({rows} x {cols} cells of {self.resolution:g} m from ({x:g}, {y:g}) m, {share} observed)"

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, cols = self.log_odds.shape
        return rows, cols

    def probability(self) -> Float[ndarray, "rows cols"]:
        """Occupancy probability of each cell, clamped to [p_min, 1 - p_min]; 0.5 where nothing is known."""
        return np.clip(sigmoid(self.log_odds), self.p_min, 1 - self.p_min)

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

    def in_cells_of(self, resolution: float) -> "Grid":
        """The same map in cells of another size (m), which lie on the multiples of that.

        A larger cell is as occupied as the most occupied of those whose middle it holds, one of which nobody spoke
        being neither: no wall is lost, and what is not wholly known to be free is not free. It counts as observed if
        one of them is. Nobody spoke of what lies outside of the grid.
        """
        index, first, missing = [], [], []
        ratio = resolution / self.resolution
        for count, low in zip(self.shape, self.origin[::-1], strict=True):
            begin = round(low / self.resolution)
            cells = np.arange(np.floor(begin * self.resolution / resolution + 1e-6),
                              np.ceil((begin + count) * self.resolution / resolution - 1e-6))  # fmt: skip
            if ratio > 1:  # the first whose middle it holds, and that of the cell behind the last
                at = np.ceil(np.append(cells, cells[-1:] + 1) * ratio - 0.5 - 1e-6).astype(int) - begin
                end = at[-1] if at.size else 0
                at = at[:-1]
            else:  # where its middle lies
                at = np.floor((cells + 0.5) * ratio + 1e-6).astype(int) - begin
                end = at[-1] + 1 if at.size else 0
            missing.append((max(0, -at.min(initial=0)), max(0, end - count)))
            index.append(at + missing[-1][0])
            first.append(float(cells[0] * resolution) if cells.size else 0.0)
        if not all(len(each) for each in index):
            return Grid(self.log_odds, self.observed, resolution, (first[1], first[0]), self.views, self.p_min)

        def taken(values: ndarray) -> ndarray:
            values = np.pad(values, missing)
            if resolution <= self.resolution:
                return values[np.ix_(*index)]
            return np.maximum.reduceat(np.maximum.reduceat(values, index[0], axis=0), index[1], axis=1)

        views = None if self.views is None else taken(self.views)
        return Grid(taken(self.log_odds), taken(self.observed), resolution, (first[1], first[0]), views, self.p_min)

    def part(self, first: Int[ndarray, "2"], shape: tuple[int, int]) -> "Grid":
        """A rectangle of cells, a copy without views; what lies outside of the grid is not observed.

        Args:
            first: its first cell [row, col], which may lie outside.
            shape: its rows and columns.
        """
        low = np.clip(first, 0, self.shape)
        high = np.clip(first + np.array(shape), low, self.shape)
        source, target = (
            tuple(slice(a, b) for a, b in zip(low - begin, high - begin, strict=True)) for begin in (0, first)
        )
        log_odds, observed = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool)
        log_odds[target], observed[target] = self.log_odds[source], self.observed[source]
        x, y = np.asarray(self.origin) + first[::-1] * self.resolution
        return Grid(log_odds, observed, self.resolution, (float(x), float(y)), p_min=self.p_min)

    def observed_part(self) -> "Grid | None":
        """The smallest rectangle that holds all that was observed, as views of the arrays; None if nothing was."""
        rows, cols = (span(self.observed.any(axis=axis)) for axis in (1, 0))
        if rows.start == rows.stop:
            return None
        x, y = self.origin
        origin = x + float(cols.start) * self.resolution, y + float(rows.start) * self.resolution
        views = None if self.views is None else self.views[rows, cols]
        return Grid(self.log_odds[rows, cols], self.observed[rows, cols], self.resolution, origin, views, self.p_min)

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
        return Grid(log_odds, self.observed, self.resolution, self.origin, self.views, self.p_min)


class UnreadGrid(Grid):
    """A map that is read out when somebody looks at it: most maps on the way of a drive nobody looks at."""

    def __init__(self, read: Callable[[], Grid]):
        """``read`` is called once, at the first look."""
        object.__setattr__(self, "_read", read)

    def __reduce__(self) -> tuple[type[Grid], tuple[Any, ...]]:
        """A copy, or what is pickled, is the map as it is read: not what reads it, which is all of the mapper."""
        return Grid, tuple(getattr(self, name) for name in _CELLS)

    def __getattribute__(self, name: str) -> Any:
        own = object.__getattribute__(self, "__dict__")
        if name in _CELLS and name not in own:
            read = own["_read"]()
            for each in _CELLS:
                object.__setattr__(self, each, getattr(read, each))
        return object.__getattribute__(self, name)


_CELLS = tuple(each.name for each in fields(Grid))


def covered(
    poses: Float[ndarray, "frames 3"],
    radius: float,
    corner: Int[ndarray, "2"],
    shape: tuple[int, int],
    resolution: float,
) -> Bool[ndarray, "rows cols"]:
    """Cells whose centre a disc round one of the poses (m) covers.

    Args:
        poses: m, rad.
        radius: of the disc, m.
        corner: the first cell [row, col], counted from the world's origin.
        shape: rows and columns.
        resolution: side of a cell, m.
    """
    near = np.zeros(shape, dtype=bool)
    for pose in poses:
        # Of a large map only the cells round the disc are looked at.
        home = pose[1::-1] / resolution - corner
        low = np.maximum(np.floor(home - radius / resolution).astype(int), 0)
        high = np.maximum(np.ceil(home + radius / resolution).astype(int), 0)
        rows, cols = (slice(*ends) for ends in zip(low, high, strict=True))
        y, x = (
            (np.arange(n)[part] + 0.5 - at) * resolution
            for n, part, at in zip(shape, (rows, cols), home, strict=True)
        )
        near[rows, cols] |= y[:, None] ** 2 + x[None, :] ** 2 < radius**2
    return near


Layers = dict[str, ndarray]
"""What the cells of a part of a map hold, by name; arrays [row, col] or [row, col, channel]."""


class GrowingGrid:
    """The global map while it is built: takes evidence anywhere, grows to hold it.

    Cells lie on the multiples of the resolution, so that two maps of one place share their cells. Evidence
    is added unclamped, which makes the result independent of the order of the views. Beside ``log_odds`` and
    ``observed`` a cell may hold layers of its sensor model's own.
    """

    _MARGIN = 64

    def __init__(self, resolution: float, blank: Layers | None = None, p_min: float = P_MIN, chosen: bool = True):
        """An empty map.

        Args:
            resolution: side of a cell, m.
            blank: further layers: what each holds in a cell of which nobody has spoken, a number or a vector.
            p_min: of the grids that are read out of it, see ``Grid``.
            chosen: whether the side of a cell could be another: what is told of a map too large depends on it.
        """
        self.resolution, self._p_min, self._chosen = resolution, p_min, chosen
        self._blank: Layers = {"log_odds": np.float32(0)[...], "observed": np.False_[...]} | (blank or {})
        self._cell_bytes = sum(value.nbytes for value in self._blank.values())
        self._first = np.zeros(2, dtype=np.int64)
        self._layers = self._blank_cells((0, 0))
        self._low = np.full(2, np.iinfo(np.int64).max)
        self._high = np.full(2, np.iinfo(np.int64).min)

    def _blank_cells(self, shape: tuple[int, int]) -> Layers:
        cells = {}
        for name, value in self._blank.items():
            # Zeros cost no memory until they are written to.
            array = np.zeros((*shape, *value.shape), dtype=value.dtype)
            if np.any(value):
                array[:] = value
            cells[name] = array
        return cells

    def reserve(self, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> None:
        """Make room for the cells ``low <= [row, col] < high``, counted from the world's origin.

        Raises:
            UsageError: the map would pass MAX_CELLS or MAX_BYTES; it is as it was.
        """
        if not self._holds(low, high):
            first, last = self._bounds(low, high)
            size = self._layers["log_odds"].shape
            rows, cols = (int(n) for n in last - first)
            grown = self._blank_cells((rows, cols))
            if np.all(size):
                source, target = (
                    tuple(slice(a, b) for a, b in zip(self._low - begin, self._high - begin, strict=True))
                    for begin in (self._first, first)
                )
                for name in grown:
                    # What was copied goes at once: the memory never holds both maps.
                    grown[name][target] = self._layers.pop(name)[source]
            self._first, self._layers = first, grown
        self._low, self._high = np.minimum(self._low, low), np.maximum(self._high, high)

    def check_room(self, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> None:
        """Raise what ``reserve`` of these cells, be it part by part, would raise; nothing is reserved."""
        if not self._holds(low, high):
            self._bounds(low, high)

    def _holds(self, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> bool:
        """Whether the cells ``low <= [row, col] < high`` are there, as most are: this costs little."""
        (row, col), (low_row, low_col), (high_row, high_col) = self._first.tolist(), low.tolist(), high.tolist()
        rows, cols = self._layers["log_odds"].shape
        held = row <= low_row and col <= low_col and high_row <= row + rows and high_col <= col + cols
        return bool(rows and cols and held)

    def _bounds(self, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> tuple[Int[ndarray, "2"], Int[ndarray, "2"]]:
        """First cell, and that behind the last, of a map that also holds ``low <= [row, col] < high``."""
        first, last = self._first, self._first + self._layers["log_odds"].shape
        least, most = np.minimum(self._low, low), np.maximum(self._high, high)
        # Who drives on has to copy the map the more seldom the larger it is, while there is room.
        for share in (4, 16):
            margin = np.maximum((most - least) // share, self._MARGIN)
            begin = np.where(low < first, least - margin, first)
            end = np.where(high > last, most + margin, last)
            if np.all(last > first) and self._fits(begin, end):
                return begin, end
        # Nothing but what was asked for so far decides what is refused, whatever room was made for it.
        begin, end = least - self._MARGIN, most + self._MARGIN
        if not self._fits(begin, end):
            span = (most - least) * self.resolution
            remedy = "a coarser --resolution" if self._chosen else "cut the log in parts"
            raise UsageError(
                f"map: found a drive that spans {span[1]:.6g} x {span[0]:.6g} m at {self.resolution} m a cell, "
                f"expected at most {self._most:.1g} cells (are the poses in mm or cm, "
                f"or is one broken? if neither, {remedy})"
            )
        return begin, end

    @property
    def _most(self) -> int:
        return min(MAX_CELLS, MAX_BYTES // self._cell_bytes)

    def _fits(self, first: Int[ndarray, "2"], last: Int[ndarray, "2"]) -> bool:
        rows, cols = (float(n) for n in last - first)
        return rows * cols <= self._most

    def window(self, corner: Int[ndarray, "2"], shape: tuple[int, int]) -> Layers:
        """The layers of a rectangle of cells, as views to read and to write.

        Args:
            corner: its first cell [row, col], counted from the world's origin; it must lie in what was reserved.
            shape: its rows and columns.
        """
        row, col = corner - self._first
        part = np.s_[row : row + shape[0], col : col + shape[1]]
        return {name: layer[part] for name, layer in self._layers.items()}

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
        cells = self.window(corner, evidence.shape)
        cells["log_odds"] += evidence
        cells["observed"] |= spoken

    def reserved(
        self, corner: Int[ndarray, "2"] | None = None, shape: tuple[int, int] | None = None
    ) -> tuple[Int[ndarray, "2"], tuple[int, int]]:
        """What was reserved so far of a rectangle of cells, or of all: its first cell, its rows and columns.

        Args:
            corner: first cell [row, col] of the rectangle, counted from the world's origin.
            shape: its rows and columns.
        """
        if not self._layers["log_odds"].size:
            return np.zeros(2, dtype=np.int64), (0, 0)
        low, high = self._low, self._high
        if corner is not None and shape is not None:
            low = np.clip(low, corner, corner + shape)
            high = np.clip(high, low, corner + shape)
        rows, cols = (int(n) for n in high - low)
        return low, (rows, cols)

    def copied(self, corner: Int[ndarray, "2"], shape: tuple[int, int], names: Iterable[str]) -> Layers:
        """Some layers of a rectangle of cells, which may reach past what was reserved: copies, blank there.

        Args:
            corner: its first cell [row, col], counted from the world's origin.
            shape: its rows and columns.
            names: of the layers.
        """
        low, size = self.reserved(corner, shape)
        to = tuple(slice(int(a), int(a) + n) for a, n in zip(low - corner, size, strict=True))
        held, copies = self.window(low, size), {}
        for name in names:
            blank = self._blank[name]
            copies[name] = np.full((*shape, *blank.shape), blank, dtype=blank.dtype)
            if all(size):
                copies[name][to] = held[name]
        return copies

    def part(self, corner: Int[ndarray, "2"], shape: tuple[int, int]) -> Grid:
        """A rectangle of the map, a copy; nobody has spoken of what lies outside of what was reserved.

        Args:
            corner: its first cell [row, col], counted from the world's origin.
            shape: its rows and columns.
        """
        return self.grid().part(corner - self.reserved()[0], shape)

    def layers(self) -> Layers:
        """All layers of the part of the map that has been reserved so far, as views to read and to write."""
        return self.window(*self.reserved())

    def grid(self) -> Grid:
        """The part of the map that has been reserved so far, as views of the arrays (not copies).

        A layer named ``views`` is that of the grid.
        """
        cells = self.layers()
        x, y = (float(v) for v in self.reserved()[0][::-1] * self.resolution)
        return Grid(cells["log_odds"], cells["observed"], self.resolution, (x, y), cells.get("views"), self._p_min)
