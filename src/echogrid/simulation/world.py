"""What a robot drives through: walls, each rough or smooth, and cylinders, and its YAML.

Worlds are plane. A wall is a straight piece with two reflecting sides and no thickness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.errors import InputError, UsageError
from echogrid.files import shipped_names, shipped_or_file
from echogrid.simulation.targets import Corner, Cylinder, Edge, Plane
from echogrid.yaml_keys import Keys, as_number, parse_yaml, shown

SMOOTH_M, ROUGH_M = 0.05e-3, 2.0e-3
"""Rms heights of a mirror (varnished wood) and of the paper's almost ideal wall (granulated paint)."""

_TOUCH_M = 0.005
"""Points closer than this are one point."""


_BLOCK = 20_000
"""Pairs of a point and a wall that are looked at together."""


@dataclass(frozen=True)
class World:
    """Walls and cylinders in the plane."""

    name: str
    walls: Float[ndarray, "walls 4"]
    """End points of each wall: x0, y0, x1, y1, m."""
    roughness: Float[ndarray, "walls"]
    """Rms height of each wall's surface, m."""
    cylinders: Float[ndarray, "cylinders 3"]
    """x, y, radius, m."""
    start: tuple[float, float] | None = None
    """A point of the free space in which drives run, m."""

    def __repr__(self) -> str:
        return f"World({self.name!r}, {len(self.walls)} walls, {len(self.cylinders)} cylinders)"

    def with_walls(self, kind: str) -> "World":
        """The same world with all walls ``smooth`` or ``rough``, or ``as-given``.

        Raises:
            UsageError: another kind.
        """
        if kind == "as-given":
            return self
        heights = {"smooth": SMOOTH_M, "rough": ROUGH_M}
        if kind not in heights:
            raise UsageError(f"walls: found {kind}, expected smooth, rough or as-given")
        return replace(self, roughness=np.full(len(self.walls), heights[kind]))

    def planes(self) -> list[Plane]:
        """Both sides of every wall's line, in the order of the walls."""
        normal, R = self.hessian()
        theta = np.arctan2(normal[:, 1], normal[:, 0])
        return [Plane(float(r), float(t), v) for r, t in zip(R, theta, strict=True) for v in (1, -1)]

    def hessian(self) -> tuple[Float[ndarray, "walls 2"], Float[ndarray, "walls"]]:
        """Unit normal and distance from the origin of each wall's line."""
        along = self.walls[:, 2:] - self.walls[:, :2]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
        return normal, np.sum(normal * self.walls[:, :2], axis=1)

    @cached_property
    def vertices(self) -> tuple[list[Corner], list[Edge], Float[ndarray, "edges 4"]]:
        """The corners and edges at the ends of walls, and for each edge the sector it is hidden from.

        At a vertex the walls leave sectors between them. A sector of less than a half turn shows a corner; a
        sector of more than a half turn shows an edge. The sector hidden from the edge is the rest, given by
        the unit vectors of the two walls that bound it (counter-clockwise); a free end is hidden from nowhere
        and has zeros.
        """
        corners: list[Corner] = []
        edges: list[Edge] = []
        hidden: list[Float[ndarray, "4"]] = []
        for point in _distinct(np.concatenate([self.walls[:, :2], self.walls[:, 2:]])):
            bearings = self._bearings_at(point)
            gaps = np.diff(np.append(bearings, bearings[0] + 2 * np.pi))
            if len(bearings) == 1:
                edges.append(Edge(*point))
                hidden.append(np.zeros(4))
                continue
            corners += [Corner(*point)] * int(np.sum(gaps < np.pi - 0.02))
            wide = int(np.argmax(gaps))
            if gaps[wide] > np.pi + 0.02:
                first, last = bearings[(wide + 1) % len(bearings)], bearings[wide]
                edges.append(Edge(*point))
                hidden.append(np.array([np.cos(first), np.sin(first), np.cos(last), np.sin(last)]))
        return corners, edges, np.array(hidden).reshape(-1, 4)

    def _bearings_at(self, point: Float[ndarray, "2"]) -> Float[ndarray, "n"]:
        """Directions in which walls leave a point, counter-clockwise; a wall passing through counts twice."""
        a, b = self.walls[:, :2], self.walls[:, 2:]
        length = np.linalg.norm(b - a, axis=1)
        along = (b - a) / length[:, None]
        s = np.sum((point - a) * along, axis=1)
        across = np.abs(np.sum((point - a) * np.stack([-along[:, 1], along[:, 0]], axis=1), axis=1))
        touch = (across < _TOUCH_M) & (s > -_TOUCH_M) & (s < length + _TOUCH_M)
        out = np.concatenate([along[touch & (s < length - _TOUCH_M)], -along[touch & (s > _TOUCH_M)]])
        bearings = np.sort(np.arctan2(out[:, 1], out[:, 0]))
        return bearings[np.diff(bearings, prepend=bearings[-1] - 2 * np.pi) > 1e-3]

    def targets(self) -> list[Plane | Corner | Edge | Cylinder]:
        """All of Leonard's targets in the world."""
        corners, edges, _ = self.vertices
        return [*self.planes(), *corners, *edges, *(Cylinder(*map(float, c)) for c in self.cylinders)]

    def bounds(self) -> tuple[Float[ndarray, "2"], Float[ndarray, "2"]]:
        """Lowest and highest x, y of anything in the world, m."""
        points = [self.walls.reshape(-1, 2)]
        points += [
            self.cylinders[:, :2] - self.cylinders[:, 2:],
            self.cylinders[:, :2] + self.cylinders[:, 2:],
        ]
        corners = np.concatenate(points)
        return corners.min(axis=0), corners.max(axis=0)

    def clearance(self, p_world: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
        """Distance of each point to the nearest wall or cylinder, m; negative inside a cylinder."""
        nearest = np.full(len(p_world), np.inf)
        a, along = self.walls[:, :2], self.walls[:, 2:] - self.walls[:, :2]
        # So many points at once that what lies between them and the walls stays near the processor.
        block = max(1, _BLOCK // (len(self.walls) + len(self.cylinders)))
        for first in range(0, len(p_world), block):
            p = p_world[first : first + block, None]
            if len(a):
                s = np.clip(np.sum((p - a) * along, axis=-1) / np.sum(along**2, axis=-1), 0, 1)
                off = p - a - s[..., None] * along
                nearest[first : first + block] = np.sqrt(np.min(np.sum(off**2, axis=-1), axis=1))
            for x, y, radius in self.cylinders:
                gap = np.hypot(p[:, 0, 0] - x, p[:, 0, 1] - y) - radius
                nearest[first : first + block] = np.minimum(nearest[first : first + block], gap)
        return nearest

    def sight(self, p_world: Float[ndarray, "n 2"], bearing: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
        """Distance along each ray to what it meets first, m; inf where nothing. Plain geometry, no sound."""
        u = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        nearest = np.full(len(p_world), np.inf)
        for x0, y0, x1, y1 in self.walls:
            along, to = np.array([x1 - x0, y1 - y0]), np.array([x0, y0]) - p_world
            det = u[:, 0] * along[1] - u[:, 1] * along[0]
            det = np.where(np.abs(det) < 1e-12, np.nan, det)
            t = (to[:, 0] * along[1] - to[:, 1] * along[0]) / det
            s = (to[:, 0] * u[:, 1] - to[:, 1] * u[:, 0]) / det
            nearest = np.where((t > 0) & (s >= 0) & (s <= 1) & (t < nearest), t, nearest)
        for x, y, radius in self.cylinders:
            to = np.array([x, y]) - p_world
            ahead = np.sum(to * u, axis=1)
            half = radius**2 - (np.sum(to**2, axis=1) - ahead**2)
            t = ahead - np.sqrt(np.maximum(half, 0))
            nearest = np.where((half >= 0) & (t > 0) & (t < nearest), t, nearest)
        return nearest

    @staticmethod
    def load(name_or_file: str | Path) -> "World":
        """A world that ships with the package by name, or a world file.

        Raises:
            InputError: the file is wrong; the message names the key.
            UsageError: neither a shipped world nor a file.
        """
        return parse_world(shipped_or_file(name_or_file, "worlds", "world"), str(Path(name_or_file)))


def world_names() -> list[str]:
    """Names of the worlds that ship with the package."""
    return shipped_names("worlds")


def polyline(
    points: Sequence[Sequence[float] | Float[ndarray, "2"]] | Float[ndarray, "n 2"], closed: bool = False
) -> Float[ndarray, "m 4"]:
    """The walls along a line of points (m)."""
    line = np.asarray(points, dtype=float)
    ends = np.roll(line, -1, axis=0) if closed else line[1:]
    return np.concatenate([line if closed else line[:-1], ends], axis=1)


def _distinct(points: Float[ndarray, "n 2"]) -> Float[ndarray, "m 2"]:
    """The points without those that touch an earlier one."""
    touch = np.linalg.norm(points[:, None] - points[None], axis=-1) < _TOUCH_M
    return points[~np.any(np.tril(touch, -1), axis=1)]


def parse_world(text: str, where: str) -> World:
    """Read a world from YAML text (the format is in docs/formats.md).

    Raises:
        InputError: the message names the key.
    """
    keys = frozenset({"name", "description", "walls", "cylinders", "start"})
    top = Keys(where, parse_yaml(text, where), allowed=keys)
    walls, roughness = [np.zeros((0, 4))], [np.zeros(0)]
    for i, item in enumerate(_items(top, "walls")):
        wall = Keys(where, item, f"walls[{i}]", frozenset({"points", "closed", "roughness_mm"}))
        points = wall.rows("points", 2, -1e4, 1e4, least=2)
        closed = wall.data.get("closed", False)
        if not isinstance(closed, bool):
            raise InputError(wall.at("closed"), repr(closed), "true or false")
        pieces = polyline(points, closed)
        short = np.flatnonzero(np.linalg.norm(pieces[:, 2:] - pieces[:, :2], axis=1) < 2 * _TOUCH_M)
        if short.size:
            raise InputError(f"{wall.at('points')}[{short[0]}]", "a wall shorter than 1 cm", "distinct points")
        walls.append(pieces)
        roughness.append(np.full(len(pieces), wall.number("roughness_mm", 0.0, 100.0) * 1e-3))
    cylinders = []
    for i, item in enumerate(_items(top, "cylinders")):
        cylinder = Keys(where, item, f"cylinders[{i}]", frozenset({"centre", "radius_m"}))
        centre = _point(cylinder, "centre")
        cylinders.append([*centre, cylinder.number("radius_m", 1e-3, 100.0)])
    if not len(walls) + len(cylinders) > 1:
        raise InputError(top.at("walls"), "no wall and no cylinder", "at least one")
    return World(
        top.text("name"),
        np.concatenate(walls),
        np.concatenate(roughness),
        np.array(cylinders, dtype=float).reshape(-1, 3),
        _point(top, "start") if "start" in top.data else None,
    )


def _items(keys: Keys, key: str) -> list[object]:
    value = keys.data.get(key, [])
    if not isinstance(value, list):
        raise InputError(keys.at(key), shown(value), "a list")
    return value


def _point(keys: Keys, key: str) -> tuple[float, float]:
    value = keys.take(key)
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(keys.at(key), shown(value), "two numbers [x, y]")
    x, y = (as_number(v, -1e4, 1e4, keys.at(key)) for v in value)
    return x, y


def inside_room(world: World, p_world: Float[ndarray, "n 2"]) -> Bool[ndarray, "n"]:
    """Whether each point is shut in by walls: a sight line ends in every one of 16 directions."""
    shut = np.ones(len(p_world), dtype=bool)
    for bearing in np.arange(16) * (2 * np.pi / 16) + 0.1:
        shut &= np.isfinite(world.sight(p_world, np.full(len(p_world), bearing)))
    return shut
