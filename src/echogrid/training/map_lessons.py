"""What the set network's surroundings learn from: maps of simulated drives, as the mapper holds them, and the truth.

A lesson is a square of a map that a network without surroundings has made, and what is really there.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Integer
from numpy import ndarray
from scipy.ndimage import distance_transform_edt, maximum_filter

from echogrid.frame import Frame
from echogrid.grid import GrowingGrid
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.models.networks.set_network import SUMS, SetNetwork
from echogrid.models.networks.surroundings import PACK
from echogrid.robot import Robot
from echogrid.simulation.drive import truth_of
from echogrid.training.drives import Driven, simulated
from echogrid.training.set_lessons import MOST_SONARS, disturbed, drives_of, most_sonars, out_of_turn

FRAMES = 160
"""Frames of a drive; a map is made of some or all of them."""

LEAST_FRAMES = 30
"""Frames of the shortest part that a map is made of."""

THROUGH_SHARE = 0.5
"""Of the drives in flats, those through their doors: a door that was only seen is a door as well."""

SHAPE_SHARES = {"contour": 0.14, "room": 0.27, "corridor": 0.17, "hall": 0.08, "clutter": 0.08, "flat": 0.26}
"""How often each kind of world comes; flats more often than in the first part: surroundings tell of doors."""

SIDE = 128
"""Cells along the side of a lesson."""

BEHIND_M = 0.5
"""Hidden cells nearer to a surface than this are told apart from those farther off."""

BEHIND, DEEP, NOTHING, GAP = 2, 3, 4, 5
"""Labels beside SURFACE and FREE: hidden near a surface, hidden farther off, what is not to be judged, and free floor
in a gap between surfaces, as in a door."""

GAP_CELLS = 16
"""Cells to either side of a gap within which there is a surface, but none ahead and behind."""


class MapLessons(NamedTuple):
    """Squares of maps; the leading axis is the drive."""

    told: Float[ndarray | Array, "drives side side features"]
    """Of cells, float16, see ``surroundings.features``."""
    array: Float[ndarray | Array, "drives told"]
    """Of the robot's sonars, see ``surroundings.told_of``."""
    label: Integer[ndarray | Array, "drives side side"]
    """What is there, see BEHIND."""


KIND = drives_of(FRAMES, SHAPE_SHARES, THROUGH_SHARE)
"""The drives."""

_WAYS = 32
"""Directions in which gaps are looked for."""

_FINE = 3
"""Cells of the truth to the side of one of the scores' truths, which is odd."""


def map_lessons(
    network: SetNetwork, robot: Robot | None, drives: int, seed: int, progress: bool = False
) -> MapLessons:
    """Lessons from the maps that a network makes of simulated drives; arguments as for ``simulated``."""

    def learn(rng: np.random.Generator, driven: Driven) -> MapLessons:
        return _lesson(network, rng, driven)

    return simulated(robot, KIND, most_sonars, learn, drives, seed, progress)


def _lesson(network: SetNetwork, rng: np.random.Generator, driven: Driven) -> MapLessons:
    d, heard = driven.drive, disturbed(rng, driven)
    silent = out_of_turn(rng, FRAMES, d.robot.sonars)
    if silent is not None:
        heard[silent] = np.nan
    elif rng.random() < 0.25:
        heard[rng.random(heard.shape) < rng.uniform(0, 0.6)] = np.nan
    count = int(rng.choice([FRAMES, rng.integers(LEAST_FRAMES, FRAMES)]))
    begin = int(rng.integers(0, FRAMES - count + 1))
    part = np.s_[begin : begin + count]
    grown, fusion = _mapped(network, d.robot, d.believed[part], heard[part])
    truth = widened(truth_of(d.world, d.poses[part], KIND.truth_m / _FINE, KIND.reach_m))
    home = d.believed[begin + int(rng.integers(0, count)), :2] + rng.uniform(-1.5, 1.5, 2)
    corner = np.floor(home[::-1] / network.cell_m / PACK).astype(np.int64) * PACK - SIDE // 2
    cells = grown.copied(corner, (SIDE, SIDE), (*SUMS, "stood"))
    label = labels(truth, corner, network.cell_m)
    label[gaps(label)] = GAP
    label[(cells["occupied"] + cells["free"] <= 0) | (cells["stood"] > 0)] = NOTHING
    return MapLessons(fusion.telling(cells).astype(np.float16), fusion.array, label)


