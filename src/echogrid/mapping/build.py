"""From frames to the map: the local map of each scan, its place in the world (eq. 4), and Bayes' rule."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import batched
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import P_MIN, Grid, GrowingGrid, covered, logit
from echogrid.mapping.mapper import (
    BATCH,
    FINE_CELL_M,
    SIZES,
    WINDOW_M,
    Evidence,
    Mapper,
    in_robot,
    near_each_other,
    placed,
)
from echogrid.models.beam import ReadingModel, margin_cells, reading_of, sweeper
from echogrid.models.em import ForwardModel
from echogrid.models.network import LOCAL_CELL_M, LOCAL_CELLS, Interpreter
from echogrid.models.set_network import SetNetwork
from echogrid.models.table import DEFAULT, Model, sensor_model
from echogrid.robot import Robot

ROBOT_CELLS = 4
"""The robot stands in the central 4 x 4 cells of the local map."""

P_UNDER_ROBOT = 0.1
"""Occupancy probability of the cells in which the robot stands."""

P_VIEW_MIN, P_VIEW_MAX = 0.02, 0.98
"""No single view is taken to be more certain than this."""


WORKERS = 2
"""Batches that are interpreted side by side."""


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


def _patch_side(resolution: float) -> int:
    """Cells of the global map that hold all points among local centres, however the local map is turned."""
    return int(np.ceil((LOCAL_CELLS - 1) * LOCAL_CELL_M * np.sqrt(2) / resolution)) + 2


Patcher = Callable[
    [Float[ndarray, "scans sonars"], Float[ndarray, "scans 2"], Float[ndarray, "scans"]],
    Float[Array, "scans side side"],
]


def _patcher(robot: Robot, model: Interpreter, resolution: float) -> Patcher:
    look = local_mapper(robot, model)
    steps = jnp.arange(_patch_side(resolution)) * resolution
    prior = float(logit(model.prior))

    @jax.jit
    def patches(ranges, corner, theta):
        """Evidence of scans (m) on patches of the global map, nan where a scan says nothing.

        ``corner``: centre of each patch's first cell relative to the robot, m, world axes; ``theta``: rad.
        """
        x, y = in_robot(corner, theta, steps)
        p = jnp.clip(resample(look(ranges), in_cells(x), in_cells(y)), P_VIEW_MIN, P_VIEW_MAX)
        return jnp.log(p / (1 - p)) - prior

    return patches


def cell_of(model: Model) -> float:
    """Side (m) of the cells that a model's map has unless another is asked for."""
    return FINE_CELL_M if isinstance(model, SetNetwork) else LOCAL_CELL_M


def build_map(
    frames: Iterable[Frame],
    robot: Robot,
    model: Model | str = DEFAULT,
    resolution: float | None = None,
    half_life: float | None = None,
) -> Iterator[Grid]:
    """Fuse the frames of a drive into a global map that grows as the robot drives.

    Args:
        frames: a log; each frame is read once, and not kept but by a model that needs the whole log.
        robot: the robot that drove; its mounts are in the order of the readings.
        model: a sensor model, or its name.
        resolution: side of a global cell, m; None: ``cell_of`` the model.
        half_life: time in which evidence comes to count half, s, for places that change; None: it never fades.

    Yields:
        The map so far, after each batch of frames: views of the growing arrays, not copies. A model that needs the
        whole log yields once.

    Raises:
        UsageError: the frames do not fit the robot, the map would become too large, or evidence is to fade of a model
            other than the set network.
    """
    if isinstance(model, str):
        model = sensor_model(model)
    resolution = resolution or cell_of(model)
    fitting = _fitting(frames, robot)
    if isinstance(model, SetNetwork):
        yield from _by_views(fitting, Mapper(robot, model, resolution, half_life))
        return
    if half_life is not None:
        raise UsageError(f"map: found model {model.name}, expected the set network, whose evidence can fade")
    fitting = _apart(fitting, robot)
    if isinstance(model, Interpreter):
        yield from _by_local_maps(fitting, robot, model, resolution)
    elif isinstance(model, ForwardModel):
        yield from model.maps(fitting, robot, resolution)
    else:
        yield from _by_readings(fitting, robot, model, resolution)


def _fitting(frames: Iterable[Frame], robot: Robot) -> Iterator[Frame]:
    for frame in frames:
        if len(frame.ranges) != robot.sonars:
            raise UsageError(
                f"map: found a frame of {len(frame.ranges)} readings, expected {robot.sonars} (robot {robot.name})"
            )
        yield frame


