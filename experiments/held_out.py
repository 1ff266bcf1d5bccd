"""Held-out rooms: the network and every classical model on the same drives, the same weights and settings for all.

    python experiments/held_out.py [--rooms 20] [--robot b21] [--resolution 0.12] [--record NAME] [MODEL ...]

Rooms of smooth, rough and mixed walls and corridors of mixed walls, under three simulators: echogrid's with its
default physics (`default`), the same with a physics drawn at random for each room (`varied`), and the separately
written one of leonard.py (`leonard`). The robot tours each room; truth reaches 1.4 m from its path. Prints a table
of means over the rooms. With --record it takes rooms of its own, by which nothing else is ever judged, and the 95 %
intervals (bootstrap over the rooms) and the network against the best classical model go to docs/paper/NAME.json.
MODEL is a name that `echogrid map --interpreter` takes, a weights file, or `mrpt` or `mrpt-centred`, which are left
out where benchmarks/mrpt is not built. Default: all.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, fields
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from tqdm import tqdm

from echogrid import Frame, Robot, build_map
from echogrid.errors import UsageError
from echogrid.metrics import PathScore, Scores, path_score, score
from echogrid.models.table import DEFAULT, MODELS, sensor_model
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.drive import tour, truth_of
from echogrid.simulation.rooms import random_physics, random_world
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import inside_room
from leonard import leonard_ranges
from paper import record

sys.path.append(str(Path(__file__).parent.parent / "benchmarks"))
from mrpt import available, mrpt_map

KINDS = ("smooth", "rough", "mixed")
PLACES = (*KINDS, "corridor")
SIMULATORS = ("default", "varied", "leonard")
SHOWN = [f.name for f in fields(Scores)][:8] + [f.name for f in fields(PathScore)][:3]
PEERS = {"mrpt": False, "mrpt-centred": True}
EVERY = [*(name for name in MODELS if name != DEFAULT), *(PEERS if available() else ())]
"""The paper's network, all classical models, and the peers that are built here. The set network has cells of its own:
generalise.py measures it."""
SEED, TABLE_SEED = 20_000_000, 40_000_000
"""Of the rooms that changes are judged by, and of those that only the recorded table is made of."""
RESAMPLES = 2000


def rooms(place, count, robot, seed=SEED):
    """Worlds and drives that no training run has seen: their seeds are apart."""
    rng = np.random.default_rng([seed, PLACES.index(place)])
    shape, walls = ("corridor", "mixed") if place == "corridor" else ("room", place)
    found = 0
    while found < count:
        world = random_world(rng, shape, walls)
        try:
            poses = tour(world, robot.footprint_radius_m + 0.1)
        except UsageError:
            continue
        # A corridor may be open at its ends; its tour is to stay within.
        if len(poses) >= 120 and (shape == "room" or np.all(inside_room(world, poses[:, :2]))):
            found += 1
            yield world, poses


def frames(simulator, world, poses, robot, room, seed=SEED):
    """A drive in one of SIMULATORS."""
    rng = np.random.default_rng([seed, room])
    if simulator == "leonard":
        ranges = leonard_ranges(world, robot, poses, rng)
        return [Frame(i / 5, p, r) for i, (p, r) in enumerate(zip(poses, ranges, strict=True))]
    physics = Physics() if simulator == "default" else random_physics(rng)
    return list(Simulator(world, robot, physics).frames(poses, room))


def mapped(name, drive, robot, resolution):
    """The map of a drive by a model or a peer."""
    if name in PEERS:
        return mrpt_map(drive, robot, resolution, centred=PEERS[name])[0]
    *_, grid = build_map(drive, robot, sensor_model(name), resolution)
    return grid


def scored(grid, truth, robot):
    """The numbers of SHOWN. Collisions are a share of all pairs: a map that shows few ways has few to collide on."""
    way = path_score(grid, truth, robot.footprint_radius_m)
    collides = 0.0 if np.isnan(way.collides) and way.pairs else way.collides * (1 - way.lost)
    return *astuple(score(grid, truth))[:8], collides, way.blocked, way.lost


def visit(world, poses, room, robot_name, models, resolution, seed):
    """Scores [simulator, model, score] of one room."""
    robot, truth = Robot.load(robot_name), truth_of(world, poses)
    scores = []
    for simulator in SIMULATORS:
        drive = frames(simulator, world, poses, robot, room, seed)
        scores.append([scored(mapped(name, drive, robot, resolution), truth, robot) for name in models])
    return np.array(scores)


def study(models, robot_name, count, resolution, seed):
    """Scores [place, room, simulator, model, score]."""
    robot = Robot.load(robot_name)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        jobs = [
            [
                # No two rooms share their physics.
                pool.submit(visit, world, poses, 1000 * p + room, robot_name, models, resolution, seed)
                for room, (world, poses) in enumerate(rooms(place, count, robot, seed))
            ]
            for p, place in enumerate(PLACES)
        ]
        bar = tqdm(total=len(PLACES) * count, unit="room", disable=None)
        table = []
        for place in jobs:
            table.append([])
            for job in place:
                table[-1].append(job.result())
                bar.update()
    return np.array(table)


def interval(values, rng):
    """Mean over rooms and its 95 % interval by the bootstrap; rooms that have no value are left out."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    means = values[rng.integers(0, values.size, (RESAMPLES, values.size))].mean(axis=1)
    return [round(float(v), 4) for v in (values.mean(), *np.quantile(means, [0.025, 0.975]))]


