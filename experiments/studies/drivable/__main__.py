"""Whether maps can be driven on: doors stay open, walls stay and are where they are, after any number of passes.

    python -m experiments.studies.drivable [PART ...] [--models NAME|FILE ...] [--rooms N] [--passes N ...]
        [--out FOLDER]

PART, of which all are the default, each with tables on stdout and its numbers in docs/paper/drivable_PART.json, for
the B21, the P3-DX and a ring of 12:

- doors: two rooms with a door of 0.8 or 0.9 m in a wall of 0.05 to 0.3 m, smooth, rough and mixed, after 1 and 8
  passes: the widest free lane from room to room, and the worst probability under the robot's body. Right: a lane of
  1.6 footprint radii, nothing under the body above 0.35.
- passes: the same tour of each shipped world with fresh noise 1, 8 and 30 times: what is found, what is wiped.
- walls: how thick walls come out, and a partition of no thickness; the share of occupied cells farther than 0.1 m
  from any surface, hidden ones too; phantoms, more than 0.3 m from any surface where nobody has looked.
- swarm: recorded flights with true poses and walls (../shared/data/nanoswarm; left out where they are not).

Each model has cells of its own size (swarm: 0.04 m). --rooms sets the layouts (doors), worlds, rooms of each kind and
orientations (walls) and runs; no training and no other study has seen them. Takes about 40 minutes on 2 cores; with
--rooms 3 about 10.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

from experiments.common import report
from experiments.common.parts import check, run
from experiments.studies.drivable import doors, passes, swarm, walls
from experiments.studies.drivable.study import MODELS, Study

PARTS: dict[str, Callable[[Study], None]] = {
    "doors": doors.doors,
    "passes": passes.passes,
    "walls": walls.walls,
    "swarm": swarm.swarm,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--models", nargs="+", default=MODELS, metavar="NAME|FILE", help="models or weights files")
    parser.add_argument("--rooms", type=int, help="layouts, worlds, rooms of each kind, runs")
    parser.add_argument(
        "--passes", type=int, nargs="+", help="numbers of passes, the first of them one to compare with"
    )
    parser.add_argument("--out", type=Path, default=report.FOLDER, help="where numbers go")
    args = parser.parse_args()
    check(parser, args.parts, PARTS, args.rooms, args.models)
    if args.passes and min(args.passes) < 1:
        parser.error(f"--passes: found {min(args.passes)}, expected at least 1")
    report.FOLDER = args.out
    study = Study(tuple(args.models), args.rooms, tuple(sorted(set(args.passes))) if args.passes else None)
    run(PARTS, args.parts, study)


if __name__ == "__main__":
    main()
