"""The set network where it might fail: its probabilities, its reach, walls and doors, standing still, other arrays.

    python experiments/generalise.py [PART ...] [--model NAME|FILE] [--rooms N] [--own FILE] [--out FOLDER]
    python experiments/generalise.py --write-robot FILE

PART, of which all are the default, each with tables on stdout and its numbers in docs/paper/set_PART.json:

- calibration: reliability and `ece` in each kind of room, beside the paper's network (picture).
- reach: truth up to 1.4 m and up to 2.5 m from the path, for a tour of the room and, as that passes within 1.4 m of
  nearly everything, for its first 6 m alone; beside the paper's network and the best classical models.
- walls: how thick a wall comes out, and whether a door of 0.8 m stays open, in two rooms of known place that are
  turned and shifted against the cells; each model at its own cell size (two pictures).
- standing: what a robot claims wrongly after 1, 10, 100 and 600 scans from one place (picture).
- spacing: the same tour with frames every 5, 10, 20 and 50 cm.
- arrays: other robots, arrays that no preset has, sonars that are silent or fire in turn. With --own the weights of
  FILE, trained for the uneven ring that --write-robot writes, are set beside the general ones.
- corridor8: the recorded corridor, from all of the log and from parts of it (picture).
- simulators: four simulators, two of them written apart from what the network was trained on.

The model is `set-network` or what --model says; unless a part says otherwise, all models have its cells. --rooms sets
the rooms of each kind (walls: orientations). No training and no other study has seen the rooms. Takes about 15
minutes on 2 cores, no part more than 5.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray
from scipy import ndimage
from tqdm import tqdm

import corridor8_map
import paper
from corridor8_to_csv import frames as corridor_frames
from echogrid import Frame, Grid, Robot, World
from echogrid.errors import EchogridError
from echogrid.mapping.build import cell_of
from echogrid.metrics import ECE_BINS, FREE, FREE_BELOW, HIDDEN, OCCUPIED_ABOVE, SURFACE, Truth
from echogrid.models.network import LOCAL_CELL_M
from echogrid.models.table import DEFAULT, MODELS, sensor_model
from echogrid.robot import preset_names, robot_yaml
from echogrid.simulation.drive import STEP_M, tour, truth_of
from echogrid.simulation.world import polyline
from held_out import PLACES, SHOWN, against, frames, interval, mapped, rooms, scored
from mujoco_sonar import available, mujoco_ranges
from paper import Panel, page, record, save
from results import rows

SEED = 80_000_000
ROBOT = "b21"
CLASSICAL = ("muriel", "elfes", "fuzzy")
"""The best of the classical models on the held-out rooms."""
COLOURS = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple", "tab:brown")

Means = dict[str, list[float] | None]
"""Of each score the mean over the rooms and its 95 % interval."""


@dataclass(frozen=True)
class Study:
    """What is measured."""

    model: str
    """Name, or weights file."""
    rooms: int | None
    """Rooms of each kind; None: as many as each part has by default."""
    own: str | None = None
    """Weights trained for the array ``uneven10``."""

    def beside(self, *others: str) -> list[str]:
        """The model and others, none twice."""
        return list(dict.fromkeys([self.model, *others]))

    @property
    def cell(self) -> float:
        """Side of the model's cells, m."""
        return cell_of(sensor_model(self.model))

    def settings(self, count: int) -> dict[str, Any]:
        """What a record begins with."""
        return {"model": label(self.model), "rooms": count, "seed": SEED, "cell_m": self.cell}


def label(model: str) -> str:
    """How tables call a model: a weights file by its name alone."""
    return model if model in MODELS else Path(model).stem


def labels(models: Iterable[str]) -> list[str]:
    """The labels of models."""
    return [label(model) for model in models]


def colour_of(model: str, number: int) -> str:
    """Colour of the ``number``-th model of a picture: the paper's network is always dark."""
    return "0.25" if model == "network" else COLOURS[number % len(COLOURS)]


def key(figure: Figure, panel: Axes) -> None:
    """What the lines of a panel mean, below all panels."""
    handles, names = panel.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(handles), frameon=False)


