"""Drives through a world: poses along waypoints, a tour of a room, and the truth that such a drive could see."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage, sparse

from echogrid.errors import InputError, UsageError
from echogrid.files import read_text
from echogrid.geometry import wrap
from echogrid.grid import MAX_CELLS
from echogrid.metrics import Truth
from echogrid.simulation.world import World, inside_room

STEP_M = 0.05
"""Way between two frames of a simulated drive."""

TURN_RAD = np.deg2rad(9.0)
"""Turn between two frames where the robot turns on the spot."""

_LATTICE_M = 1.0
"""A tour passes within about this of every point of the free space."""

_MAX_NODES = 250_000


def along(waypoints: Float[ndarray, "n 2"]) -> Float[ndarray, "frames 3"]:
    """Poses of a robot that drives straight from waypoint to waypoint (m) and turns on the spot between."""
    points = waypoints[np.append(True, np.any(np.diff(waypoints, axis=0) != 0, axis=1))]
    if len(points) < 2:
        return np.array([[*points[0], 0.0]])
    poses = []
    heading = None
    for a, b in pairwise(points):
        towards = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
        if heading is not None:
            poses += [[*a, between] for between in _headings_between(heading, towards)]
        steps = max(1, round(float(np.linalg.norm(b - a)) / STEP_M))
        poses += [[*(a + (b - a) * i / steps), towards] for i in range(steps)]
        heading = towards
    return np.array([*poses, [*points[-1], heading]])


def turning(poses: Float[ndarray, "frames 3"]) -> Float[ndarray, "more 3"]:
    """The same drive, but where the heading changes by more than between two frames the robot turns on the spot."""
    out = [poses[:1]]
    for before, now in pairwise(poses):
        out += [np.array([[*before[:2], between]]) for between in _headings_between(before[2], now[2])]
        out.append(now[None])
    return np.concatenate(out)


def _headings_between(before: float, after: float) -> list[float]:
    """Those of a robot that turns on the spot from one heading to another, the short way, rad."""
    turn = float(wrap(after - before))
    parts = int(abs(turn) / TURN_RAD) + 1
    return [float(wrap(before + turn * i / parts)) for i in range(1, parts)]


def read_waypoints(path: str | Path) -> Float[ndarray, "n 2"]:
    """Waypoints from a text file: ``x,y`` in m on each line, ``#`` begins a comment.

    Raises:
        InputError: the message names the line.
    """
    lines = read_text(Path(path), "a file of x,y lines").splitlines()
    points = []
    for number, line in enumerate(lines, start=1):
        text = line.split("#")[0].strip()
        if not text:
            continue
        try:
            x, y = (float(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"{path}:{number}", repr(text[:60]), "x,y in metres") from None
        if not (abs(x) <= 1e4 and abs(y) <= 1e4):
            raise InputError(f"{path}:{number}", repr(text[:60]), "x,y within 10 km")
        points.append([x, y])
    if len(points) < 2:
        raise InputError(path, f"{len(points)} waypoints", "at least 2")
    return np.array(points)


def tour(world: World, clearance: float) -> Float[ndarray, "frames 3"]:
    """A drive that passes through all of a room, keeping a distance (m) to everything.

    It visits the points of a lattice, always going on to the nearest one not yet visited, on the shortest way
    that prefers the middle of the free space. The room is the free space round ``world.start``, or else the
    largest one that is shut in by walls, or else the largest one.

    Raises:
        UsageError: no free space to drive in, or ``world.start`` is not in it.
    """
    places, gap, free, cell = _free_space(world, clearance)
    nodes = -np.ones(free.shape, dtype=int)
    nodes[free] = np.arange(free.sum())
    where = places[free]
    graph = _lattice(nodes, 1.0 + 2.0 * np.exp(-(gap - clearance) / 0.2), cell)
    stops = _stops(where)
    here = int(np.argmin(np.linalg.norm(where - (world.start or where[0]), axis=1)))
    left = set(stops.tolist()) - {here}
    path = [here]
    while left:
        # The next stop is near almost always; only where it is not is the whole room searched.
        for limit in (4 * _LATTICE_M, np.inf):
            cost, before = sparse.csgraph.dijkstra(graph, indices=here, return_predecessors=True, limit=limit)
            goal = min(left, key=lambda n: cost[n])
            if np.isfinite(cost[goal]):
                break
        if not np.isfinite(cost[goal]):
            break
        back = [goal]
        while back[-1] != here:
            back.append(int(before[back[-1]]))
        path += back[-2::-1]
        left -= set(back)
        here = goal
    return _smooth(where[path])


def start_of(world: World, clearance: float) -> Float[ndarray, "2"]:
    """Where a drive begins (m): ``world.start``, or else the roomiest place of the room that ``tour`` goes through.

    Raises:
        UsageError: as of ``tour``.
    """
    places, gap, free, _ = _free_space(world, clearance)
    if world.start is not None:
        return np.array(world.start, dtype=float)
    return places[free][np.argmax(gap[free])]


def _free_space(
    world: World, clearance: float
) -> tuple[Float[ndarray, "ny nx 2"], Float[ndarray, "ny nx"], Bool[ndarray, "ny nx"], float]:
    """Places on a lattice, the distance of each to everything, which are the room's, and their spacing; all in m."""
    low, high = world.bounds()
    cell = max(0.1, float(np.sqrt(np.prod(high - low) / _MAX_NODES)))
    nx, ny = np.maximum(1, np.ceil((high - low) / cell)).astype(int)
    x, y = np.meshgrid(low[0] + (np.arange(nx) + 0.5) * cell, low[1] + (np.arange(ny) + 0.5) * cell)
    points = np.column_stack([x.ravel(), y.ravel()])
    gap = world.clearance(points).reshape(ny, nx)
    free = _room(world, points, gap > clearance)
    if not free.any():
        found = f"no free space {clearance:.2f} m from all walls"
        raise UsageError(f"world {world.name}: found {found}, expected a room with walls all round")
    return points.reshape(ny, nx, 2), gap, free, cell