def _mapped(network: SetNetwork, robot: Robot, poses: ndarray, ranges: ndarray):
    """The map of a drive. Sonars are filled up to few numbers in all, for each of which the network is compiled."""
    most = next(n for n in (*MOST_SONARS, robot.sonars) if n >= robot.sonars)
    fill = most - robot.sonars
    own = None if robot.own_max_ranges_m is None else np.pad(robot.own_max_ranges_m, (0, fill), mode="edge")
    filled = replace(
        robot, mounts=np.pad(robot.mounts, [(0, fill), (0, 0)], constant_values=np.nan), own_max_ranges_m=own
    )
    ranges = np.pad(ranges, [(0, 0), (0, fill)], constant_values=np.nan)
    fusion = network.fusion(filled, network.cell_m)
    grown = GrowingGrid(network.cell_m, fusion.blank)
    frames = [Frame(0.1 * i, pose, row) for i, (pose, row) in enumerate(zip(poses, ranges, strict=True))]
    for batch in fusion.batches(frames):
        evidence = fusion.read(batch, filled=True)()
        grown.reserve(evidence.corner, evidence.end)
        fusion.fuse(grown, evidence)
    return grown, fusion


def widened(truth: Truth) -> Truth:
    """Surface in each cell about whose middle a square, as large as a cell of the scores' truths, holds some.

    The scores ask of the middles of their cells, so this is what there is to know. In their own cells the face of a
    wall would lie anywhere, and a map that learns from them takes walls for thicker than their faces.
    """
    surface = maximum_filter(truth.cells == SURFACE, size=_FINE, mode="constant")
    return replace(truth, cells=np.where(surface, np.int8(SURFACE), truth.cells))


def gaps(label: Integer[ndarray, "side side"]) -> Bool[ndarray, "side side"]:
    """Which free cells have surfaces near on two sides that face each other, and none on the two between."""
    side = len(label)
    framed = np.pad(label == SURFACE, GAP_CELLS)
    met = np.zeros((_WAYS, side, side), dtype=bool)
    for k in range(_WAYS):
        for step in range(1, GAP_CELLS + 1):
            row, col = (GAP_CELLS + round(step * turned(2 * np.pi * k / _WAYS)) for turned in (np.sin, np.cos))
            met[k] |= framed[row : row + side, col : col + side]
    facing, across = met & np.roll(met, _WAYS // 2, axis=0), np.roll(met, _WAYS // 4, axis=0)
    return (label == FREE) & np.any(facing & ~across & ~np.roll(across, _WAYS // 2, axis=0), axis=0)


def labels(truth: Truth, corner: Integer[ndarray, "2"], cell_m: float) -> Integer[ndarray, "side side"]:
    """What is at the middles of the cells of a square, see BEHIND; as ``score`` reads a map."""
    gap = distance_transform_edt(truth.cells != SURFACE) * truth.resolution
    kinds = np.where(truth.cells == HIDDEN, np.where(gap < BEHIND_M, BEHIND, DEEP), truth.cells).astype(np.int8)
    if not np.any(truth.cells == SURFACE):
        kinds[truth.cells == HIDDEN] = DEEP
    framed = np.pad(kinds, 1, constant_values=NOTHING)
    index = []
    for k in (0, 1):
        middle = (corner[k] + np.arange(SIDE) + 0.5) * cell_m - truth.origin[::-1][k]
        index.append(np.clip(np.floor(middle / truth.resolution).astype(int), -1, kinds.shape[k]) + 1)
    return framed[np.ix_(*index)]