def each(work: Callable[..., Any], jobs: Iterable[tuple], what: str) -> list[Any]:
    """The results of jobs in their order, two at a time."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        waiting = [pool.submit(work, *job) for job in jobs]
        return [job.result() for job in tqdm(waiting, what, unit="job", disable=None)]


def held(places: Sequence[str], count: int, robot: Robot) -> Iterator[tuple[int, World, ndarray]]:
    """Number, world and tour of rooms, place after place. The number decides the noise; no two rooms share it."""
    for place in places:
        for room, (world, poses) in enumerate(rooms(place, count, robot, SEED)):
            yield 1000 * PLACES.index(place) + room, world, poses


def drive_in(simulator: str, world: World, poses: ndarray, robot: Robot, room: int) -> list[Frame]:
    """A drive under a simulator of held_out.py or under ``mujoco``."""
    if simulator != "mujoco":
        return frames(simulator, world, poses, robot, room, SEED)
    ranges = mujoco_ranges(world, robot, poses, np.random.default_rng([SEED, room]))
    return [Frame(i / 5, p, r) for i, (p, r) in enumerate(zip(poses, ranges, strict=True))]


def read(grid: Grid, truth: Truth) -> Float[ndarray, "rows cols"]:
    """The map's probability at the centres of the truth's cells."""
    row, col = np.indices(truth.cells.shape)
    return grid.probability_at((np.stack([col, row], axis=-1) + 0.5) * truth.resolution + truth.origin)


def averages(scores: Float[ndarray, "rooms scores"]) -> Means:
    """What JSON holds of the scores of held_out.py."""
    rng = np.random.default_rng(SEED)
    return {name: interval(column, rng) for name, column in zip(SHOWN, scores.T, strict=True)}


def shown(value: Sequence[float] | None, digits: int = 3) -> str:
    """The mean of an interval as a table shows it."""
    return "-" if value is None else f"{value[0]:.{digits}f}"


def show(title: str, header: Sequence[str], body: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    print(f"\n{title}\n\n{rows(list(header), [list(row) for row in body])}", flush=True)


def show_scores(title: str, first: str, means: dict[str, Means]) -> None:
    """Print a table of scores, a row for each name."""
    show(title, [first, *SHOWN], ([name, *map(shown, scores.values())] for name, scores in means.items()))


# Calibration

CALIBRATED = ("default", "varied")


def binned(
    room: int, world: World, poses: ndarray, models: list[str], cell: float
) -> Float[ndarray, "simulators models 3 bins"]:
    """For each bin of p its cells of the truth, the sum of their p, and how many are surface."""
    robot, truth = Robot.load(ROBOT), truth_of(world, poses)
    known = truth.cells != HIDDEN
    surface = truth.cells[known] == SURFACE
    table = []
    for simulator in CALIBRATED:
        drive = drive_in(simulator, world, poses, robot, room)
        table.append([])
        for name in models:
            p = read(mapped(name, drive, robot, cell), truth)[known]
            bins = np.minimum((p * ECE_BINS).astype(int), ECE_BINS - 1)
            sums = [np.bincount(bins, weights=v, minlength=ECE_BINS) for v in (np.ones_like(p), p, surface)]
            table[-1].append(sums)
    return np.array(table)


def calibration(study: Study) -> None:
    """Reliability of the probabilities and ``ece``."""
    count, models = study.rooms or 8, study.beside("network")
    jobs = ((*room, models, study.cell) for room in held(PLACES, count, Robot.load(ROBOT)))
    sums = np.array(each(binned, jobs, "calibration")).reshape(len(PLACES), count, -1, len(models), 3, ECE_BINS)
    gaps = np.abs(sums[..., 2, :] - sums[..., 1, :]).sum(axis=-1) / sums[..., 0, :].sum(axis=-1)
    pooled = sums.sum(axis=1)
    rng = np.random.default_rng(SEED)
    found: dict[str, Any] = {}
    for s, simulator in enumerate(CALIBRATED):
        found[simulator] = {}
        for i, place in enumerate(PLACES):
            found[simulator][place] = {}
            for m, model in enumerate(labels(models)):
                cells, p, surface = pooled[i, s, m]
                used = np.flatnonzero(cells)
                found[simulator][place][model] = {
                    "ece": interval(gaps[i, :, s, m], rng),
                    "ece of all cells together": round(float(np.abs(surface - p).sum() / cells.sum()), 4),
                    "bin": used.tolist(),
                    "cells": cells[used].astype(int).tolist(),
                    "mean p": (p / np.maximum(cells, 1))[used].round(4).tolist(),
                    "surface": (surface / np.maximum(cells, 1))[used].round(4).tolist(),
                }
    show(
        f"ece (mean over {count} rooms; in brackets of all their cells together), cells of {study.cell:g} m",
        ["simulator", "walls", *labels(models)],
        (
            [simulator, place, *(f"{shown(e['ece'])} ({e['ece of all cells together']:.3f})" for e in by.values())]
            for simulator, places in found.items()
            for place, by in places.items()
        ),
    )
    record("set_calibration", study.settings(count) | {"robot": ROBOT, "found": found})
    draw_calibration(found, count, study.cell)


def draw_calibration(found: dict[str, Any], count: int, cell: float) -> None:
    """Share of surface against p, and below how many cells have that p."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    axes = figure.subplots(2 * len(found), len(PLACES), sharex=True, sharey="row", height_ratios=[3, 1] * len(found))
    for (simulator, places), pair in zip(found.items(), axes.reshape(len(found), 2, -1), strict=True):
        for (place, models), curve, counts in zip(places.items(), *pair, strict=True):
            curve.plot([0, 1], [0, 1], color="0.6", lw=0.8, ls="--", label="calibrated")
            for i, (model, entry) in enumerate(models.items()):
                colour = colour_of(model, i)
                p, share, cells = (np.array(entry[k], dtype=float) for k in ("mean p", "surface", "cells"))
                many = cells >= 20
                curve.plot(p[many], share[many], "o-", ms=3.5, lw=1.2, color=colour, label=model)
                curve.plot(p[~many], share[~many], "o", ms=3.5, mfc="none", color=colour)
                all_bins = np.bincount(entry["bin"], weights=cells, minlength=ECE_BINS)
                counts.stairs(all_bins, np.linspace(0, 1, ECE_BINS + 1), color=colour, lw=1.2)
                text = f"ece {shown(entry['ece'])}"
                curve.text(0.03, 0.96 - 0.09 * i, text, color=colour, transform=curve.transAxes, va="top", size=9)
            curve.set(xlim=(0, 1), ylim=(-0.02, 1.02))
            curve.set_title(f"{simulator}, {place if place != 'corridor' else 'corridors'}", fontsize="medium")
            curve.grid(alpha=0.3)
            counts.set_yscale("log")
            counts.grid(alpha=0.3)
    for curves, counts in zip(axes[::2], axes[1::2], strict=True):
        curves[0].set_ylabel("share that is surface")
        counts[0].set_ylabel("cells")
    for panel in axes[-1]:
        panel.set_xlabel("p of the map")
    key(figure, axes[0, 0])
    figure.suptitle(
        f"What share of the cells with a probability is surface: {count} rooms of each kind, cells of {cell:g} m; "
        "open dots stand for fewer than 20 cells"
    )
    save(figure, "set_calibration")


