"""Positions beside MRPT's, in one run: ``python -m benchmarks.position_peers [CASES] [--turns N]``.

The same drives of sonars and drifting odometry go to ``slam``, ``OnlineSlam`` and ``Localiser`` and to MRPT's
particle filters (mrpt_position.py), in turns; one line where those are not built. For each case and task: ATE, the
root mean square of the distances to the true positions after rigid alignment of the whole trajectory (median of the
turns, each with a seed of its own; least and most), and how many scans go through a second of CPU time (the fastest
turn).

Tasks: *whole drive*, the poses of all scans as they are known in the end; *as driven*, each as it was known when its
scan came; *known map*, as driven in the true map of what can be seen from the way, begun at the true pose, which both
believe to within START_SPREAD. CASES is a folder of cases (experiments/studies/position); what is missing of NAMES is
simulated into it, two minutes a case.

MRPT's settings (mrpt_position.py) did best of ten that were tried, with one seed, on the first 2,000 scans of the
flat (``FILTER``), and of three on the first 2,400 of the ring with four rangers (``KNOWN``); the motion model has the
odometry's true noise as it adds up between two updates. Its map is tried as it comes, and with cones that lie on the
axes of the sonars.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from tqdm import tqdm

from benchmarks import mrpt_position
from benchmarks.mrpt_position import Filter
from echogrid import Frame, Grid, Localiser, Robot, slam
from echogrid.metrics import FREE, SURFACE, Truth, trajectory_error
from echogrid.output.map_file import read_truth
from echogrid.position.localiser import START_SPREAD
from echogrid.position.online import OnlineSlam
from experiments.studies.position.cases import Case
from experiments.studies.position.simulated import make

NAMES = ("ring-mixed-four-6", "flat-mixed-b21-1", "ring-mixed-p3dx-1")
CASES, TURNS = Path("build/position"), 3

FILTER = Filter(particles=100, average=False, power=0.1)
"""Of MRPT's SLAM."""
KNOWN = Filter(particles=300)
"""Of MRPT's filter in a known map."""

SURE = 4.0
"""Log-odds of walls and floor in the known map."""

WHOLE, DRIVEN, KNOWN_MAP = "whole drive", "as driven", "known map"

Found = tuple[dict[str, Float[ndarray, "frames 3"]], float]
"""Poses by task, and the seconds of CPU time that they took together."""


@dataclass(frozen=True)
class Drive:
    """A case as all programs get it."""

    name: str
    robot: Robot
    frames: list[Frame]
    truth: Float[ndarray, "frames 3"]
    grid: Grid
    """The true map."""


def drive_of(folder: Path, name: str) -> Drive:
    """A case of a folder, simulated if it is not there."""
    if not (folder / name / "case.json").is_file():
        make(folder, name)
    case = Case(folder / name)
    return Drive(name, case.robot, list(case.log()), case.truth(), map_of(read_truth(folder / name / "truth.npz")))


def map_of(truth: Truth) -> Grid:
    """A map of what is there, unknown where it is hidden."""
    log_odds = np.select([truth.cells == SURFACE, truth.cells == FREE], [SURE, -SURE], 0.0).astype(np.float32)
    return Grid(log_odds, log_odds != 0, truth.resolution, truth.origin)


def by_slam(drive: Drive, _seed: int) -> Found:
    """The poses that ``slam`` finds."""
    begin = time.process_time()
    poses = slam(drive.frames, drive.robot).poses
    return {WHOLE: poses}, time.process_time() - begin


def by_online_slam(drive: Drive, _seed: int) -> Found:
    """Those that ``OnlineSlam`` tells with each scan, all that came before being placed."""
    begin = time.process_time()
    finder, poses = OnlineSlam(drive.robot), []
    for frame in drive.frames:
        finder.add(frame)
        finder.wait()
        poses.append(finder.pose)
    finder.close()
    return {DRIVEN: np.array(poses)}, time.process_time() - begin


