"""Paths on a map: the shortest safe one from a place to another, or why there is none."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import hypot, inf, sqrt

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray
from scipy import ndimage

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.grid import Grid
from echogrid.limits import MOST_M, as_reals
from echogrid.planning.clearance import CORNER, MARGIN_M, Floor, Sides
from echogrid.robot import Robot
from echogrid.yaml_keys import shown

STEP_M = 0.05
"""Between the points of a path, at most."""

OFF_M = 0.1
"""A start or goal so little off what the robot can stand on is moved there: maps and poses are not exact."""

NARROW_M, NARROW_P, NARROW_SHARE, NARROW_COST = 0.01, 0.5, 0.5, 30.0
"""Where no way is wide and sure enough: kept from what is occupied; of the footprint, all but the inner share of its
radius may cover what is occupied with less than this probability; what a metre costs of what is open by that alone.
Maps of sonar draw the posts of a door some centimetres too wide."""

_NODES = 64
"""Points of a way between which straight lines are tried."""

_ROUNDS = 40
"""How often corners are rounded."""


class NoPathError(UsageError):
    """There is no path; the text says why, and how near to the goal the robot gets."""


@dataclass(frozen=True)
class Path:
    """A way for the robot's middle."""

    points: Float[ndarray, "n 2"]
    """x, y in the frame of the map, m, from the start to the goal."""
    clearance_m: Float[ndarray, "n"]
    """Room between the footprint there and the nearest cell that is not known to be free; below 0: it covers such."""
    narrow: Float[ndarray, "2"] | None = None
    """Where it leads through what is hardly wide enough, or only likely free, x, y, m: the narrowest such place."""

    @property
    def s_m(self) -> Float[ndarray, "n"]:
        """Way from the start to each point."""
        return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(self.points, axis=0), axis=1)))

    @property
    def length_m(self) -> float:
        """Of the whole way."""
        return float(self.s_m[-1])

    def __repr__(self) -> str:
        (x0, y0), (x1, y1) = self.points[[0, -1]].tolist()
        least = float(np.min(self.clearance_m))
        return f"Path({self.length_m:.2f} m from ({x0:g}, {y0:g}) to ({x1:g}, {y1:g}), {least:.2f} m beside it)"


Point = Float[ndarray, "2"] | Sequence[float]


def plan(grid: Grid, start: Point, goal: Point, robot: Robot, unknown: bool = False) -> Path:
    """The shortest safe path on a map, one that keeps its distance where there is room for it.

    Cells that were observed are occupied above p = 0.65 and free below 0.25, as by Nav2's defaults; all others are
    unknown. A map_server pair is read by its own thresholds (``read_map``). The footprint is a disc; it stays 3 cm
    from what is occupied, and on what is free. Only where there is no such way it stays 1 cm from what is occupied,
    and its rim may cover what is more likely free than not; it does so as little as can be, and ``Path.narrow`` says
    where.

    Args:
        grid: the map.
        start: x, y of the robot's middle, m, in the frame of the map.
        goal: where it is to go, likewise.
        robot: for its footprint.
        unknown: whether it may drive on what is unknown, at 30 times the way.

    Raises:
        NoPathError: there is none, and why.
        UsageError: no such points, a robot without a footprint, or a map without free cells or with too many.
    """
    ends = _ends(start, goal)
    if robot.footprint_radius_m <= 0:
        found = "found 0, expected the radius of what is to drive, m"
        raise UsageError(f"robot {robot.name}: footprint_radius_m: {found}")
    corner_m = CORNER * grid.resolution
    floor = Floor.of(grid, robot.footprint_radius_m, margin_m=max(MARGIN_M, corner_m))
    sure = floor.costs(unknown)
    first, last = (_standing(floor, sure, p, what) for p, what in zip(ends, ("start", "goal"), strict=True))
    # Elsewhere in its cell than in the middle there may be less room.
    tight = floor.walls.room_m(ends) < floor.radius_m
    ends[tight] = floor.grid.centre_of(np.array([first, last]))[tight]
    if (way := _way(floor, sure, first, last, ends)) is not None:
        return way
    narrow = floor.daring(NARROW_P, max(NARROW_M, corner_m))
    costs = np.where(np.isfinite(sure), sure, np.float32(NARROW_COST) * narrow.costs(unknown))
    if not unknown:
        costs[floor.known_m < NARROW_SHARE * floor.radius_m] = inf
    if (way := _way(floor, costs, first, last, ends)) is None:
        raise NoPathError(f"plan: {_no_way(narrow, costs, unknown, first, last, ends[1])}")
    return replace(way, narrow=_narrowest(floor, way, sure))


