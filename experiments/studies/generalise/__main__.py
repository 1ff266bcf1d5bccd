"""The set network where it might fail: its probabilities, its reach, walls and doors, standing still, other arrays.

    python -m experiments.studies.generalise [PART ...] [--model NAME|FILE] [--rooms N] [--own FILE] [--out FOLDER]
    python -m experiments.studies.generalise --write-robot FILE

PART, of which all are the default, each with tables on stdout and its numbers in docs/paper/set_PART.json:

- calibration: reliability and `ece` in each kind of room, beside the paper's network (picture).
- reach: truth up to 1.4 m and up to 2.5 m from the path, for a tour of the room and, as that passes within 1.4 m of
  nearly everything, for its first 6 m alone; beside the paper's network and the best classical models.
- walls: how thick a wall comes out, and whether a door of 0.8 m stays open, in two rooms of known place that are
  turned and shifted against the cells; each model at its own cell size (two pictures).
- standing: what a robot claims wrongly after 1, 10, 100 and 600 scans from one place (picture).
- spacing: the same tour with frames every 5, 10, 20 and 50 cm.
- arrays: other robots, arrays that no preset has, sonars that are silent or fire in turn. With --own the weights of
  FILE, trained for the uneven ring that --write-robot writes, are set beside the general ones.
- corridor8: the recorded corridor, from all of the log and from parts of it (picture).
- simulators: four simulators, two of them written apart from what the network was trained on.

The model is `set-network` or what --model says; unless a part says otherwise, all models have its cells. --rooms sets
the rooms of each kind (walls: orientations). No training and no other study has seen the rooms. Takes about 20
minutes on 2 cores, no part more than 5.
"""

import argparse
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from echogrid.mapping.registry import DEFAULT
from echogrid.robot import robot_yaml
from experiments.common import report
from experiments.common.parts import check, run
from experiments.studies.generalise import (
    arrays,
    calibration,
    corridor8,
    reach,
    simulators,
    spacing,
    standing,
    walls,
)
from experiments.studies.generalise.study import Study

PARTS: dict[str, Callable[[Study], None]] = {
    "calibration": calibration.calibration,
    "reach": reach.reach,
    "walls": walls.walls,
    "standing": standing.standing,
    "spacing": spacing.spacing,
    "arrays": arrays.arrays,
    "corridor8": corridor8.corridor8,
    "simulators": simulators.simulators,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--model", default=DEFAULT, help="name or weights file")
    parser.add_argument("--rooms", type=int, help="rooms of each kind")
    parser.add_argument("--own", help=f"weights trained for {arrays.UNEVEN}")
    parser.add_argument("--out", type=Path, default=report.FOLDER, help="where numbers and pictures go")
    parser.add_argument("--write-robot", type=Path, metavar="FILE", help=f"write {arrays.UNEVEN}, and do no more")
    args = parser.parse_args()
    if args.write_robot:
        args.write_robot.write_text(robot_yaml(arrays.arrays_of()[arrays.UNEVEN].robot), encoding="utf-8")
        return
    check(parser, args.parts, PARTS, args.rooms, filter(None, [args.model, args.own]))
    report.FOLDER = args.out
    study = Study(args.model, args.rooms, args.own)
    with tempfile.TemporaryDirectory(prefix="echogrid-generalise-") as compiled:
        # Each map is traced anew; the processes that do it share what they compile.
        os.environ |= {
            "JAX_COMPILATION_CACHE_DIR": compiled,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        run(PARTS, args.parts, study)


if __name__ == "__main__":
    main()
