"""Speed of the compiled core against what Python has, interleaved in one run; size and start of the core.

    python -m benchmarks.core [OLD]

OLD is a worktree of a commit that maps by JAX, which the networks are compared with (benchmarks.core_networks).
Targets: maps at least 5 times as fast as JAX makes them, of one scan alone 10 times, at least 40 % of the floor;
scores of poses at least 30 times as fast as numpy has them.

Each row is timed in turns, core and other, on one thread. Times are of the CPU, the least of all turns: what else the
machine does cannot be told from them.
"""

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from benchmarks import core_networks
from echogrid import _core

TURNS = 7
POINTS, CELLS, RESOLUTION = 512, 500, 0.05


def seconds(work: Callable[[], object]) -> float:
    """Of the CPU, in all threads."""
    begin = time.process_time()
    work()
    return time.process_time() - begin


def compare(what: str, core: Callable[[], object], other: Callable[[], object], unit: str, *counts: int) -> None:
    """Print a row: both times and how many times as fast the core is.

    Args:
        what: is timed.
        core: does it by the core.
        other: by something else.
        unit: "us" or "ms".
        counts: how many of what the times are told of the core and the other do; one if none are given.
    """
    turns = np.array([(seconds(core), seconds(other)) for _ in range(TURNS)])
    mine, its = turns.min(axis=0) / (counts or 1) * {"us": 1e6, "ms": 1e3}[unit]
    print(f"  {what:<58} {mine:>9.3f} {its:>9.1f} {unit} {its / mine:>8.1f} x")


class NumpyScorer:
    """The score as numpy does it best: float32, as many poses at once as the cache holds."""

    def __init__(self, b: ndarray, resolution: float):
        """Of a map [row, col] whose corner is (0, 0), of cells of some m."""
        self._around = np.pad(b, 2).astype(np.float32)
        self._resolution = np.float32(resolution)

    def score(self, points: ndarray, a: ndarray, poses: ndarray, at_once: int) -> ndarray:
        """Of poses [n, 3]."""
        parts = [self._part(points, a, poses[i : i + at_once]) for i in range(0, len(poses), at_once)]
        return np.concatenate(parts)

    def _part(self, points: ndarray, a: ndarray, poses: ndarray) -> ndarray:
        x0, y0, heading = (poses.T[:, :, None]).astype(np.float32)
        c, s = np.cos(heading) / self._resolution, np.sin(heading) / self._resolution
        rows, cols = self._around.shape
        col = np.clip(points[:, 0] * c - points[:, 1] * s + (x0 / self._resolution + 1.5), 0, cols - 2)
        row = np.clip(points[:, 0] * s + points[:, 1] * c + (y0 / self._resolution + 1.5), 0, rows - 2)
        first_col, first_row = col.astype(np.int32), row.astype(np.int32)
        u, v = col - first_col, row - first_row
        at, flat = first_row * cols + first_col, self._around.ravel()
        here, right, above, across = (flat.take(at + off) for off in (0, 1, cols, cols + 1))
        low, high = here + u * (right - here), above + u * (across - above)
        return np.log1p(a * (low + v * (high - low))).sum(axis=1)


def scores() -> None:
    rng = np.random.default_rng(1)
    b = np.clip(gaussian_filter(rng.normal(0, 3, (CELLS, CELLS)), 1), -0.96, 0.96).astype(np.float32)
    points = rng.uniform(-2.5, 2.5, (POINTS, 2)).astype(np.float32)
    a = rng.uniform(-0.96, 0.96, POINTS).astype(np.float32)
    poses = np.column_stack([rng.uniform(0, CELLS * RESOLUTION, (20_000, 2)), rng.uniform(-3, 3, 20_000)])
    core, other = _core.PoseScorer(b, (0.0, 0.0), RESOLUTION), NumpyScorer(b, RESOLUTION)
    inside = poses[np.all((poses[:, :2] > 3) & (poses[:, :2] < CELLS * RESOLUTION - 3), axis=1)][:1000]
    apart = np.max(np.abs(core.score(points, a, inside) - other.score(points, a, inside, 16)))
    print(f"score by core and numpy, {POINTS} points, cells of {RESOLUTION} m; they differ by at most {apart:.0e}")
    for kind, asked in (("anywhere in 25 x 25 m", poses), ("21 x 21 x 31, side by side", search_around(12, 12))):
        for at_once in (16, 1):
            compare(
                f"a pose, {kind}; numpy does {at_once} at once",
                lambda asked=asked: core.score(points, a, asked),
                lambda asked=asked, at_once=at_once: other.score(points, a, asked[:400], at_once),
                "us",
                len(asked),
                400,
            )