def _way(
    floor: Floor,
    costs: Float32[ndarray, "rows cols"],
    first: tuple[int, int],
    last: tuple[int, int],
    ends: Float[ndarray, "2 2"],
) -> Path | None:
    """The cheapest path from one open cell to another, between places in them, m; None: there is none."""
    to_go = _core.cost_to_go(costs, np.array([last], np.int64), floor.grid.resolution)
    if not np.isfinite(to_go[first]):
        return None
    points = path_along(floor, costs, to_go, first, ends).points
    if first == last:
        points = _spaced(ends) if np.any(ends[0] != ends[1]) else ends[:1]
    if np.any(floor.walls.room_m(points) < floor.radius_m):  # cells are large: from middle to middle
        points = _spaced(floor.grid.centre_of(_down(to_go, costs, first)))
    return Path(points, Sides(floor.grid, ~floor.free).room_m(points) - floor.radius_m)


def _narrowest(floor: Floor, way: Path, sure: Float32[ndarray, "rows cols"]) -> Float[ndarray, "2"]:
    """Of the points of a path where it could not be by costs that are sure, or of all, that with least room."""
    tight = ~np.isfinite(sure[tuple(floor.grid.index_of(way.points).T)])
    return way.points[np.argmin(np.where(tight | ~tight.any(), way.clearance_m, inf))]


def path_along(
    floor: Floor,
    costs: Float32[ndarray, "rows cols"],
    to_go: Float[ndarray, "rows cols"],
    first: tuple[int, int],
    ends: Float[ndarray, "2 2"] | None = None,
) -> Path:
    """The path that goes down a field of costs to its goal, smoothed.

    Args:
        floor: what it is on.
        costs: of a metre in each cell, as of ``Floor.costs``.
        to_go: as of ``_core.cost_to_go`` with them; finite in the first cell.
        first: cell [row, col] where it begins.
        ends: start and goal, m; the path begins and ends there where these are in cells that are open.
    """
    cells = _down(to_go, costs, first)
    points = floor.grid.centre_of(cells)
    for end, p in zip((0, -1), ends if ends is not None else (), strict=False):
        if floor.cell(p) == tuple(cells[end].tolist()):
            points[end] = p
    points = _rounded(_spaced(_straightened(points, to_go[tuple(cells.T)], floor, costs)), floor, costs)
    row, col = floor.grid.index_of(points).T
    return Path(points, floor.known_m[row, col] - floor.radius_m)


def _ends(start: Point, goal: Point) -> Float[ndarray, "2 2"]:
    ends = []
    for what, value in (("start", start), ("goal", goal)):
        p = as_reals(value)
        if p is None or p.shape != (2,) or not np.all(np.abs(p) <= MOST_M):
            raise UsageError(f"plan: {what}: found {shown(value)}, expected x, y within {MOST_M:g} m")
        ends.append(p)
    return np.array(ends)


def _standing(
    floor: Floor, costs: Float32[ndarray, "rows cols"], p: Float[ndarray, "2"], what: str
) -> tuple[int, int]:
    """The cell in which the robot can stand nearest to a point, or a NoPathError that says why it cannot."""
    near, off = floor.standing(costs, p)
    if near is not None and off <= OFF_M + floor.grid.resolution:
        return near
    stands = "there is no place to stand"
    if near is not None:
        stands = f"the nearest place to stand is {off:.2f} m off, at {_told(floor, near)}"
    found = f"found {_why_not(floor, floor.cell(p))}, expected free floor for a footprint of {floor.radius_m:g} m"
    raise NoPathError(f"plan: {what} {_place(p)}: {found}; {stands}")


