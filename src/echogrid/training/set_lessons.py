"""What the set network learns from through the map: simulated drives.

A lesson keeps the drive as the mapper would get it (poses, mounts, readings) and points of the world with what is
really there, so that a loss can look at any point from any frame.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Integer
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from echogrid.errors import UsageError
from echogrid.geometry import wrap, wrapped
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.models.networks.memory import Memory
from echogrid.robot import Robot
from echogrid.simulation.drive import STEP_M, tour
from echogrid.simulation.simulate import disturb, passers_by
from echogrid.simulation.world import World
from echogrid.training.drives import Driven, Kind, Points, picked, simulated

FRAMES = 80
"""Frames of a drive."""

POINTS = (24, 20, 16, 8, 8)
"""Points of a drive: surface, free within 0.4 m of a surface, free elsewhere, hidden within 0.3 m, hidden within 1 m.
"""

TRUTH_M, REACH_M = 0.1, 2.5
"""Cells of the truth, and how far it reaches from the path."""

NEAR_M, NEAR_SHARE = 1.4, 0.6
"""This share of the points lies within so far of the path; the rest anywhere."""

MOST_SONARS, LARGE_SHARE = (24, 48), 0.1
"""Most sonars of a random robot; and of this share of them."""

PEOPLE_SHARE, IN_TURN_SHARE = 0.15, 0.15
"""Share of the drives past which people walk, and of those whose sonars fire in turn, group after group."""


class Lessons(NamedTuple):
    """Drives and points; the leading axis is the drive."""

    ranges: Float[ndarray | Array, "drives frames sonars"]
    """Readings, m, float16; inf = no echo, nan = not fired or no such sonar."""
    mounts: Float[ndarray | Array, "drives sonars 3"]
    """As the robot file says, m and rad; nan: no such sonar."""
    max_range: Float[ndarray | Array, "drives sonars"]
    """m."""
    beam: Float[ndarray | Array, "drives"]
    """Beam width, rad."""
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


def random_way(
    rng: np.random.Generator, world: World, clearance: float, frames: int = FRAMES
) -> Float[ndarray, "frames 3"] | None:
    """So many poses from place to place through a world, at about ``clearance`` (m) from everything; None: no room.

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
    if world.name == "flat" and rng.random() < 0.8:
        return _through_rooms(rng, world, clearance, step, frames)
    kind = rng.choice(["drive", "stand", "turn"], p=[0.88, 0.07, 0.05])
    if kind == "stand":
        return np.tile([*places[0], rng.uniform(-np.pi, np.pi)], (frames, 1))
    if kind == "turn":
        bearing = rng.uniform(-np.pi, np.pi) + rng.uniform(-0.2, 0.2) * np.arange(frames)
        return np.column_stack([np.tile(places[0], (frames, 1)), wrap(bearing)])
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
        if length > step * frames:
            break
    if len(way) < 2:
        return None
    run = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1)))
    # Where the world is too small for so long a way, the frames lie nearer to each other.
    s = np.linspace(0.0, min(step * frames, run[-1]), frames)
    xy = np.column_stack([np.interp(s, run, np.array(way)[:, k]) for k in (0, 1)])
    leg = np.clip(np.searchsorted(run, s, side="right") - 1, 0, len(way) - 2)
    heading = np.unwrap(np.arctan2(*np.diff(way, axis=0).T[::-1])[leg])
    turn = rng.choice([0.0, rng.uniform(-np.pi, np.pi)])
    spin = rng.choice([0.0, 0.0, rng.normal(0, 0.1)]) * np.arange(frames)
    return np.column_stack([xy, wrap(heading + turn + spin)])


def _through_rooms(
    rng: np.random.Generator, world: World, clearance: float, step: float, frames: int
) -> Float[ndarray, "frames 3"] | None:
    """So many poses about ``step`` (m) apart of a tour, which passes through doors; None: no room."""
    try:
        poses = tour(world, clearance)
    except UsageError:
        return None
    poses = poses[:: max(1, round(step / STEP_M))]
    begin = int(rng.integers(0, max(1, len(poses) - frames // 2)))
    poses = np.concatenate([poses[begin:], poses[::-1] + np.array([0.0, 0.0, np.pi]), poses])
    return np.resize(wrapped(poses), (frames, 3))


def _points_of(rng: np.random.Generator, truth: Truth, poses: Float[ndarray, "frames 3"]) -> Points | None:
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
    split = []
    for cells, count in zip(kinds, POINTS, strict=True):
        first = round(NEAR_SHARE * count)
        split += [(cells & near, first), (cells, count - first)]
    return picked(rng, truth, split)


def drives_of(frames: int, shape_shares: dict[str, float]) -> Kind:
    """Drives of so many frames through worlds of such shapes."""
    return Kind(
        frames,
        shape_shares,
        partial(random_way, frames=frames),
        _points_of,
        TRUTH_M,
        REACH_M,
        frank_share=0.15,
    )


KIND = drives_of(FRAMES, {"contour": 0.18, "room": 0.3, "corridor": 0.17, "hall": 0.1, "clutter": 0.08, "flat": 0.17})
"""The drives."""


def disturbed(rng: np.random.Generator, driven: Driven) -> Float[ndarray, "frames sonars"]:
    """The readings of a drive (m) as the robot tells them: people walk past, and the ranging module errs."""
    ranges, robot = driven.ranges, driven.drive.robot
    if rng.random() < PEOPLE_SHARE:
        ranges = passers_by(ranges, driven.sonars, rng)
    return robot.clean(disturb(ranges, driven.physics, robot.max_range_m, rng))


def out_of_turn(rng: np.random.Generator, frames: int, sonars: int) -> Bool[ndarray, "frames sonars"] | None:
    """Which readings are missing where sonars fire in turn, group after group; None: all fire at once, as most do."""
    if rng.random() >= IN_TURN_SHARE:
        return None
    return (np.arange(frames)[:, None] - np.arange(sonars)) % rng.choice([2, 3, 4, 8]) != 0


def most_sonars(rng: np.random.Generator) -> int:
    """Most sonars of a random robot."""
    return MOST_SONARS[int(rng.random() < LARGE_SHARE)]


def _lesson(rng: np.random.Generator, driven: Driven) -> Lessons:
    """A drive with all that disturbs its readings, padded."""
    d, told = driven.drive, disturbed(rng, driven)
    silent = out_of_turn(rng, FRAMES, d.robot.sonars)
    if silent is None:
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
        np.pad(d.robot.max_ranges_m, (0, most - d.robot.sonars), constant_values=1.0).astype(np.float32),
        np.array(d.robot.beam_width_rad, dtype=np.float32),
        d.believed.astype(np.float32),
        weight,
        traits,
        d.points.astype(np.float32),
        d.label,
    )


def lessons(robot: Robot | None, drives: int, seed: int, progress: bool = False) -> Lessons:
    """Lessons from simulated drives; arguments as for ``simulated``."""
    return simulated(robot, KIND, most_sonars, _lesson, drives, seed, progress)
