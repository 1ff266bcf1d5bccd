"""How thick walls come out, what is black behind them, and how far that is from any surface: rooms held out."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Grid, Robot, World
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import record
from experiments.common.rooms import KINDS, frames, numbered, robots
from experiments.studies.drivable.doors import SURFACES, way
from experiments.studies.drivable.measures import phantoms, smear
from experiments.studies.drivable.study import SEED, Study, share, tidy, told
from experiments.studies.generalise.study import label, show
from experiments.studies.generalise.suite import ALONG_M, ENDS_M, faces, suite
from experiments.studies.generalise.walls import OFFSETS_M, extent

ROOMS = 10
SEEN_M = 1.4
"""A wall is measured where a pose is so near and sees it."""


def seen_faces(
    world: World, poses: Float[ndarray, "frames 3"]
) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2"]]:
    """Places along the walls of a world that are seen from a path from one side alone, and the way behind each."""
    at, behind = [], []
    for x0, y0, x1, y1 in world.walls:
        a, along = np.array([x0, y0]), np.array([x1 - x0, y1 - y0])
        length = float(np.hypot(*along))
        unit = along / length
        places = a + np.arange(ENDS_M, length - ENDS_M, ALONG_M)[:, None] * unit
        normal = np.array([-unit[1], unit[0]])
        for place in places:
            to = poses[:, :2] - place
            near = to[np.hypot(*to.T) < SEEN_M]
            gap = np.hypot(*near.T)
            sight = world.sight(np.broadcast_to(place, near.shape) + 1e-3 * near, np.arctan2(near[:, 1], near[:, 0]))
            sides = np.unique(np.sign(near[sight > gap] @ normal))
            if len(sides) == 1:
                at.append(place)
                behind.append(-sides[0] * normal)
    return np.array(at).reshape(-1, 2), np.array(behind).reshape(-1, 2)


def thickness(grid: Grid, at: Float[ndarray, "n 2"], behind: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
    """How far walls reach in front of their faces and behind them on the map, m; nan where they are missing."""
    across = at[:, None] + OFFSETS_M[:, None] * behind[:, None]
    return np.array([extent(p) for p in grid.probability_at(across)]).reshape(-1, 2)


def median(values: Float[ndarray, "n"]) -> float | None:
    """Of what is there."""
    there = values[~np.isnan(values)]
    return float(np.median(there)) if there.size else None


def room_of(room: int, world: World, poses: ndarray, robot: Robot, models: tuple[str, ...]) -> list[dict[str, Any]]:
    """What each model makes of a room."""
    drive, (at, behind) = frames("default", world, poses, robot, room, SEED), seen_faces(world, poses)
    found = []
    for model in models:
        grid = mapped(model, drive, robot, None)
        extents, ghosts = thickness(grid, at, behind), phantoms(grid, world, poses)
        area = float(np.sum(ghosts)) * grid.resolution**2
        entry = {"thick_m": median(extents.sum(axis=1)), "behind_m": median(extents[:, 1]), "phantom_m2": area}
        found.append({"model": label(model), "robot": robot.name} | entry | smear(grid, world.clearance))
    return found


def partition_of(number: int, surface: str, robot: Robot, models: tuple[str, ...]) -> list[dict[str, Any]]:
    """How thick each model draws a partition of no thickness that is seen from both sides."""
    rooms_ = suite(number, surface, 0.0)
    poses = way(rooms_)
    drive = frames("default", rooms_.world, poses, robot, number, SEED)
    lines = [
        (rooms_.at(at), rooms_.at(at + over) - rooms_.at(at)) for kind, at, over in faces(rooms_) if kind != "outer"
    ]
    at, behind = (np.concatenate(part) for part in zip(*lines, strict=True))
    found = []
    for model in models:
        extents = thickness(mapped(model, drive, robot, None), at, behind)
        found.append({"model": label(model), "robot": robot.name, "thick_m": median(extents.sum(axis=1))})
    return found


def walls(study: Study) -> None:
    """Thickness, smear and phantoms."""
    count = study.rooms or ROOMS
    arrays = robots().values()
    jobs = [(*room, robot, study.models) for robot in arrays for room in numbered(KINDS, count, robot, SEED)]
    kinds = [KINDS[room // 1000] for room, *_ in jobs]
    rooms_ = [{"kind": kind} | e for kind, es in zip(kinds, each(room_of, jobs, "walls"), strict=True) for e in es]
    jobs = [(n, surface, robot, study.models) for robot in arrays for surface in SURFACES for n in range(count)]
    thin = [
        {"kind": job[1]} | e for job, es in zip(jobs, each(partition_of, jobs, "partitions"), strict=True) for e in es
    ]
    body = []
    for key in (
        {"kind": k, "robot": r, "model": m} for k in KINDS for r in robots() for m in map(label, study.models)
    ):
        some, other = ([e for e in entries if key.items() <= e.items()] for entries in (rooms_, thin))
        clear = sum(e["phantom_m2"] == 0 for e in some)
        means = [share([e[name] for e in some]) for name in ("thick_m", "behind_m", "smear", "off_m", "phantom_m2")]
        partition = told(share([e["thick_m"] for e in other]), 2)
        shown = [told(value, 3 if k > 1 else 2) for k, value in enumerate(means)]
        body.append([*key.values(), *shown[:2], partition, *shown[2:4], f"{clear} of {len(some)}", shown[4]])
    header = ["walls", "array", "model", "thick (m)", "behind (m)", "partition (m)", "smear", "median off (m)"]
    header += ["without phantoms", "phantoms (m2)"]
    show("Walls: medians along them; smear: share of occupied cells more than 0.1 m from any surface", header, body)
    record("drivable_walls", tidy(study.settings(rooms=count) | {"rooms_of": rooms_, "partitions": thin}))
