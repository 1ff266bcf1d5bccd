"""From frames to the map: the local map of each scan, its place in the world (eq. 4), and Bayes' rule."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import batched
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.beam import ReadingModel, margin_cells, reading_of, sweeper
from echogrid.em import ForwardModel
from echogrid.errors import UsageError
from echogrid.grid import P_MIN, Grid, GrowingGrid, covered, logit
from echogrid.interpret import LOCAL_CELL_M, LOCAL_CELLS, Interpreter
from echogrid.log import Frame
from echogrid.memory import TRAITS, Memory
from echogrid.models import DEFAULT, Model, sensor_model
from echogrid.robot import Robot
from echogrid.set_network import REACH_M, SetNetwork

ROBOT_CELLS = 4
"""The robot stands in the central 4 x 4 cells of the local map."""

P_UNDER_ROBOT = 0.1
"""Occupancy probability of the cells in which the robot stands."""

P_VIEW_MIN, P_VIEW_MAX = 0.02, 0.98
"""No single view is taken to be more certain than this."""

BATCH = 64
"""Scans that are interpreted together; few enough to stay in the cache."""

SUMS = ("occupied", "free", "occupied2", "free2")
"""Layers of a map that is fused by the set network: evidence for and against a surface, and of its squares."""

SIZES = (1, 8, BATCH)
"""Batches of these sizes are compiled for: one scan alone is not to wait for many."""

FINE_CELL_M = 0.04
"""Cells of the set network's map: fine enough that where a cell lies on a wall does not matter."""

WORKERS = 2
"""Batches that are interpreted side by side."""

WINDOW_M = 3.0
"""Way along an axis within which scans are taken together into one window of the map."""


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
        x, y = _in_robot(corner, theta, steps)
        p = jnp.clip(resample(look(ranges), in_cells(x), in_cells(y)), P_VIEW_MIN, P_VIEW_MAX)
        return jnp.log(p / (1 - p)) - prior

    return patches


def _in_robot(corner, theta, steps):
    """Coordinates in the robot's frame (m) of the cells of patches; see ``_patcher``."""
    x = corner[:, 0, None, None] + steps[None, None, :]
    y = corner[:, 1, None, None] + steps[None, :, None]
    cos, sin = jnp.cos(theta)[:, None, None], jnp.sin(theta)[:, None, None]
    return cos * x + sin * y, cos * y - sin * x


def cell_of(model: Model) -> float:
    """Side (m) of the cells that a model's map has unless another is asked for."""
    return FINE_CELL_M if isinstance(model, SetNetwork) else LOCAL_CELL_M


def build_map(
    frames: Iterable[Frame],
    robot: Robot,
    model: Model | str = DEFAULT,
    resolution: float | None = None,
) -> Iterator[Grid]:
    """Fuse the frames of a drive into a global map that grows as the robot drives.

    Args:
        frames: a log; each frame is read once, and not kept but by a model that needs the whole log.
        robot: the robot that drove; its mounts are in the order of the readings.
        model: a sensor model, or its name.
        resolution: side of a global cell, m; None: ``cell_of`` the model.

    Yields:
        The map so far, after each batch of frames: views of the growing arrays, not copies. A model that needs the
        whole log yields once.

    Raises:
        UsageError: the frames do not fit the robot, or the map would become too large.
    """
    if isinstance(model, str):
        model = sensor_model(model)
    resolution = resolution or cell_of(model)
    fitting = _fitting(frames, robot)
    if isinstance(model, SetNetwork):
        yield from _by_views(fitting, robot, model, resolution)
    elif isinstance(model, ForwardModel):
        yield from model.maps(fitting, robot, resolution)
    elif isinstance(model, ReadingModel):
        yield from _by_readings(fitting, robot, model, resolution)
    else:
        yield from _by_local_maps(fitting, robot, model, resolution)


def _fitting(frames: Iterable[Frame], robot: Robot) -> Iterator[Frame]:
    for frame in frames:
        if len(frame.ranges) != robot.sonars:
            raise UsageError(
                f"map: found a frame of {len(frame.ranges)} readings, expected {robot.sonars} (robot {robot.name})"
            )
        yield frame


def _by_local_maps(frames: Iterator[Frame], robot: Robot, model: Interpreter, resolution: float) -> Iterator[Grid]:
    patches = _patcher(robot, model, resolution)
    grown = GrowingGrid(resolution)
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[Future[_Evidence]] = deque()
        for batch in batched(frames, BATCH):
            waiting.append(pool.submit(_interpret, batch, robot, patches, resolution))
            # Batches are interpreted side by side, and fused in their order.
            if len(waiting) > WORKERS:
                yield _fuse(grown, waiting.popleft().result())
        while waiting:
            yield _fuse(grown, waiting.popleft().result())


class _Evidence(NamedTuple):
    """What a batch of scans adds to the global map."""

    corner: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    log_odds: Float[ndarray, "scans side side"]
    """0 where nothing is said."""
    spoken: Bool[ndarray, "scans side side"]


class _Placed(NamedTuple):
    """A batch of scans, filled up, and where its patches of the global map lie."""

    ranges: Float[ndarray, "scans sonars"]
    """m; nan behind the last scan."""
    first: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    corner: Float[ndarray, "scans 2"]
    """Centre of that cell relative to the robot, m, world axes, x first."""
    theta: Float[ndarray, "scans"]


