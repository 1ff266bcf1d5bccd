"""Recorded drives as cases, from data that has no place in the repository.

    python -m experiments.studies.position.recordings FOLDER [--data ../shared/data]

- nanoswarm: flights in mazes, truth by motion capture; each side's eight zones as rays, or as a cone of 45 degrees
  that reads the least of them. All drones of a run one after the other, 0.1 s a frame (times are not recorded; from
  stop to stop, and from drone to drone, the poses jump), and each drone by itself (``-d0``). ``authors.tum``: their
  own SLAM. In exp1_two-drones the true heading of a stop (frames 450 to 464) is wrong by 93 degrees.
- nanosmcl: flights in an office, as rays and as cones, no truth; its floor plan as ``plan.yaml``, and in
  ``case.json`` where about the origin of the odometry lies in it.
- crazyflie4: flights with four rangers, no truth.
- corridor8: its poses as truth, and made to drift.

What is not there is left out and told.
"""

import argparse
import csv
import gzip
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid import Frame, Robot, load_log
from echogrid.output.trajectory import write_tum
from experiments.common import corridor8 as corridor
from experiments.common.zones import KINDS, SIDES, ZONES, drone, zone_ranges
from experiments.studies.position.buildings import SEED
from experiments.studies.position.cases import Facts, write_case
from experiments.studies.position.driving import length_of
from experiments.studies.position.measures import poses_of
from experiments.studies.position.odometry import Odometry

DATA = Path(__file__).parents[4] / "shared" / "data"
STARTS = {"S6": (0.90, 0.12, 355.0), "S8": (-2.4, -0.2, 85.0), "S11": (2.98, -2.12, 111.0)}
"""Where the origin of the odometry of nanosmcl lies in the plan: m, m, degrees.

S6 and S11 as its README has them; that of S8 is another one. From where it is laid there 28 % of its rays go through
walls, and of its hits in what S11 saw 9 % lie on free floor (here 12 and 3 %)."""
_MIDDLE_ROWS = (3, 4)
"""Of the eight rows of zones to the front: those that look neither up nor down."""


def nanoswarm(data: Path, out: Path) -> None:
    """Flights in mazes."""
    for file in sorted((data / "nanoswarm").glob("*.csv")):
        if file.stem == "walls":
            continue
        with file.open(encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
        by = {of: _numbers(rows, [f"{axis}_{of}" for axis in ("x", "y", "yaw")]) for of in ("odom", "slam", "vicon")}
        mm = np.stack([_numbers(rows, [f"{side}{zone}" for zone in range(ZONES)]) for side in SIDES], axis=1)
        depth = np.where(mm <= 0, np.nan, mm / 1000)
        drones = _numbers(rows, ["drone"])[:, 0]
        parts = [("", np.ones(len(rows), dtype=bool))]
        parts += [(f"-d{number:g}", drones == number) for number in np.unique(drones) if len(np.unique(drones)) > 1]
        for kind in KINDS:
            for suffix, part in parts:
                _swarm_case(out / f"nanoswarm-{file.stem}-{kind}{suffix}", kind, depth, by, part)


def _numbers(rows: list[dict[str, str]], names: list[str]) -> Float[ndarray, "rows names"]:
    return np.array([[float(row[name]) for name in names] for row in rows])


def _swarm_case(
    folder: Path,
    kind: str,
    depth: Float[ndarray, "frames 4 8"],
    by: dict[str, Float[ndarray, "frames 3"]],
    part: Bool[ndarray, "frames"],
) -> None:
    robot = drone(kind, 3.5)
    odom, slam, vicon = (by[of][part] for of in ("odom", "slam", "vicon"))
    ranges = zone_ranges(depth[part], kind, robot)
    frames = [Frame(0.1 * i, pose, reading) for i, (pose, reading) in enumerate(zip(odom, ranges, strict=True))]
    facts = Facts("maze", "recorded", robot.name, length_of(vicon), "recorded")
    write_case(folder, facts, robot, frames, {"odometry": odom}, vicon)
    write_tum(folder / "authors.tum", np.array([frame.stamp for frame in frames]), slam)


def nanosmcl(data: Path, out: Path) -> None:
    """Flights in an office with its plan."""
    for run, (x, y, turn) in STARTS.items():
        with gzip.open(data / "nanosmcl" / f"{run}.csv.gz", "rt", encoding="utf-8") as lines:
            rows = list(csv.DictReader(lines))
        stamps, odom = _numbers(rows, ["t_s"])[:, 0].tolist(), _numbers(rows, ["x", "y", "yaw"])
        sides = np.array([[_columns(row, side) for side in SIDES] for row in rows])
        for kind in KINDS:
            robot = drone(kind, 4.0)
            ranges = zone_ranges(sides, kind, robot)
            frames = list(map(Frame, stamps, odom, ranges))
            start = (x, y, float(np.deg2rad(turn)))
            folder = out / f"nanosmcl-{run}-{kind}"
            facts = Facts("office", "recorded", robot.name, length_of(odom), "recorded", start)
            write_case(folder, facts, robot, frames, {"odometry": odom}, None)
            for name, new in (("floorplan.yaml", "plan.yaml"), ("floorplan.pgm", "floorplan.pgm")):
                shutil.copyfile(data / "nanosmcl" / name, folder / new)


def _columns(row: dict[str, str], side: str) -> list[float]:
    """Distances (m; nan: none) in the columns of a side; to the front the least of the rows in the middle."""
    names = [[f"{side}{r}{c}" for r in _MIDDLE_ROWS] if side == "f" else [f"{side}{c}"] for c in range(ZONES)]
    read = np.array([[float(row[name]) for name in column] + [np.inf] for column in names])
    least = np.min(np.where(read > 0, read, np.inf), axis=1)
    return np.where(np.isinf(least), np.nan, least).tolist()


def crazyflie4(data: Path, out: Path) -> None:
    """Flights with four rangers."""
    robot = Robot.load(data / "crazyflie4" / "crazyflie4.yaml")
    for file in sorted((data / "crazyflie4").glob("*.csv")):
        frames = list(load_log(file, robot))
        poses = poses_of(frames)
        facts = Facts("corridors", "recorded", robot.name, length_of(poses), "recorded")
        write_case(out / f"crazyflie4-{file.stem}", facts, robot, frames, {"odometry": poses}, None)


def corridor8(data: Path, out: Path) -> None:
    """A corridor whose recorded poses are straight enough to be the truth."""
    robot = Robot.load(corridor.ROBOT)
    frames = list(corridor.frames(data / "corridor8", robot))
    poses = poses_of(frames)
    for number in range(3):
        errors = {
            "odometry": Odometry().of(poses, np.random.default_rng([SEED, number])),
            "twice": Odometry().times(2.0).of(poses, np.random.default_rng([SEED, number])),
        }
        facts = Facts("corridor8", "recorded", robot.name, length_of(poses), "recorded")
        write_case(out / f"corridor8-{number}", facts, robot, frames, errors, poses)


SETS: dict[str, Callable[[Path, Path], None]] = {
    "nanoswarm": nanoswarm,
    "nanosmcl": nanosmcl,
    "crazyflie4": crazyflie4,
    "corridor8": corridor8,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where cases go; outside of the repository")
    parser.add_argument("--data", type=Path, default=DATA, metavar="FOLDER", help="where the recordings are")
    args = parser.parse_args()
    for name, make in SETS.items():
        if (args.data / name).is_dir():
            make(args.data, args.folder)
            print(name, flush=True)
        else:
            print(f"no {name} in {args.data}: left out")


if __name__ == "__main__":
    main()
