"""Places that are worth a look: where the floor that is known to be free ends, though the robot might go on."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import ConvexHull

from echogrid import _core
from echogrid.geometry import wrap
from echogrid.planning.clearance import Floor, spread, swept
from echogrid.robot import Robot

BEYOND_M = 0.15
"""What the robot could reach only within this of where it can be counts as seen: rims of walls are never sure."""

LEAST_M2 = 0.04
"""Of places beyond that for the robot's middle; less is no room."""

APART_M = 1.5
"""A frontier longer than this is looked at in parts."""

STAND_M = 0.4
"""So far from the edge the robot stands, at most, to look from where its sonars hear what is beyond."""

ROOM_WORTH = 2.0
"""Where a robot stands each centimetre of range that it hears is worth so many of way."""

LONE_M, BESIDE_M, LONE_SHARE = 0.6, 0.16, 0.75
"""What stands alone is at most so large, m, and so much of the ground within the second of it is free; what is heard
of posts in a door has unknown ground behind it."""

REACH_M = 2.0
"""How far a look tells, m."""

_RAYS, _RAY_STEP_M = 72, 0.08
"""Of a look round."""

MOST = 40
"""Frontiers that are weighed, those nearest to the robot."""


@dataclass(frozen=True)
class Reach:
    """Where a robot gets to on a floor from one place, and what that costs."""

    floor: Floor
    to_go: Float[ndarray, "rows cols"]
    """What it costs from each cell to where the robot is; inf where there is no way."""

    @staticmethod
    def of(floor: Floor, at: tuple[int, int]) -> "Reach":
        """From a cell [row, col], which must be open."""
        return Reach(floor, _core.cost_to_go(floor.known_costs, np.array([at], np.int64), floor.grid.resolution))

    @cached_property
    def cells(self) -> Bool[ndarray, "rows cols"]:
        """Where the robot's middle can get to."""
        return np.isfinite(self.to_go)

    @property
    def beyond(self) -> int:
        """BEYOND_M in cells."""
        return max(1, round(BEYOND_M / self.floor.grid.resolution))

    @cached_property
    def near(self) -> Bool[ndarray, "rows cols"]:
        """Likewise, and what is within BEYOND_M of that."""
        return _grown(self.cells, self.beyond)

    @cached_property
    def hull(self) -> Float[ndarray, "sides 3"]:
        """Of the ground that is known to be free: a point (x, y) is within where a x + b y + c <= 0 for all sides."""
        rows = np.flatnonzero(self.floor.free.any(axis=1))
        free = self.floor.free[rows]
        first, last = np.argmax(free, axis=1), free.shape[1] - 1 - np.argmax(free[:, ::-1], axis=1)
        corners = [np.column_stack([col, rows + k]) for col in (first, last + 1) for k in (0, 1)]
        grid = self.floor.grid
        return ConvexHull(np.array(grid.origin) + grid.resolution * np.concatenate(corners)).equations

    @cached_property
    def lone(self) -> Bool[ndarray, "rows cols"]:
        """What is occupied and stands alone on free ground, as pillars and legs do: no door, however unsure."""
        floor, lone = self.floor, np.zeros_like(self.floor.free)
        pieces, _ = ndimage.label(floor.occupied, np.ones((3, 3)))
        most, by = LONE_M / floor.grid.resolution, round(BESIDE_M / floor.grid.resolution)
        for number, box in enumerate(ndimage.find_objects(pieces), 1):
            if all(side.stop - side.start <= most for side in box):
                wider = tuple(slice(max(0, side.start - by), side.stop + by) for side in box)
                piece = pieces[wider] == number
                beside = ndimage.binary_dilation(piece, iterations=by) & ~piece
                lone[wider] |= piece & (np.mean(floor.free[wider][beside]) > LONE_SHARE)
        return lone