def against(network, other, rng):
    """Ratio and difference of two means over the same rooms, with 95 % intervals; a ratio to 0 is inf."""
    drawn = rng.integers(0, len(other), (RESAMPLES, len(other)))
    ours, theirs = network[drawn].mean(axis=1), other[drawn].mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.append(network.mean(), ours) / np.append(other.mean(), theirs)
    differences = np.append(network.mean() - other.mean(), ours - theirs)
    found = {}
    for name, values in {"ratio": ratios, "difference": differences}.items():
        # Of 0 to 0 nothing can be said; the rest of the draws say what there is to say.
        drawn_values = values[1:][~np.isnan(values[1:])]
        if np.isnan(values[0]) or not drawn_values.size:
            found[name] = None
            continue
        low, high = np.quantile(drawn_values, [0.025, 0.975], method="nearest")
        found[name] = [None if np.isinf(v) else round(float(v), 4) for v in (values[0], low, high)]
    return found


def summary(table, models):
    """Means with intervals, and the network against the best classical model, in what JSON can hold."""
    rng = np.random.default_rng(TABLE_SEED)
    classical = [m for m, model in enumerate(models) if model in MODELS and "network" not in model]
    means, ratios = {}, {}
    for s, simulator in enumerate(SIMULATORS):
        means[simulator], ratios[simulator] = {}, {}
        for p, place in enumerate(PLACES):
            part = table[p, :, s]
            means[simulator][place] = {
                model: {name: interval(part[:, m, i], rng) for i, name in enumerate(SHOWN)}
                for m, model in enumerate(models)
            }
            ratios[simulator][place] = {}
            for name in ("nll", "wiped") if "network" in models and classical else ():
                column = part[:, :, SHOWN.index(name)]
                best = classical[int(np.argmin(column[:, classical].mean(axis=0)))]
                compared = against(column[:, models.index("network")], column[:, best], rng)
                ratios[simulator][place][name] = {"best classical": models[best]} | compared
    return {"means": means, "ratios": ratios}


def markdown(means, simulator, place):
    """A table of one simulator and place."""
    lines = ["| model | " + " | ".join(SHOWN) + " |", "|---" * (1 + len(SHOWN)) + "|"]
    for model, scores in means[simulator][place].items():
        shown = ["-" if scores[name] is None else f"{scores[name][0]:.3f}" for name in SHOWN]
        lines.append(f"| {model} | " + " | ".join(shown) + " |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=EVERY)
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--resolution", type=float, default=0.12)
    parser.add_argument("--robot", default="b21")
    parser.add_argument("--record")
    args = parser.parse_args()
    models = [name for name in args.models if name not in PEERS or available()]
    seed = TABLE_SEED if args.record else SEED
    found = summary(study(models, args.robot, args.rooms, args.resolution, seed), models)
    for simulator in SIMULATORS:
        for place in PLACES:
            print(f"\n{simulator}, {place}\n\n{markdown(found['means'], simulator, place)}")
    if args.record:
        settings = {"robot": args.robot, "rooms": args.rooms, "resolution": args.resolution, "seed": seed}
        record(args.record, settings | found)


if __name__ == "__main__":
    main()
