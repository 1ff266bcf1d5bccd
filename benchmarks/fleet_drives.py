"""The drives that ``benchmarks.fleet`` maps: ten robots in a building of 60 x 40 m, simulated once and kept.

    .venv/bin/python -m benchmarks.fleet_drives FOLDER 200

Two corridors with 14 rooms on each of their sides; a robot comes out of one room, drives along the corridor and into
another one: about 30 m. Log N is of robot N modulo ten, whose seed it begins with.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from tqdm import tqdm

from echogrid.files import replacing
from echogrid.frame import Frame
from echogrid.logs.csv_log import write_csv
from echogrid.robot import Robot
from echogrid.simulation.drive import along
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import World

WIDE_M, HIGH_M = 60.0, 40.0
ROOMS, DOOR_M = 14, 1.2
"""Rooms along a side of a corridor; all doors are in their middle."""

CORRIDORS_M = (10.0, 30.0)
"""y of the middles of the corridors."""

HALF_M = 1.1
"""Half the width of a corridor."""

ROBOTS = 10

NEAR_M = 9.0
"""Walls farther from a drive than this are left out of its simulation: no sonar hears them."""


def building() -> World:
    """The building."""
    side, walls = WIDE_M / ROOMS, []
    walls += [[0, 0, WIDE_M, 0], [WIDE_M, 0, WIDE_M, HIGH_M], [WIDE_M, HIGH_M, 0, HIGH_M], [0, HIGH_M, 0, 0]]
    walls.append([0, HIGH_M / 2, WIDE_M, HIGH_M / 2])
    for y in CORRIDORS_M:
        for k in range(ROOMS):
            door = (k + 0.5) * side
            for edge, far in ((y - HALF_M, y - HIGH_M / 4), (y + HALF_M, y + HIGH_M / 4)):
                walls += [[k * side, edge, door - DOOR_M / 2, edge], [door + DOOR_M / 2, edge, (k + 1) * side, edge]]
                if k:
                    walls.append([k * side, edge, k * side, far])
    lines = np.array(walls, dtype=float)
    rng = np.random.default_rng(0)
    roughness = 1e-3 * np.exp(rng.uniform(np.log(0.05), np.log(2.0), len(lines)))
    return World("building", lines, roughness, np.zeros((0, 3)))


def way(rng: np.random.Generator) -> Float[ndarray, "n 2"]:
    """Waypoints (m) from a room to another one on the same corridor, at most six doors on."""
    y, side = rng.choice(CORRIDORS_M), WIDE_M / ROOMS
    first = int(rng.integers(ROOMS))
    last = int(np.clip(first + rng.choice([-1, 1]) * rng.integers(2, 7), 0, ROOMS - 1))
    points = []
    for k, order in ((first, 1), (last, -1)):
        door, up = (k + 0.5) * side, rng.choice([-1, 1])
        inside = [door + rng.uniform(-0.8, 0.8), y + up * rng.uniform(4.5, 7.5)]
        points += [inside, [door, y + up * 2.2], [door, y + rng.uniform(-0.2, 0.2)]][::order]
    return np.array(points)


def near(world: World, poses: Float[ndarray, "frames 3"]) -> World:
    """The walls of a world that a drive may hear."""
    low, high = poses[:, :2].min(axis=0) - NEAR_M, poses[:, :2].max(axis=0) + NEAR_M
    a, b = np.minimum(world.walls[:, :2], world.walls[:, 2:]), np.maximum(world.walls[:, :2], world.walls[:, 2:])
    kept = np.all((a <= high) & (b >= low), axis=1)
    return replace(world, walls=world.walls[kept], roughness=world.roughness[kept])


def make(folder: Path, count: int) -> list[Path]:
    """The first so many logs; those that are there already stay."""
    folder.mkdir(parents=True, exist_ok=True)
    world, robot = building(), Robot.load("p3dx")
    paths = [folder / f"robot{k % ROBOTS}-{k // ROBOTS:04}.csv" for k in range(count)]
    for k, path in enumerate(tqdm(paths, desc="simulating", unit="log", disable=None)):
        if path.exists():
            continue
        rng = np.random.default_rng([k % ROBOTS, k // ROBOTS])
        poses = np.round(along(way(rng)), 6)
        frames = Simulator(near(world, poses), robot).frames(poses, int(rng.integers(2**31)))
        with replacing(path) as new:
            write_csv(new, (Frame(round(f.stamp, 3), f.pose, np.round(f.ranges, 4)) for f in frames), robot.sonars)
    return paths


if __name__ == "__main__":
    make(Path(sys.argv[1]), int(sys.argv[2]))
