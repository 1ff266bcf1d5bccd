"""Held-out rooms: the network and the cone model on the same drives, the same weights for all walls.

    python experiments/held_out.py [--rooms 20] [--robot b21] [--resolution 0.12] [MODEL ...]

Three kinds of room (smooth, rough, mixed walls) under three kinds of simulator: echogrid's with its default
physics, echogrid's with physics drawn at random for each room, and the one of leonard.py. The robot tours each room;
truth reaches 1.4 m from its path. Prints a table of means over the rooms. MODEL is ``network``, ``cone`` or a weights
file.
"""

import argparse
from dataclasses import astuple, fields

import numpy as np
from tqdm import tqdm

from echogrid import Frame, Robot, build_map
from echogrid.acoustics import Physics
from echogrid.drive import tour, truth_of
from echogrid.errors import UsageError
from echogrid.interpret import interpreter
from echogrid.metrics import Scores, score
from echogrid.rooms import random_physics, random_world
from echogrid.simulate import Simulator
from leonard import leonard_ranges

KINDS = ("smooth", "rough", "mixed")
SIMULATORS = ("default", "varied", "leonard")
SHOWN = [f.name for f in fields(Scores)][:8]
SEED = 20_000_000


def rooms(kind, count, robot):
    """Worlds and drives that no training run has seen: their seeds are apart."""
    rng = np.random.default_rng([SEED, KINDS.index(kind)])
    found = 0
    while found < count:
        world = random_world(rng, "room", kind)
        try:
            poses = tour(world, robot.footprint_radius_m + 0.1)
        except UsageError:
            continue
        if len(poses) >= 120:
            found += 1
            yield world, poses


def frames(simulator, world, poses, robot, seed):
    """A drive in one of SIMULATORS."""
    rng = np.random.default_rng([SEED, seed])
    if simulator == "leonard":
        ranges = leonard_ranges(world, robot, poses, rng)
        return [Frame(i / 5, p, r) for i, (p, r) in enumerate(zip(poses, ranges, strict=True))]
    physics = Physics() if simulator == "default" else random_physics(rng)
    return list(Simulator(world, robot, physics).frames(poses, seed))


def study(models, robot, count, resolution):
    """Scores [simulator, kind, model, room, score]."""
    table = np.full((len(SIMULATORS), len(KINDS), len(models), count, len(SHOWN)), np.nan)
    for k, kind in enumerate(KINDS):
        for n, (world, poses) in enumerate(tqdm(rooms(kind, count, robot), total=count, desc=kind, disable=None)):
            truth = truth_of(world, poses)
            for s, simulator in enumerate(SIMULATORS):
                drive = frames(simulator, world, poses, robot, n)
                for m, model in enumerate(models):
                    *_, grid = build_map(drive, robot, model, resolution)
                    table[s, k, m, n] = astuple(score(grid, truth))[: len(SHOWN)]
    return table


def markdown(table, models):
    """The table as Markdown, means over the rooms."""
    lines = ["| simulator | walls | model | " + " | ".join(SHOWN) + " |", "|---" * (3 + len(SHOWN)) + "|"]
    for s, simulator in enumerate(SIMULATORS):
        for k, kind in enumerate(KINDS):
            for m, model in enumerate(models):
                mean = np.nanmean(table[s, k, m], axis=0)
                lines.append(
                    f"| {simulator} | {kind} | {model.name} | " + " | ".join(f"{v:.3f}" for v in mean) + " |"
                )
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=["network", "cone"])
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--resolution", type=float, default=0.12)
    parser.add_argument("--robot", default="b21")
    args = parser.parse_args()
    models = [interpreter(name) for name in args.models]
    print(markdown(study(models, Robot.load(args.robot), args.rooms, args.resolution), models))


if __name__ == "__main__":
    main()