@dataclass(frozen=True)
class Frontier:
    """A place at the edge of what is known, which the robot can get to. What it shows is looked up when asked for."""

    cell: tuple[int, int]
    """Middle of the edge, [row, col]."""
    place: Float[ndarray, "2"]
    """Likewise, m."""
    cost: float
    """Of the way there, as of ``Floor.costs``, m."""
    reach: Reach = field(repr=False)
    robot: Robot = field(repr=False)
    solid: Bool[ndarray, "rows cols"] = field(repr=False)
    """Where a line of sight ends."""

    @cached_property
    def stand(self) -> tuple[int, int]:
        """Where the robot stands for its first look, [row, col], within STAND_M of the edge."""
        return _stand(self.reach.floor, self.robot.deaf_m, np.array(self.cell), self.reach.cells)

    @property
    def off_walls(self) -> tuple[int, int]:
        """Likewise nearer to the edge, where there is half that room."""
        return _stand(self.reach.floor, self.robot.deaf_m / 2, np.array(self.cell), self.reach.cells)

    @property
    def heading(self) -> float:
        """Into which it sees most from there, rad."""
        return self._seen[0]

    @property
    def gain_m2(self) -> float:
        """Unknown ground that its sonars would see there."""
        return self._seen[1]

    @property
    def promise_m2(self) -> float:
        """Of that round it: what nothing occupied hides, and what lies within the hull of what is free; both count.

        Weak spots of walls, and corners above all, have next to none: of 1,600 with less than 0.6 m2 one was a door.
        """
        return self._seen[2]

    @cached_property
    def _seen(self) -> tuple[float, float, float]:
        return look(self.reach.floor, self.robot, self.place, self.solid, self.reach.hull)


def frontiers(
    reach: Reach, robot: Robot, sure: float, least_m2: float = LEAST_M2, share: float = 1.0
) -> list[Frontier]:
    """The frontiers of a floor, those nearest to the robot first.

    Args:
        reach: where the robot gets to.
        robot: for its sonars.
        sure: what is occupied with less than this probability may be a door yet.
        least_m2: what is beyond must have so much room for the robot's middle.
        share: of the width of the robot that a door has in the map at least; posts may look thicker than they are.
    """
    floor = reach.floor
    solid = floor.above(sure) | reach.lone
    groups = _groups(floor, _edge(reach, solid, least_m2, share * floor.radius_m), reach.to_go)
    found = []
    for cells in groups:
        cell = _middle(floor, robot, cells)
        place = floor.grid.centre_of(np.array(cell))
        found.append(Frontier(cell, place, float(reach.to_go[cell]), reach, robot, solid))
    return found


def _middle(floor: Floor, robot: Robot, cells: Int[ndarray, "n 2"]) -> tuple[int, int]:
    """The cell of an edge that is nearest to its middle, but rather where there is room."""
    off = np.linalg.norm(cells - np.mean(cells, axis=0), axis=1) * floor.grid.resolution
    row, col = cells[np.argmin(off + ROOM_WORTH * floor.short_m(cells, robot.deaf_m))].tolist()
    return row, col


def _edge(
    reach: Reach, solid: Bool[ndarray, "rows cols"], least_m2: float, radius_m: float
) -> Bool[ndarray, "rows cols"]:
    """Cells in reach beside which there is room for a disc, unless what is unknown turns out occupied."""
    size = reach.floor.grid.resolution
    deep = ~(swept(solid, radius_m, size) | reach.near)
    pieces, count = ndimage.label(deep)
    room = np.bincount(pieces.ravel(), minlength=count + 1) * size**2 >= least_m2
    room[0] = False
    by = reach.beyond + 1 + round((reach.floor.radius_m - radius_m) / size)
    edge = reach.cells & _grown(np.take(room, pieces), by)
    if radius_m < reach.floor.radius_m:  # posts that look thick; not corners of which nothing was heard
        edge &= _grown(reach.floor.occupied & ~solid, by)
    return edge


def _grown(cells: Bool[ndarray, "rows cols"], by: int) -> Bool[ndarray, "rows cols"]:
    """Cells within some of a square round each."""
    return spread(spread(cells, by, 0), by, 1)