# Reach

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
        drive = drive_in("default", world, part, robot, room)
        truths = [truth_of(world, part, reach=reach) for reach in REACHES_M]
        grids = [mapped(name, drive, robot, cell) for name in models]
        table.append(
            [[(*scored(g, truth, robot), np.sum(truth.cells == SURFACE)) for truth in truths] for g in grids]
        )
    return np.array(table)


def reach(study: Study) -> None:
    """Scores with truth near the path, and farther from it."""
    count, models = study.rooms or 8, study.beside("network", *CLASSICAL)
    jobs = ((*room, models, study.cell) for room in held(PLACES, count, Robot.load(ROBOT)))
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


# Walls and doors

WALL_MODELS = ("network", *CLASSICAL, "nav2")
SURFACES = ("smooth", "rough")
DEPTHS_M, HALF_M = (3.2, 2.6), 2.0
"""The two rooms reach so far to either side of the wall between them, and so far along it."""
DOOR_M, DOOR_AT_M = 0.8, 0.7
PARTITIONS_M = {"thin": 0.0, "0.15 m thick": 0.15}
CLEARANCE_M, RADIUS_M = 0.32, 0.2
"""What the drive keeps from the walls, and the robot that is to pass the door on the map."""
APART_M = 0.6
"""No farther from the partition a robot is at the door."""
WAYS = ("driven through", "seen from the rooms")
"""All of the drive, and without what it has seen at the door."""
ALONG_M, ENDS_M = 0.05, 0.4
"""Walls are crossed at places so far apart, and so far from their ends."""
FINE_M = 0.005
OFFSETS_M = np.arange(-200, 201) * FINE_M
"""Places of a line across a wall; behind the wall is positive."""
ASIDE_M = 0.3
"""A surface farther from the true face is not that wall."""