def search_around(x: float, y: float) -> ndarray:
    """Poses within half a metre and 0.3 rad."""
    near = np.linspace(-0.5, 0.5, 21)
    return np.array([(x + i, y + j, heading) for i in near for j in near for heading in np.linspace(-0.3, 0.3, 31)])


def graph_of(costs: ndarray, resolution: float) -> csr_array:
    """The steps of cost_to_go on open ground, for scipy."""
    rows = len(costs)
    number = np.arange(costs.size, dtype=np.int32).reshape(costs.shape)
    starts, ends, steps = [], [], []
    for r, first, second in (
        (0, np.s_[:-1], np.s_[1:]),
        (1, np.s_[:], np.s_[:]),
        (1, np.s_[:-1], np.s_[1:]),
        (1, np.s_[1:], np.s_[:-1]),
    ):
        a, b = (np.s_[: rows - r], first), (np.s_[r:], second)
        starts.append(number[a].ravel())
        ends.append(number[b].ravel())
        length = resolution * np.hypot(r, first != np.s_[:])
        steps.append((length * (costs[a] + costs[b]) / 2).ravel())
    there = tuple(np.concatenate(each) for each in (starts, ends))
    return coo_array((np.concatenate(steps), there), shape=(costs.size, costs.size)).tocsr()


def costs_to_go() -> None:
    rng = np.random.default_rng(2)
    for cells in (200, 1000):
        hills = gaussian_filter(rng.random((cells, cells)), 8)
        hills = 1 + 29 * (hills - hills.min()) / np.ptp(hills)
        goals = np.array([[cells // 2, cells // 2], [5, 7]])
        numbers = goals @ (cells, 1)
        for kind, costs in (("of one cost", np.ones_like(hills)), ("of costs 1 to 30", hills)):
            costs = costs.astype(np.float32)
            graph = graph_of(costs.astype(float), RESOLUTION)

            def core(costs: ndarray = costs, goals: ndarray = goals) -> ndarray:
                return _core.cost_to_go(costs, goals, RESOLUTION)

            def other(graph: csr_array = graph, numbers: ndarray = numbers) -> ndarray:
                return dijkstra(graph, directed=False, indices=numbers, min_only=True)

            assert np.allclose(core().ravel(), other(), rtol=1e-12)
            compare(f"{cells} x {cells} cells {kind}", core, other, "ms")


def start_and_size() -> None:
    code = """
import time
import echogrid
begin = time.perf_counter()
from echogrid import _core
print(time.perf_counter() - begin)
"""
    command = [sys.executable, "-c", code]
    starts = [float(subprocess.run(command, capture_output=True, check=True).stdout) for _ in range(9)]
    size = Path(_core.__file__).stat().st_size
    print(f"the module: {size / 1e3:.0f} kB, imported in {min(starts) * 1e3:.1f} ms (least of 9)")


def main() -> None:
    print(f"core: instructions {_core.instructions()}; one thread, CPU time, least of {TURNS} turns")
    _core.set_threads(1)
    print(f"  {'':<58} {'core':>9} {'other':>9}")
    scores()
    print("cost to go, core and scipy's dijkstra without the making of its graph")
    costs_to_go()
    start_and_size()
    if len(sys.argv) > 1:
        core_networks.compare(sys.argv[1])


if __name__ == "__main__":
    main()
