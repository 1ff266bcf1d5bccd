"""Does the simulated sonar look like a real one? A recorded ring of 24 sonars beside simulated drives.

    python experiments/scitos24.py [FOLDER] [--drives 40] [--frames 800]

FOLDER holds the recording (sensor_readings_24.data): a SCITOS G5 that follows the walls of one room, 9 scans a
second, readings in mm, 5 m or more = no echo, no poses. Beside it the robot `scitos-g5` drives along the walls of
random rooms, or tours them, each under a physics of its own (`rooms.random_physics`, what the network is trained on),
as fast as the recording moves: its sonars ahead close in by up to 2 cm a scan, and its picture shifts by one sonar in
9 or 10 scans where it turns. It stands still for a while now and then. All readings are rounded to mm. The
transducers are those of the preset, an assumption, and for the same drives once more such as the training draws.

The statistics need no poses. Ring and room differ, so the question is only whether the recording lies inside the
family of simulated drives. Writes docs/paper/scitos24 (PNG and SVG) and scitos24.json.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray
from scipy import ndimage
from tqdm import tqdm

from echogrid import Robot, World
from echogrid.errors import UsageError
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.drive import tour
from echogrid.simulation.rooms import random_physics, random_transducer, random_world
from echogrid.simulation.simulate import Simulator, disturb
from echogrid.simulation.world import inside_room
from paper import record, save

FOLDER = Path(__file__).parents[2] / "shared" / "data" / "scitos24"
SEED = 60_000_000
BAND = (5, 95)
"""Percentiles of the simulated drives between which a statistic counts as inside."""

CURVES: dict[str, tuple[str, ndarray]] = {
    "reading": ("reading (m)", np.linspace(0.2, 5.0, 49)),
    "neighbour step": ("step between neighbouring sonars (m)", np.geomspace(0.001, 5.0, 49)),
    "time step": ("step of a sonar from scan to scan (m)", np.geomspace(0.001, 5.0, 49)),
    "second difference": ("second difference in time (m)", np.geomspace(0.001, 5.0, 49)),
    "no echo, sonar": ("no echo of a sonar, share of its scans", np.linspace(0, 1, 51)),
    "no-echo run": ("scans in a row without echo", np.unique(np.geomspace(1, 60, 33).round())),
}
"""What cumulative distributions are drawn of, and where they are read."""

STATISTICS = {
    "no echo": "no echo",
    "neighbours within 2 cm": "neighbours agree within 2 cm",
    "neighbours within 5 cm": "neighbours agree within 5 cm",
    "neighbours beyond 50 cm": "neighbours differ by over 50 cm",
    "steps beyond 10 cm": "step in time over 10 cm",
    "repeats": "exactly the last reading",
    "outliers, long": "outlier in time, over 50 cm too long",
    "outliers, short": "outlier in time, over 50 cm too short",
    "flickers": "10 cm off between two that agree",
    "echo lost": "no echo after an echo",
    "echo found": "echo after no echo",
    "dropouts": "no echo between two that agree",
    "ghosts": "echo between two without",
    "one-scan gaps": "gaps that last one scan",
    "noise": "white error (m)",
}
"""Shares (but for the last), and how the picture names them."""


def recording(folder: Path) -> Float[ndarray, "frames 24"]:
    """Readings in m; nan = no echo."""
    lines = (folder / "sensor_readings_24.data").read_text(encoding="utf-8").split()[1:]
    ranges = np.array([[float(value) for value in line.split(",")[:24]] for line in lines])
    return np.where(ranges < 5.0, ranges, np.nan)


def share(of: ndarray, among: ndarray | None = None) -> float:
    """How many of those ``among`` which something is asked are so; nan if it is asked of none."""
    asked = of if among is None else of[among]
    return float(np.mean(asked)) if asked.size else np.nan


def samples(r: Float[ndarray, "frames sonars"]) -> dict[str, Float[ndarray, "n"]]:
    """What CURVES draws."""
    second = np.abs(r[2:] - 2 * r[1:-1] + r[:-2])
    values = {
        "reading": r,
        "neighbour step": np.abs(np.roll(r, -1, axis=1) - r),
        "time step": np.abs(np.diff(r, axis=0)),
        "second difference": second,
        "no echo, sonar": np.isnan(r).mean(axis=0),
        "no-echo run": gaps(r),
    }
    return {name: value[~np.isnan(value)] for name, value in values.items()}


def gaps(r: Float[ndarray, "frames sonars"]) -> Float[ndarray, "n"]:
    """Lengths of the runs of scans in which a sonar hears nothing, but for those that the drive's ends cut."""
    lengths = []
    for column in r.T:
        change = np.flatnonzero(np.diff(np.isnan(column).astype(int))) + 1
        run = np.diff(change)
        lengths.append(run[0 if change.size and np.isnan(column[change[0]]) else 1 :: 2])
    return np.concatenate(lengths).astype(float)


