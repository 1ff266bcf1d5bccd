"""Whether a map gets worse the longer one drives: the same tour with fresh noise on every shipped world."""

from typing import Any

from echogrid import Robot, World, score
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import sensor_model
from echogrid.simulation.drive import tour, truth_of
from echogrid.simulation.world import world_names
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import robots
from experiments.studies.drivable.doors import KEPT_M
from experiments.studies.drivable.study import Study, passes_of, tidy, told
from experiments.studies.generalise.study import label, show

PASSES = (1, 8, 30)
WIPED, FOUND = 0.005, 0.01
"""Many passes may wipe so much more than one, and find so much less."""
SCORES = ("found", "wiped", "false", "nll")


def repeated(name: str, robot: Robot, models: tuple[str, ...], passes: tuple[int, ...]) -> list[dict[str, Any]]:
    """Scores of each model after some numbers of passes through a shipped world."""
    world = World.load(name)
    poses = tour(world, robot.footprint_radius_m + KEPT_M)
    truth = truth_of(world, poses)
    mappers = {model: Mapper(robot, sensor_model(model)) for model in models}
    found = []
    for count, drive in enumerate(passes_of(world, robot, poses, max(passes), world_names().index(name)), start=1):
        for model, mapper in mappers.items():
            mapper.add(drive)
            if count in passes:
                scores = score(mapper.grid(), truth)
                entry = {"world": name, "robot": robot.name, "model": label(model), "passes": count}
                found.append(entry | {each_: getattr(scores, each_) for each_ in SCORES})
    return found


def worse(first: dict[str, Any], later: dict[str, Any]) -> bool:
    """Whether more passes have made a map worse."""
    return later["wiped"] > first["wiped"] + WIPED or later["found"] < first["found"] - FOUND


def passes(study: Study) -> None:
    """The same tour again and again."""
    counts, worlds = study.passes or PASSES, world_names()[: study.rooms]
    jobs = [(name, robot, study.models, counts) for name in worlds for robot in robots().values()]
    found = [entry for entries in each(repeated, jobs, "passes") for entry in entries]
    body, summary = [], dict.fromkeys(map(label, study.models), 0)
    for name in worlds:
        for robot in robots():
            for model in summary:
                key = {"world": name, "robot": robot, "model": model}
                some = [e for e in found if key.items() <= e.items()]
                bad = any(worse(some[0], e) for e in some[1:])
                summary[model] += bad
                columns = [" / ".join(told(e[s]) for e in some) for s in ("found", "wiped")]
                body.append([name, robot, model, *columns, "worse" if bad else ""])
    after = " / ".join(map(str, counts))
    show(f"The same tour, {after} passes", ["world", "array", "model", "found", "wiped", ""], body)
    print("\nworse for more passes: " + ", ".join(f"{model} {n} of {len(jobs)}" for model, n in summary.items()))
    record("drivable_passes", tidy(study.settings(worlds=worlds) | {"worse": summary, "found": found}))
