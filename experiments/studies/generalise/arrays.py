"""Other robots, arrays that no preset has, and sonars that are silent or fire in turn."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Frame, Robot, World
from echogrid.robot import preset_names
from echogrid.simulation.drive import truth_of
from experiments.common.bootstrap import against
from experiments.common.maps import SHOWN, mapped, scored
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import frames, numbered
from experiments.studies.generalise.study import ROBOT, SEED, Study, averages, label, labels, show_scores


@dataclass(frozen=True)
class Sonars:
    """An array, and which of its readings come."""

    robot: Robot
    groups: int = 1
    """Of so many sonars one is read in a frame."""
    in_turn: bool = False
    """The next one in the next frame; else always the same."""


def silenced(drive: Iterable[Frame], groups: int, in_turn: bool) -> list[Frame]:
    """A drive of which only the readings that ``Sonars`` says have come."""
    kept = []
    for i, frame in enumerate(drive):
        quiet = (np.arange(len(frame.ranges)) - i * in_turn) % groups != 0
        kept.append(replace(frame, ranges=np.where(quiet, np.nan, frame.ranges)))
    return kept


def arrayed(name: str, axes_deg: Iterable[float]) -> Robot:
    """A B21 with other sonars, all on its ring."""
    axis = np.deg2rad(np.array(list(axes_deg)))
    return replace(
        Robot.load(ROBOT), name=name, mounts=np.column_stack([0.25 * np.cos(axis), 0.25 * np.sin(axis), axis])
    )


UNEVEN_DEG = (-171.0, -132.0, -96.0, -58.0, -41.0, -6.0, 13.0, 52.0, 87.0, 139.0)
UNEVEN = "uneven10"
COMPARED = ("auc", "nll")
"""By which scores general weights are set against such trained for one array."""


def arrays_of() -> dict[str, Sonars]:
    """All arrays by name."""
    found = {name: Sonars(Robot.load(name)) for name in [ROBOT, *sorted(set(preset_names()) - {ROBOT})]}
    found |= {f"ring{n}": Sonars(arrayed(f"ring{n}", np.arange(n) * 360 / n)) for n in (8, 12, 16, 36, 48)}
    found[UNEVEN] = Sonars(arrayed(UNEVEN, UNEVEN_DEG))
    found["fan7"] = Sonars(arrayed("fan7", np.linspace(-60, 60, 7)))
    ring = Robot.load(ROBOT)
    found["b21, every second sonar silent"] = Sonars(ring, 2)
    found["b21, every second reading removed"] = Sonars(ring, 2, in_turn=True)
    found["b21, in turn in 4 groups"] = Sonars(ring, 4, in_turn=True)
    return found


def heard(
    room: int, world: World, poses: ndarray, sonars: Sonars, models: list[str], cell: float
) -> Float[ndarray, "models scores"]:
    """Scores of a room."""
    drive = frames("default", world, poses, sonars.robot, room, SEED)
    drive, truth = silenced(drive, sonars.groups, sonars.in_turn), truth_of(world, poses)
    return np.array([scored(mapped(name, drive, sonars.robot, cell), truth, sonars.robot) for name in models])


def gained(
    general: Float[ndarray, "rooms scores"], own: Float[ndarray, "rooms scores"], rng: np.random.Generator
) -> dict[str, Any]:
    """Scores of general weights and of such trained for one array, and by how much those of the general differ."""
    found: dict[str, Any] = {"general": averages(general), "own": averages(own)}
    for name in COMPARED:
        score = SHOWN.index(name)
        found[name] = against(general[:, score], own[:, score], rng)["difference"]
    return found


def show_own(own: dict[str, Any]) -> None:
    """Print what ``gained`` found in each place."""
    for place, entry in own.items():
        means = {"general": entry["general"], "its own": entry["own"]}
        show_scores(f"{place}, {UNEVEN}: general weights and such trained for this array", "weights", means)
        differences = [
            "{}: {:+.4f} ({:+.4f} to {:+.4f})".format(name, *entry[name]) for name in COMPARED if entry[name]
        ]
        print(f"\ngeneral less own, 95 % interval: {'; '.join(differences)}")


def arrays(study: Study) -> None:
    """Scores with other arrays; and what weights trained for one array gain."""
    places, count, models = ("smooth", "mixed"), study.rooms or 4, study.beside("network")
    tours: dict[float, list[tuple[int, World, ndarray]]] = {}
    jobs: list[tuple] = []
    for name, sonars in arrays_of().items():
        # Robots of one size drive the same ways.
        size = sonars.robot.footprint_radius_m
        if size not in tours:
            tours[size] = list(numbered(places, count, sonars.robot, SEED))
        used = [*models, study.own] if name == UNEVEN and study.own else models
        jobs += [(*room, sonars, used, study.cell) for room in tours[size]]
    results = iter(each(heard, jobs, "arrays"))
    found: dict[str, Any] = {place: {label(model): {} for model in models} for place in places}
    rng = np.random.default_rng(SEED)
    own: dict[str, Any] = {}
    for name in arrays_of():
        for place in places:
            table = np.array([next(results) for _ in range(count)])
            for m, model in enumerate(labels(models)):
                found[place][model][name] = averages(table[:, m])
            if table.shape[1] > len(models):
                own[place] = gained(table[:, 0], table[:, -1], rng)
    for place, by in found.items():
        for model, means in by.items():
            show_scores(f"{place}, {model}, cells of {study.cell:g} m", "array", means)
    show_own(own)
    extra = {"simulator": "default", "found": found} | ({"own": own} if own else {})
    record("set_arrays", study.settings(count) | extra)