def statistics(r: Float[ndarray, "frames sonars"]) -> dict[str, float]:
    """STATISTICS of readings in m (nan = no echo)."""
    neighbour = samples(r)["neighbour step"]
    step = np.abs(np.diff(r, axis=0))
    both = ~np.isnan(step)
    before, here, after = r[:-2], r[1:-1], r[2:]
    agree = np.abs(after - before) < 0.05
    silent = np.isnan(r)
    second = np.abs(before - 2 * here + after)
    run = gaps(r)
    return {
        "no echo": share(silent),
        "neighbours within 2 cm": share(neighbour <= 0.02),
        "neighbours within 5 cm": share(neighbour <= 0.05),
        "neighbours beyond 50 cm": share(neighbour > 0.5),
        "steps beyond 10 cm": share(step > 0.1, both),
        "repeats": share(step < 0.0005, both),
        "outliers, long": share(here - np.maximum(before, after) > 0.5, agree),
        "outliers, short": share(np.minimum(before, after) - here > 0.5, agree),
        "flickers": share(np.minimum(np.abs(here - before), np.abs(here - after)) > 0.1, agree),
        "echo lost": share(silent[1:], ~silent[:-1]),
        "echo found": share(~silent[1:], silent[:-1]),
        "dropouts": share(np.isnan(here), agree),
        "ghosts": share(~np.isnan(here), np.isnan(before) & np.isnan(after)),
        "one-scan gaps": share(run == 1),
        "noise": 1.4826 * float(np.nanmedian(second)) / np.sqrt(6.0),
    }


def cumulative(r: Float[ndarray, "frames sonars"]) -> dict[str, Float[ndarray, "n"]]:
    """CURVES of readings in m (nan = no echo)."""
    return {
        name: np.searchsorted(np.sort(value), CURVES[name][1], side="right") / max(len(value), 1)
        for name, value in samples(r).items()
    }


def along_walls(world: World, distance: float) -> Float[ndarray, "n 2"]:
    """A closed way that keeps a distance (m) to what is nearest, the longest one inside the room."""
    low, high = world.bounds()
    x, y = np.arange(low[0], high[0], 0.04), np.arange(low[1], high[1], 0.04)
    points = np.column_stack([values.ravel() for values in np.meshgrid(x, y)])
    gap = world.clearance(points).reshape(len(y), len(x))
    ways = Figure().subplots().contour(x, y, gap, levels=[distance]).allsegs[0]
    ways = [way for way in ways if len(way) > 20 and inside_room(world, way[::10]).all()]
    if not ways:
        raise UsageError(f"world {world.name}: found no way {distance:.2f} m along its walls, expected a room")
    return max(ways, key=lambda way: float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()))


def paced(way: Float[ndarray, "n 2"], rng: np.random.Generator, frames: int) -> Float[ndarray, "frames 3"]:
    """Poses along a way at the pace of the recording, with stops, from a random place on."""
    smooth = ndimage.gaussian_filter1d(way, 2.0, axis=0, mode="nearest")
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1)))
    s = np.arange(0.0, length[-1], 0.005)
    p = np.column_stack([np.interp(s, length, smooth[:, k]) for k in (0, 1)])
    ahead = np.diff(p, axis=0, append=2 * p[-1:] - p[-2:-1])
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    heading = ndimage.gaussian_filter1d(heading, 20.0, mode="nearest")
    # Whichever takes longer: the way itself or the turn along it.
    turn = np.abs(np.diff(heading, prepend=heading[0]))
    time = np.cumsum(np.maximum(0.005 / rng.uniform(0.008, 0.022), turn / np.deg2rad(rng.uniform(1.2, 2.2))))
    for at in rng.uniform(0, time[-1], rng.poisson(time[-1] / 200)):
        time = time + np.where(time > at, rng.uniform(5, 60), 0.0)
    when = np.arange(time[0], time[-1])
    begin = rng.integers(0, max(len(when) - frames, 1))
    when = when[begin : begin + frames]
    return np.column_stack([np.interp(when, time, value) for value in (*p.T, heading)])


