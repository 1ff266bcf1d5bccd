"""Floor plans of rectangular rooms: thick walls with doors in them, ways from room to room, furniture off the way.

A plan is drawn from the robot's way: rooms are convex, so a way from point to point within one and straight through
the middle of its doors meets no wall, and furniture is put where the way does not pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.simulation.rooms import box
from echogrid.simulation.world import polyline

KEPT_M = 0.55
"""Furniture and pillars stay so far from the way: the widest robot, and what it cuts at corners."""

_INSIDE_M = 0.55
"""A way through a door is straight from so far before it to so far behind."""


@dataclass(frozen=True)
class Door:
    """A door between two rooms whose rectangles touch."""

    rooms: tuple[int, int]
    axis: int
    """0: the wall runs along y, the way through along x; 1: the other way round."""
    at: float
    """Where the wall lies along the axis, m."""
    span: tuple[float, float]
    """Where the door begins and ends across it, m."""

    def point(self, side: int, off: float) -> tuple[float, float]:
        """A point before (side -1) or behind (side 1) the door's middle, at a distance, m."""
        place = (self.at + side * off, sum(self.span) / 2)
        return place if self.axis == 0 else place[::-1]


@dataclass(frozen=True)
class Plan:
    """Rooms side by side and the doors between them."""

    rooms: Float[ndarray, "rooms 4"]
    """Lowest and highest x, then y, of each: x0, y0, x1, y1, m; the walls' thickness is within."""
    doors: tuple[Door, ...]
    thick: float
    """Of all walls, m."""

    def doors_of(self, room: int) -> list[int]:
        """Numbers of the doors of a room."""
        return [i for i, door in enumerate(self.doors) if room in door.rooms]

    def walls(self) -> list[Float[ndarray, "walls 4"]]:
        """Groups of walls, each of one surface: the sides of each room, and the jambs of each door."""
        half, groups = self.thick / 2, []
        for number, (x0, y0, x1, y1) in enumerate(self.rooms):
            for axis, at, low, high, sign in (
                (0, x0, y0, y1, 1), (0, x1, y0, y1, -1), (1, y0, x0, x1, 1), (1, y1, x0, x1, -1),
            ):  # fmt: skip
                gaps = sorted(
                    door.span for i in self.doors_of(number)
                    if (door := self.doors[i]).axis == axis and abs(door.at - at) < 1e-6
                )  # fmt: skip
                ends = [low + half, *(edge for span in gaps for edge in span), high - half]
                groups.append(
                    np.array(
                        [_piece(axis, at + sign * half, a, b) for a, b in zip(ends[::2], ends[1::2], strict=True)]
                    )
                )
        for door in self.doors:
            jambs = [_piece(1 - door.axis, edge, door.at - half, door.at + half) for edge in door.span]
            groups.append(np.array(jambs))
        return groups


def _piece(axis: int, at: float, low: float, high: float) -> list[float]:
    """A wall across an axis: x0, y0, x1, y1."""
    return [at, low, at, high] if axis == 0 else [low, at, high, at]


def between(
    rng: np.random.Generator, rooms: Float[ndarray, "rooms 4"], i: int, j: int, width: tuple[float, float]
) -> Door | None:
    """A door (its width drawn, m) somewhere in the wall that two rooms share, or None where that is too short."""
    a, b = rooms[i], rooms[j]
    for axis in (0, 1):
        across = 1 - axis
        for first, second in ((a, b), (b, a)):
            low, high = max(a[across], b[across]), min(a[across + 2], b[across + 2])
            wide = float(rng.uniform(*width))
            if abs(first[axis + 2] - second[axis]) < 1e-6 and high - low > wide + 0.3:
                edge = min(0.35, (high - low - wide) / 2)
                begin = float(rng.uniform(low + edge, high - edge - wide))
                rooms_ = (i, j) if first is a else (j, i)
                return Door(rooms_, axis, float(first[axis + 2]), (begin, begin + wide))
    return None


def way_through(rng: np.random.Generator, plan: Plan, length: float, first: int = 0) -> Float[ndarray, "n 2"]:
    """Waypoints of a drive from room to room, always on to the room that was seen least, at least ``length`` m.

    In each such room it goes round some of the corners of a rectangle within, in one direction or the other; those on
    the way there it only passes. It ends once every room was seen, however long that takes.
    """
    seen = np.zeros(len(plan.rooms))
    here, run = first, 0.0
    points = _round(rng, plan.rooms[here], None)
    seen[here] = 1
    while run < length or not seen.all():
        routes = _routes(rng, plan, here)
        there = min(routes, key=lambda room: (seen[room], len(routes[room]), rng.random()))
        for number in routes[there]:
            door = plan.doors[number]
            side = -1 if door.rooms[0] == here else 1
            points += [door.point(side, _INSIDE_M), door.point(-side, _INSIDE_M)]
            here = door.rooms[1] if side < 0 else door.rooms[0]
        seen[here] += 1
        points += _round(rng, plan.rooms[here], points[-1])
        run = float(np.sum(np.linalg.norm(np.diff(np.array(points), axis=0), axis=1)))
    return np.array(points)


