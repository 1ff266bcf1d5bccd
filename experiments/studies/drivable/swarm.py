"""Real flights in small mazes with true poses and walls: ../shared/data/nanoswarm, time of flight, four sides."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from echogrid import Frame, Robot
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.zones import KINDS, SIDES, ZONES, drone, zone_ranges
from experiments.studies.drivable.measures import SMEAR_M, near_to, occupied, smear
from experiments.studies.drivable.study import Study, share, tidy, told
from experiments.studies.generalise.study import label, show

FOLDER = Path(__file__).parents[4] / "shared" / "data" / "nanoswarm"
MAZES = {
    "exp1_two-drones": "env1a",
    "icp": "env1a",
    "exp1_four-drones": "env1b",
    "exp2_two-drones": "env2",
    "exp2_four-drones": "env2",
    "exp3_two-drones": "env3",
    "exp4_0_2": "env4",
    "exp4_0_8": "env4",
}
MAX_M = 3.5
CELL_M = 0.04
NEAR_M = 1.5
"""Walls are looked for where the path is so near."""


def flight(file: Path, kind: str, robot: Robot) -> list[Frame]:
    """A run as frames at the poses of the motion capture; a cone reads the least of its zones."""
    with file.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    pose = np.array([[float(row[name]) for name in ("x_vicon", "y_vicon", "yaw_vicon")] for row in rows])
    mm = np.array([[[float(row[f"{side}{zone}"]) for zone in range(ZONES)] for side in SIDES] for row in rows])
    # What lies past the range is no echo.
    ranges = zone_ranges(np.where(mm <= 0, np.nan, mm / 1000), kind, robot)
    return [Frame(0.1 * i, p, r) for i, (p, r) in enumerate(zip(pose, ranges, strict=True))]


def walls_of(file: Path, maze: str) -> Float[ndarray, "n 2"]:
    """Points on the walls of a maze, 2 cm apart."""
    with file.open(encoding="utf-8") as lines:
        rows = [
            [float(row[k]) for k in ("x0", "y0", "x1", "y1")] for row in csv.DictReader(lines) if row["maze"] == maze
        ]
    points = []
    for x0, y0, x1, y1 in rows:
        steps = max(2, int(np.hypot(x1 - x0, y1 - y0) / 0.02))
        points.append(np.column_stack([np.linspace(x0, x1, steps), np.linspace(y0, y1, steps)]))
    return np.concatenate(points)


def flown(run: str, kind: str, models: tuple[str, ...]) -> list[dict[str, Any]]:
    """What each model makes of a run."""
    robot, points = drone(kind, MAX_M), walls_of(FOLDER / "walls.csv", MAZES[run])
    frames = flight(FOLDER / f"{run}.csv", kind, robot)
    path = np.array([frame.pose[:2] for frame in frames])
    near = points[KDTree(path).query(points)[0] < NEAR_M]
    found = []
    for model in models:
        grid = mapped(model, frames, robot, CELL_M)
        claimed, told_ = occupied(grid), smear(grid, near_to(points))
        there = float(np.mean(near_to(claimed)(near) < SMEAR_M)) if len(claimed) else 0.0
        at_wall = None if told_["smear"] is None else 1 - told_["smear"]
        entry = {"run": run, "kind": kind, "model": label(model), "found": there}
        found.append(entry | {"at a wall": at_wall, "off_m": told_["off_m"]})
    return found


def swarm(study: Study) -> None:
    """The flights that are here; none is no error."""
    runs = [run for run in MAZES if (FOLDER / f"{run}.csv").is_file()][: study.rooms]
    if not runs:
        print(f"\nno flights in {FOLDER}: left out")
        return
    jobs = [(run, kind, study.models) for run in runs for kind in KINDS]
    found = [entry for entries in each(flown, jobs, "swarm") for entry in entries]
    rows = [[e["run"], e["kind"], e["model"], *(told(e[k]) for k in ("found", "at a wall", "off_m"))] for e in found]
    for kind in KINDS:
        for model in map(label, study.models):
            some = [e for e in found if (e["kind"], e["model"]) == (kind, model)]
            means = [told(share([e[k] for e in some])) for k in ("found", "at a wall", "off_m")]
            rows.append(["all", kind, model, *means])
    header = ["run", "a side as", "model", "wall found", "occupied at a wall", "median off (m)"]
    show(f"nanoswarm, true poses, cells of {CELL_M:g} m, within 0.1 m", header, rows)
    record("drivable_swarm", tidy(study.settings(cell_m=CELL_M) | {"found": found}))
