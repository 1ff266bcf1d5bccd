"""Paths planned on maps and driven in the true world, between random places: collisions, length, ways not found."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Grid, NoPathError, Path, Robot, World, build_map, plan
from echogrid._core import cost_to_go
from echogrid.geometry import wrap
from echogrid.planning.clearance import Floor
from echogrid.planning.following import Pace, follow
from echogrid.planning.paths import path_along
from echogrid.simulation.drive import along
from echogrid.simulation.simulate import Simulator
from experiments.common.report import table
from experiments.studies.planning.exploring import ROBOTS
from experiments.studies.position.buildings import WALLS, building

KINDS = ("flat", "ring", "hall")
ROOM_M = 0.08
"""Start and goal have so much room beside the footprint, and so has the way that is asked for."""
NEAR_M = 1.2
"""They lie within this of the drive: nobody plans on what was never seen."""
_STEP_S, _CELL_M = 0.1, 0.05


def truth_grid(world: World) -> Grid:
    """The world as a map: free but for the cells within 1 cm of a wall or in a pillar."""
    low, high = world.bounds()
    cols, rows = np.ceil((high - low) / _CELL_M).astype(int) + 2
    origin = low - _CELL_M
    x, y = np.meshgrid(origin[0] + (np.arange(cols) + 0.5) * _CELL_M, origin[1] + (np.arange(rows) + 0.5) * _CELL_M)
    gap = world.clearance(np.column_stack([x.ravel(), y.ravel()])).reshape(rows, cols)
    log_odds = np.where(gap > _CELL_M / 2, -5, 5).astype(np.float32)
    return Grid(log_odds, np.ones_like(log_odds, bool), _CELL_M, (float(origin[0]), float(origin[1])))


def driven(path: Path, pace: Pace) -> Float[ndarray, "n 3"]:
    """Poses of a robot that follows a path, its pose being known."""
    first = path.points[0]
    to = path.points[min(5, len(path.points) - 1)] - first
    poses = [np.array([*first, np.arctan2(to[1], to[0])])]
    while len(poses) < 20_000:
        near = int(np.argmin(np.linalg.norm(path.points - poses[-1][:2], axis=1)))
        velocity = follow(path.points, poses[-1], float(path.clearance_m[near]), pace)
        if velocity is None:
            break
        (speed, turn), (x, y, theta) = velocity, poses[-1]
        middle = theta + turn * _STEP_S / 2
        way = speed * _STEP_S
        poses.append(
            np.array([x + way * np.cos(middle), y + way * np.sin(middle), float(wrap(theta + turn * _STEP_S))])
        )
    return np.array(poses)


def planned(kind: str, number: int, walls: str, robot_name: str, pairs: int) -> dict[str, Any]:
    """What became of random pairs in one building that was mapped with given poses."""
    place, robot = building(kind, walls, number), Robot.load(robot_name)
    poses = along(place.way)
    *_, grid = build_map(list(Simulator(place.world, robot).frames(poses, number)), robot)
    true = Floor(truth_grid(place.world), robot.footprint_radius_m, ROOM_M, dear=0.0)
    costs = true.known_costs
    rng = np.random.default_rng([number, WALLS.index(walls)])
    open_ = np.argwhere(np.isfinite(costs))
    near = (
        np.min(np.linalg.norm(true.grid.centre_of(open_)[:, None] - poses[None, ::20, :2], axis=2), axis=1) < NEAR_M
    )
    open_ = open_[near]
    found: dict[str, Any] = {"building": f"{kind}-{number}", "walls": walls, "robot": robot_name, "pairs": 0,
                             "lost": 0, "collisions": 0, "least_m": [], "ratio": [], "why": []}  # fmt: skip
    while found["pairs"] < pairs:
        first, last = open_[rng.integers(0, len(open_), 2)]
        to_go = cost_to_go(costs, last[None].astype(np.int64), _CELL_M)
        if not np.isfinite(to_go[tuple(first)]) or to_go[tuple(first)] < 1.0:
            continue
        found["pairs"] += 1
        shortest = path_along(true, costs, to_go, (int(first[0]), int(first[1]))).length_m
        start, goal = true.grid.centre_of(np.array([first, last]))
        try:
            path = plan(grid, start, goal, robot)
        except NoPathError as reason:
            found["lost"] += 1
            found["why"].append(str(reason)[:200])
            continue
        way = np.concatenate([path.points, driven(path, Pace())[:, :2]])
        least = float(np.min(place.world.clearance(way))) - robot.footprint_radius_m
        found["collisions"] += least < 0
        found["least_m"].append(least)
        found["ratio"].append(path.length_m / shortest)
    return found


def summary(found: list[dict[str, Any]]) -> str:
    """A row for each kind of building and of walls."""
    rows = []
    for kind in KINDS:
        for walls in WALLS:
            some = [one for one in found if one["building"].startswith(kind) and one["walls"] == walls]
            if not some:
                continue
            count = sum(one["pairs"] for one in some)
            ratio = np.concatenate([one["ratio"] for one in some])
            rows.append([
                kind, walls, str(count), str(sum(one["collisions"] for one in some)),
                f"{min(min(one['least_m']) for one in some):.3f}", f"{np.median(ratio):.3f}",
                f"{np.percentile(ratio, 95):.3f}", f"{sum(one['lost'] for one in some) / count:.1%}",
            ])  # fmt: skip
    return table(("building", "walls", "pairs", "collisions", "least clearance, m", "length / shortest", "95 %",
                  "no path"), rows)  # fmt: skip


def jobs(pairs: int) -> list[tuple[str, int, str, str, int]]:
    """One building of each kind, walls and robot."""
    return [(kind, 20, walls, robot, pairs) for kind in KINDS for walls in WALLS for robot in ROBOTS]
