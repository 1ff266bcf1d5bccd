"""What a robot that does not move claims wrongly."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray
from scipy import ndimage

from echogrid import Robot, World
from echogrid.metrics import FREE, OCCUPIED_ABOVE, SURFACE
from echogrid.simulation.drive import truth_of
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import draw_key, record, save
from experiments.common.rooms import frames, numbered
from experiments.studies.generalise.study import SEED, Study, colour_of, labels, read, show

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
    drive = frames("varied", world, np.tile(pose, (SCANS[-1], 1)), robot, number, SEED)
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
        for room, world, poses in numbered(["smooth"], count, robot, SEED):
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
    draw_key(figure, panels[0])
    figure.suptitle("Claimed wrongly by a robot that stands in a smooth room, within 1.4 m and sight")
    save(figure, "set_standing")
