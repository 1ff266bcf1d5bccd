"""The paper's local map: what a scan, read as a whole, says of a square round the robot, and its place in the world.

An interpreter answers for each cell of the square; eq. 4 resamples the square into the cells of the global map, and
Bayes' rule fuses it there.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import batched
from typing import NamedTuple, override

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid import _core
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

ON_LOG_ODDS = False
"""Whether eq. 4 takes the mean of log-odds in place of probabilities; for the study of what that is worth."""

UNSPOKEN, UNSPOKEN_ON_LOG_ODDS = 4.0, 100.0
"""To the core what is not spoken of rides with its value, so much below it."""

Bound = Callable[
    [Float[ndarray, "scans sonars"]], tuple[Float[ndarray, "scans points"], Bool[ndarray, "scans points"]]
]
"""Scans -> occupancy probability of each point under the interpreter's prior, and where the scan spoke at all."""


class Interpreter(Model):
    """A sensor model that reads all sonars of a scan at once. Its views are fused by Bayes' rule."""

    prior: float
    """Occupancy probability that the model gives a point of which it knows nothing."""

    @abstractmethod
    def bind(self, robot: Robot, p_robot: Float[ndarray, "points 2"]) -> Bound:
        """Prepare for the points (m, robot frame) of a local map."""

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        self.refuse_fading(half_life)
        return _Patches(robot, self, resolution)


class LocalMap(NamedTuple):
    """What each scan of a batch says of the square round the robot; cells [row, col], row 0 the lowest y."""

    probability: Float[ndarray, "scans 24 24"]
    spoken: Bool[ndarray, "scans 24 24"]
    """Where the scan says anything; elsewhere the probability is the interpreter's prior."""


def local_cells() -> Float[ndarray, "576 2"]:
    """Centres of the local map's cells in the robot's frame (m), row by row from the lowest y."""
    axis = (np.arange(LOCAL_CELLS) + 0.5 - LOCAL_CELLS / 2) * LOCAL_CELL_M
    x, y = np.meshgrid(axis, axis)
    return np.column_stack([x.ravel(), y.ravel()])


def local_mapper(robot: Robot, model: Interpreter) -> Callable[[Float[ndarray, "scans sonars"]], LocalMap]:
    """The function that turns scans (m) into local maps: one question to the interpreter for each cell."""
    cells = local_cells()
    ask = model.bind(robot, cells)
    middle = np.max(np.abs(cells), axis=1) < ROBOT_CELLS / 2 * LOCAL_CELL_M
    under = middle & (np.hypot(*cells.T) < robot.footprint_radius_m)
    # The floor under the robot is free under the interpreter's prior as well.
    p_under = 1 / (1 + np.exp(-(logit(P_UNDER_ROBOT) + logit(model.prior))))

    def look(ranges: Float[ndarray, "scans sonars"]) -> LocalMap:
        probability, spoken = ask(ranges)
        probability = np.where(under, np.float32(p_under), probability)
        shape = (-1, LOCAL_CELLS, LOCAL_CELLS)
        return LocalMap(probability.reshape(shape), (spoken | under).reshape(shape))

    return look


def in_cells(metres: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """A coordinate in the robot's frame (m) in cells, counted from the centre of the first."""
    return np.asarray(metres) / LOCAL_CELL_M + (LOCAL_CELLS - 1) / 2


def coded(local: LocalMap) -> Float[ndarray, "scans 576"]:
    """Local maps as the core takes them: what is not spoken of lies so much lower that it is no value."""
    value, apart = local.probability, UNSPOKEN
    if ON_LOG_ODDS:
        value, apart = logit(np.clip(value, 1e-9, 1 - 1e-7)), UNSPOKEN_ON_LOG_ODDS
    return np.where(local.spoken, value, value - apart).reshape(-1, LOCAL_CELLS**2).astype(np.float32)


class _Told(NamedTuple):
    """What a batch of scans adds to the global map."""

    add: Callable[[Float[ndarray, "rows cols"], Bool[ndarray, "rows cols"], Int[ndarray, "rows cols"]], None]
    """Adds it to the window's log-odds, observed cells and views."""


class _Patches(Fusion):
    """Each scan is a patch of the global map, added to its log-odds."""

    side_by_side = False

    def __init__(self, robot: Robot, model: Interpreter, resolution: float):
        self.blank = {"views": np.int32(0)[...]}
        self._model, self._resolution = model, resolution
        # Cells that hold all points among local centres, however the local map is turned.
        self.reach_cells = self._side = int(np.ceil((LOCAL_CELLS - 1) * LOCAL_CELL_M * np.sqrt(2) / resolution)) + 2
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        self._look = local_mapper(robot, self._model)
        far = np.min(robot.max_ranges_m - np.hypot(*robot.mounts[:, :2].T)) >= HALF_M * np.sqrt(2)
        beams = None if far else np.column_stack([robot.mounts, robot.max_ranges_m]).astype(np.float32)
        prior, footprint = float(logit(self._model.prior)), robot.footprint_radius_m
        self._rule = _core.LocalFusion(
            prior, P_VIEW_MIN, P_VIEW_MAX, ON_LOG_ODDS, footprint, beams, float(np.cos(CONE_RAD))
        )

    @override
    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        return batched(apart(frames, self.robot), BATCH)

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        look, rule = self._look, self._rule

        def work() -> Evidence:
            at = placed(np.array([frame.pose for frame in batch]), self._side, self._resolution)
            ranges = np.array([frame.ranges for frame in batch], dtype=np.float32)
            told = coded(look(ranges))
            add = partial(rule.add, told, ranges, at.centre, at.theta, at.first, self._resolution)
            return Evidence(at.corner, at.end, _Told(add))

        return work

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        cells = grown.window(evidence.corner, (rows, cols))
        evidence.told.add(cells["log_odds"], cells["observed"], cells["views"])
