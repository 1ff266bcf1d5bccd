"""Simulated short drives through random worlds, for training: each in a world and under a physics of its own."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int8
from numpy import ndarray
from tqdm import tqdm

from echogrid.errors import UsageError
from echogrid.metrics import Truth
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics, acoustics
from echogrid.simulation.drive import truth_of
from echogrid.simulation.echo import drives_ranges
from echogrid.simulation.rooms import (
    frank_sensing,
    random_physics,
    random_robot,
    random_transducer,
    random_world,
    told_beam,
)
from echogrid.simulation.scene import Scene
from echogrid.simulation.simulate import sonar_poses
from echogrid.simulation.world import World

_WALLS = _TARGETS = 40
"""Walls and targets of a scene; worlds with more are drawn again."""

_MOST_TRIES = 500
"""Worlds that are tried for a drive before the robot is given up as too large for them."""

_CHUNK = 16
"""Drives that are simulated together."""

Points = tuple[Float[ndarray, "points 2"], Int8[ndarray, "points"]]
"""Points of the world (m), and what is there: 1 = surface, 0 = free, 2 = hidden."""


@dataclass(frozen=True)
class Kind:
    """Which drives are learnt from."""

    frames: int
    """Frames of a drive."""
    shape_shares: dict[str, float]
    """How often each kind of world comes."""
    way: Callable[[np.random.Generator, World, float], Float[ndarray, "frames 3"] | None]
    """Poses that keep a clearance (m) in a world; None: no room found."""
    points: Callable[[np.random.Generator, Truth, Float[ndarray, "frames 3"]], Points | None]
    """Points of a truth grid that are asked for; None: there are too few."""
    truth_m: float
    """Side of the truth's cells, m."""
    reach_m: float
    """How far the truth reaches from the path, m."""
    frank_share: float = 0.0
    """How many of the robots have rangers as of ``frank_sensing``."""


@dataclass(frozen=True)
class Drive:
    """A short drive through a world of its own, and points of the world with what is really there."""

    world: World
    robot: Robot
    poses: Float[ndarray, "frames 3"]
    believed: Float[ndarray, "frames 3"]
    """The poses that the mapper is told."""
    points: Float[ndarray, "points 2"]
    label: Int8[ndarray, "points"]


class Driven(NamedTuple):
    """A drive, and what its sonars heard."""

    drive: Drive
    physics: Physics
    sonars: Float[ndarray, "frames sonars 3"]
    """Where each sonar really was and pointed, m and rad, world frame."""
    ranges: Float[ndarray, "frames sonars"]
    """True first echoes, m; inf = no echo."""


def picked(
    rng: np.random.Generator, truth: Truth, kinds: list[tuple[Bool[ndarray, "rows cols"], int]], least: int = 4
) -> Points | None:
    """Cell centres of a truth grid: of each kind of cells so many; None: a kind has fewer than ``least`` cells."""
    found = []
    for cells, count in kinds:
        index = np.argwhere(cells)
        if len(index) < least:
            return None
        found.append(index[rng.integers(0, len(index), count)])
    rows, cols = np.concatenate(found).T
    return (np.column_stack([cols, rows]) + 0.5) * truth.resolution + truth.origin, truth.cells[rows, cols]


def random_drive(rng: np.random.Generator, robot: Robot, kind: Kind) -> Drive:
    """A drive of a robot through a random world.

    Raises:
        UsageError: the robot is too large for all worlds that were tried.
    """
    for _ in range(_MOST_TRIES):
        shape = str(rng.choice(list(kind.shape_shares), p=list(kind.shape_shares.values())))
        world = random_world(rng, shape)
        if len(world.walls) > _WALLS or len(world.vertices[1]) + len(world.cylinders) > _TARGETS:
            continue
        poses = kind.way(rng, world, robot.footprint_radius_m + 0.05)
        if poses is None:
            continue
        points = kind.points(rng, truth_of(world, poses, kind.truth_m, kind.reach_m), poses)
        if points is None:
            continue
        off = rng.choice([0.0, 0.01, 0.02]) * rng.standard_normal((kind.frames, 3)) * [1, 1, 0.5]
        return Drive(world, robot, poses, poses + off, *points)
    raise UsageError(
        f"robot {robot.name}: found no room to drive in among {_MOST_TRIES}, expected a footprint_radius_m of "
        f"less than about 1 m (it is {robot.footprint_radius_m:g})"
    )


