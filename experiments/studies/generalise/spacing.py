"""The same tour with fewer and fewer frames."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Robot, World
from echogrid.simulation.drive import truth_of
from experiments.common.maps import mapped, scored
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import frames, numbered
from experiments.studies.generalise.study import ROBOT, SEED, Study, averages, labels, show_scores

SPACINGS_CM = {5: 1, 10: 2, 20: 4, 50: 10}
"""Of the frames, and which of a tour's poses have one."""


def spaced(
    room: int, world: World, poses: ndarray, models: list[str], cell: float
) -> Float[ndarray, "spacings models scores"]:
    """Scores of a room; the truth is what the whole tour sees."""
    robot, truth = Robot.load(ROBOT), truth_of(world, poses)
    table = []
    for step in SPACINGS_CM.values():
        drive = frames("default", world, poses[::step], robot, room, SEED)
        table.append([scored(mapped(name, drive, robot, cell), truth, robot) for name in models])
    return np.array(table)


def spacing(study: Study) -> None:
    """Scores of the same tour with fewer and fewer frames."""
    places, count, models = ("smooth", "mixed"), study.rooms or 8, study.beside("network", "muriel")
    jobs = ((*room, models, study.cell) for room in numbered(places, count, Robot.load(ROBOT), SEED))
    shape = len(places), count, len(SPACINGS_CM), len(models), -1
    table = np.array(each(spaced, jobs, "spacing")).reshape(shape)
    found: dict[str, Any] = {}
    for i, place in enumerate(places):
        found[place] = {}
        for m, model in enumerate(labels(models)):
            means = {f"{cm} cm": averages(table[i, :, k, m]) for k, cm in enumerate(SPACINGS_CM)}
            found[place][model] = means
            show_scores(f"{place}, {model}, cells of {study.cell:g} m", "frames every", means)
    record("set_spacing", study.settings(count) | {"robot": ROBOT, "simulator": "default", "found": found})
