"""Rooms that no training run has seen, and drives in them under each simulator."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Frame, Robot, World
from echogrid.errors import UsageError
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.drive import tour
from echogrid.simulation.rooms import random_physics, random_world
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import inside_room
from experiments.common.leonard import leonard_ranges
from experiments.common.mujoco_sonar import mujoco_ranges

KINDS = ("smooth", "rough", "mixed")
PLACES = (*KINDS, "corridor")
SEED = 20_000_000
"""Of the rooms that changes are judged by. What is recorded has seeds of its own."""
APART = {"leonard": leonard_ranges, "mujoco": mujoco_ranges}
"""Simulators that were written apart from what the network was trained on."""


def robots() -> dict[str, Robot]:
    """The array of the paper, the commonest one, and a plain ring."""
    angle = np.deg2rad(np.arange(12) * 30.0)
    mounts = np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), angle])
    ring = replace(
        Robot.load("p3dx"), name="ring12", footprint_radius_m=0.22, min_range_m=0.1, max_range_m=4.0, mounts=mounts
    )
    return {"b21": Robot.load("b21"), "p3dx": Robot.load("p3dx"), "ring12": ring}


def rooms(place: str, count: int, robot: Robot, seed: int) -> Iterator[tuple[World, Float[ndarray, "poses 3"]]]:
    """Worlds of one of PLACES, each with the robot's tour of it (m, m, rad)."""
    rng = np.random.default_rng([seed, PLACES.index(place)])
    shape, walls = ("corridor", "mixed") if place == "corridor" else ("room", place)
    found = 0
    while found < count:
        world = random_world(rng, shape, walls)
        try:
            poses = tour(world, robot.footprint_radius_m + 0.1)
        except UsageError:
            continue
        # A corridor may be open at its ends; its tour is to stay within.
        if len(poses) >= 120 and (shape == "room" or np.all(inside_room(world, poses[:, :2]))):
            found += 1
            yield world, poses


def numbered(
    places: Sequence[str], count: int, robot: Robot, seed: int
) -> Iterator[tuple[int, World, Float[ndarray, "poses 3"]]]:
    """Number, world and tour of ``rooms``, place after place. The number decides the noise; no two rooms share it."""
    for place in places:
        for room, (world, poses) in enumerate(rooms(place, count, robot, seed)):
            yield 1000 * PLACES.index(place) + room, world, poses


def frames(
    simulator: str, world: World, poses: Float[ndarray, "poses 3"], robot: Robot, room: int, seed: int
) -> list[Frame]:
    """A drive under echogrid's simulator with its ``default`` or a ``varied`` physics, or under one of APART."""
    rng = np.random.default_rng([seed, room])
    if simulator in APART:
        ranges = APART[simulator](world, robot, poses, rng)
        return [Frame(i / 5, p, r) for i, (p, r) in enumerate(zip(poses, ranges, strict=True))]
    physics = Physics() if simulator == "default" else random_physics(rng)
    return list(Simulator(world, robot, physics).frames(poses, room))
