"""Time of one decision of an explorer, by the size of its map: ``python -m benchmarks.decision``.

A building of two corridors and 16 rooms is explored until the map has MOST cells; each row holds the decisions that
were made while what was seen of it had about so many. One thread; asked for are 50 ms at 250,000 cells.
"""

import time
from typing import override

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Robot, _core
from echogrid.grid import Grid
from echogrid.planning.explore import Exploration
from echogrid.planning.explorer import Explorer
from experiments.studies.position.buildings import building

MOST, STEP = 300_000, 50_000


class _Timed(Explorer):
    """An explorer that notes how long it thinks, and ends when its map has MOST cells."""

    def __init__(self, robot: Robot):
        super().__init__(robot)
        self.cells: list[int] = []
        self.took_s: list[float] = []

    @override
    def think(self, grid: Grid, pose: Float[ndarray, "3"], stamp: float) -> None:
        begin = time.perf_counter()
        super().think(grid, pose, stamp)
        self.took_s.append(time.perf_counter() - begin)
        part = grid.observed_part()
        self.cells.append(0 if part is None else part.observed.size)
        if self.cells[-1] >= MOST:
            self.state = "done"


def main() -> None:
    """Print a row for each robot and size."""
    _core.set_threads(1)
    place = building("floors", "mixed", 20)
    print(f"{'robot':6} {'cells':>8} {'decisions':>9} {'median, ms':>10} {'90 %, ms':>8}")
    for name in ("b21", "p3dx"):
        robot = Robot.load(name)
        explorer = _Timed(robot)
        Exploration(place.world, robot, np.array([*place.way[0], 0.0]), explorer=explorer).run()
        cells, took_ms = np.array(explorer.cells), 1000 * np.array(explorer.took_s)
        for size in range(0, MOST, STEP):
            these = took_ms[(cells >= size) & (cells < size + STEP)]
            if len(these):
                middle, most = np.quantile(these, [0.5, 0.9])
                print(f"{name:6} {size + STEP // 2:8} {len(these):9} {middle:10.1f} {most:8.1f}", flush=True)


if __name__ == "__main__":
    main()
