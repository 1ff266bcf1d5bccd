"""Training examples: simulated short drives, and points of the world with the looks at them.

An example is a point of the world with up to VIEWS looks at it from along a short drive, each from a world, an
array and a physics of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int8, Integer
from numpy import ndarray
from scipy.ndimage import distance_transform_edt
from tqdm import tqdm

from echogrid.errors import UsageError
from echogrid.geometry import inverse, transform
from echogrid.mapping.build import in_cells, local_cells
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.models.network import HALF_M, LOCAL_CELL_M, LOCAL_CELLS, ZONE, Zone, zone_of
from echogrid.robot import Robot
from echogrid.simulation.acoustics import acoustics
from echogrid.simulation.drive import truth_of
from echogrid.simulation.echo import Scene
from echogrid.simulation.rooms import random_physics, random_robot, random_transducer, random_world
from echogrid.simulation.simulate import disturb, drives_ranges, sonar_poses
from echogrid.simulation.world import World

FRAMES = 48
"""Frames of a training drive."""

VIEWS = 16
"""Looks at a point that an example keeps."""

POINTS = (20, 20, 8, 12)
"""Points of a drive: surface, free within 0.4 m of a surface, free elsewhere, hidden."""

SHAPE_SHARES = {"contour": 0.3, "room": 0.4, "corridor": 0.2, "hall": 0.1}
"""How often each kind of world comes."""

_WALLS = _TARGETS = 40
"""Walls and targets of a scene; worlds with more are drawn again."""

_MOST_TRIES = 500
"""Worlds that are tried for a drive before the robot is given up as too large for them."""

_CHUNK = 16
"""Drives that are simulated together."""


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
    """Where the point lies in that frame's local map, see ``mapping.surrounding``."""
    label: Integer[ndarray | Array, "drives points"]
    """1 = surface, 0 = free, 2 = hidden."""


@dataclass(frozen=True)
class _Drive:
    world: World
    robot: Robot
    poses: Float[ndarray, "frames 3"]
    believed: Float[ndarray, "frames 3"]
    """The poses that the mapper is told."""
    points: Float[ndarray, "points 2"]
    label: Int8[ndarray, "points"]


def random_drive(rng: np.random.Generator, world: World, clearance: float) -> Float[ndarray, "frames 3"] | None:
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


def _points_of(rng: np.random.Generator, truth: Truth) -> tuple[Float[ndarray, "n 2"], Int8[ndarray, "n"]] | None:
    """Cell centres of a truth grid: fixed numbers of surface, near free, far free and hidden ones."""
    gap = distance_transform_edt(truth.cells != SURFACE) * truth.resolution
    free = truth.cells == FREE
    kinds = [
        truth.cells == SURFACE,
        free & (gap < 0.4),
        free & (gap >= 0.4),
        (truth.cells == HIDDEN) & (gap < 1.0),
    ]
    picked = []
    for cells, count in zip(kinds, POINTS, strict=True):
        index = np.argwhere(cells)
        if len(index) < 4:
            return None
        picked.append(index[rng.integers(0, len(index), count)])
    rows, cols = np.concatenate(picked).T
    centre = (np.column_stack([cols, rows]) + 0.5) * truth.resolution + truth.origin
    return centre, truth.cells[rows, cols]


def _drive(rng: np.random.Generator, robot: Robot) -> _Drive:
    for _ in range(_MOST_TRIES):
        shape = str(rng.choice(list(SHAPE_SHARES), p=list(SHAPE_SHARES.values())))
        world = random_world(rng, shape)
        if len(world.walls) > _WALLS or len(world.vertices[1]) + len(world.cylinders) > _TARGETS:
            continue
        poses = random_drive(rng, world, robot.footprint_radius_m + 0.05)
        if poses is None:
            continue
        points = _points_of(rng, truth_of(world, poses, LOCAL_CELL_M, HALF_M))
        if points is None:
            continue
        off = rng.choice([0.0, 0.01, 0.02]) * rng.standard_normal((FRAMES, 3)) * [1, 1, 0.5]
        return _Drive(world, robot, poses, poses + off, *points)
    raise UsageError(
        f"robot {robot.name}: found no room to drive in among {_MOST_TRIES}, expected a footprint_radius_m of "
        f"less than about 1 m (it is {robot.footprint_radius_m:g})"
    )


