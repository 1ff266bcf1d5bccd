"""Buildings to drive in, each with a way through it: flats, rings of corridors, halls with pillars, whole floors.

Everything is drawn from a generator; a building is the same for all robots, as the widest of them gets through.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import World
from echogrid.simulation.rooms import random_roughness
from echogrid.simulation.world import polyline
from experiments.studies.position.plans import KEPT_M, Door, Plan, between, closed, furnished, spaced, way_through

Shape = tuple[list[Float[ndarray, "walls 4"]], list[list[float]], Float[ndarray, "n 2"]]
"""Groups of walls, each of one surface; pillars (x, y, radius); waypoints. All in m."""

DOOR_M = (0.85, 1.0)
LAPS = 4
WALLS = ("smooth", "rough", "mixed")


@dataclass(frozen=True)
class Building:
    """A world and a way through it."""

    world: World
    way: Float[ndarray, "n 2"]
    """Waypoints, m."""


def flat(rng: np.random.Generator) -> Shape:
    """Six rooms in two rows, or three to each side of a corridor, driven through for 120 to 160 m."""
    width, depths = rng.uniform(9.5, 13.0), rng.uniform(2.9, 4.2, 2)
    hall = float(rng.choice([0.0, rng.uniform(1.5, 2.0)]))
    rooms = []
    for y0, y1 in ((0.0, depths[0]), (depths[0] + hall, depths.sum() + hall)):
        cuts = width * (np.arange(1, 3) / 3 + rng.uniform(-0.05, 0.05, 2))
        edges = [0.0, *cuts, width]
        rooms += [[a, y0, b, y1] for a, b in pairwise(edges)]
    pairs = [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3), (1, 4), (2, 5)]
    if hall:
        rooms.append([0.0, depths[0], width, depths[0] + hall])
        pairs = [(i, 6) for i in range(6)] + [(0, 1), (4, 5)]
    else:
        # A door less makes some of it blind alleys, so that ways lead back through the same doors.
        pairs.pop(int(rng.integers(0, 4)))
    return _of_rooms(rng, np.array(rooms), pairs, rng.uniform(124.0, 150.0), 6.0)


def floors(rng: np.random.Generator) -> Shape:
    """Two corridors with four rooms to each side and a link at each end, 500 m."""
    rooms, pairs, base = [], [], 0.0
    width = rng.uniform(16.0, 19.0)
    for _ in range(2):
        depth, hall, first = rng.uniform(3.2, 4.5, 2), rng.uniform(1.6, 2.2), len(rooms)
        for y0, y1 in ((base, base + depth[0]), (base + depth[0] + hall, base + depth.sum() + hall)):
            cuts = width * (np.arange(1, 4) / 4 + rng.uniform(-0.03, 0.03, 3))
            edges = [0.0, *cuts, width]
            rooms += [[a, y0, b, y1] for a, b in pairwise(edges)]
        rooms.append([0.0, base + depth[0], width, base + depth[0] + hall])
        pairs += [(first + i, first + 8) for i in range(8)]
        pairs += [(first, first + 1), (first + 6, first + 7)]
        base = float(base + depth.sum() + hall)
    # The links run along the ends of both corridors.
    ends = rng.uniform(1.6, 2.2, 2)
    (low, high) = rooms[8][1], rooms[17][3]
    rooms += [[-ends[0], low, 0.0, high], [width, low, width + ends[1], high]]
    pairs += [(8, 18), (17, 18), (8, 19), (17, 19)]
    return _of_rooms(rng, np.array(rooms), pairs, 515.0, 6.0)


def _of_rooms(
    rng: np.random.Generator,
    rooms: Float[ndarray, "rooms 4"],
    pairs: list[tuple[int, int]],
    length: float,
    density: float,
) -> Shape:
    """The shape of rooms with doors between some, driven through until the way is so long that all were seen."""
    doors: list[Door] = [door for i, j in pairs if (door := between(rng, rooms, i, j, DOOR_M))]
    plan = Plan(rooms, tuple(doors), float(rng.uniform(0.06, 0.2)))
    way = way_through(rng, plan, length)
    boxes, posts = furnished(rng, list(rooms), way, density)
    return plan.walls() + boxes, posts, way


def ring(rng: np.random.Generator) -> Shape:
    """A corridor round a block, with recessed doors and a bay or two, lapped LAPS times: 160 to 180 m."""
    wide, half = rng.uniform(1.5, 2.3), rng.uniform(21.3, 23.0)
    a = rng.uniform(0.5, 0.68) * half
    middle = np.array([[0.0, 0.0], [a, 0.0], [a, half - a], [0.0, half - a]])
    if rng.random() < 0.4:  # a corner is turned inwards, which leaves the length of a lap as it is
        x, y = a * rng.uniform(0.5, 0.65), (half - a) * rng.uniform(0.4, 0.55)
        middle = np.array([[0.0, 0.0], [a, 0.0], [a, y], [x, y], [x, half - a], [0.0, half - a]])
    outer, inner = _beside(middle, -wide / 2), _beside(middle, wide / 2)
    groups = [wall for side in (outer, inner) for wall in _with_doors(rng, side, -1.0 if side is outer else 1.0)]
    lap = _round_corners(middle, min(0.6, wide / 3))
    wander = lap + rng.uniform(-0.12, 0.12, (LAPS, *lap.shape))
    return groups, [], np.concatenate([*wander, wander[0, :1]])


def _beside(polygon: Float[ndarray, "n 2"], off: float) -> Float[ndarray, "n 2"]:
    """A polygon of right angles (counter-clockwise) with its sides moved to the left, m."""
    ahead = np.roll(polygon, -1, axis=0) - polygon
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    return polygon + off * (left + np.roll(left, 1, axis=0))


def _with_doors(
    rng: np.random.Generator, polygon: Float[ndarray, "n 2"], out: float
) -> list[Float[ndarray, "walls 4"]]:
    """The sides of a polygon with doors recessed to the left (``out`` 1) or right (-1) of it, a surface for each."""
    groups = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        length = float(np.linalg.norm(b - a))
        u = (b - a) / length
        left = out * np.array([-u[1], u[0]])
        start, s = a, rng.uniform(0.5, 2.0)
        while s + 1.4 < length:
            door, depth = (
                rng.uniform(0.8, 1.1),
                rng.choice([0.04, 0.08, 0.15, 0.3, 0.6], p=[0.25, 0.25, 0.25, 0.15, 0.1]),
            )
            first, last = a + s * u, a + (s + door) * u
            groups.append(np.array([[*start, *first]]))
            groups.append(polyline([first, first + depth * left, last + depth * left, last]))
            start, s = last, s + door + rng.uniform(0.8, 4.0)
        groups.append(np.array([[*start, *b]]))
    return groups


def _round_corners(polygon: Float[ndarray, "n 2"], cut: float) -> Float[ndarray, "m 2"]:
    """The corners of a polygon cut off by a length (m) on both sides."""
    ahead = np.roll(polygon, -1, axis=0) - polygon
    u = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return np.stack([polygon - cut * np.roll(u, 1, axis=0), polygon + cut * u], axis=1).reshape(-1, 2)


def hall(rng: np.random.Generator) -> Shape:
    """A hall with pillars and a few boxes, driven through for 190 m; in its middle no wall is in reach."""
    columns, rows = int(rng.integers(3, 5)), int(rng.integers(2, 4))
    step, rim = rng.uniform(3.6, 4.6), rng.uniform(2.7, 3.4)
    size = np.array([columns, rows]) * step + 2 * rim
    corners = np.array([[0, 0], [size[0], 0], size, [0, size[1]]])
    # The robot drives from crossing to crossing of aisles; the pillars stand between them.
    stand = rim + (np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2) + 0.5) * step
    stand = stand + rng.uniform(-0.4, 0.4, stand.shape)
    pillars = [[*map(float, p), float(rng.uniform(0.12, 0.35))] for p in stand if rng.random() < 0.85]
    used: dict[tuple[int, int, int, int], float] = {}
    here, points, run = (0, 0), [], 0.0
    while run < 190.0:
        points.append(rim + np.array(here) * step + rng.uniform(-0.25, 0.25, 2))
        near = [(here[0] + dx, here[1] + dy) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        near = [n for n in near if 0 <= n[0] <= columns and 0 <= n[1] <= rows]
        price = [used.get((*min(here, n), *max(here, n)), 0.0) + 0.8 * rng.random() for n in near]
        there = near[int(np.argmin(price))]
        used[(*min(here, there), *max(here, there))] = used.get((*min(here, there), *max(here, there)), 0.0) + 1
        here, run = there, run + step
    way = np.array(points)
    boxes, posts = furnished(rng, [np.array([0, 0, *size])], way, 14.0)
    line = spaced(way, 0.1)
    pillars = [p for p in pillars if np.min(np.hypot(*(line - p[:2]).T)) > p[2] + KEPT_M]
    return closed(corners) + boxes, pillars + posts, way


KINDS: dict[str, Callable[[np.random.Generator], Shape]] = {
    "flat": flat,
    "ring": ring,
    "hall": hall,
    "floors": floors,
}


def building(kind: str, walls: str, number: int) -> Building:
    """The ``number``-th building of one of KINDS with WALLS of a kind, turned at random.

    Its form and the way do not depend on the walls.
    """
    seed = [SEED, list(KINDS).index(kind), number]
    rng = np.random.default_rng(seed)
    groups, pillars, way = KINDS[kind](rng)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    heights = random_roughness(np.random.default_rng([*seed, WALLS.index(walls)]), len(groups), walls)
    pieces = (np.concatenate(groups).reshape(-1, 2) @ turn).reshape(-1, 4)
    roughness = np.repeat(heights, [len(group) for group in groups])
    long_enough = np.linalg.norm(pieces[:, 2:] - pieces[:, :2], axis=1) > 0.01
    round_ = np.array(pillars, dtype=float).reshape(-1, 3)
    round_[:, :2] = round_[:, :2] @ turn
    return Building(World(f"{kind}-{number}", pieces[long_enough], roughness[long_enough], round_), way @ turn)


SEED = 310_000_000
"""Of all buildings; no training and no other study draws from it."""