def _why_not(floor: Floor, cell: tuple[int, int] | None) -> str:
    """What is wrong with a cell for the robot to stand in."""
    if cell is None:
        (x, y), (rows, cols), size = floor.grid.origin, floor.grid.shape, floor.grid.resolution
        spans = f"x {x:.2f} to {x + cols * size:.2f}, y {y:.2f} to {y + rows * size:.2f} m"
        return f"a place outside of what was mapped ({spans})"
    if floor.occupied[cell]:
        return "what is occupied, a wall as a rule"
    if not floor.free[cell]:
        return "ground that is not known"
    near, what = floor.gap_m[cell], "something occupied"
    if near >= floor.body_m:
        near, what = floor.known_m[cell], "unknown ground"
    return f"{what} {near:.2f} m off"


def _no_way(
    floor: Floor,
    costs: Float32[ndarray, "rows cols"],
    unknown: bool,
    first: tuple[int, int],
    last: tuple[int, int],
    goal: Float[ndarray, "2"],
) -> str:
    """Why no way leads from one open cell to another, in which the goal (m) lies."""
    reached = np.isfinite(_core.cost_to_go(costs, np.array([first], np.int64), floor.grid.resolution))
    near = floor.nearest(reached, goal)
    assert near is not None
    off = float(np.linalg.norm(floor.grid.centre_of(np.array(near)) - goal))
    # On what is free the footprint may come up to what is not; from what is occupied it keeps its margin.
    room = floor.gap_m
    if not unknown:
        room = np.where(floor.known_m > 0, np.minimum(room, floor.known_m + np.float32(floor.margin_m)), 0)
    wide, narrow = _widest(room, first, last)
    lacks = f"the widest way there is {2 * wide:.2f} m wide, at {_told(floor, narrow)}"
    lacks = lacks if wide > 0 else "walls, or what is unknown, are all round it"
    needs = 2 * floor.body_m
    over = "" if unknown else _over_unknown(floor, first, last)
    return (
        f"found no way to {_place(goal)}: {lacks}, expected a way {needs:.2f} m wide; "
        f"the robot gets within {off:.2f} m of it, at {_told(floor, near)}{over}"
    )


def _over_unknown(floor: Floor, first: tuple[int, int], last: tuple[int, int]) -> str:
    """That there is a way over what is not known, if there is."""
    to_go = _core.cost_to_go(floor.costs(unknown=True), np.array([last], np.int64), floor.grid.resolution)
    return "; over ground that is not known there is a way (--unknown)" if np.isfinite(to_go[first]) else ""


def _widest(
    room_m: Float[ndarray, "rows cols"], first: tuple[int, int], last: tuple[int, int]
) -> tuple[float, tuple[int, int]]:
    """Half the width (m) of the widest way between two cells, 0 without any, and the cell where it is narrowest."""
    levels = np.unique(room_m[room_m > 0])
    low, high = 0, len(levels)
    while low < high:  # the first width at which they are no longer joined
        middle = (low + high) // 2
        piece, _ = ndimage.label(room_m >= levels[middle])
        joined = piece[first] and piece[first] == piece[last]
        low, high = (middle + 1, high) if joined else (low, middle)
    if not low:
        return 0.0, first
    wide = levels[low - 1]
    # The way goes through as few as can be of what is as narrow: not round the end of a wall that it could keep off.
    costs = np.where(room_m > wide, 1, np.where(room_m == wide, room_m.size, np.inf)).astype(np.float32)
    to_go = _core.cost_to_go(costs, np.array([last], np.int64), 1.0)
    cells = _down(to_go, costs, first)
    row, col = cells[np.argmin(room_m[tuple(cells.T)])].tolist()
    return float(wide), (row, col)


def _place(p: Float[ndarray, "2"]) -> str:
    return f"({p[0]:.2f}, {p[1]:.2f}) m"


def _told(floor: Floor, cell: tuple[int, int]) -> str:
    return _place(floor.grid.centre_of(np.array(cell)))


_STEPS = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])


def _down(
    to_go: Float[ndarray, "rows cols"], costs: Float32[ndarray, "rows cols"], first: tuple[int, int]
) -> Int[ndarray, "n 2"]:
    """Cells from the first to a goal, each the one after which least is to go."""
    rows, cols = costs.shape
    row, col = first
    cells = [(row, col)]
    while to_go[row, col] > 0:
        best, there = inf, (row, col)
        here = float(costs[row, col])
        for i, j in _STEPS.tolist():
            r, c = row + i, col + j
            if not (0 <= r < rows and 0 <= c < cols) or to_go[r, c] >= to_go[row, col]:
                continue
            if i and j and not (np.isfinite(costs[r, col]) and np.isfinite(costs[row, c])):
                continue
            through = float(to_go[r, c]) + (sqrt(2) if i and j else 1.0) * (here + float(costs[r, c])) / 2
            if through < best:
                best, there = through, (r, c)
        if there == (row, col):
            break
        row, col = there
        cells.append(there)
    return np.array(cells)


