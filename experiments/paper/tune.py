"""The parameters of the classical models: one search, the same for all, on rooms that no table is made of.

    python -m experiments.paper.tune [MODEL ...]

For each model settings are drawn at random from the ranges below, PER_PARAMETER for each open parameter, scored on
one drive of each kind of place, and the best FINALISTS again on all drives; the one with the lowest mean `nll`
wins. Half of the drives are a B21's and half a P3-DX's, half have echogrid's default physics and half a physics of
their own, and half are cut to their first third, as of a robot that passes but once. All that a source fixes stays
fixed. The winners are written to docs/paper/tune.json; they are the defaults of the classes in
echogrid.models.classical.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np

from echogrid import Robot, build_map
from echogrid.mapping.registry import MODELS
from echogrid.metrics import score
from echogrid.simulation.drive import truth_of
from experiments.common.report import record, recorded
from experiments.common.rooms import PLACES, frames, rooms

SEED, ROBOTS, RESOLUTION = 30_000_000, ("b21", "p3dx"), 0.12
PER_PARAMETER, FINALISTS, ROUNDS = 12, 10, 4

REACH = {"reach_m": [0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 3.0]}
COMMON = REACH | {"no_echo": [False, True]}
RANGES = {
    "cone": REACH | {"p_occupied": (0.55, 0.9), "p_free": (0.2, 0.48), "thickness_m": (0.12, 0.4)},
    "cone-no-echo": REACH | {"p_occupied": (0.55, 0.9), "p_free": (0.2, 0.48), "thickness_m": (0.12, 0.4)},
    "moravec-elfes": COMMON | {"error_m": (0.06, 0.3)},
    "elfes": COMMON | {"p_hit": (0.02, 0.6), "sigma_m": (0.04, 0.2), "sigma_rad": (0.05, 0.25)},
    "nav2-tuned": {"phi_m": (0.5, 3.0)},
    "himm": COMMON | {"certain": (3.0, 15.0)},
    "muriel": COMMON | {"strength": (0.05, 0.9), "background": (0.001, 0.18), "specular": (0.0, 1.0)},
    "dempster-shafer": COMMON | {"rho": (0.01, 0.4), "thickness_m": (0.12, 0.36)},
    "fuzzy": COMMON
    | {
        "k_empty": (0.01, 0.5),
        "k_occupied": (0.05, 0.9),
        "depth_m": (0.06, 0.3),
        "visibility_m": (0.5, 3.0),
        "union": (0.3, 1.0),
    },
    "lim-cho": COMMON
    | {"p_occupied": (0.55, 0.9), "thickness_m": (0.12, 0.4), "fading_m": (1.0, 6.0), "p_specular": (0.01, 0.3)},
    "em": COMMON
    | {
        "p_hit": (0.03, 0.5),
        "p_random": (0.02, 0.5),
        "sigma_m": (0.05, 0.15),
        "p_occupied": (0.02, 0.3),
        "weight": (0.05, 0.6),
    },
}
"""A list: one of these; a pair: between these, evenly in the logarithm if the ends are four-fold apart."""


def drives():
    """Robots, frames and truths: round by round one of each kind of place."""
    found = []
    for p, place in enumerate(PLACES):
        found.append([])
        rooms_of = {name: rooms(place, ROUNDS, Robot.load(name), SEED + i) for i, name in enumerate(ROBOTS)}
        for k in range(ROUNDS):
            # Half of each, and as evenly mixed as four drives allow; every round has some of each.
            robot, physics = (k + p) % 2, (k // 2 + p // 2) % 2
            cut = (robot + physics + p) % 2
            world, poses = next(rooms_of[ROBOTS[robot]])
            poses = poses[: max(60, len(poses) // 3)] if cut else poses
            log = frames(("varied", "default")[physics], world, poses, Robot.load(ROBOTS[robot]), 10 * p + k, SEED)
            found[-1].append((ROBOTS[robot], log, truth_of(world, poses)))
    return [drive for several in zip(*found, strict=True) for drive in several]


def drawn(rng, ranges):
    """A setting at random."""
    setting = {}
    for name, range_ in ranges.items():
        if isinstance(range_, list):
            setting[name] = range_[rng.integers(len(range_))]
        elif range_[0] > 0 and range_[1] >= 4 * range_[0]:
            setting[name] = float(f"{np.exp(rng.uniform(*np.log(range_))):.3g}")
        else:
            setting[name] = float(f"{rng.uniform(*range_):.3g}")
    return setting


def nll(model, some):
    """Mean over drives."""
    values = []
    for name, log, truth in some:
        *_, grid = build_map(log, Robot.load(name), model, RESOLUTION)
        values.append(score(grid, truth).nll)
    return float(np.mean(values))


def search(name, all_drives):
    """The best setting of a model and what it reached."""
    rng = np.random.default_rng([SEED, list(RANGES).index(name)])
    model: Any = MODELS[name]()
    settings = [drawn(rng, RANGES[name]) for _ in range(PER_PARAMETER * len(RANGES[name]))]
    first = [nll(replace(model, **setting), all_drives[: len(PLACES)]) for setting in settings]
    best = np.argsort(first, kind="stable")[:FINALISTS]
    again = [nll(replace(model, **settings[i]), all_drives) for i in best]
    return {
        "setting": settings[best[int(np.argmin(again))]],
        "nll": round(min(again), 4),
        "nll of the finalists": sorted(round(value, 4) for value in again),
        "settings tried": len(settings),
        "ranges": RANGES[name],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=list(RANGES))
    args = parser.parse_args()
    all_drives = drives()
    print(f"{len(all_drives)} drives, {sum(len(log) for _, log, _ in all_drives)} scans", flush=True)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        jobs = {name: pool.submit(search, name, all_drives) for name in args.models}
        found = {}
        for name, job in jobs.items():
            found[name] = job.result()
            print(name, found[name], flush=True)
    # A search of some models replaces theirs only; one that was broken off replaces none.
    record("tune", found if set(found) == set(RANGES) else recorded("tune") | found)


if __name__ == "__main__":
    main()
