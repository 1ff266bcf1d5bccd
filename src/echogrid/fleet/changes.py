"""What has changed in a place from one store to another: what became occupied, and what became free."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.fleet.lattice import Region
from echogrid.fleet.reading import Reading
from echogrid.grid import FREE_THRESH, OCCUPIED_THRESH, Grid, logit

ENOUGH = 5
"""Scans that spoke of a cell, on both sides, so that it is compared."""

NEAR = 3
"""Cells. A wall has not come, or gone, where the other side has one within this: poses are no more exact."""

LEAST_CELLS = 6
"""Of an area; fewer are a speck."""


@dataclass(frozen=True)
class Area:
    """Cells that belong together and have changed alike."""

    became: str
    """occupied or free."""
    centre: tuple[float, float]
    """x, y, m, world."""
    box: tuple[float, float, float, float]
    """Lowest x, y and highest x, y, m."""
    cells: int
    before: float
    """Mean log-odds of its cells in the first store."""
    after: float
    """Likewise in the second."""
    views: tuple[int, int]
    """Least number of scans that spoke of one of its cells, in either."""

    @property
    def evidence(self) -> float:
        """How much log-odds differ, over all cells."""
        return self.cells * abs(self.after - self.before)


@dataclass(frozen=True)
class Changes:
    """What differs between two maps of a region."""

    areas: list[Area]
    """The greatest evidence first."""
    occupied: Float[ndarray, "n 2"]
    """Middles of the cells that became occupied, m, world."""
    free: Float[ndarray, "m 2"]
    """Likewise of those that became free."""
    compared: int
    """Cells that both sides saw enough of."""
    seen: tuple[int, int]
    """Cells that each saw."""
    after: Grid
    """The map of the second store."""


def common(before: Reading, after: Reading) -> Region:
    """The cells that both stores have tiles of.

    Raises:
        UsageError: there are none.
    """
    first, second = before.extent, after.extent
    region = Region(np.maximum(first.low, second.low), np.minimum(first.high, second.high))
    if np.any(region.high <= region.low):
        raise UsageError(
            f"{after.store.path}: found no place in common with {before.store.path}, "
            "expected two stores of one place in one frame"
        )
    return region


def compare(before: Grid, after: Grid) -> Changes:
    """What differs between two maps of the same cells."""
    enough = np.ones(before.shape, dtype=bool)
    for grid in (before, after):
        assert grid.views is not None
        enough &= grid.observed & (grid.views >= ENOUGH)
    was, now = before.log_odds > logit(OCCUPIED_THRESH), after.log_odds > logit(OCCUPIED_THRESH)
    empty, emptied = before.log_odds < logit(FREE_THRESH), after.log_odds < logit(FREE_THRESH)
    came = enough & now & empty & ~_wide(was & before.observed, NEAR)
    went = enough & was & emptied & ~_wide(now & after.observed, NEAR)
    areas, kept = [], []
    for became, changed in (("occupied", came), ("free", went)):
        found, left = _areas(became, changed, before, after)
        areas += found
        kept.append(after.centre_of(np.argwhere(left)))
    areas.sort(key=lambda area: (-area.evidence, area.centre))
    seen = int(before.observed.sum()), int(after.observed.sum())
    return Changes(areas, kept[0], kept[1], int(enough.sum()), seen, after)


def _wide(marked: Bool[ndarray, "rows cols"], cells: int) -> Bool[ndarray, "rows cols"]:
    """What is marked, and all within so many cells of it."""
    from scipy.ndimage import maximum_filter

    return maximum_filter(marked, 2 * cells + 1)


def _areas(
    became: str, changed: Bool[ndarray, "rows cols"], before: Grid, after: Grid
) -> tuple[list[Area], Bool[ndarray, "rows cols"]]:
    """The areas of changed cells that are no specks, and their cells; those within ``NEAR`` belong together."""
    from scipy.ndimage import find_objects, label

    which, _ = label(_wide(changed, NEAR // 2), np.ones((3, 3)))
    which = np.where(changed, which, 0)
    areas, kept = [], np.zeros_like(changed)
    for number, part in enumerate(find_objects(which), start=1):
        if part is None:
            continue
        inside = which[part] == number
        if inside.sum() < LEAST_CELLS:
            continue
        kept[part] |= inside
        areas.append(_area(became, np.argwhere(inside) + np.array([each.start for each in part]), before, after))
    return areas, kept


def _area(became: str, cells: Int[ndarray, "n 2"], before: Grid, after: Grid) -> Area:
    at, half = tuple(cells.T), after.resolution / 2
    places = after.centre_of(cells)
    low, high, middle = places.min(axis=0) - half, places.max(axis=0) + half, places.mean(axis=0)
    assert before.views is not None
    assert after.views is not None
    return Area(
        became,
        (float(middle[0]), float(middle[1])),
        (float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        len(cells),
        float(before.log_odds[at].mean()),
        float(after.log_odds[at].mean()),
        (int(before.views[at].min()), int(after.views[at].min())),
    )