def by_localiser(drive: Drive, seed: int) -> Found:
    """Those that ``Localiser`` tells with each scan."""
    begin = time.process_time()
    localiser = Localiser(drive.grid, drive.robot, drive.truth[0], seed)
    poses = [localiser.add(frame).pose for frame in drive.frames]
    return {KNOWN_MAP: np.array(poses)}, time.process_time() - begin


def by_rbpf_slam(options: Filter) -> Callable[[Drive, int], Found]:
    """Those that MRPT's SLAM finds, as driven and in the end."""

    def work(drive: Drive, seed: int) -> Found:
        found = mrpt_position.rbpf_slam(drive.frames, drive.robot, options, seed)
        return {WHOLE: found.end, DRIVEN: found.then}, found.cpu_seconds

    return work


def by_monte_carlo(options: Filter) -> Callable[[Drive, int], Found]:
    """Those that MRPT's filter finds in the true map."""

    def work(drive: Drive, seed: int) -> Found:
        found = mrpt_position.monte_carlo(
            drive.frames, drive.robot, drive.grid, drive.truth[0], START_SPREAD, options, seed
        )
        return {KNOWN_MAP: found.then}, found.cpu_seconds

    return work


def programs(particles: int) -> dict[str, Callable[[Drive, int], Found]]:
    """All that find poses, by name; MRPT's SLAM with so many particles."""
    options = replace(FILTER, particles=particles)
    return {
        "echogrid `slam`": by_slam,
        "echogrid `OnlineSlam`": by_online_slam,
        "echogrid `Localiser`": by_localiser,
        "rbpf-slam": by_rbpf_slam(replace(options, centred=False)),
        "rbpf-slam, cones centred": by_rbpf_slam(options),
        "pf-localization": by_monte_carlo(KNOWN),
    }


def rows_of(drive: Drive, programs: Mapping[str, Callable[[Drive, int], Found]], turns: int) -> list[str]:
    """The rows of a case: its odometry, then task by task what programs make of it."""
    off: dict[tuple[str, str], list[float]] = {}
    took: dict[str, list[float]] = {}
    for seed in tqdm(range(1, turns + 1), drive.name, leave=False):
        for name, work in programs.items():
            found, cpu = work(drive, seed)
            took.setdefault(name, []).append(cpu)
            for task, poses in found.items():
                off.setdefault((task, name), []).append(trajectory_error(poses, drive.truth).aligned_rms_m)
    given = trajectory_error(np.array([frame.pose for frame in drive.frames]), drive.truth).aligned_rms_m
    rows = [f"| {drive.name} | - | odometry | {given:.3f} | |"]
    for task in (WHOLE, DRIVEN, KNOWN_MAP):
        for (own, name), each in off.items():
            if own == task:
                told = f"{np.median(each):.3f}" + (f" ({min(each):.3f} to {max(each):.3f})" if np.ptp(each) else "")
                speed = len(drive.frames) / min(took[name])
                rows.append(f"| {drive.name} | {task} | {name} | {told} | {speed:.0f} |")
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="?", type=Path, default=CASES, metavar="CASES", help=f"default {CASES}")
    parser.add_argument("--turns", type=int, default=TURNS, metavar="N", help=f"default {TURNS}")
    parser.add_argument("--only", nargs="*", default=NAMES, choices=NAMES, metavar="NAME", help="some of the cases")
    parser.add_argument("--particles", type=int, default=FILTER.particles, metavar="N", help="of rbpf-slam")
    args = parser.parse_args()
    for name in ("turns", "particles"):
        if (found := getattr(args, name)) < 1:
            parser.error(f"--{name}: found {found}, expected 1 or more")
    if not mrpt_position.available():
        print("mrpt_position: not built (benchmarks/mrpt/install.sh)")
        return
    print(
        f"{mrpt_position.version()}, {args.turns} turns\n\n| case | poses | program | ATE, m | scans/s of CPU time |"
    )
    print("|---|---|---|---|---|")
    for name in args.only:
        print("\n".join(rows_of(drive_of(args.cases, name), programs(args.particles), args.turns)), flush=True)


if __name__ == "__main__":
    main()
