"""What the paper's network learns from: points of the world with the looks at them.

An example is a point of the world with up to VIEWS looks at it from along a short drive.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Integer
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from echogrid.geometry import inverse, transform
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.models.networks.local_map import HALF_M, LOCAL_CELL_M, LOCAL_CELLS, in_cells, local_cells
from echogrid.models.networks.paper_network import ZONE, Zone, zone_of
from echogrid.robot import Robot
from echogrid.simulation.simulate import disturb
from echogrid.simulation.world import World
from echogrid.training.drives import Drive, Driven, Kind, Points, picked, simulated

FRAMES = 48
"""Frames of a training drive."""

VIEWS = 16
"""Looks at a point that an example keeps."""

POINTS = (20, 20, 8, 12)
"""Points of a drive: surface, free within 0.4 m of a surface, free elsewhere, hidden."""

MOST_SONARS = 24
"""Most sonars of a random robot."""


class Examples(NamedTuple):
    """Points of the world and the looks at them from short drives; the leading axis is the drive.

    Floats are float16 to keep them small.
    """

    ranges: Float[ndarray | Array, "drives frames sonars"]
    """Readings, m; inf = no echo, nan = not fired; the last column is nan: a sonar that is not there."""
    sonar: Integer[ndarray | Array, "drives 576 zone"]
    """The zone of each local cell: columns of ``ranges``."""
    off_axis: Float[ndarray | Array, "drives 576 zone"]
    distance: Float[ndarray | Array, "drives 576 zone"]
    frame: Integer[ndarray | Array, "drives points views"]
    """The frame of each look; -1: no such look."""
    at: Float[ndarray | Array, "drives points views 2"]
    """Where the point lies in that frame's local map, see ``surrounding``."""
    label: Integer[ndarray | Array, "drives points"]
    """1 = surface, 0 = free, 2 = hidden."""


def random_way(rng: np.random.Generator, world: World, clearance: float) -> Float[ndarray, "frames 3"] | None:
    """A short smooth drive of FRAMES poses that keeps ``clearance`` (m) from everything; None: no room found.

    Steps are from 1 to 20 cm, now and then the robot stands still; the heading follows the way, or is any.
    """
    tries = 48
    low, high = world.bounds()
    if rng.random() < 0.5:
        low, high = np.maximum(low, -2.5), np.minimum(high, 2.5)
    start = rng.uniform(low, np.maximum(high, low + 0.1), (tries, 2))
    step = np.exp(rng.uniform(np.log(0.01), np.log(0.2), (tries, 1))) * np.ones((tries, FRAMES))
    step = np.where(rng.random((tries, 1)) < 0.08, 0.0, step)
    bend = np.repeat(rng.normal(0, 0.7, (tries, FRAMES // 12)), 12, axis=1)
    heading = rng.uniform(-np.pi, np.pi, (tries, 1)) + np.cumsum(bend * step, axis=1)
    moves = step[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    way = start[:, None] + np.cumsum(moves, axis=1)
    near = np.min(world.clearance(way.reshape(-1, 2)).reshape(tries, FRAMES), axis=1)
    good = np.flatnonzero(near > clearance)
    if not good.size:
        return None
    best = good[0]
    turn = rng.choice([0.0, rng.uniform(-np.pi, np.pi)])
    spin = rng.choice([0.0, rng.normal(0, 0.1)]) * np.arange(FRAMES)
    return np.column_stack([way[best], heading[best] + turn + spin])


def _points_of(rng: np.random.Generator, truth: Truth, _: Float[ndarray, "frames 3"]) -> Points | None:
    """Cell centres of a truth grid: fixed numbers of surface, near free, far free and hidden ones."""
    gap = distance_transform_edt(truth.cells != SURFACE) * truth.resolution
    free = truth.cells == FREE
    kinds = [
        truth.cells == SURFACE,
        free & (gap < 0.4),
        free & (gap >= 0.4),
        (truth.cells == HIDDEN) & (gap < 1.0),
    ]
    return picked(rng, truth, list(zip(kinds, POINTS, strict=True)))


KIND = Kind(
    FRAMES,
    {"contour": 0.3, "room": 0.4, "corridor": 0.2, "hall": 0.1},
    random_way,
    _points_of,
    LOCAL_CELL_M,
    HALF_M,
)
"""The drives."""


def _views(rng: np.random.Generator, drive: Drive, zone: Zone, ranges: Float[ndarray, "frames sonars"]) -> Examples:
    """The looks at each point of a drive from frames whose local map holds it."""
    T_robot_world = inverse(drive.believed)
    at = in_cells(transform(T_robot_world[None], drive.points[:, None]))
    held = np.all((at > 0) & (at < LOCAL_CELLS - 1), axis=-1)
    # A random choice of the frames that hold the point comes first.
    order = np.argsort(np.where(held, rng.random(held.shape), 2.0), axis=1)[:, :VIEWS]
    frame = np.where(np.take_along_axis(held, order, axis=1), order, -1)
    missing = ranges.shape[1] - 1
    return Examples(
        ranges.astype(np.float16),
        np.where(zone.sonar >= 0, zone.sonar, missing).astype(np.int16),
        zone.off_axis.astype(np.float16),
        zone.distance.astype(np.float16),
        frame.astype(np.int8),
        np.take_along_axis(at, order[..., None], axis=1).astype(np.float16),
        drive.label,
    )


def _example(rng: np.random.Generator, driven: Driven, zone: int, most: int) -> Examples:
    """A drive with all that disturbs its readings, padded."""
    d = driven.drive
    told = d.robot.clean(disturb(driven.ranges, driven.physics, d.robot.max_range_m, rng))
    silent = rng.random(told.shape) < rng.choice([0.0, 0.0, rng.uniform(0, 0.6)])
    padded = np.full((FRAMES, most + 1), np.nan)
    padded[:, : d.robot.sonars] = np.where(silent, np.nan, told)
    return _views(rng, d, zone_of(d.robot.mounts, local_cells(), zone), padded)


def generate(robot: Robot | None, drives: int, seed: int, progress: bool = False, zone: int = ZONE) -> Examples:
    """Labelled examples from simulated drives.

    Args:
        robot: as for ``simulated``, as are the next three.
        drives: number of drives.
        seed: decides everything.
        progress: show a bar where there is a terminal.
        zone: sonars that the network is to read for a point; drives and readings do not depend on it.
    """
    most = robot.sonars if robot else MOST_SONARS
    return simulated(
        robot, KIND, lambda _: MOST_SONARS, partial(_example, zone=zone, most=most), drives, seed, progress
    )
