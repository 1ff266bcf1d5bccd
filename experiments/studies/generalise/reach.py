"""Scores with truth near the path, and farther from it."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Robot, World
from echogrid.metrics import SURFACE
from echogrid.simulation.drive import STEP_M, truth_of
from experiments.common.maps import SHOWN, mapped, scored
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import PLACES, frames, numbered
from experiments.studies.generalise.study import CLASSICAL, ROBOT, SEED, Study, averages, labels, show, shown

REACHES_M = (1.4, 2.5)
SHORT_M = 6.0
DRIVES = {"tour": None, f"its first {SHORT_M:g} m": round(SHORT_M / STEP_M)}


def reached(
    room: int, world: World, poses: ndarray, models: list[str], cell: float
) -> Float[ndarray, "drives models reaches scores"]:
    """Scores of a room, and behind them how many cells of the truth are surface."""
    robot = Robot.load(ROBOT)
    table = []
    for length in DRIVES.values():
        part = poses[:length]
        drive = frames("default", world, part, robot, room, SEED)
        truths = [truth_of(world, part, reach=reach) for reach in REACHES_M]
        grids = [mapped(name, drive, robot, cell) for name in models]
        table.append(
            [[(*scored(g, truth, robot), np.sum(truth.cells == SURFACE)) for truth in truths] for g in grids]
        )
    return np.array(table)


def reach(study: Study) -> None:
    """Scores with truth near the path, and farther from it."""
    count, models = study.rooms or 8, study.beside("network", *CLASSICAL)
    jobs = ((*room, models, study.cell) for room in numbered(PLACES, count, Robot.load(ROBOT), SEED))
    table = np.array(each(reached, jobs, "reach")).reshape(len(PLACES), count, *(len(DRIVES), len(models), 2, -1))
    found: dict[str, Any] = {}
    for d, drive in enumerate(DRIVES):
        found[drive] = {}
        for i, place in enumerate(PLACES):
            part = table[i, :, d]
            means = {
                model: {f"{r:g} m": averages(part[:, m, k, :-1]) for k, r in enumerate(REACHES_M)}
                for m, model in enumerate(labels(models))
            }
            cells = [round(float(v), 1) for v in part[:, 0, :, -1].mean(axis=0)]
            found[drive][place] = {"surface cells": cells, "means": means}
            show(
                f"{drive}, {place}: truth up to {REACHES_M[0]:g} m / up to {REACHES_M[1]:g} m from the path "
                f"({cells[0]:.0f} / {cells[1]:.0f} surface cells a room), cells of {study.cell:g} m",
                ["model", *SHOWN],
                (
                    [model, *(" / ".join(shown(scores[name]) for scores in by.values()) for name in SHOWN)]
                    for model, by in means.items()
                ),
            )
    record("set_reach", study.settings(count) | {"robot": ROBOT, "simulator": "default", "found": found})
