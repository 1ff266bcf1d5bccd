"""Does the simulated sonar look like a real one? A recorded ring of 24 sonars beside simulated drives.

    python -m experiments.studies.scitos24 [FOLDER] [--drives 40] [--frames 800]

FOLDER holds the recording (sensor_readings_24.data): a SCITOS G5 that follows the walls of one room, 9 scans a
second, readings in mm, 5 m or more = no echo, no poses. Beside it the robot `scitos-g5` drives along the walls of
random rooms, or tours them, each under a physics of its own (`rooms.random_physics`, what the network is trained on),
as fast as the recording moves: its sonars ahead close in by up to 2 cm a scan, and its picture shifts by one sonar in
9 or 10 scans where it turns. It stands still for a while now and then. All readings are rounded to mm. The
transducers are those of the preset, an assumption, and for the same drives once more such as the training draws.

The statistics need no poses. Ring and room differ, so the question is only whether the recording lies inside the
family of simulated drives. Writes docs/paper/scitos24.png and scitos24.json.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray
from tqdm import tqdm

from echogrid import Robot
from experiments.common.report import draw_key, record, save
from experiments.studies.scitos24.drives import as_logged, drives
from experiments.studies.scitos24.statistics import CURVES, STATISTICS, cumulative, samples, share, statistics

FOLDER = Path(__file__).parents[4] / "shared" / "data" / "scitos24"
BAND = (5, 95)
"""Percentiles of the simulated drives between which a statistic counts as inside."""

Readings = Float[ndarray, "frames sonars"]
Family = list[Readings]
Curves = dict[str, Float[ndarray, "n"]]
Table = dict[str, dict[str, Any]]

LOOKS = {"preset": ("Polaroid 600, the preset's", "0.62"), "any": ("transducers as in training", "tab:blue")}
"""The two families of drives: names and colours."""


def recording(folder: Path) -> Float[ndarray, "frames 24"]:
    """Readings in m; nan = no echo."""
    lines = (folder / "sensor_readings_24.data").read_text(encoding="utf-8").split()[1:]
    ranges = np.array([[float(value) for value in line.split(",")[:24]] for line in lines])
    return np.where(ranges < 5.0, ranges, np.nan)


def compare(real: Readings, family: Family) -> Table:
    """Each statistic of the recording and of the drives, and whether the one lies among the others."""
    of_real, of_family = statistics(real), [statistics(one) for one in family]
    table = {}
    for name, value in of_real.items():
        values = np.array([one[name] for one in of_family])
        lowest, low, middle, high, highest = np.nanpercentile(values, [0, BAND[0], 50, BAND[1], 100])
        table[name] = {
            "recorded": value,
            "lowest": lowest,
            "low": low,
            "middle": middle,
            "high": high,
            "highest": highest,
            "drives below": share(values[~np.isnan(values)] < value),
            "inside": bool(low <= value <= high),
        }
    return table


def draw_curve(axes: Axes, name: str, real: Curves, families: dict[str, list[Curves]]) -> None:
    """One of CURVES: the recording over the drives of both families."""
    label, at = CURVES[name]
    low, high = np.percentile([line[name] for line in families["any"]], BAND, axis=0)
    what = f"simulated, {LOOKS['any'][0]}: {BAND[0]} to {BAND[1]} % of {len(families['any'])} drives"
    axes.fill_between(at, low, high, color=LOOKS["any"][1], alpha=0.18, lw=0, label=what)
    for j, line in enumerate(families["preset"]):
        what = None if j else f"simulated, {LOOKS['preset'][0]}: each drive"
        axes.plot(at, line[name], color=LOOKS["preset"][1], lw=0.5, label=what)
    axes.plot(at, real[name], color="tab:red", lw=2.2, label="recorded (SCITOS G5)")
    if name not in ("reading", "no echo, sonar"):
        axes.set_xscale("log")
    axes.set(xlabel=label, ylabel="cumulative share", xlim=(at[0], at[-1]), ylim=(0, 1))
    axes.grid(alpha=0.3)


def draw_statistics(axes: Axes, tables: dict[str, Table]) -> None:
    """One line for each of STATISTICS."""
    floor = 2e-5
    for (kind, table), shift in zip(tables.items(), (0.0, 0.22), strict=True):
        for i, row in enumerate(table.values()):
            span = np.maximum([row[k] for k in ("lowest", "low", "middle", "high", "highest")], floor)
            axes.plot(span[[0, 4]], [i + shift] * 2, color=LOOKS[kind][1], lw=1.0)
            axes.plot(span[[1, 3]], [i + shift] * 2, color=LOOKS[kind][1], lw=5, alpha=0.6, solid_capstyle="butt")
            axes.plot(span[2], i + shift, "|", color="black", ms=6)
    for i, (name, row) in enumerate(tables["preset"].items()):
        axes.plot(max(row["recorded"], floor), i + 0.11, "o", color="tab:red", ms=6)
        axes.text(floor * 1.15, i - 0.17, STATISTICS[name], size="small", va="bottom")
    axes.set(xscale="log", xlim=(floor, 1.4), ylim=(len(STATISTICS) - 0.4, -0.7), xlabel="share, or m")
    axes.set_yticks([])
    axes.grid(axis="x", alpha=0.3)
    axes.set_title(f"bar: {BAND[0]} to {BAND[1]} % of the drives, line: all, tick: median", fontsize="small")


def draw(real: Readings, families: dict[str, Family], tables: dict[str, Table]) -> None:
    """The curves, and beside them the statistics."""
    figure = Figure(figsize=(14, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, 4, width_ratios=[1, 1, 1, 1.25])
    lines = {kind: [cumulative(one) for one in family] for kind, family in families.items()}
    curves = [figure.add_subplot(grid[i // 3, i % 3]) for i in range(len(CURVES))]
    for axes, name in zip(curves, CURVES, strict=True):
        draw_curve(axes, name, cumulative(real), lines)
    draw_statistics(figure.add_subplot(grid[:, 3]), tables)
    figure.suptitle("A real ring of 24 sonars beside simulated ones (rooms and physics as in training)")
    draw_key(figure, curves[-1], columns=3)
    save(figure, "scitos24")


def show(tables: dict[str, Table]) -> None:
    """Print what ``compare`` found."""
    for kind, table in tables.items():
        print(f"\n{LOOKS[kind][0]}: 5 to 95 % of the drives (all)")
        for name, row in table.items():
            print(
                f"{STATISTICS[name]:38s} {row['recorded']:.4f}  {row['low']:.4f} .. {row['high']:.4f} "
                f"({row['lowest']:.4f} .. {row['highest']:.4f}), {row['drives below']:.0%} of the drives below"
                f"{'' if row['inside'] else ', OUTSIDE'}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--frames", type=int, default=800)
    args = parser.parse_args()
    if not args.folder.is_dir():
        print(f"scitos24: found no folder {args.folder}, so docs/paper/scitos24.* stay as they are")
        return
    real = recording(args.folder)
    robot = Robot.load("scitos-g5")
    made = drives(robot, args.drives, args.frames)
    families = {
        kind: [as_logged(drive, robot, kind == "any") for drive in tqdm(made, desc=kind, leave=False)]
        for kind in LOOKS
    }
    tables = {kind: compare(real, family) for kind, family in families.items()}
    show(tables)
    draw(real, families, tables)
    numbers = {
        kind: {
            name: {k: v if isinstance(v, bool) else round(float(v), 5) for k, v in row.items()}
            for name, row in table.items()
        }
        for kind, table in tables.items()
    }
    quantiles = {
        name: {str(q): round(float(np.quantile(value, q)), 4) for q in (0.05, 0.25, 0.5, 0.75, 0.95)}
        for name, value in samples(real).items()
    }
    record(
        "scitos24",
        {
            "scans": len(real),
            "drives": len(made),
            "inside_percentiles": BAND,
            "simulated": numbers,
            "recorded_quantiles": quantiles,
            "recorded_no_echo_of_each_sonar": [round(share(np.isnan(column)), 4) for column in real.T],
        },
    )


if __name__ == "__main__":
    main()