@dataclass(frozen=True)
class Suite:
    """Two rooms and a door between them. In their own frame the partition is the y axis."""

    world: World
    turn: float
    """Rad."""
    shift: Float[ndarray, "2"]
    """m."""
    thick: float
    """Of the partition, m; it then has two faces and the door has jambs."""

    def at(self, xy: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Points of the own frame in the world."""
        return placed(xy, self.turn, self.shift)

    def back(self, p_world: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        """Points of the world in the own frame."""
        return placed(p_world - self.shift, -self.turn, np.zeros(2))


def placed(xy: Float[ndarray, "*n 2"], turn: float, shift: Float[ndarray, "2"]) -> Float[ndarray, "*n 2"]:
    """Points turned, then shifted."""
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(xy) @ np.array([[c, s], [-s, c]]) + shift


def suite(number: int, surface: str, thick: float) -> Suite:
    """The two rooms in the ``number``-th orientation; none has its walls along the cells."""
    turn = np.deg2rad(7.0 + 13.0 * number)
    shift = np.random.default_rng([SEED, number]).uniform(-1.0, 1.0, 2)
    (left, right), low, high, half = DEPTHS_M, DOOR_AT_M - DOOR_M / 2, DOOR_AT_M + DOOR_M / 2, thick / 2
    outline = polyline([[-left, -HALF_M], [right, -HALF_M], [right, HALF_M], [-left, HALF_M]], closed=True)
    if thick:
        posts = [
            [[-half, -HALF_M], [-half, low], [half, low], [half, -HALF_M]],
            [[-half, HALF_M], [-half, high], [half, high], [half, HALF_M]],
        ]
    else:
        posts = [[[0.0, -HALF_M], [0.0, low]], [[0.0, high], [0.0, HALF_M]]]
    walls = np.concatenate([outline, *(polyline(post) for post in posts)])
    walls = placed(walls.reshape(-1, 2), turn, shift).reshape(-1, 4)
    x, y = placed(np.array([-left / 2, 0.0]), turn, shift)
    world = World(f"suite {number}", walls, np.zeros(len(walls)), np.zeros((0, 3)), (float(x), float(y)))
    return Suite(world.with_walls(surface), turn, shift, thick)


def faces(rooms_: Suite) -> Iterator[tuple[str, Float[ndarray, "n 2"], Float[ndarray, "2"]]]:
    """Of each straight wall its kind, places along it and the direction behind it, in the own frame."""
    (left, right), half = DEPTHS_M, rooms_.thick / 2

    def places(begin: float, end: float) -> Float[ndarray, "n"]:
        return np.arange(begin + ENDS_M, end - ENDS_M, ALONG_M)

    for x, sign in ((-left, -1.0), (right, 1.0)):
        y = places(-HALF_M, HALF_M)
        yield "outer", np.column_stack([np.full_like(y, x), y]), np.array([sign, 0.0])
    for sign in (-1.0, 1.0):
        x = np.concatenate([places(-left, -half), places(half, right)])
        yield "outer", np.column_stack([x, np.full_like(x, sign * HALF_M)]), np.array([0.0, sign])
    if not rooms_.thick:
        y = np.concatenate([places(-HALF_M, DOOR_AT_M - DOOR_M / 2), places(DOOR_AT_M + DOOR_M / 2, HALF_M)])
        yield "partition", np.column_stack([np.zeros_like(y), y]), np.array([1.0, 0.0])


def runs(there: Bool[ndarray, "n"], places: Float[ndarray, "n"]) -> Float[ndarray, "runs 2"]:
    """Where along a line something begins and ends, m."""
    change = np.flatnonzero(np.diff(np.pad(there.astype(int), 1)))
    return np.column_stack([places[change[::2]] - FINE_M / 2, places[change[1::2] - 1] + FINE_M / 2])


def extent(p: Float[ndarray, "offsets"]) -> Float[ndarray, "2"]:
    """How far the wall on a line across reaches in front of its true face and behind it, m; nan if it is missing."""
    stretches = runs(p > OCCUPIED_ABOVE, OFFSETS_M)
    if not len(stretches):
        return np.full(2, np.nan)
    away = np.maximum(np.maximum(stretches[:, 0], -stretches[:, 1]), 0.0)
    nearest = int(np.argmin(away))
    return stretches[nearest] * [-1, 1] if away[nearest] <= ASIDE_M else np.full(2, np.nan)


def passage(grid: Grid, rooms_: Suite, below: float) -> float:
    """Width of the door where it is narrowest: of the stretch with p up to a limit, along the wall, m."""
    along = OFFSETS_M[np.abs(OFFSETS_M) <= DOOR_M]
    across = np.arange(-rooms_.thick / 2 - 0.3, rooms_.thick / 2 + 0.301, 0.02)
    x, y = np.meshgrid(across, along + DOOR_AT_M, indexing="ij")
    narrowest = np.inf
    for line in grid.probability_at(rooms_.at(np.stack([x, y], axis=-1))) <= below:
        stretches = runs(line, along)
        stretches = stretches[(stretches[:, 0] < DOOR_M / 2) & (stretches[:, 1] > -DOOR_M / 2)]
        narrowest = min(narrowest, float(np.max(stretches[:, 1] - stretches[:, 0], initial=0.0)))
    return narrowest


def passes(grid: Grid, rooms_: Suite, poses: ndarray) -> bool:
    """Whether a robot finds a way on the map from where it was in one room to where it was in the other.

    As ``path_score`` plans, through cells with p < 0.35 that keep RADIUS_M from those with p > 0.65; but from all of
    them and not from their centres, for else coarse cells leave more room than fine ones.
    """
    parts = int(np.ceil(grid.resolution / 0.02))
    p = np.repeat(np.repeat(grid.probability(), parts, axis=0), parts, axis=1).astype(float)
    gap = np.asarray(ndimage.distance_transform_edt(p <= OCCUPIED_ABOVE)) * grid.resolution / parts
    # A step to a diagonal neighbour asks that both cells beside it are open: so the four neighbours decide.
    piece, _ = ndimage.label((p < FREE_BELOW) & (gap >= RADIUS_M))
    row, col = np.floor((poses[:, 1::-1] - grid.origin[::-1]) * parts / grid.resolution).astype(int).T
    x = rooms_.back(poses[:, :2])[:, 0]
    left, right = (set(piece[row[side], col[side]].tolist()) - {0} for side in (x < -APART_M, x > APART_M))
    return bool(left & right)


def door(grid: Grid, rooms_: Suite, poses: ndarray) -> dict[str, Any]:
    """What a map shows of the door."""
    return {
        "not occupied_m": passage(grid, rooms_, OCCUPIED_ABOVE),
        "free_m": passage(grid, rooms_, FREE_BELOW),
        "passes": passes(grid, rooms_, poses),
    }


def built(number: int, surface: str, thick: float, models: list[str]) -> list[dict[str, Any]]:
    """What each model makes of the walls and the door; of the first orientation also the map."""
    robot, rooms_ = Robot.load(ROBOT), suite(number, surface, thick)
    poses = tour(rooms_.world, CLEARANCE_M)
    drive = drive_in("default", rooms_.world, poses, robot, number)
    apart = [frame for frame in drive if abs(rooms_.back(frame.pose[None, :2])[0, 0]) > APART_M]
    measured = []
    for name in models:
        grids = [mapped(name, part, robot, None) for part in (drive, apart)]
        lines: dict[str, list[ndarray]] = {}
        for kind, at, behind in faces(rooms_):
            across = rooms_.at(at[:, None] + OFFSETS_M[:, None] * behind)
            lines.setdefault(kind, []).append(grids[0].probability_at(across))
        measured.append(
            {
                "profiles": {kind: np.concatenate(p) for kind, p in lines.items()},
                "doors": dict(zip(WAYS, [door(grid, rooms_, poses) for grid in grids], strict=True)),
                "panel": (grids[0], poses[:, :2], rooms_.world) if number == 0 else None,
            }
        )
    return measured


def quantiles(values: Float[ndarray, "n"]) -> list[float] | None:
    """Median and 90th percentile, m."""
    return [round(float(v), 4) for v in np.quantile(values, [0.5, 0.9])] if values.size else None


def thickness(profiles: Float[ndarray, "n offsets"], kind: str) -> dict[str, Any]:
    """How thick a wall is where lines cross it."""
    extents = np.array([extent(p) for p in profiles])
    there = extents[~np.isnan(extents[:, 0])]
    found: dict[str, Any] = {"places": len(extents), "missing": round(1 - len(there) / len(extents), 4)}
    found["thick_m"] = quantiles(there.sum(axis=1))
    if kind == "partition":
        return found | {"to either side_m": quantiles(there.max(axis=1))}
    return found | {"front_m": quantiles(there[:, 0]), "behind_m": quantiles(there[:, 1])}


def walls(study: Study) -> None:
    """How thick walls come out, and whether a door stays open."""
    count, models = study.rooms or 4, study.beside(*WALL_MODELS)
    jobs = [(n, s, thick, models) for s in SURFACES for thick in PARTITIONS_M.values() for n in range(count)]
    results = dict(zip([job[:3] for job in jobs], each(built, jobs, "walls"), strict=True))
    cells = {label(model): cell_of(sensor_model(model)) for model in models}
    found: dict[str, Any] = {"cell_m": cells, "thickness": {}, "doors": {}}
    profiles: dict[tuple[str, str], dict[str, ndarray]] = {}
    for surface in SURFACES:
        found["thickness"][surface], found["doors"][surface] = {}, {}
        for kind in ("outer", "partition"):
            some = [results[n, surface, 0.0] for n in range(count)]
            lines = {model: np.concatenate([r[m]["profiles"][kind] for r in some]) for m, model in enumerate(cells)}
            found["thickness"][surface][kind] = {model: thickness(p, kind) for model, p in lines.items()}
            profiles[surface, kind] = {model: p.mean(axis=0) for model, p in lines.items()}
        for partition, thick in PARTITIONS_M.items():
            some = [results[n, surface, thick] for n in range(count)]
            found["doors"][surface][partition] = {
                model: {way: opened([r[m]["doors"][way] for r in some]) for way in WAYS}
                for m, model in enumerate(cells)
            }
    show_walls(found, cells)
    drawn = {"door_m": DOOR_M, "radius_m": RADIUS_M, "clearance_m": CLEARANCE_M}
    record("set_walls", study.settings(count) | {"robot": ROBOT, "simulator": "default"} | drawn | found)
    draw_profiles(profiles, count)
    panels: list[Panel] = []
    for surface in SURFACES:
        for model, entry in zip(cells, results[0, surface, 0.0], strict=True):
            panels.append((f"{surface}: {model}, {cells[model]:g} m", *entry["panel"]))
    title = f"Two rooms, a partition without thickness and a door of {DOOR_M:g} m: each model at its own cell size"
    page(panels, len(cells), 3.2, 0.82, title, "set_doors")


def opened(doors: list[dict[str, Any]]) -> dict[str, Any]:
    """Of each orientation the width of the door, and the share of them in which the robot passes."""
    widths = {name: [round(d[name], 3) for d in doors] for name in ("not occupied_m", "free_m")}
    return widths | {"passes": round(float(np.mean([d["passes"] for d in doors])), 3)}


def show_walls(found: dict[str, Any], cells: dict[str, float]) -> None:
    """Print the tables of ``walls``."""

    def metres(values: list[float] | None, cell: float) -> str:
        return "-" if values is None else ", ".join(f"{v:.3f} ({v / cell:.1f})" for v in values)

    columns = {
        "outer walls": ("outer", "thick_m"),
        "in front": ("outer", "front_m"),
        "behind": ("outer", "behind_m"),
        "partition": ("partition", "thick_m"),
        "to either side": ("partition", "to either side_m"),
    }
    for surface, kinds in found["thickness"].items():
        body = []
        for model, cell in cells.items():
            missing = " / ".join(f"{kinds[kind][model]['missing']:.3f}" for kind in kinds)
            extents = [metres(kinds[kind][model][name], cell) for kind, name in columns.values()]
            body.append([model, f"{cell:g}", *extents, missing])
        title = f"{surface} walls: extent with p > {OCCUPIED_ABOVE} across, median and 90th percentile, m (cells)"
        show(title, ["model", "cell", *columns, "missing: outer / partition"], body)
    body = []
    for surface, partitions in found["doors"].items():
        for partition, by in partitions.items():
            for model, ways in by.items():
                row = [surface, partition, model, f"{cells[model]:g}"]
                for entry in ways.values():
                    row += [
                        f"{np.median(entry[k]):.2f}, {np.min(entry[k]):.2f}" for k in ("not occupied_m", "free_m")
                    ]
                    row.append(f"{entry['passes']:.2f}")
                body.append(row)
    header = ["walls", "partition", "model", "cell"]
    for way in WAYS:
        header += [f"{way}: p <= {OCCUPIED_ABOVE}", f"p < {FREE_BELOW}", "passes"]
    title = (
        f"Door of {DOOR_M:g} m: its width where it is narrowest, median and least over the orientations, m, and the "
    )
    show(f"{title}share of them in which a robot of {RADIUS_M:g} m radius passes", header, body)


def draw_profiles(profiles: dict[tuple[str, str], dict[str, ndarray]], count: int) -> None:
    """Mean probability on the way through a wall."""
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True)
    for ((surface, kind), by), panel in zip(profiles.items(), panels.flat, strict=True):
        for i, (model, p) in enumerate(by.items()):
            panel.plot(OFFSETS_M, p, lw=1.4, color=colour_of(model, i), label=model)
        panel.axvline(0, color="0.5", lw=0.8)
        panel.axhline(OCCUPIED_ABOVE, color="0.5", lw=0.8, ls=":")
        panel.set_title(f"{surface}: {'outer walls' if kind == 'outer' else 'thin partition'}", fontsize="medium")
        panel.set(xlim=(-0.6, 0.8), ylim=(0, 1))
        panel.grid(alpha=0.3)
    for panel in panels[-1]:
        panel.set_xlabel("distance behind the true face (m)")
    for panel in panels[:, 0]:
        panel.set_ylabel("mean p")
    key(figure, panels[0, 0])
    figure.suptitle(f"Through a wall, each model at its own cell size: mean over all places and {count} orientations")
    save(figure, "set_walls")


# Standing still

STAND_ROBOTS = ("b21", "p3dx")
STANDS = 3
"""Places in a room where the robot stands."""
SCANS = (1, 10, 100, 600)
SURE = 0.9
CLAIMS = ("free wrong", "free far wrong", "surface wrong", "surface wiped", "free right", "surface right")


def stood(
    number: int, world: World, pose: Float[ndarray, "1 3"], robot: Robot, models: list[str], cell: float
) -> tuple[list[int], Float[ndarray, "models scans claims"]]:
    """Free and surface cells within sight of a place, and how many of them are claimed; see CLAIMS."""
    drive = drive_in("varied", world, np.tile(pose, (SCANS[-1], 1)), robot, number)
    truth = truth_of(world, pose)
    free, surface = truth.cells == FREE, truth.cells == SURFACE
    far = free & (np.asarray(ndimage.distance_transform_edt(~surface)) > 2)
    table = []
    for name in models:
        table.append([])
        for scans in SCANS:
            p = read(mapped(name, drive[:scans], robot, cell), truth)
            near = ndimage.maximum_filter(p, size=3) > OCCUPIED_ABOVE
            claimed = [
                free & (p > SURE),
                far & (p > SURE),
                surface & (p < 1 - SURE),
                surface & (p < 1 - SURE) & ~near,
            ]
            claimed += [free & (p < 1 - SURE), surface & (p > SURE)]
            table[-1].append([np.sum(cells) for cells in claimed])
    return [int(free.sum()), int(surface.sum())], np.array(table)


def standing(study: Study) -> None:
    """What is claimed wrongly by a robot that does not move."""
    count, models = study.rooms or 6, study.beside("network")
    found: dict[str, Any] = {}
    jobs = []
    for robot in map(Robot.load, STAND_ROBOTS):
        for room, world, poses in held(["smooth"], count, robot):
            picked = poses[np.linspace(0, len(poses) - 1, STANDS + 2).astype(int)[1:-1]]
            jobs += [
                (STANDS * room + i, world, pose[None], robot, models, study.cell) for i, pose in enumerate(picked)
            ]
    cells, claims = zip(*each(stood, jobs, "standing"), strict=True)
    cells = np.array(cells).reshape(len(STAND_ROBOTS), -1, 2)
    table = np.array(claims).reshape(len(STAND_ROBOTS), -1, len(models), len(SCANS), len(CLAIMS))
    for r, robot in enumerate(STAND_ROBOTS):
        free, surface = (round(float(v), 1) for v in cells[r].mean(axis=0))
        means = table[r].mean(axis=0)
        found[robot] = {"free cells": free, "surface cells": surface, "claimed": {}}
        for m, model in enumerate(labels(models)):
            found[robot]["claimed"][model] = {
                str(scans): {name: round(float(v), 2) for name, v in zip(CLAIMS, means[m, k], strict=True)}
                for k, scans in enumerate(SCANS)
            }
        show(
            f"{robot} standing at {STANDS} places in each of {count} smooth rooms, physics varied: mean number of "
            f"cells claimed, of {free:.0f} free and {surface:.0f} surface cells within 1.4 m and sight (free wrong: "
            f"p > {SURE}; far: and over 2 cells from any surface; surface wrong: p < {1 - SURE:.1f}; wiped: and none "
            f"beside > {OCCUPIED_ABOVE})",
            ["model", "scans", *CLAIMS],
            (
                [model, scans, *(f"{v:.2f}" for v in values.values())]
                for model, by in found[robot]["claimed"].items()
                for scans, values in by.items()
            ),
        )
    extra = {"places": STANDS, "simulator": "varied", "sure": SURE, "truth_cell_m": 0.1}
    record("set_standing", study.settings(count) | extra | {"found": found})
    draw_standing(found, labels(models))


def draw_standing(found: dict[str, Any], models: list[str]) -> None:
    """Wrong claims against the number of scans."""
    figure = Figure(figsize=(9.5, 4.4), layout="constrained")
    panels = figure.subplots(1, 2)
    for panel, kind, claims in zip(panels, ("free", "surface"), (CLAIMS[:2], CLAIMS[2:4]), strict=True):
        for (robot, entry), dash in zip(found.items(), ("-", "--"), strict=True):
            for i, model in enumerate(models):
                colour = colour_of(model, i)
                for claim, mark in zip(claims, "ox", strict=True):
                    share = [
                        100 * values[claim] / entry[f"{kind} cells"] for values in entry["claimed"][model].values()
                    ]
                    name = f"{model}, {robot}" if mark == "o" else None
                    panel.plot(SCANS, share, mark + dash, color=colour, ms=5, lw=1.2, label=name)
        panel.set_xscale("log")
        panel.set_xticks(SCANS, map(str, SCANS))
        panel.minorticks_off()
        panel.set_ylim(bottom=0)
        panel.set_xlabel("scans from one place")
        panel.set_ylabel(f"share of the {kind} cells (%)")
        panel.grid(alpha=0.3)
    panels[0].set_title(f"free cells with p > {SURE}; crosses: over 2 cells from any surface", fontsize="medium")
    panels[1].set_title(f"surface with p < {1 - SURE:.1f}; crosses: and nothing occupied beside", fontsize="medium")
    key(figure, panels[0])
    figure.suptitle("Claimed wrongly by a robot that stands in a smooth room, within 1.4 m and sight")
    save(figure, "set_standing")


# Spacing of the frames

SPACINGS_CM = {5: 1, 10: 2, 20: 4, 50: 10}
"""Of the frames, and which of a tour's poses have one."""


def spaced(
    room: int, world: World, poses: ndarray, models: list[str], cell: float
) -> Float[ndarray, "spacings models scores"]:
    """Scores of a room; the truth is what the whole tour sees."""
    robot, truth = Robot.load(ROBOT), truth_of(world, poses)
    table = []
    for step in SPACINGS_CM.values():
        drive = drive_in("default", world, poses[::step], robot, room)
        table.append([scored(mapped(name, drive, robot, cell), truth, robot) for name in models])
    return np.array(table)


def spacing(study: Study) -> None:
    """Scores of the same tour with fewer and fewer frames."""
    places, count, models = ("smooth", "mixed"), study.rooms or 8, study.beside("network", "muriel")
    jobs = ((*room, models, study.cell) for room in held(places, count, Robot.load(ROBOT)))
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


# Arrays


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
    drive = drive_in("default", world, poses, sonars.robot, room)
    drive, truth = silenced(drive, sonars.groups, sonars.in_turn), truth_of(world, poses)
    return np.array([scored(mapped(name, drive, sonars.robot, cell), truth, sonars.robot) for name in models])


def arrays(study: Study) -> None:
    """Scores with other arrays; and what weights trained for one array gain."""
    places, count, models = ("smooth", "mixed"), study.rooms or 4, study.beside("network")
    tours: dict[float, list[tuple[int, World, ndarray]]] = {}
    jobs: list[tuple] = []
    for name, sonars in arrays_of().items():
        # Robots of one size drive the same ways.
        size = sonars.robot.footprint_radius_m
        if size not in tours:
            tours[size] = list(held(places, count, sonars.robot))
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
                general, special = table[:, 0], table[:, -1]
                auc, nll = SHOWN.index("auc"), SHOWN.index("nll")
                own[place] = {
                    "general": averages(general),
                    "own": averages(special),
                    "auc": against(general[:, auc], special[:, auc], rng)["difference"],
                    "nll": against(general[:, nll], special[:, nll], rng)["difference"],
                }
    for place, by in found.items():
        for model, means in by.items():
            show_scores(f"{place}, {model}, cells of {study.cell:g} m", "array", means)
    for place, entry in own.items():
        means = {"general": entry["general"], "its own": entry["own"]}
        show_scores(f"{place}, {UNEVEN}: general weights and such trained for this array", "weights", means)
        differences = [
            "{}: {:+.4f} ({:+.4f} to {:+.4f})".format(name, *entry[name]) for name in ("auc", "nll") if entry[name]
        ]
        print(f"\ngeneral less own, 95 % interval: {'; '.join(differences)}")
    extra = {"simulator": "default", "found": found} | ({"own": own} if own else {})
    record("set_arrays", study.settings(count) | extra)


# The recorded corridor


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
    folder = corridor8_map.FOLDER
    if not folder.is_dir():
        print(f"corridor8: found no folder {folder}, so set_corridor8.* stay as they are")
        return
    robot = Robot.load(corridor8_map.ROBOT)
    log = list(corridor_frames(folder, robot))
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
            measured = {k: round(v, 4) for k, v in corridor8_map.measure(grid).items()}
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
    page(shown_maps, 2, 5.6, 0.69, title, "set_corridor8", mark_corridor)


def mark_corridor(panel: Axes) -> None:
    """Add the walls that are known."""
    for y, name in ((corridor8_map.RIGHT_M, "walls as measured"), (corridor8_map.LEFT_M, None)):
        panel.plot(corridor8_map.X[[0, -1]], [y, y], color="tab:red", lw=1.0, ls="--", label=name)
    panel.set(xlim=(-2, 19), ylim=(-11.5, 3))


# Simulators

SIMULATORS = ("default", "varied", "leonard", "mujoco")


def simulated(
    room: int, world: World, poses: ndarray, simulators_: list[str], models: list[str], cell: float
) -> Float[ndarray, "simulators models scores"]:
    """Scores of a room."""
    robot, truth = Robot.load(ROBOT), truth_of(world, poses)
    table = []
    for simulator in simulators_:
        drive = drive_in(simulator, world, poses, robot, room)
        table.append([scored(mapped(name, drive, robot, cell), truth, robot) for name in models])
    return np.array(table)


def simulators(study: Study) -> None:
    """Scores under four simulators, and ratios to the best classical model."""
    count, models = study.rooms or 8, study.beside("network", *CLASSICAL)
    here = [name for name in SIMULATORS if name != "mujoco" or available()]
    if len(here) < len(SIMULATORS):
        print("simulators: found no package mujoco, so its column is left out")
    jobs = ((*room, here, models, study.cell) for room in held(PLACES, count, Robot.load(ROBOT)))
    shape = len(PLACES), count, len(here), len(models), -1
    table = np.array(each(simulated, jobs, "simulators")).reshape(shape)
    classical = [m for m, name in enumerate(models) if name in CLASSICAL and name != study.model]
    rng = np.random.default_rng(SEED)
    found: dict[str, Any] = {"means": {}, "ratios": {}}
    body = []
    for s, simulator in enumerate(here):
        found["means"][simulator], found["ratios"][simulator] = {}, {}
        for i, place in enumerate(PLACES):
            part = table[i, :, s]
            means = {model: averages(part[:, m]) for m, model in enumerate(labels(models))}
            found["means"][simulator][place], found["ratios"][simulator][place] = means, {}
            show_scores(f"{simulator}, {place}, cells of {study.cell:g} m", "model", means)
            row = [simulator, place]
            for name in ("nll", "wiped"):
                column = part[:, :, SHOWN.index(name)]
                best = classical[int(np.argmin(column[:, classical].mean(axis=0)))]
                compared = {"best classical": models[best]} | against(column[:, 0], column[:, best], rng)
                found["ratios"][simulator][place][name] = compared
                row += [models[best], f"{column[:, 0].mean():.3f} / {column[:, best].mean():.3f}"]
                row.append(spread(compared["ratio"]))
            body.append(row)
    header = ["simulator", "walls"]
    for name in ("nll", "wiped"):
        header += [f"least {name} of the classical", f"{label(study.model)} / it", "ratio"]
    show("against the best classical model", header, body)
    record("set_simulators", study.settings(count) | {"robot": ROBOT} | found)


def spread(values: list[float | None] | None) -> str:
    """A ratio with its interval; a ratio to 0 is infinite, one of 0 to 0 says nothing."""
    if values is None:
        return "-"
    mean, low, high = ("inf" if v is None else f"{v:.2f}" for v in values)
    return f"{mean} ({low} to {high})"


PARTS: dict[str, Callable[[Study], None]] = {
    "calibration": calibration,
    "reach": reach,
    "walls": walls,
    "standing": standing,
    "spacing": spacing,
    "arrays": arrays,
    "corridor8": corridor8,
    "simulators": simulators,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--model", default=DEFAULT, help="name or weights file")
    parser.add_argument("--rooms", type=int, help="rooms of each kind")
    parser.add_argument("--own", help=f"weights trained for {UNEVEN}")
    parser.add_argument("--out", type=Path, default=paper.FOLDER, help="where numbers and pictures go")
    parser.add_argument("--write-robot", type=Path, metavar="FILE", help=f"write the robot {UNEVEN}, and do no more")
    args = parser.parse_args()
    if args.write_robot:
        args.write_robot.write_text(robot_yaml(arrays_of()[UNEVEN].robot), encoding="utf-8")
        return
    unknown = set(args.parts) - set(PARTS)
    if unknown:
        parser.error(f"found {', '.join(sorted(unknown))}, expected some of {', '.join(PARTS)}")
    if args.rooms is not None and args.rooms < 1:
        parser.error(f"--rooms: found {args.rooms}, expected at least 1")
    for name in filter(None, [args.model, args.own]):
        try:
            sensor_model(name)
        except EchogridError as error:
            parser.error(str(error))
    paper.FOLDER = args.out
    study = Study(args.model, args.rooms, args.own)
    with tempfile.TemporaryDirectory(prefix="echogrid-generalise-") as compiled:
        # Each map is traced anew; the processes that do it share what they compile.
        os.environ |= {
            "JAX_COMPILATION_CACHE_DIR": compiled,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        for name in args.parts or PARTS:
            begin = time.perf_counter()
            print(f"\n## {name}")
            PARTS[name](study)
            print(f"\n{name}: {(time.perf_counter() - begin) / 60:.1f} min", flush=True)


if __name__ == "__main__":
    main()
