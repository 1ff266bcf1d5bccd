"""Time of one decision of an explorer, by the size of its map: ``python -m benchmarks.decision``.

A building of two corridors and 16 rooms is explored until the map has MOST cells; each row holds the decisions that
were made while what was seen of it had about so many. One thread; asked for are 50 ms at 250,000 cells.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid import Robot, _core
from echogrid.grid import Grid
from echogrid.planning.explore import Exploration
from echogrid.planning.explorer import Explorer
from experiments.studies.position.buildings import Building, building

MOST, STEP = 300_000, 50_000


def main() -> None:
    """Print a row for each robot and size."""
    _core.set_threads(1)
    place = building("floors", "mixed", 20)
    print(f"{'robot':6} {'cells':>8} {'decisions':>9} {'median, ms':>10} {'90 %, ms':>8}")
    for name in ("b21", "p3dx"):
        robot = Robot.load(name)
        seen, took_ms = _explored(place, robot)
        for size in range(0, MOST, STEP):
            these = took_ms[(seen >= size) & (seen < size + STEP)]
            if len(these):
                middle, most = np.quantile(these, [0.5, 0.9])
                print(f"{name:6} {size + STEP // 2:8} {len(these):9} {middle:10.1f} {most:8.1f}", flush=True)


def _explored(place: Building, robot: Robot) -> tuple[Int[ndarray, "decisions"], Float[ndarray, "decisions"]]:
    """Cells of the map at each decision of an exploration that ends at MOST, and time that this took, ms."""
    explorer, cells = Explorer(robot), []

    def note(grid: Grid) -> None:
        part = grid.observed_part()
        cells.append(0 if part is None else part.observed.size)
        if cells[-1] >= MOST:
            explorer.state = "done"

    start = np.array([*place.way[0], 0.0])
    found = Exploration(place.world, robot, start, explorer=explorer, on_map=note).run()
    return np.array(cells), 1000 * found.decision_s


if __name__ == "__main__":
    main()
