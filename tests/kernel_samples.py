"""What the kernels of both networks make of things drawn at random, to compare one set of instructions with another.

    python tests/kernel_samples.py FILE

writes it to FILE (NPZ), without what only tests need.
"""

import sys
from math import inf, nan, pi
from typing import Any

import numpy as np

from echogrid import _core
from echogrid.models.networks import set_core, surroundings
from echogrid.models.networks.local_map import LOCAL_CELLS
from echogrid.models.networks.set_layers import initial
from echogrid.models.networks.surroundings import PACK

UNITS, SCANS, SPAN, CELL_M = 7, 9, 150, 0.04


def sampled() -> dict[str, Any]:
    """Arrays by name."""
    found: dict[str, Any] = {"instructions": _core.instructions()}
    for sonars, longest, moved in (
        (1, 6.0, False),
        (5, 1.0, True),
        (24, 3.0, False),
        (24, 6.0, True),
        (48, 2.0, True),
    ):
        name = f"{sonars} sonars of {longest:g} m{' that moved' * moved}"
        found |= {f"{name}: {what}": value for what, value in scans(sonars, longest, moved).items()}
    for rows, cols in ((3, 5), (31, 77), (64, 130)):
        found |= {f"{rows} x {cols} cells: {what}": value for what, value in read(rows, cols).items()}
    for cols in (5, 90):  # fewer than the widest vectors have lanes, more than the narrowest
        found |= {f"local maps in {cols} columns: {what}": value for what, value in fused(cols).items()}
    return found | {"points": points()}


def grown(rng: np.random.Generator, weights: dict[str, Any], by: float) -> dict[str, Any]:
    """Weights of a network that has something to say of everything."""
    return {name: (value + rng.normal(0, by, value.shape)).astype(np.float32) for name, value in weights.items()}


def mostly(rng: np.random.Generator, ranges: Any) -> Any:
    """Some without an echo, some that did not fire."""
    ranges[rng.random(ranges.shape) < 0.2] = inf
    ranges[rng.random(ranges.shape) < 0.2] = nan
    return ranges.astype(np.float32)


def scans(sonars: int, longest: float, moved: bool) -> dict[str, Any]:
    """Polar tables, what they tell of points, and their sums in the cells of a window."""
    rng = np.random.default_rng(sonars)
    network = set_core.network(grown(rng, initial(rng, UNITS), 0.3), None)
    mounts = np.column_stack([rng.uniform(-0.3, 0.3, (sonars, 2)), rng.uniform(-pi, pi, sonars)])
    looked = mounts + rng.normal(0, 0.05, (SCANS, sonars, 3)) if moved else None
    array = set_core.sonar_array(mounts, longest, 0.2, 0.4, longest < 5)
    ranges = mostly(rng, rng.uniform(0.05, longest, (SCANS, sonars)))
    tables = network.tables(array, ranges, rng.random((SCANS, 4)).astype(np.float32), looked)
    side = int(np.ceil(2 * set_core.REACH_M / CELL_M)) + 2
    place = rng.uniform(0, 0.8, (SCANS, 2))
    home = np.floor(place / CELL_M).astype(int) - side // 2
    corner, first = (home + 0.5) * CELL_M - place, (home - home.min(axis=0))[:, ::-1]
    layers = [np.zeros((SPAN, SPAN), np.float32) for _ in range(5)]
    views = np.zeros((SPAN, SPAN), np.int32)
    weight = rng.uniform(0, 1, SCANS).astype(np.float32)
    tables.add(
        corner.astype(np.float32), rng.uniform(-9, 9, SCANS), first.astype(np.int32), weight, CELL_M, layers, views
    )
    at = rng.uniform(-2.7, 2.7, (2, SCANS, 333)).astype(np.float32)
    return {
        "tables": tables.values(),
        "until": tables.told_until(),
        "told": tables.at(*at),
        "sums": np.stack(layers),
        "views": views,
    }


def read(rows: int, cols: int) -> dict[str, Any]:
    """Log-odds of cells and which are observed, alone and with their surroundings."""
    rng = np.random.default_rng(cols)
    looks = rng.exponential(8, (rows, cols)) * (rng.random((rows, cols)) < 0.8)
    sums = [looks * rng.uniform(0, 3, (rows, cols)) for _ in range(4)]
    cells = [each.astype(np.float32) for each in (*sums, looks, rng.random((rows, cols)) < 0.05)]
    weights, told = grown(rng, initial(rng, UNITS), 0.3), rng.random(surroundings.TOLD).astype(np.float32)
    found, squares = {}, (rows // PACK + 2, cols // PACK + 2)
    for name, stack in (("alone", None), ("with surroundings", grown(rng, surroundings.initial(rng), 0.05))):
        log_odds, observed = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), bool)
        begun = set_core.begun(stack, told)
        network = set_core.network(weights, stack)
        network.read_out(cells, (1, 1), squares, begun, 0.7, 0.05, -4.0, log_odds, observed, (1, 1))
        found |= {name: log_odds, f"observed {name}": observed}
    return found


def points() -> Any:
    """What the paper's network says of points."""
    rng = np.random.default_rng(1)
    zone, first, second, sonars, count = 3, 21, 10, 24, 577
    shapes = (5 * zone * first,), (first * second,), (second,), (second,), (1,)
    weights = [rng.normal(0, 0.5, shape).astype(np.float32) for shape in shapes]
    network = _core.PaperNetwork(
        weights,
        sonars,
        rng.integers(0, sonars + 1, (zone, count)).astype(np.int32),
        rng.uniform(0.1, 3, (zone, count)).astype(np.float32),
        -rng.integers(0, 2, (zone, count)).astype(np.int32),
        rng.normal(0, 1, (first, count)).astype(np.float32),
        0.2,
    )
    return network.look(mostly(rng, rng.uniform(0.1, 5, (SCANS, sonars))))


def fused(cols: int) -> dict[str, Any]:
    """Local maps by eq. 4 and Bayes' rule in a window of so many columns."""
    rng = np.random.default_rng(cols)
    beams = np.column_stack([rng.uniform(-0.2, 0.2, (8, 2)), rng.uniform(-pi, pi, 8), rng.uniform(1, 3, 8)])
    fusion = _core.LocalFusion(-1.4, 0.02, 0.98, False, 0.2, beams.astype(np.float32), 0.7)
    told = rng.uniform(0.01, 0.99, (SCANS, LOCAL_CELLS**2)) - 4.0 * (rng.random((SCANS, LOCAL_CELLS**2)) < 0.2)
    shape = (60, cols)
    log_odds, observed, views = np.zeros(shape, np.float32), np.zeros(shape, bool), np.zeros(shape, np.int32)
    fusion.add(
        told.astype(np.float32),
        mostly(rng, rng.uniform(0.1, 3, (SCANS, 8))),
        rng.uniform(-2, -1, (SCANS, 2)).astype(np.float32),
        rng.uniform(-9, 9, SCANS),
        rng.integers(0, 9, (SCANS, 2)).astype(np.int32),
        0.06,
        log_odds,
        observed,
        views,
    )
    return {"log-odds": log_odds, "observed": observed, "views": views}


if __name__ == "__main__":
    np.savez(sys.argv[1], **sampled())