def _routes(rng: np.random.Generator, plan: Plan, here: int) -> dict[int, list[int]]:
    """For each other room the doors on the way there, through as few as can be."""
    routes: dict[int, list[int]] = {here: []}
    edge = [here]
    for room in edge:
        for number in rng.permutation(plan.doors_of(room)).tolist():
            beyond = sum(plan.doors[number].rooms) - room
            if beyond not in routes:
                routes[beyond] = [*routes[room], number]
                edge.append(beyond)
    del routes[here]
    assert len(routes) == len(plan.rooms) - 1, "a plan has doors to all rooms"
    return routes


def _round(
    rng: np.random.Generator, room: Float[ndarray, "4"], entered: tuple[float, float] | None
) -> list[tuple[float, float]]:
    """Points of a way round a room (m) from where it was entered; a narrow one is gone along."""
    x0, y0, x1, y1 = room
    inset = rng.uniform(0.65, 1.0, 4)
    low = np.minimum([x0 + inset[0], y0 + inset[1]], [(x0 + x1) / 2 - 0.02, (y0 + y1) / 2 - 0.02])
    high = np.maximum([x1 - inset[2], y1 - inset[3]], [(x0 + x1) / 2 + 0.02, (y0 + y1) / 2 + 0.02])
    if min(high - low) < 0.6:  # a corridor: to one end of it
        end = low if rng.random() < 0.5 else high
        middle, long_ = (low + high) / 2, int(np.argmax(high - low))
        middle[long_] = end[long_]
        return [tuple(middle)]
    corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    start = 0 if entered is None else int(np.argmin([np.hypot(x - entered[0], y - entered[1]) for x, y in corners]))
    step = int(rng.choice([-1, 1]))
    return [corners[(start + step * i) % 4] for i in range(int(rng.integers(2, 5)))]


def furnished(
    rng: np.random.Generator,
    rooms: Sequence[Float[ndarray, "4"]],
    way: Float[ndarray, "n 2"],
    density: float,
) -> tuple[list[Float[ndarray, "walls 4"]], list[list[float]]]:
    """Boxes and posts in rooms (as many for each as ``density`` tells in the mean), none of them near the way."""
    groups, posts = [], []
    line = spaced(way, 0.1)
    for x0, y0, x1, y1 in rooms:
        for _ in range(rng.poisson(density)):
            x, y = rng.uniform([x0 + 0.25, y0 + 0.25], [x1 - 0.25, y1 - 0.25])
            if rng.random() < 0.25:
                radius = float(rng.uniform(0.03, 0.2))
                if _gap(line, np.array([[x, y]])) > radius + KEPT_M:
                    posts.append([float(x), float(y), radius])
                continue
            piece = box(rng, x, y, 0.3, 1.1)
            corners = piece[:, :2]
            inside = np.all((corners > [x0 + 0.1, y0 + 0.1]) & (corners < [x1 - 0.1, y1 - 0.1]))
            rim = np.concatenate([a + (b - a) * np.linspace(0, 1, 8)[:, None] for a, b in
                                  zip(corners, np.roll(corners, -1, axis=0), strict=True)])  # fmt: skip
            if inside and _gap(line, rim) > KEPT_M:
                groups.append(piece)
    return groups, posts


def spaced(way: Float[ndarray, "n 2"], step: float) -> Float[ndarray, "m 2"]:
    """Points along a way, at most ``step`` m apart."""
    parts = [
        a + (b - a) * np.arange(0, 1, step / max(step, np.linalg.norm(b - a)))[:, None] for a, b in pairwise(way)
    ]
    return np.concatenate([*parts, way[-1:]])


def _gap(line: Float[ndarray, "n 2"], points: Float[ndarray, "m 2"]) -> float:
    return float(np.min(np.linalg.norm(line[:, None] - points[None], axis=-1)))


def closed(points: Float[ndarray, "n 2"]) -> list[Float[ndarray, "1 4"]]:
    """The sides of a polygon, each a surface of its own."""
    return [polyline([a, b]) for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