def _straightened(
    points: Float[ndarray, "n 2"],
    to_go: Float[ndarray, "n"],
    floor: Floor,
    costs: Float32[ndarray, "rows cols"],
) -> Float[ndarray, "m 2"]:
    """The cheapest way along some of the points by straight lines, or as it was where none is cheaper."""
    nodes = np.unique(np.linspace(0, len(points) - 1, min(len(points), _NODES)).round().astype(int))
    count = len(nodes)
    if count < 2:
        return points
    i, j = np.triu_indices(count, 1)
    price = np.full((count, count), np.inf)
    price[i, j] = _line_costs(points[nodes[i]], points[nodes[j]], floor, costs)
    along = to_go[nodes[:-1]] - to_go[nodes[1:]]
    best, before, straight = np.full(count, np.inf), np.zeros(count, int), np.zeros(count, bool)
    best[0] = 0
    for k in range(1, count):
        through = best[:k] + price[:k, k]
        before[k], straight[k] = int(np.argmin(through)), True
        best[k] = through[before[k]]
        if best[k - 1] + along[k - 1] < best[k] - 1e-9:
            best[k], before[k], straight[k] = best[k - 1] + along[k - 1], k - 1, False
    way, k = [points[nodes[-1]][None]], count - 1
    while k > 0:
        a = before[k]
        way.append(points[nodes[a]][None] if straight[k] else points[nodes[a] : nodes[k]])
        k = a
    return np.concatenate(way[::-1])


def _line_costs(
    a: Float[ndarray, "n 2"], b: Float[ndarray, "n 2"], floor: Floor, costs: Float32[ndarray, "rows cols"]
) -> Float[ndarray, "n"]:
    """What straight lines between points (m) cost; inf where one meets a closed cell."""
    length = np.linalg.norm(b - a, axis=1)
    counts = np.ceil(2 * length / floor.grid.resolution).astype(int) + 1
    line = np.repeat(np.arange(len(a)), counts)
    first = np.cumsum(counts) - counts
    share = (np.arange(len(line)) - first[line] + 0.5) / counts[line]
    row, col = floor.grid.index_of(a[line] + share[:, None] * (b - a)[line]).T
    return np.add.reduceat(costs[row, col].astype(float), first) / counts * length


def _spaced(points: Float[ndarray, "n 2"]) -> Float[ndarray, "m 2"]:
    """Points on the same line, STEP_M apart at most, the corners among them."""
    if len(points) < 2:
        return points
    way = [points[:1]]
    for a, b in pairwise(points):
        parts = max(1, int(np.ceil(hypot(*(b - a)) / STEP_M - 1e-9)))
        way.append(a + (np.arange(1, parts + 1) / parts)[:, None] * (b - a))
    return np.concatenate(way)


def _rounded(
    points: Float[ndarray, "n 2"], floor: Floor, costs: Float32[ndarray, "rows cols"]
) -> Float[ndarray, "n 2"]:
    """The points with corners rounded, none moved to where a metre costs more than the dearest beside it."""
    points = points.copy()
    for _ in range(_ROUNDS if len(points) > 2 else 0):
        for half in (1, 2):  # points whose neighbours stay
            inner = slice(half, -1, 2)
            if not len(points[inner]):
                continue
            count = len(points[inner])
            before, after = points[half - 1 :: 2][:count], points[half + 1 :: 2][:count]
            moved = 0.5 * points[inner] + 0.25 * (before + after)
            now, then, *beside = (_at(p, floor, costs) for p in (points[inner], moved, before, after))
            fine = then <= np.maximum(now, np.minimum(*beside)) + 1e-6
            points[inner] = np.where(fine[:, None], moved, points[inner])
    return points


def _at(p: Float[ndarray, "n 2"], floor: Floor, costs: Float32[ndarray, "rows cols"]) -> Float32[ndarray, "n"]:
    row, col = floor.grid.index_of(p).T
    return costs[row, col]
