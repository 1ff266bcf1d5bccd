"""What sonars would hear in a map, and how well that agrees with what they heard."""

import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from echogrid.grid import Grid
from echogrid.robot import Robot

REACH_M = 5.0
"""Farther echoes are taken for none: they say little of where a robot is."""

OCCUPIED, FREE = 0.65, 0.35
"""A cell is a wall above the first probability, floor below the second."""

_HEADINGS, _CELL_M, _STEP_M = 120, 0.1, 0.02
"""Of the table: bearings, side of a cell, steps of a range."""

_MOST = 300_000_000
"""Entries of the table; of a larger map the cells are larger."""

_UNKNOWN, _NOTHING = 254, 255
"""Entries: the beam ends where nobody knows; nothing within reach. The nearest of several is the least."""

_NONE = 255
"""The range, in steps, of no echo."""

_SPREAD_M, _SPREAD = 0.06, 0.02
"""Standard deviation of an echo: of the map's cells and of the wall's relief, and of the range a metre."""

_ANY, _LONGER, _MISSED = 0.05, 0.15, 0.35
"""Likelihoods beside 1 of the echo that is expected: of any other, for there are people and furniture; of one from
farther off, for a smooth wall that is met aslant is heard past; of none."""


class Beams:
    """How far the nearest wall is in a sonar's beam, from every cell of floor in every direction."""

    def __init__(self, grid: Grid, robot: Robot) -> None:
        """Look round in a map (some tenths of a second for a flat).

        Args:
            grid: the map.
            robot: whose beam width and ranges count.
        """
        self._reach = np.minimum(robot.max_ranges_m, REACH_M)
        p = grid.probability()
        floor = grid.observed & (p < FREE)
        times = max(1, round(_CELL_M / grid.resolution))
        while floor.sum() / times**2 * _HEADINGS > _MOST:
            times *= 2
        self._cell, self._origin = times * grid.resolution, np.array(grid.origin)
        picked = slice(times // 2, None, times)
        middles, walls = floor[picked, picked], (grid.observed & (p > OCCUPIED))[picked, picked]
        cells = np.argwhere(middles)
        self._row_of = np.full(np.array(middles.shape) + 2, len(cells), dtype=np.int32)  # with a rim
        self._row_of[1:-1, 1:-1][middles] = np.arange(len(cells))
        self._row_of[1:-1, 1:-1][walls] = len(cells) + 1
        half = max(1, round(robot.beam_width_rad / 2 * _HEADINGS / (2 * np.pi)))
        middle = (cells[:, ::-1] * times + times // 2 + 0.5) * grid.resolution + self._origin
        self._table = _nearest(_rays(grid, middle, float(self._reach.max())), half)
        self._logs = np.stack([_log_likelihoods(float(reach)) for reach in self._reach])

    def log_likelihood(
        self, poses: Float[ndarray, "n 3"], ranges: Float[ndarray, "sonars"], mounts: Float[ndarray, "sonars 3"]
    ) -> Float32[ndarray, "n"]:
        """How well a scan agrees with the map from each pose.

        Args:
            poses: m, m, rad, in the map.
            ranges: m; inf: no echo, nan: not fired.
            mounts: from where the sonars looked, in the robot's frame, m, m, rad.
        """
        fired = np.flatnonzero(~np.isnan(ranges))
        if not len(fired):
            return np.zeros(len(poses), dtype=np.float32)
        x, y, axis = mounts[fired].T
        cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        scale = 1 / self._cell
        at_x, at_y = ((poses[:, i, None] - self._origin[i]) * scale + 1 for i in (0, 1))
        cols = (at_x + (cos * x - sin * y) * scale).astype(np.int32)
        rows = (at_y + (sin * x + cos * y) * scale).astype(np.int32)
        np.clip(cols, 0, self._row_of.shape[1] - 1, out=cols)
        np.clip(rows, 0, self._row_of.shape[0] - 1, out=rows)
        bearing = np.rint((poses[:, 2, None] + axis) * (_HEADINGS / (2 * np.pi))).astype(np.int32) % _HEADINGS
        expected = self._table[self._row_of[rows, cols], bearing]
        heard = np.minimum(ranges[fired], self._reach[fired])
        measured = np.where(heard < self._reach[fired], np.rint(heard / _STEP_M), _NONE).astype(np.int32)
        logs = self._logs[fired, measured]
        return logs[np.arange(len(fired)), expected].sum(axis=1)


def _rays(grid: Grid, start: Float[ndarray, "cells 2"], reach: float) -> Float32[ndarray, "cells headings"]:
    """Way (m) from points to the first cell that is a wall, up to ``reach``; nan: nobody knows."""
    p = grid.probability()
    walls = grid.observed & (p > OCCUPIED)
    told = np.pad(grid.observed, 1)
    cell = grid.resolution
    clear = np.pad(distance_transform_edt(~walls) if walls.any() else np.full(grid.shape, np.inf), 1) * cell
    most = np.array(told.shape[::-1]) - 1
    ways = np.full((len(start), _HEADINGS), np.inf, dtype=np.float32)
    for k in range(_HEADINGS):
        angle = 2 * np.pi * k / _HEADINGS
        along = np.array([np.cos(angle), np.sin(angle)])
        way, live = np.zeros(len(start)), np.arange(len(start))
        while len(live):
            cells = np.floor((start[live] + way[live, None] * along - grid.origin) / cell).astype(int) + 1
            cols, rows = np.clip(cells, 0, most).T
            near, known = clear[rows, cols], told[rows, cols]
            wall = known & (near < 0.75 * cell)
            ways[live[wall], k] = way[live[wall]]
            ways[live[~known], k] = np.nan
            # no wall is passed over, and the next cell that nobody knows is not either by much
            way[live] += np.clip(near - 0.5 * cell, 0.5 * cell, 4 * cell)
            live = live[known & ~wall & (way[live] < reach)]
    return ways


def _nearest(ways: Float32[ndarray, "cells headings"], half: int) -> UInt8[ndarray, "more headings"]:
    """The table: the nearest of the ways within half a beam; one row more of unknown ground, one of walls."""
    table = np.full((len(ways) + 2, _HEADINGS), _UNKNOWN, dtype=np.uint8)
    steps = np.where(np.isinf(ways), _NOTHING, np.rint(ways / _STEP_M))
    steps = np.where(np.isnan(ways), _UNKNOWN, steps).astype(np.uint8)
    nearest = steps.copy()
    for k in range(1, half + 1):
        for turned in (np.roll(steps, k, axis=1), np.roll(steps, -k, axis=1)):
            np.minimum(nearest, turned, out=nearest)
    table[:-2], table[-1] = nearest, 0
    return table


def _log_likelihoods(reach: float) -> Float32[ndarray, "measured expected"]:
    """Of a range in steps, the last none, where so many steps are expected."""
    expected = np.arange(256) * _STEP_M
    measured = np.arange(256)[:, None] * _STEP_M
    spread = _SPREAD_M + _SPREAD * expected
    likely = _ANY + (1 - _ANY) * np.exp(-0.5 * ((measured - expected) / spread) ** 2)
    likely = np.where(measured > expected + 3 * spread, likely + _LONGER, likely)
    likely[:, _NOTHING] = _ANY
    likely[_NONE] = np.where(expected >= reach - 0.1, 1.0, _MISSED)
    likely[:, _UNKNOWN] = _MISSED
    return np.log(likely).astype(np.float32)