def simulated[T: tuple](
    robot: Robot | None,
    kind: Kind,
    most_sonars: Callable[[np.random.Generator], int],
    learn: Callable[[np.random.Generator, Driven], T],
    drives: int,
    seed: int,
    progress: bool = False,
) -> T:
    """What is learnt from simulated drives, its arrays with the drive as leading axis.

    Args:
        robot: the array to drive with; None: a new random one (or preset) for each drive.
        kind: of the drives.
        most_sonars: how many sonars the random robots of a chunk of drives have at most.
        learn: makes of a drive what is learnt from it.
        drives: number of drives.
        seed: decides everything.
        progress: show a bar where there is a terminal.

    Raises:
        UsageError: the robot is too large for all worlds that were tried.
    """
    rng = np.random.default_rng(seed)
    parts: list[T] = []
    waiting: list[Callable[[], list[T]]] = []
    with tqdm(total=drives, desc="drives", unit="drive", disable=None if progress else True) as bar:
        for _ in range(0, drives, _CHUNK):
            # The simulator works on one chunk while the next is laid out.
            waiting.append(_begin(rng.spawn(1)[0], robot, kind, most_sonars, learn))
            if len(waiting) > 1:
                parts += waiting.pop(0)()
                bar.update(_CHUNK)
        parts += waiting.pop()()
        bar.update(_CHUNK)
    return _stack(parts[:drives])


def _begin[T: tuple](
    rng: np.random.Generator,
    robot: Robot | None,
    kind: Kind,
    most_sonars: Callable[[np.random.Generator], int],
    learn: Callable[[np.random.Generator, Driven], T],
) -> Callable[[], list[T]]:
    """Lay out a chunk of drives and set the simulator on them; the result waits for it and learns."""
    most = most_sonars(rng)
    batch = [random_drive(rng, robot or random_robot(rng, most), kind) for _ in range(_CHUNK)]
    physics, heads, worlds = [], [], []
    for i, d in enumerate(batch):
        frank = robot is None and rng.random() < kind.frank_share
        sound, head = frank_sensing(rng) if frank else (random_physics(rng), d.robot.transducer)
        if robot and rng.random() < 0.5:
            head = random_transducer(rng)
        if frank:
            batch[i] = replace(d, robot=replace(d.robot, transducer=head, beam_width_rad=told_beam(rng, head)))
        physics.append(sound)
        heads.append(head)
        worlds.append(d.world.with_walls("rough") if frank else d.world)
    scenes = _stack([Scene.of(world, _WALLS, _TARGETS) for world in worlds])
    air = _stack([acoustics(head, p) for head, p in zip(heads, physics, strict=True)])
    # One size for all of a chunk, and few sizes in all: each is compiled for.
    placed = np.zeros((_CHUNK, kind.frames, robot.sonars if robot else most, 3), dtype=np.float32)
    for i, d in enumerate(batch):
        placed[i, :, : d.robot.sonars] = sonar_poses(_bent(rng, d.robot.mounts), d.poses)
    noise = np.array([p.level_noise_db for p in physics])[:, None, None]
    level = (noise * rng.standard_normal(placed.shape[:3])).astype(np.float32)
    heard = drives_ranges(scenes, air, placed[..., :2], placed[..., 2], level)

    def finish() -> list[T]:
        return [
            learn(rng, Driven(d, p, placed[i, :, : d.robot.sonars], ranges[:, : d.robot.sonars]))
            for i, (d, p, ranges) in enumerate(zip(batch, physics, np.asarray(heard, dtype=float), strict=True))
        ]

    return finish


def _bent(rng: np.random.Generator, mounts: Float[ndarray, "sonars 3"]) -> Float[ndarray, "sonars 3"]:
    """The mounts as they really are: a little off what the robot file says."""
    return mounts + rng.choice([0.0, 1.0]) * rng.standard_normal(mounts.shape) * [0.004, 0.004, 0.02]


def _stack[T: tuple](items: list[T]) -> T:
    """A tuple of arrays from tuples of their parts."""
    return type(items[0])(*(np.stack([np.asarray(v) for v in field]) for field in zip(*items, strict=True)))
