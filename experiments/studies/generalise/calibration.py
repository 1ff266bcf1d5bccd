"""Reliability of the probabilities, and ``ece``, in each kind of room."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray

from echogrid import Robot, World
from echogrid.metrics import ECE_BINS, HIDDEN, SURFACE
from echogrid.simulation.drive import truth_of
from experiments.common.bootstrap import interval
from experiments.common.maps import mapped
from experiments.common.pool import each
from experiments.common.report import draw_key, record, save
from experiments.common.rooms import PLACES, frames, numbered
from experiments.studies.generalise.study import ROBOT, SEED, Study, colour_of, labels, read, show, shown

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
        drive = frames(simulator, world, poses, robot, room, SEED)
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
    jobs = ((*room, models, study.cell) for room in numbered(PLACES, count, Robot.load(ROBOT), SEED))
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
    draw_key(figure, axes[0, 0])
    figure.suptitle(
        f"What share of the cells with a probability is surface: {count} rooms of each kind, cells of {cell:g} m; "
        "open dots stand for fewer than 20 cells"
    )
    save(figure, "set_calibration")
