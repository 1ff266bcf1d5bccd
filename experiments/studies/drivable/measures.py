"""What makes a map one to drive on, measured on any grid: lanes, the floor under the robot, smear, phantoms."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from scipy.spatial import KDTree

from echogrid import Grid, World
from echogrid.metrics import FREE_BELOW, HIDDEN, OCCUPIED_ABOVE
from echogrid.simulation.drive import truth_of

LANE_BELOW = 0.25
"""A lane goes through cells below this probability."""
BODY = 0.8
"""Share of the footprint's radius under which the floor is looked at."""
SMEAR_M = 0.1
"""An occupied cell farther than this from any surface is smear."""
PHANTOM_M = 0.3
"""An occupied cell farther than this from any surface, where nobody has looked, is a phantom."""
REACH_M = 2.6
"""From the path; past it no map of ours says anything."""

Distance = Callable[[Float[ndarray, "n 2"]], Float[ndarray, "n"]]
"""Of points (m) from the nearest surface, m."""


def lane_m(grid: Grid, start: Float[ndarray, "2"], goal: Float[ndarray, "2"]) -> float:
    """Width (m) of the widest free lane from one point to another; 0 if there is none.

    Twice what its middle keeps from the centres of the cells that are not free: a lane of n cells has n to n + 1.
    """
    free = np.pad(grid.probability() < LANE_BELOW, 1)
    gap = np.asarray(ndimage.distance_transform_edt(free))
    a, b = (tuple((grid.index_of(p[None])[0] + 1).tolist()) for p in (start, goal))
    if not all(0 <= k < n for at in (a, b) for k, n in zip(at, gap.shape, strict=True)):
        return 0.0
    wide = np.unique(gap[gap > 0])
    low, high = 0, len(wide)
    while low < high:  # the first width at which they are no longer joined
        middle = (low + high) // 2
        piece, _ = ndimage.label(gap >= wide[middle])
        low, high = (middle + 1, high) if piece[a] and piece[a] == piece[b] else (low, middle)
    return 2 * grid.resolution * float(wide[low - 1]) if low else 0.0


def under_body(grid: Grid, poses: Float[ndarray, "frames 3"], radius: float) -> Float[ndarray, "n"]:
    """Probabilities where the body of a robot (radius in m) has been: the middle and two circles at each pose."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = BODY * radius * np.column_stack([np.cos(angle), np.sin(angle)])
    points = [poses[:, None, :2] + share * circle for share in (0.0, 0.5, 1.0)]
    return grid.probability_at(np.concatenate(points, axis=1).reshape(-1, 2))


def occupied(grid: Grid) -> Float[ndarray, "n 2"]:
    """Centres of the cells that the map claims to be occupied, m."""
    return grid.centre_of(np.argwhere(grid.probability() > OCCUPIED_ABOVE))


def smear(grid: Grid, distance: Distance) -> dict[str, Any]:
    """How far occupied cells lie from any surface, hidden ones too: share past SMEAR_M, and the median, m."""
    off = distance(occupied(grid))
    if not off.size:
        return {"cells": 0, "smear": None, "off_m": None}
    return {"cells": off.size, "smear": float(np.mean(off > SMEAR_M)), "off_m": float(np.median(off))}


def phantoms(grid: Grid, world: World, poses: Float[ndarray, "frames 3"]) -> Bool[ndarray, "n"]:
    """Which of the ``occupied`` cells are phantoms: far from any surface, where no sight line from the path ends."""
    points, truth = occupied(grid), truth_of(world, poses, reach=REACH_M)
    index = np.floor((points - truth.origin) / truth.resolution).astype(int)
    rows, cols = truth.cells.shape
    inside = np.all((index >= 0) & (index < [cols, rows]), axis=1)
    hidden = np.full(len(points), True)
    hidden[inside] = truth.cells[index[inside, 1], index[inside, 0]] == HIDDEN
    return hidden & (world.clearance(points) > PHANTOM_M)


def near_to(points: Float[ndarray, "n 2"]) -> Distance:
    """The distance from points on surfaces."""
    tree = KDTree(points)
    return lambda p: tree.query(p)[0]


def body_claims(p: Float[ndarray, "n"]) -> dict[str, float]:
    """What a map says of the floor under the robot: the worst, and the share that it does not call free."""
    return {"worst": float(p.max()), "not free": float(np.mean(p > FREE_BELOW))}
