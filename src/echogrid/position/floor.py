"""Where in a map a robot can be, and where it cannot have driven."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.grid import Grid
from echogrid.position.beams import FREE, OCCUPIED
from echogrid.yaml_keys import shown

ABOUT_M = 0.3
"""A start that is given is right to about so far."""


class Walls:
    """Cells through which no robot drives."""

    def __init__(self, grid: Grid, longest: float) -> None:
        """The walls of a map; no way that is asked for is longer (m)."""
        self._taken = np.pad(grid.observed & (grid.probability() > OCCUPIED), 1)
        self._origin, self._cell = np.array(grid.origin), grid.resolution
        self._count = int(np.ceil(longest / self._cell))

    def crossed(self, begin: Float[ndarray, "n 2"], end: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
        """Whether a straight way between two places (m) leads through one, but for where it begins."""
        begin, end = ((place - self._origin) / self._cell + 1 for place in (begin, end))
        crossed = np.zeros(len(begin), dtype=bool)
        most = np.array(self._taken.shape[::-1]) - 1
        for part in np.linspace(1, 0, self._count, endpoint=False):
            cols, rows = np.clip(begin + part * (end - begin), 0, most).astype(np.int32).T
            crossed |= self._taken[rows, cols]
        return crossed


def check_start(grid: Grid, start: Float[ndarray, "_"] | Sequence[float] | None) -> None:
    """Raise a UsageError if in a map no robot is found, or a start (m, m, rad) does not lie on its floor."""
    p = grid.probability()
    floor = bool((grid.observed & (p < FREE)).any())
    if not floor or not (grid.observed & (p > OCCUPIED)).any():
        raise UsageError(f"map: found no {'wall' if floor else 'free floor'}, expected both")
    if start is None:
        return
    pose = np.asarray(start, dtype=float)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise UsageError(f"start: found {shown(start)}, expected x, y, heading")
    row, col = in_map(grid, pose)
    where = f"start: found {pose[0]:g}, {pose[1]:g} m"
    if not grid.observed[row, col]:
        raise UsageError(f"{where}, of which the map knows nothing, expected free floor")
    if grid.probability_at(pose[:2]) > OCCUPIED:
        raise UsageError(f"{where}, in a wall, expected free floor")
    free = grid.centre_of(np.argwhere(grid.observed & (p < FREE)))
    if np.hypot(*(free - pose[:2]).T).min() > ABOUT_M:
        raise UsageError(f"{where}, where the map knows no free floor within {ABOUT_M:g} m, expected free floor")


def in_map(grid: Grid, pose: Float[ndarray, "3"]) -> Int[ndarray, "2"]:
    """The cell of a map in which a pose (m, m, rad) lies."""
    cell = grid.index_of(pose[:2])
    if np.any(cell < 0) or np.any(cell >= grid.shape):
        low = np.array(grid.origin)
        high = low + np.array(grid.shape[::-1]) * grid.resolution
        box = f"x {low[0]:g} to {high[0]:g}, y {low[1]:g} to {high[1]:g} m"
        where = f"start: found {pose[0]:g}, {pose[1]:g} m"
        raise UsageError(f"{where}, outside of the map, expected a place in it: {box}")
    return cell