def _room(world: World, points: Float[ndarray, "n 2"], open_: Bool[ndarray, "ny nx"]) -> Bool[ndarray, "ny nx"]:
    labels, count = ndimage.label(open_)
    if count == 0:
        return open_
    if world.start is not None:
        there = labels.ravel()[np.argmin(np.linalg.norm(points - world.start, axis=1))]
        if there == 0:
            at = f"({world.start[0]:.2f}, {world.start[1]:.2f}) m, outside or too near a wall"
            raise UsageError(f"world {world.name}: start: found {at}, expected free space")
        return (labels == there) & open_
    shut = inside_room(world, points).reshape(open_.shape) & open_
    sizes = np.bincount(labels[shut if shut.any() else open_], minlength=count + 1)
    sizes[0] = 0
    return labels == int(np.argmax(sizes))


def _lattice(nodes: Int[ndarray, "ny nx"], price: Float[ndarray, "ny nx"], cell: float) -> sparse.csr_array:
    """Edges between the eight-neighbours that are nodes, as long as they are dear."""
    first, second, length = [], [], []
    ny, nx = nodes.shape
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: ny - dy, max(0, -dx) : nx - max(0, dx)]
        b = np.s_[dy:, max(0, dx) : nx + min(0, dx)]
        both = (nodes[a] >= 0) & (nodes[b] >= 0)
        first.append(nodes[a][both])
        second.append(nodes[b][both])
        length.append((cell * np.hypot(dx, dy) * (price[a] + price[b]) / 2)[both])
    i, j, w = np.concatenate(first), np.concatenate(second), np.concatenate(length)
    count = int(nodes.max()) + 1
    return sparse.csr_array((np.tile(w, 2), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(count, count))


def _stops(where: Float[ndarray, "n 2"]) -> Int[ndarray, "m"]:
    """For each square of the lattice that holds nodes, the node nearest to the middle of its nodes."""
    square = np.floor((where - where.min(axis=0)) / _LATTICE_M).astype(int)
    _, group = np.unique(square, axis=0, return_inverse=True)
    group = group.ravel()
    size = np.bincount(group)
    middle = np.column_stack([np.bincount(group, where[:, k]) / size for k in (0, 1)])
    off = np.linalg.norm(where - middle[group], axis=1)
    order = np.lexsort((off, group))
    return order[np.append(True, np.diff(group[order]) > 0)]


def _smooth(path: Float[ndarray, "n 2"]) -> Float[ndarray, "frames 3"]:
    """Poses STEP_M apart along a way whose corners are rounded, heading along the way."""
    if len(path) == 1:
        return np.array([[*path[0], 0.0]])
    round_ = ndimage.uniform_filter1d(path, size=3, axis=0, mode="nearest")
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(round_, axis=0), axis=1)))
    keep = np.append(True, np.diff(length) > 1e-9)
    length, round_ = length[keep], round_[keep]
    s = np.arange(0.0, length[-1], STEP_M)
    p = np.column_stack([np.interp(s, length, round_[:, k]) for k in (0, 1)])
    ahead = np.column_stack([np.interp(s + 0.15, length, round_[:, k]) for k in (0, 1)])
    behind = np.column_stack([np.interp(s - 0.15, length, round_[:, k]) for k in (0, 1)])
    towards = ahead - behind
    return np.column_stack([p, np.arctan2(towards[:, 1], towards[:, 0])])