Drive = tuple[World, Physics, Float[ndarray, "frames 3"], int]
"""A room, its physics, poses in it, and the seed of what disturbs the readings."""


def drives(robot: Robot, count: int, frames: int) -> list[Drive]:
    """Random rooms with a drive in each: three in four along the walls, the others tours."""
    rng = np.random.default_rng(SEED)
    made: list[Drive] = []
    while len(made) < count:
        world, physics = random_world(rng, "room"), random_physics(rng)
        near = robot.footprint_radius_m + 0.1
        try:
            way = tour(world, near)[:, :2] if len(made) % 4 == 3 else along_walls(world, near + rng.uniform(0, 0.4))
        except UsageError:
            continue
        if len(way) < 2:
            continue
        poses = paced(way, rng, frames)
        if len(poses) < frames / 2:
            continue
        made.append((world, physics, poses, int(rng.integers(2**32))))
    return made


def as_logged(drive: Drive, robot: Robot, any_transducer: bool) -> Float[ndarray, "frames sonars"]:
    """A simulated drive in the form of the recording."""
    world, physics, poses, seed = drive
    rng = np.random.default_rng(seed)
    if any_transducer:
        robot = replace(robot, transducer=random_transducer(rng))
    ranges = Simulator(world, robot, physics).ranges(poses, rng)
    ranges = robot.clean(disturb(ranges, physics, robot.max_range_m, rng))
    return np.where(np.isfinite(ranges), np.round(ranges, 3), np.nan)


Family = list[Float[ndarray, "frames sonars"]]
Table = dict[str, dict[str, Any]]

LOOKS = {"preset": ("Polaroid 600, the preset's", "0.62"), "any": ("transducers as in training", "tab:blue")}
"""The two families of drives: names and colours."""


def draw(real: Float[ndarray, "frames sonars"], families: dict[str, Family], tables: dict[str, Table]) -> None:
    """The curves, and one line for each statistic."""
    figure = Figure(figsize=(14, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, 4, width_ratios=[1, 1, 1, 1.25])
    lines = {kind: [cumulative(one) for one in family] for kind, family in families.items()}
    recorded = cumulative(real)
    handles: list[Any] = []
    for i, (name, (label, at)) in enumerate(CURVES.items()):
        axes = figure.add_subplot(grid[i // 3, i % 3])
        low, high = np.percentile([line[name] for line in lines["any"]], BAND, axis=0)
        what = f"simulated, {LOOKS['any'][0]}: {BAND[0]} to {BAND[1]} % of {len(lines['any'])} drives"
        axes.fill_between(at, low, high, color=LOOKS["any"][1], alpha=0.18, lw=0, label=what)
        for j, line in enumerate(lines["preset"]):
            what = None if j else f"simulated, {LOOKS['preset'][0]}: each drive"
            axes.plot(at, line[name], color=LOOKS["preset"][1], lw=0.5, label=what)
        axes.plot(at, recorded[name], color="tab:red", lw=2.2, label="recorded (SCITOS G5)")
        if name not in ("reading", "no echo, sonar"):
            axes.set_xscale("log")
        axes.set(xlabel=label, ylabel="cumulative share", xlim=(at[0], at[-1]), ylim=(0, 1))
        axes.grid(alpha=0.3)
        handles = axes.get_legend_handles_labels()[0]
    axes = figure.add_subplot(grid[:, 3])
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
    figure.suptitle("A real ring of 24 sonars beside simulated ones (rooms and physics as in training)")
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    save(figure, "scitos24")


def compare(real: Float[ndarray, "frames sonars"], family: Family) -> Table:
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
    for kind, table in tables.items():
        print(f"\n{LOOKS[kind][0]}: 5 to 95 % of the drives (all)")
        for name, row in table.items():
            print(
                f"{STATISTICS[name]:38s} {row['recorded']:.4f}  {row['low']:.4f} .. {row['high']:.4f} "
                f"({row['lowest']:.4f} .. {row['highest']:.4f}), {row['drives below']:.0%} of the drives below"
                f"{'' if row['inside'] else ', OUTSIDE'}"
            )
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
