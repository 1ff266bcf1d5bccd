"""Lessons: simulated drives through random worlds, from which the set network learns through the map.

A lesson keeps the drive as the mapper would get it (poses, mounts, readings) and points of the world with what is
really there, so that a loss can look at any point from any frame.
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
from echogrid.geometry import wrap
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.models.memory import Memory
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics, acoustics
from echogrid.simulation.drive import truth_of
from echogrid.simulation.echo import Scene
from echogrid.simulation.rooms import random_physics, random_robot, random_transducer, random_world
from echogrid.simulation.simulate import disturb, drives_ranges, passers_by, sonar_poses
from echogrid.simulation.world import World
from echogrid.training.examples import bent, stack

FRAMES = 80
"""Frames of a drive."""

POINTS = (24, 20, 16, 8, 8)
"""Points of a drive: surface, free within 0.4 m of a surface, free elsewhere, hidden within 0.3 m, hidden within 1 m.
"""

TRUTH_M, REACH_M = 0.1, 2.5
"""Cells of the truth, and how far it reaches from the path."""

NEAR_M, NEAR_SHARE = 1.4, 0.6
"""This share of the points lies within so far of the path; the rest anywhere."""

SHAPE_SHARES = {"contour": 0.22, "room": 0.38, "corridor": 0.2, "hall": 0.1, "clutter": 0.1}
"""How often each kind of world comes."""

MOST_SONARS, LARGE_SHARE = (24, 48), 0.1
"""Most sonars of a random robot; and of this share of them."""

PEOPLE_SHARE, IN_TURN_SHARE = 0.15, 0.15
"""Share of the drives past which people walk, and of those whose sonars fire in turn, group after group."""

_WALLS = _TARGETS = 40
_MOST_TRIES = 500
_CHUNK = 16


class Lessons(NamedTuple):
    """Drives and points; the leading axis is the drive."""

    ranges: Float[ndarray | Array, "drives frames sonars"]
    """Readings, m, float16; inf = no echo, nan = not fired or no such sonar."""
    mounts: Float[ndarray | Array, "drives sonars 3"]
    """As the robot file says, m and rad; nan: no such sonar."""
    max_range: Float[ndarray | Array, "drives"]
    poses: Float[ndarray | Array, "drives frames 3"]
    """As the mapper is told, m and rad."""
    weight: Float[ndarray | Array, "drives frames"]
    """What each frame counts, see ``Memory``."""
    traits: Float[ndarray | Array, "drives frames traits"]
    """What the surroundings are like, likewise."""
    points: Float[ndarray | Array, "drives points 2"]
    """m, world frame."""
    label: Integer[ndarray | Array, "drives points"]
    """1 = surface, 0 = free, 2 = hidden."""


@dataclass(frozen=True)
class _Drive:
    world: World
    robot: Robot
    poses: Float[ndarray, "frames 3"]
    believed: Float[ndarray, "frames 3"]
    points: Float[ndarray, "points 2"]
    label: Int8[ndarray, "points"]


def random_way(rng: np.random.Generator, world: World, clearance: float) -> Float[ndarray, "frames 3"] | None:
    """FRAMES poses from place to place through a world, at about ``clearance`` (m) from everything; None: no room.

    It keeps three quarters of the clearance everywhere.

    Frames are 2 to 50 cm apart; now and then the robot stands still or turns on the spot. The heading follows the
    way, or keeps an angle to it, or any.
    """
    low, high = world.bounds()
    if rng.random() < 0.5:
        low, high = np.maximum(low, -3.0), np.minimum(high, 3.0)
    places = rng.uniform(low, np.maximum(high, low + 0.1), (150, 2))
    places = places[world.clearance(places) > clearance]
    if len(places) < 2:
        return None
    step = np.exp(rng.uniform(np.log(0.02), np.log(0.5)))
    kind = rng.choice(["drive", "stand", "turn"], p=[0.88, 0.07, 0.05])
    if kind == "stand":
        return np.tile([*places[0], rng.uniform(-np.pi, np.pi)], (FRAMES, 1))
    if kind == "turn":
        bearing = rng.uniform(-np.pi, np.pi) + rng.uniform(-0.2, 0.2) * np.arange(FRAMES)
        return np.column_stack([np.tile(places[0], (FRAMES, 1)), wrap(bearing)])
    way = [places[0]]
    length = 0.0
    for _ in range(40):
        goals = places[rng.integers(0, len(places), 10)]
        far = np.linalg.norm(goals - way[-1], axis=1)
        # So near to each other that nothing can lie unseen between two.
        looks = 2 + int(2 * np.max(far) / clearance)
        lines = way[-1] + np.linspace(0.0, 1.0, looks)[:, None, None] * (goals - way[-1])
        clear = np.min(world.clearance(lines.reshape(-1, 2)).reshape(looks, 10), axis=0) > clearance
        good = np.flatnonzero(clear & (far > 0.2))
        if good.size:
            way.append(goals[good[0]])
            length += far[good[0]]
        if length > step * FRAMES:
            break
    if len(way) < 2:
        return None
    run = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    # Where the world is too small for so long a way, the frames lie nearer to each other.
    s = np.linspace(0.0, min(step * FRAMES, run[-1]), FRAMES)
    xy = np.column_stack([np.interp(s, run, np.array(way)[:, k]) for k in (0, 1)])
    leg = np.clip(np.searchsorted(run, s, side="right") - 1, 0, len(way) - 2)
    heading = np.unwrap(np.arctan2(*np.diff(way, axis=0).T[::-1])[leg])
    turn = rng.choice([0.0, rng.uniform(-np.pi, np.pi)])
    spin = rng.choice([0.0, 0.0, rng.normal(0, 0.1)]) * np.arange(FRAMES)
    return np.column_stack([xy, wrap(heading + turn + spin)])


def _points_of(
    rng: np.random.Generator, truth: Truth, poses: Float[ndarray, "frames 3"]
) -> tuple[Float[ndarray, "n 2"], Int8[ndarray, "n"]] | None:
    """Cell centres of a truth grid: fixed numbers of surface, near free, far free and hidden ones."""
    gap = distance_transform_edt(truth.cells != SURFACE) * truth.resolution
    free = truth.cells == FREE
    hidden = truth.cells == HIDDEN
    kinds = [truth.cells == SURFACE, free & (gap < 0.4), free & (gap >= 0.4), hidden & (gap < 0.3)]
    kinds.append(hidden & (gap >= 0.3) & (gap < 1.0))
    path = np.ones(truth.cells.shape, dtype=bool)
    col, row = np.floor((poses[:, :2] - truth.origin) / truth.resolution).astype(int).T
    path[row, col] = False
    near = distance_transform_edt(path) * truth.resolution < NEAR_M
    picked = []
    for cells, count in zip(kinds, POINTS, strict=True):
        index, close = np.argwhere(cells), np.argwhere(cells & near)
        if len(close) < 4:
            return None
        first = round(NEAR_SHARE * count)
        picked += [close[rng.integers(0, len(close), first)], index[rng.integers(0, len(index), count - first)]]
    rows, cols = np.concatenate(picked).T
    centre = (np.column_stack([cols, rows]) + 0.5) * truth.resolution + truth.origin
    return centre, truth.cells[rows, cols]


def _drive(rng: np.random.Generator, robot: Robot) -> _Drive:
    for _ in range(_MOST_TRIES):
        shape = str(rng.choice(list(SHAPE_SHARES), p=list(SHAPE_SHARES.values())))
        world = random_world(rng, shape)
        if len(world.walls) > _WALLS or len(world.vertices[1]) + len(world.cylinders) > _TARGETS:
            continue
        poses = random_way(rng, world, robot.footprint_radius_m + 0.05)
        if poses is None:
            continue
        points = _points_of(rng, truth_of(world, poses, TRUTH_M, REACH_M), poses)
        if points is None:
            continue
        off = rng.choice([0.0, 0.01, 0.02]) * rng.standard_normal((FRAMES, 3)) * [1, 1, 0.5]
        return _Drive(world, robot, poses, poses + off, *points)
    raise UsageError(
        f"robot {robot.name}: found no room to drive in among {_MOST_TRIES}, expected a footprint_radius_m of "
        f"less than about 1 m (it is {robot.footprint_radius_m:g})"
    )


def lessons(robot: Robot | None, drives: int, seed: int, progress: bool = False) -> Lessons:
    """Lessons from simulated drives.

    Args:
        robot: the array to drive with; None: a new random one (or preset) for each drive.
        drives: number of drives, each in a world and under a physics of its own.
        seed: decides everything.
        progress: show a bar where there is a terminal.
    """
    rng = np.random.default_rng(seed)
    parts: list[Lessons] = []
    bar = tqdm(total=drives, desc="drives", unit="drive", disable=None if progress else True)
    waiting: list[Callable[[], list[Lessons]]] = []
    for _ in range(0, drives, _CHUNK):
        # The simulator works on one chunk while the next is laid out.
        waiting.append(_begin(rng.spawn(1)[0], robot))
        if len(waiting) > 1:
            parts += waiting.pop(0)()
            bar.update(_CHUNK)
    parts += waiting.pop()()
    bar.update(_CHUNK)
    bar.close()
    return stack(parts[:drives])


def _begin(rng: np.random.Generator, robot: Robot | None) -> Callable[[], list[Lessons]]:
    """Lay out a chunk of drives and set the simulator on them; the result waits for it and makes lessons."""
    # One size for all of a chunk, and few sizes in all: each is compiled for.
    most = MOST_SONARS[int(rng.random() < LARGE_SHARE)]
    batch = [_drive(rng, robot or random_robot(rng, most)) for _ in range(_CHUNK)]
    physics = [random_physics(rng) for _ in batch]
    heads = [d.robot.transducer if robot and rng.random() < 0.5 else random_transducer(rng) for d in batch]
    scenes = stack([Scene.of(d.world, _WALLS, _TARGETS) for d in batch])
    air = stack([acoustics(head, p) for head, p in zip(heads, physics, strict=True)])
    most = robot.sonars if robot else most
    placed = np.zeros((_CHUNK, FRAMES, most, 3), dtype=np.float32)
    for i, d in enumerate(batch):
        placed[i, :, : d.robot.sonars] = sonar_poses(bent(rng, d.robot.mounts), d.poses)
    noise = np.array([p.level_noise_db for p in physics])[:, None, None]
    level = (noise * rng.standard_normal(placed.shape[:3])).astype(np.float32)
    heard = drives_ranges(scenes, air, placed[..., :2], placed[..., 2], level)

    def finish() -> list[Lessons]:
        return [
            _lesson(rng, d, p, placed[i, :, : d.robot.sonars], ranges[:, : d.robot.sonars])
            for i, (d, p, ranges) in enumerate(zip(batch, physics, np.asarray(heard, dtype=float), strict=True))
        ]

    return finish


def _lesson(
    rng: np.random.Generator,
    d: _Drive,
    physics: Physics,
    placed: Float[ndarray, "frames sonars 3"],
    ranges: Float[ndarray, "frames sonars"],
) -> Lessons:
    """A drive with all that disturbs its readings, padded."""
    if rng.random() < PEOPLE_SHARE:
        ranges = passers_by(ranges, placed, rng)
    told = d.robot.clean(disturb(ranges, physics, d.robot.max_range_m, rng))
    if rng.random() < IN_TURN_SHARE:
        groups = rng.choice([2, 3, 4, 8])
        silent = (np.arange(FRAMES)[:, None] - np.arange(d.robot.sonars)) % groups != 0
    else:
        silent = rng.random(told.shape) < rng.choice([0.0, 0.0, rng.uniform(0, 0.6)])
    most = max(d.robot.sonars, MOST_SONARS[1])
    padded = np.full((FRAMES, most), np.nan, dtype=np.float16)
    told = np.where(silent, np.nan, told)
    padded[:, : d.robot.sonars] = told
    mounts = np.full((most, 3), np.nan, dtype=np.float32)
    mounts[: d.robot.sonars] = d.robot.mounts
    weight, traits = Memory(d.robot.mounts).take(d.believed, told)
    return Lessons(
        padded,
        mounts,
        np.array(d.robot.max_range_m, dtype=np.float32),
        d.believed.astype(np.float32),
        weight,
        traits,
        d.points.astype(np.float32),
        d.label,
    )
