"""Turn the recorded run "corridor8" into a CSV log.

    python -m experiments.paper.corridor8_to_csv FOLDER OUT.csv

common/corridor8.py says what FOLDER holds.
"""

import argparse
import sys
from pathlib import Path

from echogrid.errors import EchogridError
from echogrid.logs.csv_log import write_csv
from echogrid.robot import Robot
from experiments.common.corridor8 import ROBOT, frames


def main() -> int:
    parser = argparse.ArgumentParser(description="Turn the recorded run corridor8 into a CSV log.")
    parser.add_argument("folder", type=Path, help="folder with measurement.txt and poses.txt")
    parser.add_argument("out", type=Path, help="CSV log to write")
    options = parser.parse_args()
    try:
        robot = Robot.load(ROBOT)
        write_csv(options.out, frames(options.folder, robot), robot.sonars)
    except EchogridError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