def truth_of(world: World, poses: Float[ndarray, "frames 3"], resolution: float = 0.1, reach: float = 1.4) -> Truth:
    """The truth grid of a world as far as it can be seen from a drive.

    Surface: the cells in which sight lines end, each end moved 1 cm into the wall. Free: cells that are not
    surface and whose centre a sight line passes. Hidden: all else, and all farther than ``reach`` (m) from
    the path.

    Raises:
        UsageError: the grid would pass MAX_CELLS.
    """
    path = poses
    path = path[_spaced(path, 0.1)]
    low = np.floor((path[:, :2].min(axis=0) - reach) / resolution).astype(int) - 1
    high = np.ceil((path[:, :2].max(axis=0) + reach) / resolution).astype(int) + 1
    cols, rows = high - low
    if float(cols) * float(rows) > MAX_CELLS:
        raise UsageError(
            f"truth: found a drive that spans {cols * resolution:.6g} x {rows * resolution:.6g} m, expected at most "
            f"{MAX_CELLS:.0e} cells of {resolution} m"
        )
    cells = np.full((rows, cols), 2, dtype=np.int8)
    rays = max(360, round(2 * np.pi * reach / (resolution / 3)))
    bearing = np.arange(rays) * (2 * np.pi / rays)
    u = np.column_stack([np.cos(bearing), np.sin(bearing)])
    span = int(np.ceil(reach / resolution)) + 1
    window = np.arange(-span, span + 1)
    surface = np.zeros((rows, cols), dtype=bool)
    for start in range(0, len(path), 64):
        chunk = path[start : start + 64, :2]
        sight = world.sight(np.repeat(chunk, rays, axis=0), np.tile(bearing, len(chunk))).reshape(len(chunk), rays)
        for p, reaches in zip(chunk, sight, strict=True):
            stopped = reaches <= reach
            ends = p + (reaches[stopped, None] + 0.01) * u[stopped]
            col, row = (np.floor(ends / resolution).astype(int) - low).T
            surface[row, col] = True
            home = np.floor(p / resolution).astype(int) - low
            col, row = np.meshgrid(home[0] + window, home[1] + window)
            inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
            row, col = row[inside], col[inside]
            to = (np.column_stack([col, row]) + low + 0.5) * resolution - p
            distance = np.linalg.norm(to, axis=1)
            ray = np.rint(np.arctan2(to[:, 1], to[:, 0]) / (2 * np.pi / rays)).astype(int) % rays
            seen = (distance < reaches[ray]) & (distance <= reach)
            cells[row[seen], col[seen]] = 0
    cells[surface] = 1
    return Truth(cells, resolution, (float(low[0] * resolution), float(low[1] * resolution)))


def _spaced(poses: Float[ndarray, "frames 3"], way: float) -> Int[ndarray, "n"]:
    """Indices of poses about ``way`` metres apart along a drive, the first among them."""
    run = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)))
    return np.unique(np.floor(run / way), return_index=True)[1]
