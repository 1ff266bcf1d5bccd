"""Places that are worth a look: where the floor that is known to be free ends, though the robot might go on."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from echogrid import _core
from echogrid.geometry import wrap
from echogrid.planning.clearance import Floor, gap
from echogrid.robot import Robot

BEYOND_M = 0.15
"""What the robot could reach only within this of where it can be counts as seen: rims of walls are never sure."""

LEAST_M2 = 0.04
"""Of places beyond that for the robot's middle; less is no room."""

APART_M = 1.5
"""A frontier longer than this is looked at in parts."""

STAND_M = 0.4
"""So far from the edge the robot stands, at most, to look from where its sonars hear what is beyond."""

REACH_M = 2.0
"""How far a look tells, m."""

_RAYS, _RAY_STEP_M = 72, 0.08
"""Of a look round."""

MOST = 40
"""Frontiers that are weighed, those nearest to the robot."""


@dataclass(frozen=True)
class Frontier:
    """A place at the edge of what is known, which the robot can get to."""

    cell: tuple[int, int]
    """Middle of the edge, [row, col]."""
    place: Float[ndarray, "2"]
    """Likewise, m."""
    stand: tuple[int, int]
    """Where the robot stands for its first look, [row, col], within STAND_M of that."""
    cost: float
    """Of the way there, as of ``Floor.costs``, m."""
    heading: float
    """Into which it sees most from there, rad."""
    gain_m2: float
    """Unknown ground that its sonars would see there."""
    length_m: float
    """Of the edge."""


@dataclass(frozen=True)
class Edges:
    """All frontiers of a floor as it is seen from one place, and the costs of the ways to them."""

    frontiers: list[Frontier]
    reach: Bool[ndarray, "rows cols"]
    """Where the robot's middle can get to."""
    to_go: Float[ndarray, "rows cols"]
    """What it costs from each cell to where the robot is."""


def edges(floor: Floor, robot: Robot, at: tuple[int, int], sure: float) -> Edges:
    """The frontiers of a floor.

    Args:
        floor: the map.
        robot: for its sonars.
        at: the cell [row, col] where it stands, which must be open.
        sure: what is occupied with less than this probability may be a door yet.
    """
    costs = floor.known_costs
    to_go = _core.cost_to_go(costs, np.array([at], np.int64), floor.grid.resolution)
    reach = np.isfinite(to_go)
    edge = _edge(floor, reach, sure)
    groups = _groups(floor, edge, to_go)
    solid = floor.above(sure)
    return Edges([_looked(floor, robot, solid, group, reach, to_go) for group in groups], reach, to_go)


def _edge(floor: Floor, reach: Bool[ndarray, "rows cols"], sure: float) -> Bool[ndarray, "rows cols"]:
    """Cells in reach beside which there is room for the robot, unless what is unknown turns out occupied."""
    size = floor.grid.resolution
    cells = max(1, round(BEYOND_M / size))
    maybe = (gap(floor.above(sure), size) >= floor.radius_m) & ~reach
    deep = maybe & ~_grown(reach, cells)
    pieces, count = ndimage.label(deep)
    room = np.bincount(pieces.ravel(), minlength=count + 1) * size**2 >= LEAST_M2
    room[0] = False
    return reach & _grown(room[pieces], cells + 1)


def _grown(cells: Bool[ndarray, "rows cols"], by: int) -> Bool[ndarray, "rows cols"]:
    """Cells within some of a square round each."""
    return ndimage.maximum_filter(cells.view(np.uint8), 2 * by + 1).view(bool)


def _groups(
    floor: Floor, edge: Bool[ndarray, "rows cols"], to_go: Float[ndarray, "rows cols"]
) -> list[Int[ndarray, "n 2"]]:
    """The cells of each frontier, those nearest to the robot first; long ones in parts."""
    labels, _ = ndimage.label(edge, np.ones((3, 3)))
    cells = np.argwhere(edge)
    # Parts by squares of the lattice, so that they stay the same while the map grows.
    square = np.floor(floor.grid.centre_of(cells) / APART_M).astype(int)
    keys = np.column_stack([labels[tuple(cells.T)], square])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    parts = [cells[group.ravel() == k] for k in range(group.max(initial=-1) + 1)]
    return sorted(parts, key=lambda part: float(np.min(to_go[tuple(part.T)])))[:MOST]


def _looked(
    floor: Floor,
    robot: Robot,
    solid: Bool[ndarray, "rows cols"],
    cells: Int[ndarray, "n 2"],
    reach: Bool[ndarray, "rows cols"],
    to_go: Float[ndarray, "rows cols"],
) -> Frontier:
    """A frontier as it is seen from near its middle, or the cell of it that is nearest to that."""
    middle = np.mean(cells, axis=0)
    edge = cells[np.argmin(np.linalg.norm(cells - middle, axis=1))]
    row, col = edge.tolist()
    place = floor.grid.centre_of(edge)
    heading, gain = look(floor, robot, place, solid)
    length = len(cells) * floor.grid.resolution / max(1, round(BEYOND_M / floor.grid.resolution))
    stand = _stand(floor, robot, edge, reach)
    return Frontier((row, col), place, stand, float(to_go[row, col]), heading, gain, length)


def _stand(floor: Floor, robot: Robot, edge: Int[ndarray, "2"], reach: Bool[ndarray, "rows cols"]) -> tuple[int, int]:
    """The cell in reach near one at an edge, straight ahead of it, from which sonars hear what is not known best."""
    by = int(STAND_M / floor.grid.resolution)
    first, last = np.maximum(edge - by, 0), np.minimum(edge + by + 1, floor.grid.shape)
    near = np.argwhere(reach[first[0] : last[0], first[1] : last[1]]) + first
    off = np.linalg.norm(near - edge, axis=1) * floor.grid.resolution
    near, off = near[off <= STAND_M], off[off <= STAND_M]
    # Each centimetre of range is worth two of way.
    for cell in near[np.argsort(off + 2 * floor.short_m(near, robot.deaf_m), kind="stable")]:
        between = np.rint(np.linspace(edge, cell, 2 * by + 1)).astype(int)
        if reach[tuple(between.T)].all():
            row, col = cell.tolist()
            return row, col
    raise AssertionError("an edge is in reach")


def look(
    floor: Floor, robot: Robot, place: Float[ndarray, "2"], solid: Bool[ndarray, "rows cols"]
) -> tuple[float, float]:
    """Into which heading (rad) a robot's sonars see most unknown ground from a place (m), and how much, m2.

    Args:
        floor: the map.
        robot: for its sonars.
        place: where it is, m.
        solid: where a line of sight ends: behind what may be a door yet there may be a room.
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
    area = np.sum(seen * r, axis=1) * _RAY_STEP_M * (2 * np.pi / _RAYS)
    # Of each heading: what lies in the directions into which its sonars look.
    turned = (np.arange(_RAYS) - np.arange(_RAYS)[:, None]) % _RAYS
    gains = _covered(robot)[turned] @ area
    best = int(np.argmax(gains))
    return float(bearing[best]), float(gains[best])


def _covered(robot: Robot) -> Bool[ndarray, "rays"]:
    """Directions in the robot's frame into which a sonar looks."""
    bearing = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    off = wrap(bearing[:, None] - robot.mounts[:, 2])
    return np.any(np.abs(off) <= robot.beam_width_rad / 2 + np.pi / _RAYS, axis=1)
