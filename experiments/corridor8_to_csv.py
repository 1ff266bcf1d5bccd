"""Turn the recorded run "corridor8" into a CSV log.

    python experiments/corridor8_to_csv.py FOLDER OUT.csv

FOLDER holds ``measurement.txt`` (t s0 ... s7; ms, mm) and ``poses.txt`` (t x y theta; ms, mm, 0.1 degree),
line by line at the same times. The data has no licence, so it is not part of this repository. Readings
from 5 m on become no echo (the recorder wrote 5110), those below 0.17 m not valid: the limits of
corridor8.yaml.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from echogrid.errors import EchogridError, InputError
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.logs.formats import write_csv
from echogrid.robot import Robot

ROBOT_FILE = Path(__file__).with_name("corridor8.yaml")


def table(path: Path, columns: int) -> np.ndarray:
    """The numbers of a blank-separated file, one row a line."""
    try:
        values = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(path, str(error), f"rows of {columns} numbers") from None
    if values.shape[1] != columns:
        raise InputError(path, f"{values.shape[1]} columns", str(columns))
    return values


def frames(folder: Path, robot: Robot) -> Iterator[Frame]:
    """The run, in m, s and rad, its time from 0."""
    readings = table(folder / "measurement.txt", 1 + robot.sonars)
    poses = table(folder / "poses.txt", 4)
    if not np.array_equal(readings[:, 0], poses[:, 0]):
        raise InputError(folder, "other times in poses.txt than in measurement.txt", "the same, line by line")
    stamps = (readings[:, 0] - readings[0, 0]) / 1000
    ranges = robot.clean(readings[:, 1:] / 1000)
    headings = wrap(np.deg2rad(poses[:, 3] / 10))
    T_world_robot = np.column_stack([poses[:, 1:3] / 1000, headings])
    yield from map(Frame, stamps.tolist(), T_world_robot, ranges)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Turn the recorded run corridor8 into a CSV log.")
    parser.add_argument("folder", type=Path, help="folder with measurement.txt and poses.txt")
    parser.add_argument("out", type=Path, help="CSV log to write")
    options = parser.parse_args(arguments)
    try:
        robot = Robot.load(ROBOT_FILE)
        write_csv(options.out, frames(options.folder, robot), robot.sonars)
    except EchogridError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