def _views(rng: np.random.Generator, drive: _Drive, zone: Zone, ranges: Float[ndarray, "frames sonars"]) -> Examples:
    """The looks at each point of a drive from frames whose local map holds it."""
    T_robot_world = inverse(drive.believed)
    at = np.asarray(in_cells(transform(T_robot_world[None], drive.points[:, None])))
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


def generate(robot: Robot | None, drives: int, seed: int, progress: bool = False, zone: int = ZONE) -> Examples:
    """Labelled examples from simulated drives.

    Args:
        robot: the array to drive with; None: a new random one (or preset) for each drive.
        drives: number of drives, each in a world and under a physics of its own.
        seed: decides everything.
        progress: show a bar where there is a terminal.
        zone: sonars that the network is to read for a point; drives and readings do not depend on it.
    """
    rng = np.random.default_rng(seed)
    parts: list[Examples] = []
    bar = tqdm(total=drives, desc="drives", unit="drive", disable=None if progress else True)
    waiting: list[Callable[[], list[Examples]]] = []
    for _ in range(0, drives, _CHUNK):
        # The simulator works on one chunk while the next is laid out.
        waiting.append(_begin(rng.spawn(1)[0], robot, zone))
        if len(waiting) > 1:
            parts += waiting.pop(0)()
            bar.update(_CHUNK)
    parts += waiting.pop()()
    bar.update(_CHUNK)
    bar.close()
    return stack(parts[:drives])


def _begin(rng: np.random.Generator, robot: Robot | None, zone: int) -> Callable[[], list[Examples]]:
    """Lay out a chunk of drives and set the simulator on them; the result waits for it and makes examples."""
    batch = [_drive(rng, robot or random_robot(rng)) for _ in range(_CHUNK)]
    physics = [random_physics(rng) for _ in batch]
    heads = [d.robot.transducer if robot and rng.random() < 0.5 else random_transducer(rng) for d in batch]
    scenes = stack([Scene.of(d.world, _WALLS, _TARGETS) for d in batch])
    air = stack([acoustics(head, p) for head, p in zip(heads, physics, strict=True)])
    mounts = np.zeros((_CHUNK, FRAMES, robot.sonars if robot else 24, 3), dtype=np.float32)
    for i, d in enumerate(batch):
        mounts[i, :, : d.robot.sonars] = sonar_poses(bent(rng, d.robot.mounts), d.poses)
    noise = np.array([p.level_noise_db for p in physics])[:, None, None]
    level = (noise * rng.standard_normal(mounts.shape[:3])).astype(np.float32)
    heard = drives_ranges(scenes, air, mounts[..., :2], mounts[..., 2], level)

    def finish() -> list[Examples]:
        examples = []
        for d, p, ranges in zip(batch, physics, np.asarray(heard, dtype=float), strict=True):
            told = d.robot.clean(disturb(ranges[:, : d.robot.sonars], p, d.robot.max_range_m, rng))
            silent = rng.random(told.shape) < rng.choice([0.0, 0.0, rng.uniform(0, 0.6)])
            padded = np.full((FRAMES, mounts.shape[2] + 1), np.nan)
            padded[:, : d.robot.sonars] = np.where(silent, np.nan, told)
            examples.append(_views(rng, d, zone_of(d.robot.mounts, local_cells(), zone), padded))
        return examples

    return finish


def bent(rng: np.random.Generator, mounts: Float[ndarray, "sonars 3"]) -> Float[ndarray, "sonars 3"]:
    """The mounts as they really are: a little off what the robot file says."""
    return mounts + rng.choice([0.0, 1.0]) * rng.standard_normal(mounts.shape) * [0.004, 0.004, 0.02]


def stack[T: tuple](items: list[T]) -> T:
    """A tuple of arrays from tuples of their parts."""
    return type(items[0])(*(np.stack([np.asarray(v) for v in field]) for field in zip(*items, strict=True)))
