"""Whether a door that the robot drives through stays open, after one pass and after many."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Grid, Robot
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import sensor_model
from echogrid.simulation.drive import along
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import robots
from experiments.studies.drivable.measures import body_claims, lane_m, under_body
from experiments.studies.drivable.study import SEED, Study, passes_of, share, tidy, told
from experiments.studies.generalise.study import label, show
from experiments.studies.generalise.suite import DEPTHS_M, DOOR_AT_M, Suite, suite

LAYOUTS, PASSES = 20, (1, 8)
DOORS_M, WALLS_M = (0.8, 0.9), (0.05, 0.3)
SURFACES = ("smooth", "rough", "mixed")
KEPT_M = 0.1
"""What a tour of a room keeps from everything besides the robot's radius."""
LEFT_M, RIGHT_M = (-0.8, -2.4), (0.8, 1.8)
"""Where a way round each of the two rooms runs, to either side of the wall between them."""
ROUND_M = 1.2
"""And to either side of their middle."""
WIDE = 1.6
"""Footprint radii that a lane must have for the robot to drive in it."""
WORST = 0.35
"""No cell under the robot's body may be above this."""


def layout(number: int) -> Suite:
    """The ``number``-th layout; every six have each door with each kind of walls."""
    thick = float(np.random.default_rng([SEED, number]).uniform(*WALLS_M))
    return suite(number, SURFACES[number % 3], thick, DOORS_M[number // 3 % 2])


def way(rooms_: Suite) -> Float[ndarray, "frames 3"]:
    """Once round the one room, through the middle of the door, and round the other.

    A tour would not do: it keeps so far from everything that it leaves narrow doors alone.
    """
    (near, far), (beyond, end), y = LEFT_M, RIGHT_M, ROUND_M
    one = [[near, DOOR_AT_M], [near, y], [far, y], [far, -y], [near, -y], [near, DOOR_AT_M]]
    other = [[beyond, DOOR_AT_M], [beyond, y], [end, y], [end, -y], [beyond, -y], [beyond, DOOR_AT_M]]
    return along(rooms_.at(np.array([*one, *other])))


def open_door(grid: Grid, rooms_: Suite, poses: Float[ndarray, "frames 3"], radius: float) -> dict[str, Any]:
    """The lane from room to room, what the map claims under the robot, and whether it can be driven on.

    A lane wider than the door (and two cells) is a hole in the wall.
    """
    ends = [rooms_.at(np.array([x, 0.0])) for x in (-DEPTHS_M[0] / 2, DEPTHS_M[1] / 2)]
    # The lane begins and ends where the robot was nearest to the middles of the rooms.
    first, last = (poses[np.argmin(np.hypot(*(poses[:, :2] - end).T)), :2] for end in ends)
    lane, claims = lane_m(grid, first, last), body_claims(under_body(grid, poses, radius))
    hole = lane > rooms_.door + 2 * grid.resolution
    return {"lane_m": lane, "hole": hole} | claims | {"right": lane >= WIDE * radius and claims["worst"] <= WORST}


def driven(number: int, robot: Robot, models: tuple[str, ...], passes: tuple[int, ...]) -> list[dict[str, Any]]:
    """Of each model and number of passes what its map says of a layout's door."""
    rooms_ = layout(number)
    poses = way(rooms_)
    drives = list(passes_of(rooms_.world, robot, poses, max(passes), number))
    found = []
    for model in models:
        mapper = Mapper(robot, sensor_model(model))
        for count, drive in enumerate(drives, start=1):
            mapper.add(drive)
            if count in passes:
                found.append(
                    {"model": label(model), "passes": count}
                    | open_door(mapper.grid(), rooms_, poses, robot.footprint_radius_m)
                )
    place = {"layout": number, "surface": SURFACES[number % 3], "door_m": rooms_.door, "wall_m": rooms_.thick}
    return [place | {"robot": robot.name} | entry for entry in found]


def doors(study: Study) -> None:
    """Doors that the robot drives through."""
    count, passes = study.rooms or LAYOUTS, study.passes or PASSES
    jobs = [(n, robot, study.models, passes) for robot in robots().values() for n in range(count)]
    found = [entry for entries in each(driven, jobs, "doors") for entry in entries]
    summary, body = {}, []
    for name in robots():
        for model in map(label, study.models):
            for n in passes:
                key = {"robot": name, "model": model, "passes": n}
                some = [e for e in found if key.items() <= e.items()]
                right = sum(e["right"] for e in some)
                lanes, worst = [e["lane_m"] for e in some], [e["worst"] for e in some]
                holes = sum(e["hole"] for e in some)
                entry = {"right": right, "of": count, "least lane_m": min(lanes), "worst under": max(worst)}
                entry |= {"holes": holes}
                summary[f"{name}, {model}, {n}"] = entry
                shown = told(min(lanes), 2), told(share(lanes), 2), told(max(worst), 2), told(share(worst), 2)
                body.append([name, model, str(n), f"{right} of {count}", *shown, str(holes)])
    header = ["array", "model", "passes", "right", "least lane (m)", "mean lane (m)", "worst p under", "mean worst"]
    header += ["lanes wider than the door"]
    limit = f"lane >= {WIDE:g} radii, nothing under the body above {WORST:g}"
    show(
        f"Doors of 0.8 and 0.9 m that the robot drives through, walls of 0.05 to 0.3 m; right: {limit}", header, body
    )
    record("drivable_doors", tidy(study.settings(layouts=count) | {"summary": summary, "found": found}))