def _placed(batch: Sequence[Frame], size: int, side: int, resolution: float) -> _Placed:
    """Fill a batch up to ``size`` scans, so that one compilation serves all."""
    fill = size - len(batch)
    poses = np.pad([frame.pose for frame in batch], [(0, fill), (0, 0)], mode="edge")
    ranges = np.pad([frame.ranges for frame in batch], [(0, fill), (0, 0)], constant_values=np.nan)
    first = np.floor(poses[:, :2] / resolution).astype(np.int64) - side // 2
    corner = ((first + 0.5) * resolution - poses[:, :2]).astype(np.float32)
    theta = np.mod(poses[:, 2], 2 * np.pi).astype(np.float32)
    return _Placed(ranges.astype(np.float32), first[:, ::-1], corner, theta)


def _interpret(batch: tuple[Frame, ...], robot: Robot, patches: Patcher, resolution: float) -> _Evidence:
    placed = _placed(batch, BATCH, _patch_side(resolution), resolution)
    evidence = np.asarray(patches(placed.ranges, placed.corner, placed.theta))[: len(batch)]
    spoken = ~np.isnan(evidence)
    return _Evidence(placed.first[: len(batch)], np.where(spoken, evidence, np.float32(0)), spoken)


def _fuse(grown: GrowingGrid, evidence: _Evidence) -> Grid:
    side = evidence.log_odds.shape[1]
    grown.reserve(evidence.corner.min(axis=0), evidence.corner.max(axis=0) + side)
    for corner, log_odds, spoken in zip(*evidence, strict=True):
        grown.fuse(corner, log_odds, spoken)
    return grown.grid()


def _by_views(frames: Iterator[Frame], robot: Robot, network: SetNetwork, resolution: float) -> Iterator[Grid]:
    """The map by the set network, which sums its evidence apart for and against a surface, window by window."""
    side = int(np.ceil(2 * REACH_M / resolution)) + 2
    span = side + int(np.ceil(WINDOW_M / resolution)) + 1
    window = _windower(robot, network, resolution, side, span)
    grown = GrowingGrid(resolution, dict.fromkeys(SUMS, np.float32(0)[...]))
    memory = Memory(robot.mounts)
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[tuple[Int[ndarray, "2"], Int[ndarray, "2"], Future]] = deque()

        def oldest() -> Grid:
            corner, end, sums = waiting.popleft()
            grown.reserve(corner, end)
            rows, cols = (int(n) for n in end - corner)
            cells = grown.window(corner, (rows, cols))
            for name, added in zip(SUMS, sums.result(), strict=True):
                cells[name] += np.asarray(added)[:rows, :cols]
            cells["observed"] |= cells["occupied"] + cells["free"] > 0
            cells["log_odds"][:] = network.fuse(*(cells[name] for name in SUMS))
            return grown.grid()

        for batch in _near_each_other(frames):
            recalled = memory.take(
                np.array([frame.pose for frame in batch]), np.array([frame.ranges for frame in batch])
            )
            size = next(size for size in SIZES if size >= len(batch))
            placed = _placed(batch, size, side, resolution)
            traits = np.full((size, TRAITS), 0.5, dtype=np.float32)
            traits[: len(batch)] = recalled.traits
            weight = np.zeros(size, dtype=np.float32)
            weight[: len(batch)] = recalled.weight
            corner = placed.first.min(axis=0)
            at = (placed.first - corner).astype(np.int32)
            work = pool.submit(window, placed.ranges, traits, placed.corner, placed.theta, at, weight)
            waiting.append((corner, placed.first.max(axis=0) + side, work))
            # Batches are interpreted side by side, and fused in their order.
            if len(waiting) > WORKERS:
                yield oldest()
        while waiting:
            yield oldest()


def _windower(robot: Robot, network: SetNetwork, resolution: float, side: int, span: int) -> Callable:
    view = network.views(robot)
    steps = jnp.arange(side) * resolution

    @jax.jit
    def window(ranges, traits, corner, theta, at, weight):
        """Sums over scans (m) on a window of the global map, see SUMS.

        ``corner``, ``theta``: as in ``_Placed``; ``at``: cell [row, col] of the window at which each patch begins;
        ``weight``: what each scan counts.
        """
        found = jax.lax.optimization_barrier(view(ranges, traits, *_in_robot(corner, theta, steps)))

        def add(sums, scan):
            found, at, weight = scan
            occupied = jnp.maximum(found, 0.0)
            free = occupied - found
            added = [weight * occupied, weight * free, weight * occupied**2, weight * free**2]
            part = [jax.lax.dynamic_slice(total, at, (side, side)) for total in sums]
            return tuple(map(lambda t, p, a: jax.lax.dynamic_update_slice(t, p + a, at), sums, part, added)), None

        blank = tuple(jnp.zeros((span, span), jnp.float32) for _ in SUMS)
        return jax.lax.scan(add, blank, (found, at, weight))[0]

    return window


def _by_readings(frames: Iterator[Frame], robot: Robot, model: ReadingModel, resolution: float) -> Iterator[Grid]:
    """The map of a model that takes one reading after the other, in windows of the map that the drive passes."""
    blank = model.blank()
    grown = GrowingGrid(resolution, blank | {"stood": np.False_[...]})
    sweep = sweeper(robot, model, resolution)
    margin = margin_cells(robot, model, resolution)
    side = round(WINDOW_M / resolution) + 2 * margin + 1
    for batch in _near_each_other(frames):
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


def _near_each_other(frames: Iterator[Frame]) -> Iterator[list[Frame]]:
    """Frames in their order, as many together as one window of the map holds."""
    batch: list[Frame] = []
    low = high = np.zeros(2)
    for frame in frames:
        place = frame.pose[:2]
        low, high = (np.minimum(low, place), np.maximum(high, place)) if batch else (place, place)
        if batch and (len(batch) == BATCH or np.any(high - low > WINDOW_M)):
            yield batch
            batch, low, high = [], place, place
        batch.append(frame)
    if batch:
        yield batch
