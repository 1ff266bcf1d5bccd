"""What each part of SLAM is worth: the error of the poses found without it.

    python -m experiments.studies.position.ablation CASES [WORD ...]

On odometry of twice the usual errors; of each case ATE in metres. CASES and WORD are as of the table.
"""

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from echogrid import slam
from echogrid.metrics import trajectory_error
from echogrid.position.motion import Drift
from experiments.studies.position.cases import cases_of

NONE = 1e-9
"""In place of a standard deviation: known to be nothing."""

WITHOUT: dict[str, dict[str, object]] = {
    "whole": {},
    "no loops": {"drive.LOOPS": 0},
    "no systematic error": {
        "bends.heading_bias": lambda *_: 0.0,
        "drive.Drift": lambda: replace(Drift(), scale=NONE, bias=NONE, turning=NONE),
    },
    "no directions of walls": {"drive.COMPASS_EVERY": np.iinfo(np.int64).max},
    "one hypothesis": {"drive.UNSURE": np.inf},
    "no second look": {"drive.MOST_ROUNDS": 0},
    "2.3 m reach": {"echoes.FAR_M": 2.3},
}
"""What is put in the place of names in echogrid.position."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, metavar="CASES")
    parser.add_argument("only", nargs="*", metavar="WORD")
    args = parser.parse_args()
    print("| case | odometry |", " | ".join(WITHOUT), "|")
    print("|---" * (len(WITHOUT) + 2) + "|")
    for case in cases_of(args.cases, args.only):
        truth = case.truth()

        def ate(found: Callable[[], np.ndarray], truth: np.ndarray = truth) -> str:
            return f"{trajectory_error(found(), truth).aligned_rms_m:.3f}"

        told = [ate(lambda case=case: np.array([frame.pose for frame in case.log("twice")]))]
        for changed in WITHOUT.values():
            with ExitStack() as stack:
                for name, value in changed.items():
                    stack.enter_context(patch(f"echogrid.position.{name}", value))
                told.append(ate(lambda case=case: slam(case.log("twice"), case.robot).poses))
        print(f"| {case.name} |", " | ".join(told), "|", flush=True)


if __name__ == "__main__":
    main()
