"""The paper's local map: what a scan, read as a whole, says of a square round the robot, and its place in the world.

An interpreter answers for each cell of the square; eq. 4 resamples the square into the cells of the global map, and
Bayes' rule fuses it there.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import batched
from typing import NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.grid import GrowingGrid, logit
from echogrid.models.batches import BATCH, apart, placed
from echogrid.models.model import CONE_RAD, Evidence, Fusion, Model
from echogrid.robot import Robot

LOCAL_CELLS, LOCAL_CELL_M = 24, 0.12
"""The paper's local map: 24 x 24 cells of 12 cm, the robot in its middle."""

HALF_M = LOCAL_CELLS * LOCAL_CELL_M / 2
"""Half the side of the local map: how far the mapper looks to each side."""

ROBOT_CELLS = 4
"""The robot stands in the central 4 x 4 cells of the local map."""

P_UNDER_ROBOT = 0.1
"""Occupancy probability of the cells in which the robot stands."""

P_VIEW_MIN, P_VIEW_MAX = 0.02, 0.98
"""No single view is taken to be more certain than this."""

Bound = Callable[[Float[Array, "scans sonars"]], tuple[Float[Array, "scans points"], Bool[Array, "scans points"]]]
"""Scans -> occupancy probability of each point under the interpreter's prior, and where the scan spoke at all."""


class Interpreter(Model):
    """A sensor model that reads all sonars of a scan at once. Its views are fused by Bayes' rule."""

    prior: float
    """Occupancy probability that the model gives a point of which it knows nothing."""

    @abstractmethod
    def bind(self, robot: Robot, p_robot: Float[ndarray, "points 2"]) -> Bound:
        """Prepare for the points (m, robot frame) of a local map; what is returned is traced by JAX."""

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        self.refuse_fading(half_life)
        return _Patches(robot, self, resolution)


class LocalMap(NamedTuple):
    """What each scan of a batch says of the square round the robot; cells [row, col], row 0 the lowest y."""

    probability: Float[Array, "scans 24 24"]
    spoken: Bool[Array, "scans 24 24"]
    """Where the scan says anything; elsewhere the probability is the interpreter's prior."""


def local_cells() -> Float[ndarray, "576 2"]:
    """Centres of the local map's cells in the robot's frame (m), row by row from the lowest y."""
    axis = (np.arange(LOCAL_CELLS) + 0.5 - LOCAL_CELLS / 2) * LOCAL_CELL_M
    x, y = np.meshgrid(axis, axis)
    return np.column_stack([x.ravel(), y.ravel()])


def local_mapper(robot: Robot, model: Interpreter) -> Callable[[Float[Array, "scans sonars"]], LocalMap]:
    """The function that turns scans (m) into local maps: one question to the interpreter for each cell."""
    cells = local_cells()
    ask = model.bind(robot, cells)
    middle = np.max(np.abs(cells), axis=1) < ROBOT_CELLS / 2 * LOCAL_CELL_M
    under = middle & (np.hypot(*cells.T) < robot.footprint_radius_m)
    # The floor under the robot is free under the interpreter's prior as well.
    p_under = 1 / (1 + np.exp(-(logit(P_UNDER_ROBOT) + logit(model.prior))))

    def look(ranges: Float[Array, "scans sonars"]) -> LocalMap:
        probability, spoken = ask(ranges)
        probability = jnp.where(under, p_under, probability)
        shape = (-1, LOCAL_CELLS, LOCAL_CELLS)
        return LocalMap(probability.reshape(shape), (spoken | under).reshape(shape))

    return look


