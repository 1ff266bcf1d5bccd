"""The recorded corridor, from all of its log and from parts of it."""

from dataclasses import replace
from typing import Any

import numpy as np

from echogrid import Frame, Robot
from echogrid.models.networks.local_map import LOCAL_CELL_M
from experiments.common import corridor8 as recording
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import Panel, page, record
from experiments.studies.generalise.arrays import silenced
from experiments.studies.generalise.study import Study, label, show


def corridor_logs(robot: Robot, log: list[Frame]) -> dict[str, tuple[Robot, list[Frame]]]:
    """All of the log and parts of it."""
    found = {
        "full": (robot, log),
        "every second reading removed": (robot, silenced(log, 2, in_turn=True)),
        "every other frame removed": (robot, log[::2]),
    }
    for name, kept in {"front": [2, 3, 4, 5], "side": [0, 1, 6, 7], "alternate": [0, 2, 4, 6]}.items():
        few = replace(robot, mounts=robot.mounts[kept])
        found[f"four {name} sonars"] = few, [replace(frame, ranges=frame.ranges[kept]) for frame in log]
    return found


def corridor8(study: Study) -> None:
    """The recorded corridor from all of the log and from parts of it."""
    folder = recording.FOLDER
    if not folder.is_dir():
        print(f"corridor8: found no folder {folder}, so set_corridor8.* stay as they are")
        return
    robot = Robot.load(recording.ROBOT)
    log = list(recording.frames(folder, robot))
    logs = corridor_logs(robot, log)
    # The measures look one cell to each side of a wall, so that cells of one size have to be set beside each other.
    wanted = [
        (model, cell) for model in study.beside("network") for cell in dict.fromkeys([study.cell, LOCAL_CELL_M])
    ]
    jobs = [(model, part, few, cell) for few, part in logs.values() for model, cell in wanted]
    grids = iter(each(mapped, jobs, "corridor8"))
    found: dict[str, Any] = {}
    shown_maps: list[Panel] = []
    drive = np.array([frame.pose[:2] for frame in log])
    drawn = ("full", "every second reading removed", "four front sonars", "four side sonars")
    for name in logs:
        for model, cell in wanted:
            grid = next(grids)
            measured = {k: round(v, 4) for k, v in recording.measure(grid).items()}
            found.setdefault(f"{label(model)}, {cell:g} m", {})[name] = measured
            if (model, cell) == wanted[0] and name in drawn:
                shown_maps.append((name, grid, drive, None))
    for model, by in found.items():
        names = list(next(iter(by.values())))
        show(
            f"recorded corridor, {model} cells",
            ["log", *names],
            ([name, *(f"{shares[k]:.1%}" for k in names)] for name, shares in by.items()),
        )
    record("set_corridor8", {"model": label(study.model), "cell_m": study.cell, "found": found})
    title = f"The recorded corridor by {label(study.model)}, cells of {study.cell:g} m, from all and parts of the log"
    page(shown_maps, 2, 5.6, 0.69, title, "set_corridor8", recording.mark)
