"""Two rooms of known place with a door between them, turned and shifted against the cells."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import World
from echogrid.simulation.world import ROUGH_M, SMOOTH_M, polyline
from experiments.studies.generalise.study import SEED

DEPTHS_M, HALF_M = (3.2, 2.6), 2.0
"""The two rooms reach so far to either side of the wall between them, and so far along it."""
DOOR_M, DOOR_AT_M = 0.8, 0.7
ALONG_M, ENDS_M = 0.05, 0.4
"""Walls are crossed at places so far apart, and so far from their ends."""


@dataclass(frozen=True)
class Suite:
    """Two rooms and a door between them. In their own frame the partition is the y axis."""

    world: World
    turn: float
    """Rad."""
    shift: Float[ndarray, "2"]
    """m."""
    thick: float
    """Of the partition, m; it then has two faces and the door has jambs."""
    door: float = DOOR_M
    """Width of the door, m."""

    def at(self, xy: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Points of the own frame in the world."""
        return placed(xy, self.turn, self.shift)

    def back(self, p_world: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        """Points of the world in the own frame."""
        return placed(p_world - self.shift, -self.turn, np.zeros(2))


def placed(xy: Float[ndarray, "*n 2"], turn: float, shift: Float[ndarray, "2"]) -> Float[ndarray, "*n 2"]:
    """Points turned, then shifted."""
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(xy) @ np.array([[c, s], [-s, c]]) + shift


def suite(number: int, surface: str, thick: float, door: float = DOOR_M) -> Suite:
    """The two rooms in the ``number``-th orientation; none has its walls along the cells.

    ``surface``: smooth, rough, or mixed: rooms and partition are then of unlike walls, which of them is the rough one
    goes by the number.
    """
    turn = np.deg2rad(7.0 + 13.0 * number)
    shift = np.random.default_rng([SEED, number]).uniform(-1.0, 1.0, 2)
    (left, right), low, high, half = DEPTHS_M, DOOR_AT_M - door / 2, DOOR_AT_M + door / 2, thick / 2
    outline = polyline([[-left, -HALF_M], [right, -HALF_M], [right, HALF_M], [-left, HALF_M]], closed=True)
    if thick:
        posts = [
            [[-half, -HALF_M], [-half, low], [half, low], [half, -HALF_M]],
            [[-half, HALF_M], [-half, high], [half, high], [half, HALF_M]],
        ]
    else:
        posts = [[[0.0, -HALF_M], [0.0, low]], [[0.0, high], [0.0, HALF_M]]]
    walls = np.concatenate([outline, *(polyline(post) for post in posts)])
    walls = placed(walls.reshape(-1, 2), turn, shift).reshape(-1, 4)
    x, y = placed(np.array([-left / 2, 0.0]), turn, shift)
    world = World(f"suite {number}", walls, np.zeros(len(walls)), np.zeros((0, 3)), (float(x), float(y)))
    if surface == "mixed":
        rough = (np.arange(len(walls)) < len(outline)) ^ (number % 2 == 0)
        return Suite(replace(world, roughness=np.where(rough, ROUGH_M, SMOOTH_M)), turn, shift, thick, door)
    return Suite(world.with_walls(surface), turn, shift, thick, door)


def faces(rooms_: Suite) -> Iterator[tuple[str, Float[ndarray, "n 2"], Float[ndarray, "2"]]]:
    """Of each straight wall its kind, places along it and the direction behind it, in the own frame."""
    (left, right), half = DEPTHS_M, rooms_.thick / 2

    def places(begin: float, end: float) -> Float[ndarray, "n"]:
        return np.arange(begin + ENDS_M, end - ENDS_M, ALONG_M)

    for x, sign in ((-left, -1.0), (right, 1.0)):
        y = places(-HALF_M, HALF_M)
        yield "outer", np.column_stack([np.full_like(y, x), y]), np.array([sign, 0.0])
    for sign in (-1.0, 1.0):
        x = np.concatenate([places(-left, -half), places(half, right)])
        yield "outer", np.column_stack([x, np.full_like(x, sign * HALF_M)]), np.array([0.0, sign])
    if not rooms_.thick:
        y = np.concatenate(
            [places(-HALF_M, DOOR_AT_M - rooms_.door / 2), places(DOOR_AT_M + rooms_.door / 2, HALF_M)]
        )
        yield "partition", np.column_stack([np.zeros_like(y), y]), np.array([1.0, 0.0])
