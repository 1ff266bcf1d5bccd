"""Four simulators, two of them written apart from what the network was trained on; three robots."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from experiments.common.maps import SHOWN
from experiments.common.mujoco_sonar import available
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import PLACES, numbered, robots
from experiments.common.trials import DECIDING, ratios, visit
from experiments.studies.generalise.study import (
    CLASSICAL,
    SEED,
    Study,
    averages,
    label,
    labels,
    show,
    show_scores,
)

SIMULATORS = ("default", "varied", "leonard", "mujoco")


def simulators(study: Study) -> None:
    """Scores under four simulators, and ratios to the best classical model, for each of some robots."""
    count, models = study.rooms or 8, study.beside("network", *CLASSICAL)
    here = [name for name in SIMULATORS if name != "mujoco" or available()]
    if len(here) < len(SIMULATORS):
        print("simulators: found no package mujoco, so its column is left out")
    jobs = [
        (*room, robot, here, models, study.cell, SEED)
        for robot in robots().values()
        for room in numbered(PLACES, count, robot, SEED)
    ]
    shape = len(robots()), len(PLACES), count, len(here), len(models), -1
    table = np.array(each(visit, jobs, "simulators")).reshape(shape)
    found = {name: compared(name, part, here, models, study) for name, part in zip(robots(), table, strict=True)}
    record("set_simulators", study.settings(count) | {"robots": found})


def compared(
    robot: str,
    table: Float[ndarray, "places rooms simulators models scores"],
    here: list[str],
    models: list[str],
    study: Study,
) -> dict[str, Any]:
    """The scores of one robot, printed and to be recorded."""
    classical = [name for name in models if name in CLASSICAL and name != study.model]
    rng = np.random.default_rng(SEED)
    found: dict[str, Any] = {"means": {}, "ratios": {}}
    body = []
    for s, simulator in enumerate(here):
        found["means"][simulator], found["ratios"][simulator] = {}, {}
        for i, place in enumerate(PLACES):
            part = table[i, :, s]
            means = {model: averages(part[:, m]) for m, model in enumerate(labels(models))}
            show_scores(f"{robot}, {simulator}, {place}, cells of {study.cell:g} m", "model", means)
            against = ratios(part, models, study.model, classical, rng)
            found["means"][simulator][place], found["ratios"][simulator][place] = means, against
            row = [simulator, place]
            for name, entry in against.items():
                column, best = part[:, :, SHOWN.index(name)], entry["best classical"]
                row += [best, f"{column[:, 0].mean():.3f} / {column[:, models.index(best)].mean():.3f}"]
                row.append(spread(entry["ratio"]))
            body.append(row)
    header = ["simulator", "walls"]
    for name in DECIDING:
        header += [f"least {name} of the classical", f"{label(study.model)} / it", "ratio"]
    show(f"{robot}: against the best classical model", header, body)
    return found


def spread(values: list[float | None] | None) -> str:
    """A ratio with its interval; a ratio to 0 is infinite, one of 0 to 0 says nothing."""
    if values is None:
        return "-"
    mean, low, high = ("inf" if v is None else f"{v:.2f}" for v in values)
    return f"{mean} ({low} to {high})"
