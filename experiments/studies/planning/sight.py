"""A map that is right as far as it goes: what a robot would know that sees without error, but not through walls."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Frame, Grid, World
from experiments.studies.planning.tours import REACH_M

CELL_M, RAY_RAD, MOVED_M, RIM_M = 0.05, np.deg2rad(0.7), 0.05, 0.5
"""Of the map; between the directions into which the robot looks; so far it moves before it looks again; round the
world."""

SURE = 6.0
"""Log-odds of what was seen: surer than a weak spot of a wall."""


class Sight:
    """Maps as ``Mapper`` does, by what is in plain sight within REACH_M."""

    def __init__(self, world: World):
        """Nothing was seen of this world."""
        self._world = world
        low, high = world.bounds()
        cols, rows = np.ceil((high - low + 2 * RIM_M) / CELL_M).astype(int).tolist()
        x, y = (low - RIM_M).tolist()
        unknown = np.zeros((rows, cols), np.float32)
        self._grid = Grid(unknown, np.zeros((rows, cols), dtype=bool), CELL_M, (x, y))
        self._middles = self._grid.centre_of(np.argwhere(~self._grid.observed)).reshape(rows, cols, 2)
        self._from: Float[ndarray, "2"] | None = None

    def add(self, frames: Sequence[Frame]) -> None:
        """Look round from where the last scan was heard."""
        place = frames[-1].pose[:2]
        if self._from is not None and np.linalg.norm(place - self._from) < MOVED_M:
            return
        self._from = place.copy()
        bearing = np.arange(0.0, 2 * np.pi, RAY_RAD)
        sight = self._world.sight(np.repeat(place[None], len(bearing), axis=0), bearing)
        to = self._middles - place
        off = np.linalg.norm(to, axis=-1)
        ray = np.rint(np.arctan2(to[..., 1], to[..., 0]) % (2 * np.pi) / RAY_RAD).astype(int) % len(bearing)
        occupied = np.abs(off - sight[ray]) <= 0.7 * CELL_M
        free = (off < REACH_M) & (off < sight[ray]) & ~occupied
        occupied &= off < REACH_M
        self._grid.log_odds[free], self._grid.log_odds[occupied] = -SURE, SURE
        self._grid.observed[free | occupied] = True

    def grid(self) -> Grid:
        """The map."""
        return self._grid

    def around(self, x: float, y: float, side_m: float) -> Grid:
        """A square of it, a copy."""
        cells = round(side_m / CELL_M)
        return self._grid.part(self._grid.index_of(np.array([x, y])) - cells // 2, (cells, cells))
