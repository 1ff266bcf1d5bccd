"""Held-out rooms: the network and every classical model on the same drives, the same weights and settings for all.

    python -m experiments.paper.held_out [--rooms 20] [--robot b21] [--resolution 0.12] [--record NAME] [MODEL ...]

Rooms of smooth, rough and mixed walls and corridors of mixed walls, under three simulators: echogrid's with its
default physics (`default`), the same with a physics drawn at random for each room (`varied`), and the separately
written one of common/leonard.py (`leonard`). The robot tours each room; truth reaches 1.4 m from its path. Prints a
table of means over the rooms. With --record it takes rooms of its own, by which nothing else is ever judged, and the
95 % intervals (bootstrap over the rooms) and the network against the best classical model go to docs/paper/NAME.json.
MODEL is a name that `echogrid map --interpreter` takes, a weights file, or `mrpt` or `mrpt-centred`, which are left
out where benchmarks/mrpt is not built. Default: all.
"""

import argparse

import numpy as np

from echogrid import Robot
from echogrid.mapping.registry import MODELS
from experiments.common.bootstrap import interval
from experiments.common.maps import EVERY, PEERS, SHOWN
from experiments.common.pool import each
from experiments.common.report import record, table
from experiments.common.rooms import PLACES, SEED, numbered
from experiments.common.trials import ratios, visit

SIMULATORS = ("default", "varied", "leonard")
TABLE_SEED = 40_000_000
"""Of the rooms that only the recorded table is made of."""


def study(models, robot_name, count, resolution, seed):
    """Scores [place, room, simulator, model, score]."""
    robot = Robot.load(robot_name)
    jobs = ((*room, robot, SIMULATORS, models, resolution, seed) for room in numbered(PLACES, count, robot, seed))
    return np.array(each(visit, jobs, "rooms")).reshape(len(PLACES), count, len(SIMULATORS), len(models), -1)


def summary(scores, models):
    """Means with intervals, and the network against the best classical model, in what JSON can hold."""
    rng = np.random.default_rng(TABLE_SEED)
    classical = [model for model in models if model in MODELS and "network" not in model]
    found = {"means": {}, "ratios": {}}
    for s, simulator in enumerate(SIMULATORS):
        found["means"][simulator], found["ratios"][simulator] = {}, {}
        for p, place in enumerate(PLACES):
            part = scores[p, :, s]
            found["means"][simulator][place] = {
                model: {name: interval(part[:, m, i], rng) for i, name in enumerate(SHOWN)}
                for m, model in enumerate(models)
            }
            compared = ratios(part, models, "network", classical, rng) if "network" in models and classical else {}
            found["ratios"][simulator][place] = compared
    return found


def means_table(means):
    """A table of one simulator and place."""
    return table(
        ["model", *SHOWN],
        (
            [model, *("-" if scores[name] is None else f"{scores[name][0]:.3f}" for name in SHOWN)]
            for model, scores in means.items()
        ),
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=EVERY)
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--resolution", type=float, default=0.12)
    parser.add_argument("--robot", default="b21")
    parser.add_argument("--record")
    args = parser.parse_args()
    models = [name for name in args.models if name not in PEERS or name in EVERY]
    seed = TABLE_SEED if args.record else SEED
    found = summary(study(models, args.robot, args.rooms, args.resolution, seed), models)
    for simulator in SIMULATORS:
        for place in PLACES:
            print(f"\n{simulator}, {place}\n\n{means_table(found['means'][simulator][place])}")
    if args.record:
        settings = {"robot": args.robot, "rooms": args.rooms, "resolution": args.resolution, "seed": seed}
        record(args.record, settings | found)


if __name__ == "__main__":
    main()
