"""What the core computes, computed otherwise: in double, as the formula stands."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra


def scores(b, origin, resolution, points, a, poses):
    """Sums of log(1 + a b) of float64 [poses]; b bilinear between the centres of the cells, 0 outside of the map."""
    rows, cols = b.shape
    around = np.zeros((rows + 2, cols + 2))
    around[1:-1, 1:-1] = b
    found = []
    for x, y, heading in poses:
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        col, row = ((points @ turn.T + (x, y) - origin) / resolution - 0.5).T
        first_row, first_col = np.floor(row), np.floor(col)
        value = np.zeros(len(points))
        for r, c in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = (1 - np.abs(row - first_row - r)) * (1 - np.abs(col - first_col - c))
            at = np.clip(first_row + r + 1, 0, rows + 1), np.clip(first_col + c + 1, 0, cols + 1)
            value += weight * around[at[0].astype(int), at[1].astype(int)]
        found.append(np.sum(np.log(np.maximum(1 + a.astype(float) * value, 2.0**-24))))
    return np.array(found)


def cost_to_go(costs, goals, resolution):
    """Dijkstra's algorithm of scipy on the graph of all steps; float64 [rows, cols]."""
    rows, cols = costs.shape
    number = np.arange(rows * cols).reshape(rows, cols)
    ends = []
    for row in range(rows):
        for col in range(cols):
            for r, c in ((0, 1), (1, 0), (1, 1), (1, -1)):
                to = row + r, col + c
                if to[0] >= rows or not 0 <= to[1] < cols:
                    continue
                touched = costs[row, col], costs[to], costs[to[0], col], costs[row, to[1]]
                if np.all(np.isfinite(touched)):
                    step = resolution * np.hypot(r, c) * (float(touched[0]) + float(touched[1])) / 2
                    ends.append((number[row, col], number[to], step))
    open_goals = [number[row, col] for row, col in goals if np.isfinite(costs[row, col])]
    if not open_goals:
        return np.full(costs.shape, np.inf)
    start, end, step = np.array(ends).reshape(-1, 3).T
    # Of a sparse matrix scipy takes every step that is stored, also one of cost 0.
    graph = coo_array((step, (start.astype(int), end.astype(int))), shape=(number.size, number.size)).tocsr()
    return dijkstra(graph, directed=False, indices=open_goals, min_only=True).reshape(rows, cols)
