"""Simulated drives as fast as the recording, under what the network is trained on, in the form of the recording."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray
from scipy import ndimage

from echogrid import Robot, World
from echogrid.errors import UsageError
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.drive import tour
from echogrid.simulation.rooms import random_physics, random_transducer, random_world
from echogrid.simulation.simulate import Simulator, disturb
from echogrid.simulation.world import inside_room

SEED = 60_000_000


def along_walls(world: World, distance: float) -> Float[ndarray, "n 2"]:
    """A closed way that keeps a distance (m) to what is nearest, the longest one inside the room."""
    low, high = world.bounds()
    x, y = np.arange(low[0], high[0], 0.04), np.arange(low[1], high[1], 0.04)
    points = np.column_stack([values.ravel() for values in np.meshgrid(x, y)])
    gap = world.clearance(points).reshape(len(y), len(x))
    ways = Figure().subplots().contour(x, y, gap, levels=[distance]).allsegs[0]
    ways = [way for way in ways if len(way) > 20 and inside_room(world, way[::10]).all()]
    if not ways:
        raise UsageError(f"world {world.name}: found no way {distance:.2f} m along its walls, expected a room")
    return max(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))


def paced(way: Float[ndarray, "n 2"], rng: np.random.Generator, frames: int) -> Float[ndarray, "frames 3"]:
    """Poses along a way at the pace of the recording, with stops, from a random place on."""
    smooth = ndimage.gaussian_filter1d(way, 2.0, axis=0, mode="nearest")
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1)))
    s = np.arange(0.0, length[-1], 0.005)
    p = np.column_stack([np.interp(s, length, smooth[:, k]) for k in (0, 1)])
    ahead = np.diff(p, axis=0, append=2 * p[-1:] - p[-2:-1])
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    heading = ndimage.gaussian_filter1d(heading, 20.0, mode="nearest")
    # Whichever takes longer: the way itself or the turn along it.
    turn = np.abs(np.diff(heading, prepend=heading[0]))
    time = np.cumsum(np.maximum(0.005 / rng.uniform(0.008, 0.022), turn / np.deg2rad(rng.uniform(1.2, 2.2))))
    for at in rng.uniform(0, time[-1], rng.poisson(time[-1] / 200)):
        time = time + np.where(time > at, rng.uniform(5, 60), 0.0)
    when = np.arange(time[0], time[-1])
    begin = rng.integers(0, max(len(when) - frames, 1))
    when = when[begin : begin + frames]
    return np.column_stack([np.interp(when, time, value) for value in (*p.T, heading)])


Drive = tuple[World, Physics, Float[ndarray, "frames 3"], int]
"""A room, its physics, poses in it, and the seed of what disturbs the readings."""


def drives(robot: Robot, count: int, frames: int) -> list[Drive]:
    """Random rooms with a drive in each: three in four along the walls, the others tours."""
    rng = np.random.default_rng(SEED)
    made: list[Drive] = []
    while len(made) < count:
        world, physics = random_world(rng, "room"), random_physics(rng)
        near = robot.footprint_radius_m + 0.1
        try:
            way = tour(world, near)[:, :2] if len(made) % 4 == 3 else along_walls(world, near + rng.uniform(0, 0.4))
        except UsageError:
            continue
        if len(way) < 2:
            continue
        poses = paced(way, rng, frames)
        if len(poses) < frames / 2:
            continue
        made.append((world, physics, poses, int(rng.integers(2**32))))
    return made


def as_logged(drive: Drive, robot: Robot, any_transducer: bool) -> Float[ndarray, "frames sonars"]:
    """A simulated drive in the form of the recording."""
    world, physics, poses, seed = drive
    rng = np.random.default_rng(seed)
    if any_transducer:
        robot = replace(robot, transducer=random_transducer(rng))
    ranges = Simulator(world, robot, physics).ranges(poses, rng)
    ranges = robot.clean(disturb(ranges, physics, robot.max_range_m, rng))
    return np.where(np.isfinite(ranges), np.round(ranges, 3), np.nan)
