"""How well drives are found in a floor plan that somebody else drew, where no true poses are known.

    python -m experiments.studies.position.localised CASES [--only WORD ...] [--seeds N]

CASES are recordings with ``plan.yaml`` and the place where they began (``recordings.py``: nanosmcl). Of each the mean
distance of hits (readings of less than NEAR_M) to the walls of the plan, from the odometry laid at that place, from
the poses tracked from there as they were known when each scan came, and from those found anywhere; and of N seeds how
many of the last end within SAME_M of the tracked ones, how many of these are sure, how many of the others, and how
far the robot had driven when it became so.
"""

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from echogrid import Localiser
from echogrid.geometry import compose, inverse
from echogrid.output.map_file import read_map
from echogrid.position.localise import localise
from experiments.common import report
from experiments.studies.position.cases import Case, cases_of
from experiments.studies.position.measures import hit_to_wall, poses_of

NEAR_M, SAME_M = 2.5, 0.5
HEADER = (
    *("case", "m", "odometry, m", "tracked, m", "anywhere, m"),
    *("right", "sure", "sure elsewhere", "of seeds", "after, m"),
)


def judged(case: Case, seeds: int) -> list[str]:
    """A row of the table."""
    frames, walls = list(case.log()), read_map(case.folder / "plan.yaml")
    start = np.array(case.facts.start)
    given = poses_of(frames)
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(given[:, :2], axis=0).T)))
    localiser = Localiser(walls, case.robot, start)
    tracked = np.array([localiser.add(frame).pose for frame in frames])
    anywhere, after, elsewhere = [], [], 0
    for seed in range(seeds):
        found = localise(frames, walls, case.robot, seed=seed)
        apart = float(np.hypot(*(found.poses[-1] - tracked[-1])[:2]))
        if apart > SAME_M:
            elsewhere += int(found.sure[-1])
            continue
        anywhere.append(hit_to_wall(frames, case.robot, found.poses, walls, NEAR_M))
        if found.sure[-1]:
            after.append(way[next(event.frame for event in found.events if event.what == "sure")])
    odometry = compose(start, compose(inverse(given[0]), given))
    off = [hit_to_wall(frames, case.robot, poses, walls, NEAR_M) for poses in (odometry, tracked)]
    return [
        case.name, f"{way[-1]:.0f}", *(f"{value:.3f}" for value in off),
        f"{np.mean(anywhere):.3f}" if anywhere else "-",
        *(str(count) for count in (len(anywhere), len(after), elsewhere, seeds)),
        f"{np.median(after):.1f}" if after else "-",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, metavar="CASES")
    parser.add_argument("--only", nargs="+", default=(), metavar="WORD", help="cases whose names hold one of these")
    parser.add_argument("--seeds", type=int, default=10, metavar="N")
    args = parser.parse_args()
    cases = [case for case in cases_of(args.cases, args.only) if (case.folder / "plan.yaml").is_file()]
    print(report.table(HEADER, [judged(case, args.seeds) for case in tqdm(cases, "cases", disable=None)]))


if __name__ == "__main__":
    main()
