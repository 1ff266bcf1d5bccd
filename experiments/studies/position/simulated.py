"""Simulated cases: drives through our own buildings.

    python -m experiments.studies.position.simulated FOLDER [NAME ...]

Each case becomes a folder in FOLDER (``cases.py``), with the building besides: ``world.npz`` (walls, roughness,
cylinders) and ``truth.npz`` (its grid as ``echogrid score`` reads it). NAME is kind-walls-robot-number or
kind-walls-robot-number-simulator, or a word that some of SET hold; without any all of SET are made. What is there is
left. Takes about a minute for 100 m on one core.
"""

import argparse
import re
import zlib
from pathlib import Path

import numpy as np

from echogrid import Robot
from echogrid.output.map_file import write_truth
from echogrid.simulation.drive import truth_of
from experiments.common.rooms import frames
from experiments.studies.position.buildings import KINDS, SEED, WALLS, building
from experiments.studies.position.cases import Facts, picked, write_case
from experiments.studies.position.driving import RATE_HZ, driven, length_of
from experiments.studies.position.odometry import Odometry

HERE = Path(__file__).parent
FIRST = ("flat-mixed-b21-1", "ring-mixed-b21-1", "hall-mixed-b21-1",
         "flat-mixed-p3dx-1", "ring-mixed-p3dx-1", "hall-mixed-p3dx-1")  # fmt: skip
SET = (
    *FIRST,
    "flat-smooth-b21-2", "flat-rough-p3dx-3", "flat-mixed-uneven11-4", "flat-smooth-uneven11-5", "flat-mixed-four-6",
    "flat-smooth-p3dx-7", "flat-rough-b21-8",
    "ring-smooth-p3dx-2", "ring-rough-b21-3", "ring-mixed-uneven11-4", "ring-smooth-b21-5", "ring-mixed-four-6",
    "hall-smooth-p3dx-2", "hall-rough-uneven11-3", "hall-smooth-b21-4", "hall-mixed-uneven11-5",
    "floors-mixed-p3dx-1", "floors-mixed-b21-2",
    "flat-mixed-p3dx-9-leonard", "flat-mixed-b21-10-varied", "ring-mixed-b21-7-leonard", "ring-mixed-p3dx-8-varied",
    "hall-mixed-b21-6-leonard", "hall-mixed-p3dx-7-varied",
)  # fmt: skip
"""The smallest that tells something first."""
SPEED_M_S = (0.3, 0.5)
NAME = re.compile(rf"({'|'.join(KINDS)})-({'|'.join(WALLS)})-[a-z0-9]+-[0-9]+(-(varied|leonard|mujoco))?")


def robot_of(name: str) -> Robot:
    """A robot of the study, or a preset."""
    own = HERE / f"{name}.yaml"
    return Robot.load(own if own.is_file() else name)


def make(folder: Path, name: str) -> None:
    """Simulate a case by its name, and write it."""
    kind, walls, robot_name, number, *more = name.split("-")
    simulator = more[0] if more else "default"
    robot, place = robot_of(robot_name), building(kind, walls, int(number))
    rng = np.random.default_rng([SEED, zlib.crc32(name.encode())])
    poses = driven(place.way, float(rng.uniform(*SPEED_M_S)))
    gap = float(place.world.clearance(poses[:, :2]).min())
    assert gap > robot.footprint_radius_m, f"{name}: the drive comes within {gap:.2f} m of a wall"
    drive = frames(simulator, place.world, poses, robot, zlib.crc32(name.encode()), SEED)
    drive = [type(f)(i / RATE_HZ, f.pose, f.ranges) for i, f in enumerate(drive)]
    seed = int(rng.integers(2**32))
    errors = {
        "odometry": Odometry().of(poses, np.random.default_rng(seed)),
        "twice": Odometry().times(2.0).of(poses, np.random.default_rng(seed)),
    }
    (folder / name).mkdir(parents=True, exist_ok=True)
    world = place.world
    np.savez(folder / name / "world.npz", walls=world.walls, roughness=world.roughness, cylinders=world.cylinders)
    write_truth(folder / name / "truth.npz", truth_of(world, poses))
    write_case(
        folder / name, Facts(kind, walls, robot_name, length_of(poses), simulator), robot, drive, errors, poses
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where cases go; outside of the repository")
    parser.add_argument("names", nargs="*", metavar="NAME", help="cases, or words that some of the set hold")
    args = parser.parse_args()
    new = [word for word in args.names if not picked(SET, [word])]
    if wrong := [name for name in new if not NAME.fullmatch(name)]:
        parser.error(
            f"found {wrong[0]}, expected kind-walls-robot-number[-simulator], or a word that some of SET hold"
        )
    names = new if args.names and len(new) == len(args.names) else [*picked(SET, args.names), *new]
    for name in names:
        if not (args.folder / name / "case.json").is_file():
            make(args.folder, name)
            print(name, flush=True)


if __name__ == "__main__":
    main()