def _groups(
    floor: Floor, edge: Bool[ndarray, "rows cols"], to_go: Float[ndarray, "rows cols"]
) -> list[Int[ndarray, "n 2"]]:
    """The cells of each frontier, those nearest to the robot first; long ones in parts."""
    labels, _ = ndimage.label(edge, np.ones((3, 3)))
    cells = np.column_stack(np.divmod(np.flatnonzero(edge), edge.shape[1]))  # argwhere takes longer
    # Parts by squares of the lattice, so that they stay the same while the map grows.
    square = np.floor(floor.grid.centre_of(cells) / APART_M).astype(int)
    keys = np.column_stack([labels[tuple(cells.T)], square])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    parts = [cells[group.ravel() == k] for k in range(group.max(initial=-1) + 1)]
    return sorted(parts, key=lambda part: float(np.min(to_go[tuple(part.T)])))[:MOST]


def _stand(
    floor: Floor, deaf_m: float, edge: Int[ndarray, "2"], reach: Bool[ndarray, "rows cols"]
) -> tuple[int, int]:
    """The cell in reach near one at an edge, straight ahead of it, so far (m) off what is not known as can be."""
    by = int(STAND_M / floor.grid.resolution)
    first, last = np.maximum(edge - by, 0), np.minimum(edge + by + 1, floor.grid.shape)
    near = np.argwhere(reach[first[0] : last[0], first[1] : last[1]]) + first
    off = np.linalg.norm(near - edge, axis=1) * floor.grid.resolution
    near, off = near[off <= STAND_M], off[off <= STAND_M]
    for cell in near[np.argsort(off + ROOM_WORTH * floor.short_m(near, deaf_m), kind="stable")]:
        between = np.rint(np.linspace(edge, cell, 2 * by + 1)).astype(int)
        if reach[tuple(between.T)].all():
            row, col = cell.tolist()
            return row, col
    raise AssertionError("an edge is in reach")


def look(
    floor: Floor,
    robot: Robot,
    place: Float[ndarray, "2"],
    solid: Bool[ndarray, "rows cols"],
    hull: Float[ndarray, "sides 3"],
) -> tuple[float, float, float]:
    """Into which heading (rad) a robot's sonars see most unknown ground from a place (m), how much, m2, and what it
    promises, as of ``Frontier``.

    Args:
        floor: the map.
        robot: for its sonars.
        place: where it is, m.
        solid: where a line of sight ends: behind what may be a door yet there may be a room.
        hull: see ``Reach``.
    """
    bearing = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    reach = min(REACH_M, robot.max_range_m)
    r = np.arange(0.0, reach, _RAY_STEP_M) + _RAY_STEP_M / 2
    points = place + r[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)[:, None]
    index = floor.grid.index_of(points)
    inside = np.all((index >= 0) & (index < floor.grid.shape), axis=-1)
    row, col = np.moveaxis(np.where(inside[..., None], index, 0), -1, 0)
    ends = solid[row, col] & inside
    unknown = ~(floor.free[row, col] | floor.occupied[row, col]) | ~inside
    seen = unknown & ~np.logical_or.accumulate(ends, axis=1)
    ground = seen * r * (_RAY_STEP_M * 2 * np.pi / _RAYS)
    # Of each heading: what lies in the directions into which its sonars look.
    turned = (np.arange(_RAYS) - np.arange(_RAYS)[:, None]) % _RAYS
    gains = _covered(robot)[turned] @ ground.sum(axis=1)
    best = int(np.argmax(gains))
    open_ = ~np.logical_or.accumulate(floor.occupied[row, col] & inside, axis=1)
    within = np.all(points @ hull[:, :2].T + hull[:, 2] <= 0, axis=-1)
    return float(bearing[best]), float(gains[best]), float(np.sum(ground * open_) + np.sum(ground * within))


def _covered(robot: Robot) -> Bool[ndarray, "rays"]:
    """Directions in the robot's frame into which a sonar looks."""
    bearing = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    off = wrap(bearing[:, None] - robot.mounts[:, 2])
    return np.any(np.abs(off) <= robot.beam_width_rad / 2 + np.pi / _RAYS, axis=1)
