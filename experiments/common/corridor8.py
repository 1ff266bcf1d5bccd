"""The recorded run "corridor8": its log, and what a map of it is measured by.

Its folder holds ``measurement.txt`` (t s0 ... s7; ms, mm) and ``poses.txt`` (t x y theta; ms, mm, 0.1 degree), line
by line at the same times. The data has no licence, so it is not part of this repository. Readings from 5 m on become
no echo (the recorder wrote 5110), those below 0.17 m not valid: the limits of corridor8.yaml. There is no ground
truth; what is known is that along x = 1 .. 9 m the right wall lies at y = -0.925 m and the left one at y = +1.180 m.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from numpy import ndarray

from echogrid import Frame, Grid, Robot
from echogrid.errors import InputError
from echogrid.geometry import wrap
from echogrid.metrics import FREE_BELOW, OCCUPIED_ABOVE

RIGHT_M, LEFT_M = -0.925, 1.180
X = np.arange(1.0, 9.0, 0.02)
ROBOT = Path(__file__).with_name("corridor8.yaml")
FOLDER = Path(__file__).parents[3] / "shared" / "data" / "corridor8"


def numbers(path: Path, columns: int) -> Float[ndarray, "lines columns"]:
    """The numbers of a blank-separated file, one row a line."""
    try:
        values = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(path, str(error), f"rows of {columns} numbers") from None
    if values.shape[1] != columns:
        raise InputError(path, f"{values.shape[1]} columns", str(columns))
    return values


def frames(folder: Path, robot: Robot) -> Iterator[Frame]:
    """The run, in m, s and rad, its time from 0."""
    readings = numbers(folder / "measurement.txt", 1 + robot.sonars)
    poses = numbers(folder / "poses.txt", 4)
    if not np.array_equal(readings[:, 0], poses[:, 0]):
        raise InputError(folder, "other times in poses.txt than in measurement.txt", "the same, line by line")
    stamps = (readings[:, 0] - readings[0, 0]) / 1000
    ranges = robot.clean(readings[:, 1:] / 1000)
    headings = wrap(np.deg2rad(poses[:, 3] / 10))
    T_world_robot = np.column_stack([poses[:, 1:3] / 1000, headings])
    yield from map(Frame, stamps.tolist(), T_world_robot, ranges)


def strip(grid: Grid, low: float, high: float) -> Float[ndarray, "points"]:
    """Probabilities along the known walls between two y, m."""
    x, y = np.meshgrid(X, np.arange(low, high, 0.02))
    return grid.probability_at(np.column_stack([x.ravel(), y.ravel()]))


def wall(grid: Grid, y: float) -> float:
    """Share of a wall's length with an occupied cell at it or beside it."""
    cell = grid.resolution
    around = [(dx, dy) for dx in (-cell, 0, cell) for dy in (-cell, 0, cell)]
    p = [grid.probability_at(np.column_stack([X + dx, np.full_like(X, y + dy)])) for dx, dy in around]
    return float(np.mean(np.max(p, axis=0) > OCCUPIED_ABOVE))


def measure(grid: Grid) -> dict[str, float]:
    """Shares that say whether the corridor came out."""
    lane = strip(grid, -0.6, 0.85)
    return {
        "right wall": wall(grid, RIGHT_M),
        "left wall": wall(grid, LEFT_M),
        "lane free": float(np.mean(lane < FREE_BELOW)),
        "lane occupied": float(np.mean(lane > OCCUPIED_ABOVE)),
        "free behind right": float(np.mean(strip(grid, RIGHT_M - 1.0, RIGHT_M - 0.3) < FREE_BELOW)),
        "free behind left": float(np.mean(strip(grid, LEFT_M + 0.3, LEFT_M + 1.0) < FREE_BELOW)),
    }


def mark(panel: Axes) -> None:
    """Add the walls that are known."""
    for y, label in ((RIGHT_M, "walls as measured"), (LEFT_M, None)):
        panel.plot(X[[0, -1]], [y, y], color="tab:red", lw=1.0, ls="--", label=label)
    panel.set(xlim=(-2, 19), ylim=(-11.5, 3))