def surrounding(
    x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> tuple[list[Int[Array, "*n"]], list[Float[Array, "*n"]], Bool[Array, "*n"]]:
    """The four local cells whose centres surround each point, their weights by eq. 4, and whether there are four.

    Args:
        x: forward, in cells, counted from the centre of the first cell; see ``in_cells``.
        y: to the left, likewise.

    Returns:
        For each of the four its flat index, and its weight 1/distance as a share of their sum (at a centre that
        cell alone); whether the point lies within the outermost centres. Lists, for arrays with a short last
        axis are slow.
    """
    col, row = (jnp.clip(jnp.floor(place), 0, LOCAL_CELLS - 2) for place in (x, y))
    u, v = x - col, y - row
    inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    first = (row * LOCAL_CELLS + col).astype(jnp.int32)
    steps = [(0, 0), (1, 0), (0, 1), (1, 1)]
    near = [jax.lax.rsqrt((u - du) ** 2 + (v - dv) ** 2 + 1e-12) for du, dv in steps]
    total = near[0] + near[1] + near[2] + near[3]
    return [first + du + LOCAL_CELLS * dv for du, dv in steps], [weight / total for weight in near], inside


def in_robot(
    corner: Float[Array, "scans 2"], theta: Float[Array, "scans"], steps: Float[Array, "side"]
) -> tuple[Float[Array, "scans side side"], Float[Array, "scans side side"]]:
    """Coordinates in the robot's frame (m) of the cells of patches.

    Args:
        corner: centre of each patch's first cell relative to the robot, m, world axes.
        theta: heading of the robot, rad.
        steps: from the first cell's centre to those of its row, m.
    """
    x = corner[:, 0, None, None] + steps[None, None, :]
    y = corner[:, 1, None, None] + steps[None, :, None]
    cos, sin = jnp.cos(theta)[:, None, None], jnp.sin(theta)[:, None, None]
    return cos * x + sin * y, cos * y - sin * x


def in_cells(metres: Float[Array | ndarray, "*n"]) -> Float[Array, "*n"]:
    """A coordinate in the robot's frame (m) in the units of ``surrounding``."""
    return jnp.asarray(metres) / LOCAL_CELL_M + (LOCAL_CELLS - 1) / 2


def resample(local: LocalMap, x: Float[Array, "scans *n"], y: Float[Array, "scans *n"]) -> Float[Array, "scans *n"]:
    """Occupancy probability of points from the local map by eq. 4, nan where the local map says nothing.

    It speaks of a point that lies among four local centres, at least one of which is spoken of.

    Args:
        local: the local maps.
        x: points in each map, as for ``surrounding``.
        y: likewise.
    """
    # Whether a cell is spoken of rides with its probability, 4 below it if not: one gather serves both.
    coded = jnp.where(local.spoken, local.probability, local.probability - 4.0).reshape(-1)
    # Without the barrier the compiler works the network out again for each of the four cells.
    coded, x, y = jax.lax.optimization_barrier((coded, x, y))
    cells, weights, inside = surrounding(x, y)
    scan = jnp.arange(len(x), dtype=jnp.int32).reshape(-1, *[1] * (x.ndim - 1))
    offset = scan * LOCAL_CELLS**2
    near = [coded.at[cell + offset].get(mode="promise_in_bounds") for cell in cells]
    told = [value > -1.0 for value in near]
    terms = [w * jnp.where(said, value, value + 4.0) for w, said, value in zip(weights, told, near, strict=True)]
    total = terms[0] + terms[1] + terms[2] + terms[3]
    return jnp.where(inside & (told[0] | told[1] | told[2] | told[3]), total, jnp.nan)


def within(
    robot: Robot, ranges: Float[Array, "scans sonars"], x: Float[Array, "scans *n"], y: Float[Array, "scans *n"]
) -> Bool[Array, "scans *n"]:
    """Whether points (robot frame, m) lie under the robot, or in the range and cone of a sonar that fired."""
    told = x**2 + y**2 <= robot.footprint_radius_m**2
    for (forward, left, axis), longest, reading in zip(robot.mounts, robot.max_ranges_m, ranges.T, strict=True):
        distance = jnp.hypot(x - forward, y - left)
        ahead = (x - forward) * np.cos(axis) + (y - left) * np.sin(axis)
        fired = ~jnp.isnan(reading).reshape(-1, *[1] * (x.ndim - 1))
        told |= fired & (distance <= longest) & (ahead >= np.cos(CONE_RAD) * distance)
    return told


class _Told(NamedTuple):
    """What a batch of scans adds to the global map."""

    corner: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    log_odds: Float[ndarray, "scans side side"]
    """0 where nothing is said."""
    spoken: Bool[ndarray, "scans side side"]


class _Patches(Fusion):
    """Each scan is a patch of the global map, added to its log-odds."""

    def __init__(self, robot: Robot, model: Interpreter, resolution: float):
        self.blank = {"views": np.int32(0)[...]}
        self._model, self._resolution = model, resolution
        # Cells that hold all points among local centres, however the local map is turned.
        self.reach_cells = self._side = int(np.ceil((LOCAL_CELLS - 1) * LOCAL_CELL_M * np.sqrt(2) / resolution)) + 2
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        look = local_mapper(robot, self._model)
        steps = jnp.arange(self._side) * self._resolution
        prior = float(logit(self._model.prior))
        far = np.min(robot.max_ranges_m - np.hypot(*robot.mounts[:, :2].T)) >= HALF_M * np.sqrt(2)

        @jax.jit
        def patches(ranges, corner, theta):
            """Evidence of scans (m) on patches of the global map, nan where a scan says nothing.

            ``corner``: centre of each patch's first cell relative to the robot, m, world axes; ``theta``: rad.
            """
            x, y = in_robot(corner, theta, steps)
            p = jnp.clip(resample(look(ranges), in_cells(x), in_cells(y)), P_VIEW_MIN, P_VIEW_MAX)
            told = jnp.log(p / (1 - p)) - prior
            return told if far else jnp.where(within(robot, ranges, x, y), told, jnp.nan)

        self._patches = patches

    @override
    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        return batched(apart(frames, self.robot), BATCH)

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        patches = self._patches

        def work() -> Evidence:
            at = placed(batch, BATCH, self._side, self._resolution)
            evidence = np.asarray(patches(at.ranges, at.corner, at.theta))[: len(batch)]
            spoken, first = ~np.isnan(evidence), at.first[: len(batch)]
            told = _Told(first, np.where(spoken, evidence, np.float32(0)), spoken)
            return Evidence(first.min(axis=0), first.max(axis=0) + self._side, told)

        return work

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        for corner, log_odds, spoken in zip(*evidence.told, strict=True):
            grown.fuse(corner, log_odds, spoken)
            grown.window(corner, spoken.shape)["views"] += spoken
