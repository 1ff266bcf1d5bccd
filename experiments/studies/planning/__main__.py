"""Whether a robot can drive by our maps: paths between random places, and explorations of held-out buildings.

    python -m experiments.studies.planning [pairs | exploring | slam | peer | ideal]
        [--pairs N] [--buildings N] [--out DIR]

- pairs: N random pairs (170: 1,000 a kind of building) for each kind, walls and robot, planned on the map of a drive
  with given poses, driven by the path follower in the true world.
- exploring: the explorer in 10 buildings x 3 kinds of walls x 2 robots.
- slam: likewise with poses that are found.
- peer: likewise the nearest frontier on the map of Nav2's range layer.
- ideal: likewise with a map that is right wherever the robot sees: what the building costs, without what sonar does.

Numbers go to docs/paper/planning_PART.json.
"""

import argparse
from pathlib import Path

from experiments.common import report
from experiments.common.pool import each
from experiments.studies.planning import exploring, pairs
from experiments.studies.position.buildings import WALLS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["pairs", *exploring.PARTS])
    parser.add_argument("--pairs", type=int, default=170, help="for each kind, walls and robot")
    parser.add_argument("--buildings", type=int, default=len(exploring.BUILDINGS), help="how many are explored")
    parser.add_argument("--out", type=Path, default=report.FOLDER, help="where numbers go")
    args = parser.parse_args()
    report.FOLDER = args.out
    if args.part == "pairs":
        found = each(pairs.planned, pairs.jobs(args.pairs), "pairs")
        print(pairs.summary(found))
        report.record("planning_pairs", {"found": [report.rounded(one) for one in found]})
        return
    jobs = [
        (kind, number, walls, robot, args.part)
        for kind, number in exploring.BUILDINGS[: args.buildings]
        for walls in WALLS
        for robot in exploring.ROBOTS
    ]
    exploring.told(each(exploring.explored, jobs, args.part), f"planning_{args.part}")


if __name__ == "__main__":
    main()
