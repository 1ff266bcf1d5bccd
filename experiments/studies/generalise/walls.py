"""How thick walls come out, and whether a door stays open."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from numpy import ndarray
from scipy import ndimage

from echogrid import Grid, Robot
from echogrid.mapping.registry import sensor_model
from echogrid.metrics import FREE_BELOW, OCCUPIED_ABOVE
from echogrid.simulation.drive import tour
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import Panel, draw_key, page, record, save
from experiments.common.rooms import frames
from experiments.studies.generalise.study import CLASSICAL, ROBOT, SEED, Study, colour_of, label, show
from experiments.studies.generalise.suite import DOOR_AT_M, DOOR_M, Suite, faces, suite

WALL_MODELS = ("network", *CLASSICAL, "nav2")
SURFACES = ("smooth", "rough")
PARTITIONS_M = {"thin": 0.0, "0.15 m thick": 0.15}
CLEARANCE_M, RADIUS_M = 0.32, 0.2
"""What the drive keeps from the walls, and the robot that is to pass the door on the map."""
APART_M = 0.6
"""No farther from the partition a robot is at the door."""
WAYS = ("driven through", "seen from the rooms")
"""All of the drive, and without what it has seen at the door."""
FINE_M = 0.005
OFFSETS_M = np.arange(-200, 201) * FINE_M
"""Places of a line across a wall; behind the wall is positive."""
ASIDE_M = 0.3
"""A surface farther from the true face is not that wall."""


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
    drive = frames("default", rooms_.world, poses, robot, number, SEED)
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
    cells = {label(model): sensor_model(model).cell_m for model in models}
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
    draw_key(figure, panels[0, 0])
    figure.suptitle(f"Through a wall, each model at its own cell size: mean over all places and {count} orientations")
    save(figure, "set_walls")