def _apart(frames: Iterator[Frame], robot: Robot) -> Iterator[Frame]:
    """Frames whose sonars all look from the robot's own mounts: others fall into one for each place of the robot."""
    for frame in frames:
        if frame.mounts is None:
            yield frame
            continue
        places = compose(frame.pose, compose(frame.mounts, inverse(robot.mounts)))
        kinds, kind = np.unique(np.round(places, 4), axis=0, return_inverse=True)
        for k in range(len(kinds)):
            same = kind == k
            ranges = np.where(same, frame.ranges, np.nan)
            if not np.isnan(ranges).all():
                yield Frame(frame.stamp, places[np.argmax(same)], ranges)


def _by_local_maps(frames: Iterator[Frame], robot: Robot, model: Interpreter, resolution: float) -> Iterator[Grid]:
    patches = _patcher(robot, model, resolution)
    grown = GrowingGrid(resolution, {"views": np.int32(0)[...]})
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[Future[_Patches]] = deque()
        for batch in batched(frames, BATCH):
            waiting.append(pool.submit(_interpret, batch, robot, patches, resolution))
            # Batches are interpreted side by side, and fused in their order.
            if len(waiting) > WORKERS:
                yield _fuse(grown, waiting.popleft().result())
        while waiting:
            yield _fuse(grown, waiting.popleft().result())


class _Patches(NamedTuple):
    """What a batch of scans adds to the global map."""

    corner: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    log_odds: Float[ndarray, "scans side side"]
    """0 where nothing is said."""
    spoken: Bool[ndarray, "scans side side"]


def _interpret(batch: tuple[Frame, ...], robot: Robot, patches: Patcher, resolution: float) -> _Patches:
    at = placed(batch, BATCH, _patch_side(resolution), resolution)
    evidence = np.asarray(patches(at.ranges, at.corner, at.theta))[: len(batch)]
    spoken = ~np.isnan(evidence)
    return _Patches(at.first[: len(batch)], np.where(spoken, evidence, np.float32(0)), spoken)


def _fuse(grown: GrowingGrid, evidence: _Patches) -> Grid:
    side = evidence.log_odds.shape[1]
    grown.reserve(evidence.corner.min(axis=0), evidence.corner.max(axis=0) + side)
    for corner, log_odds, spoken in zip(*evidence, strict=True):
        grown.fuse(corner, log_odds, spoken)
        grown.window(corner, spoken.shape)["views"] += spoken
    return grown.grid()


def _by_readings(frames: Iterator[Frame], robot: Robot, model: ReadingModel, resolution: float) -> Iterator[Grid]:
    """The map of a model that takes one reading after the other, in windows of the map that the drive passes."""
    blank = model.blank()
    grown = GrowingGrid(resolution, blank | {"stood": np.False_[...]})
    sweep = sweeper(robot, model, resolution)
    margin = margin_cells(robot, model, resolution)
    side = round(WINDOW_M / resolution) + 2 * margin + 1
    for batch in near_each_other(frames):
        poses = np.array([frame.pose for frame in batch])
        corner = np.floor(poses[:, 1::-1].min(axis=0) / resolution).astype(np.int64) - margin
        grown.reserve(corner, corner + side)
        cells = grown.window(corner, (side, side))
        # The last batch is filled up, so that one compilation serves all.
        fill = BATCH - len(batch)
        ranges = np.pad([frame.ranges for frame in batch], [(0, fill), (0, 0)], constant_values=np.nan)
        readings = reading_of(robot, np.pad(poses, [(0, fill), (0, 0)], mode="edge"), ranges, corner, resolution)
        swept = sweep({name: cells[name] for name in (*blank, "observed")}, readings)
        for name, layer in swept.items():
            cells[name][:] = layer
        cells["stood"] |= covered(poses, robot.footprint_radius_m, corner, (side, side), resolution)
        cells["observed"] |= cells["stood"]
        log_odds = model.log_odds({name: cells[name] for name in blank})
        # Whatever a model makes of the echoes, where the robot has stood there is nothing.
        cells["log_odds"][:] = np.where(cells["stood"], np.minimum(log_odds, logit(P_MIN)), log_odds)
        yield grown.grid()


def _by_views(frames: Iterator[Frame], mapper: Mapper) -> Iterator[Grid]:
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[Future[Evidence]] = deque()
        for batch in mapper.batches(frames):
            # Of one size, for a log is read in less time than another program is compiled.
            waiting.append(pool.submit(mapper.prepare(batch, SIZES[-1])))
            # Batches are interpreted side by side, and fused in their order.
            if len(waiting) > WORKERS:
                mapper.fuse(waiting.popleft().result())
                yield mapper.grid()
        while waiting:
            mapper.fuse(waiting.popleft().result())
            yield mapper.grid()
