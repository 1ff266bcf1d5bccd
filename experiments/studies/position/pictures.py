"""Pictures of what SLAM makes of drives, for docs/position.md.

    python -m experiments.studies.position.pictures maps CASES FILE [WORD ...]
    python -m experiments.studies.position.pictures drives CASES FILE [WORD ...]

``maps`` draws the map from the odometry beside the map from the poses found, a row a case; ``drives`` the walls of
simulated buildings with the drive as the odometry has it, as it was found and as it was, laid onto the true one.
The cases are those whose names hold a word.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray

from echogrid import Log, build_map, slam
from echogrid.grid import Grid
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.metrics import laid_onto, trajectory_error
from experiments.studies.position.cases import Case, cases_of, posed
from experiments.studies.position.measures import poses_of


def draw_maps(cases: Sequence[Case], path: Path) -> None:
    """A row a case: the map from odometry, and that from the poses found."""
    figure = Figure(figsize=(11, 5.2 * len(cases)), dpi=110, layout="constrained")
    axes = figure.subplots(len(cases), 2, squeeze=False)
    for row, case in zip(axes, cases, strict=True):
        frames = list(case.log())
        given, found = poses_of(frames), slam(Log.of(frames), case.robot).poses
        for own, poses, name in zip(row, (given, found), ("odometry as it is", "poses found"), strict=True):
            *_, grid = build_map(posed(frames, poses), case.robot, sensor_model(DEFAULT), None)
            _draw_map(own, grid, poses)
            own.set_title(f"{case.name}: {name}")
    figure.savefig(path)


def _draw_map(axes: Axes, grid: Grid, poses: Float[ndarray, "frames 3"]) -> None:
    part = grid.observed_part() or grid
    shown = np.where(part.observed, 1 - part.probability(), 0.72)
    rows, cols = shown.shape
    x, y = part.origin
    box = (x, x + cols * part.resolution, y, y + rows * part.resolution)
    axes.imshow(shown, origin="lower", extent=box, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.plot(*poses[:, :2].T, color="tab:blue", lw=0.5)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")


def draw_drives(cases: Sequence[Case], path: Path) -> None:
    """A panel a case: its walls, and the drive by odometry of twice the usual errors, as found, and as it was."""
    figure = Figure(figsize=(6.2 * len(cases), 6.6), dpi=110, layout="constrained")
    for axes, case in zip(figure.subplots(1, len(cases), squeeze=False)[0], cases, strict=True):
        frames, truth = list(case.log("twice")), case.truth()
        found = slam(Log.of(frames), case.robot).poses
        for wall in np.load(case.folder / "world.npz")["walls"]:
            axes.plot(wall[::2], wall[1::2], color="black", lw=1.2)
        given = poses_of(frames)
        for poses, name, color, wide in ((given, "odometry", "tab:orange", 0.7), (found, "found", "tab:blue", 1.2)):
            error = trajectory_error(poses, truth).aligned_rms_m
            label = f"{name}, ATE {error:.2f} m"
            axes.plot(*laid_onto(poses, truth)[:, :2].T, color=color, lw=wide, label=label)
        axes.plot(*truth[:, :2].T, color="tab:green", lw=0.6, ls="--", label="true")
        axes.set(title=case.name, xlabel="x, m", ylabel="y, m", aspect="equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False, fontsize=9)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("maps", "drives"))
    parser.add_argument("cases", type=Path, metavar="CASES")
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("only", nargs="*", metavar="WORD")
    args = parser.parse_args()
    cases = cases_of(args.cases, args.only)
    (draw_maps if args.what == "maps" else draw_drives)(cases, args.file)


if __name__ == "__main__":
    main()
