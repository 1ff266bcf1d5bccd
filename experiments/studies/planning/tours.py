"""The shortest tour that somebody could drive who knows the building: views of all its floor, in a good order."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid import Robot, World
from echogrid._core import cost_to_go
from echogrid.planning.explore import Reachable

CELL_M, VIEWS_M, FLOOR_M = 0.1, 0.5, 0.3
"""Of the world's free space; between the places to look from; between the points of floor that are to be seen."""

REACH_M = 2.0
"""A place is seen from so far, in plain sight."""


def tour_m(world: World, robot: Robot, start: Float[ndarray, "2"], share: float) -> float:
    """Length (m) of a tour from the start that has a share of the reachable floor in sight within REACH_M.

    Views by greedy cover, ordered by the nearest next and then by two-opt: near the shortest.
    """
    floor = Reachable.of(world, robot, start).points
    floor = floor[np.all(np.floor(floor / 0.05).astype(int) % round(FLOOR_M / 0.05) == 0, axis=1)]
    low, high = world.bounds()
    cols, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
    x, y = (low[k] + (np.arange(n) + 0.5) * CELL_M for k, n in enumerate((cols, rows)))
    middles = np.stack(np.meshgrid(x, y), axis=-1)
    gap = world.clearance(middles.reshape(-1, 2)).reshape(rows, cols)
    costs = np.where(gap > robot.footprint_radius_m + 0.05, 1, np.inf).astype(np.float32)

    def field(p: Float[ndarray, "2"]) -> Float[ndarray, "rows cols"]:
        return cost_to_go(costs, np.floor((p - low) / CELL_M).astype(np.int64)[None, ::-1].copy(), CELL_M)

    home = field(start)
    step = round(VIEWS_M / CELL_M)
    views = np.argwhere(np.isfinite(home) & (np.add.outer(np.arange(rows) % step, np.arange(cols) % step) == 0))
    places = middles[tuple(views.T)]
    seen = _sight(world, places, floor)
    chosen = _cover(seen, home[tuple(views.T)], share)
    stops = np.concatenate([start[None], places[chosen]])
    fields = [field(p) for p in stops]
    cells = np.floor((stops - low) / CELL_M).astype(int)
    apart = np.array([[one[row, col] for col, row in cells] for one in fields])
    return _ordered(apart)


def _sight(world: World, places: Float[ndarray, "views 2"], floor: Float[ndarray, "n 2"]) -> Bool[ndarray, "views n"]:
    seen = np.zeros((len(places), len(floor)), dtype=bool)
    for i, p in enumerate(places):
        to = floor - p
        off = np.linalg.norm(to, axis=1)
        near = np.flatnonzero(off < REACH_M)
        free = world.sight(np.repeat(p[None], len(near), axis=0), np.arctan2(to[near, 1], to[near, 0]))
        seen[i, near] = free >= off[near]
    return seen


def _cover(seen: Bool[ndarray, "views n"], cost: Float[ndarray, "views"], share: float) -> list[int]:
    left, chosen = np.ones(seen.shape[1], dtype=bool), []
    wanted = share * np.count_nonzero(seen.any(axis=0))
    while np.count_nonzero(seen.any(axis=0) & ~left) < wanted:
        gain = np.count_nonzero(seen & left, axis=1)
        best = int(np.argmax(gain - 1e-3 * cost))
        chosen.append(best)
        left &= ~seen[best]
    return chosen


def _ordered(apart: Float[ndarray, "n n"]) -> float:
    """Length of an open tour from the first stop through all."""
    order, left = [0], set(range(1, len(apart)))
    while left:
        order.append(min(left, key=lambda k: apart[order[-1], k]))
        left.remove(order[-1])

    def length(tour: list[int]) -> float:
        return float(np.sum(apart[tour[:-1], tour[1:]]))

    improved = True
    while improved:
        improved = False
        for i in range(1, len(order) - 1):
            for j in range(i + 1, len(order)):
                turned = order[:i] + order[i : j + 1][::-1] + order[j + 1 :]
                if length(turned) < length(order) - 1e-6:
                    order, improved = turned, True
    return length(order)
