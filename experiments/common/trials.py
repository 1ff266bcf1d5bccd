"""Rooms visited under several simulators: the scores of models on the same drives, and the best classical one."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Robot, World
from echogrid.simulation.drive import truth_of
from experiments.common.bootstrap import against
from experiments.common.maps import SHOWN, mapped, scored
from experiments.common.rooms import frames

DECIDING = ("nll", "wiped")
"""The scores by which models are set against each other."""


def visit(
    room: int,
    world: World,
    poses: Float[ndarray, "poses 3"],
    robot: Robot,
    simulators: Sequence[str],
    models: Sequence[str],
    resolution: float,
    seed: int,
) -> Float[ndarray, "simulators models scores"]:
    """Scores of one room, its cells of ``resolution`` m; ``room`` and ``seed`` decide the noise."""
    truth = truth_of(world, poses)
    scores = []
    for simulator in simulators:
        drive = frames(simulator, world, poses, robot, room, seed)
        scores.append([scored(mapped(name, drive, robot, resolution), truth, robot) for name in models])
    return np.array(scores)


def ratios(
    scores: Float[ndarray, "rooms models scores"],
    models: Sequence[str],
    model: str,
    classical: Sequence[str],
    rng: np.random.Generator,
) -> dict[str, dict[str, Any]]:
    """By each of DECIDING a model against the one that came out best of the classical ones."""
    found = {}
    for name in DECIDING:
        columns = dict(zip(models, scores[:, :, SHOWN.index(name)].T, strict=True))
        best = min(classical, key=lambda other: columns[other].mean())
        found[name] = {"best classical": best} | against(columns[model], columns[best], rng)
    return found
