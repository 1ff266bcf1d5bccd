"""The set network's map: scans read together, their evidence summed window by window, fading if it is asked to."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.grid import Grid, GrowingGrid, Layers
from echogrid.models.memory import TRAITS, Memory
from echogrid.models.set_network import REACH_M, SetNetwork, array_of, asked, moved_view, view
from echogrid.robot import Robot

BATCH = 64
"""Scans that are interpreted together; few enough to stay in the cache."""

SIZES = (1, 8, BATCH)
"""Batches of these sizes are compiled for: one scan alone is not to wait for many."""

WINDOW_M = 3.0
"""Way along an axis within which scans are taken together into one window of the map."""

FINE_CELL_M = 0.04
"""Cells of the set network's map: fine enough that where a cell lies on a wall does not matter."""

SUMS = ("occupied", "free", "occupied2", "free2")
"""Layers of the map: evidence for and against a surface, and of its squares."""

FORGOTTEN = 0.05
"""Evidence, in log-odds, that has faded below this is none; one clear view of a surface or of a floor is 1 to 4."""

_RENEW = 32.0
"""Half-lives after which the sums are brought back to scale, long before float32 overflows."""


class Placed(NamedTuple):
    """A batch of scans, filled up, and where its patches of the global map lie."""

    ranges: Float[ndarray, "scans sonars"]
    """m; nan behind the last scan."""
    first: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    corner: Float[ndarray, "scans 2"]
    """Centre of that cell relative to the robot, m, world axes, x first."""
    theta: Float[ndarray, "scans"]


def placed(batch: Sequence[Frame], size: int, side: int, resolution: float) -> Placed:
    """Fill a batch up to ``size`` scans, so that one compilation serves all."""
    fill = size - len(batch)
    poses = np.pad([frame.pose for frame in batch], [(0, fill), (0, 0)], mode="edge")
    ranges = np.pad([frame.ranges for frame in batch], [(0, fill), (0, 0)], constant_values=np.nan)
    first = np.floor(poses[:, :2] / resolution).astype(np.int64) - side // 2
    corner = ((first + 0.5) * resolution - poses[:, :2]).astype(np.float32)
    theta = np.mod(poses[:, 2], 2 * np.pi).astype(np.float32)
    return Placed(ranges.astype(np.float32), first[:, ::-1], corner, theta)


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


def near_each_other(frames: Iterable[Frame], span_s: float = np.inf) -> Iterator[list[Frame]]:
    """Frames in their order, as many together as one window of the map holds, and of at most so long a time."""
    batch: list[Frame] = []
    low = high = np.zeros(2)
    for frame in frames:
        place = frame.pose[:2]
        low, high = (np.minimum(low, place), np.maximum(high, place)) if batch else (place, place)
        late = bool(batch) and frame.stamp - batch[0].stamp > span_s
        if batch and (len(batch) == BATCH or late or np.any(high - low > WINDOW_M)):
            yield batch
            batch, low, high = [], place, place
        batch.append(frame)
    if batch:
        yield batch


class Evidence(NamedTuple):
    """What a batch of scans adds to the map."""

    corner: Int[ndarray, "2"]
    """Global cell [row, col] of the window's first cell."""
    end: Int[ndarray, "2"]
    """Global cell behind its last."""
    sums: Sequence[Float[Array, "span span"]]
    """See SUMS, and last the scans that spoke; cells past the end are to be left out."""
    stamp: float
    """Time of the last scan, s."""
    epoch: float
    """Time at which evidence counts as it is, s; what is later counts more, where evidence fades."""


class Mapper:
    """Builds the map of one drive, scan by scan."""

    def __init__(
        self, robot: Robot, network: SetNetwork, resolution: float | None = None, half_life: float | None = None
    ):
        """An empty map.

        Args:
            robot: the robot that drives; its mounts are in the order of the readings.
            network: the sensor model.
            resolution: side of a cell, m; None: FINE_CELL_M.
            half_life: time in which evidence comes to count half, s; None: it never fades.
        """
        self.half_life = half_life
        self.resolution = resolution or FINE_CELL_M
        self._network = network
        self._side = int(np.ceil(2 * REACH_M / self.resolution)) + 2
        span = self._side + int(np.ceil(WINDOW_M / self.resolution)) + 1
        self._sizes = {"resolution": self.resolution, "side": self._side, "span": span}
        blank = dict.fromkeys(SUMS, np.float32(0)[...]) | {"views": np.int32(0)[...]}
        self._grown = GrowingGrid(self.resolution, blank)
        self.equip(robot)
        self._epoch, self._summed_epoch, self._now = -np.inf, -np.inf, -np.inf

    def equip(self, robot: Robot) -> None:
        """Go on with another array of sonars; the map stays, what was remembered of the surroundings does not."""
        self.robot = robot
        array = array_of(robot.mounts, robot.max_range_m, robot.footprint_radius_m)
        given = jax.tree.map(jnp.asarray, (self._network.weights, array))
        self._window = partial(_window, *given, **self._sizes)
        self._memory = Memory(robot.mounts, self.half_life)

    def add(self, frames: Iterable[Frame]) -> None:
        """Take scans into the map at once, in their order.

        Raises:
            UsageError: a frame has another number of readings than the robot has sonars, or the map would become
                too large.
        """
        for batch in self.batches(frames):
            self.fuse(self.prepare(batch)())

    def batches(self, frames: Iterable[Frame]) -> Iterator[list[Frame]]:
        """Frames in their order, as many together as ``prepare`` takes at once."""
        return near_each_other(frames, np.inf if self.half_life is None else _RENEW * self.half_life)

    def prepare(self, batch: Sequence[Frame], size: int | None = None) -> Callable[[], Evidence]:
        """Look up what scans near each other are to be read with; what is returned reads them, in any thread.

        Batches are to be prepared in their order, and what comes of them fused in it.

        Args:
            batch: scans as of ``batches``.
            size: one of SIZES, to which the batch is filled up; None: the smallest that holds it. Each is a program
                to compile, which takes a second or more.
        """
        stamps = np.array([frame.stamp for frame in batch])
        recalled = self._memory.take(
            np.array([frame.pose for frame in batch]), np.array([frame.ranges for frame in batch]), stamps
        )
        size = size or next(size for size in SIZES if size >= len(batch))
        at = placed(batch, size, self._side, self.resolution)
        traits = np.full((size, TRAITS), 0.5, dtype=np.float32)
        traits[: len(batch)] = recalled.traits
        weight = np.zeros(size, dtype=np.float32)
        weight[: len(batch)] = recalled.weight
        if self.half_life is not None:
            if (stamps[0] - self._epoch) / self.half_life > _RENEW:
                self._epoch = float(stamps[0])
            # Rather than let all that was summed fade, what is new counts more.
            weight[: len(batch)] *= np.exp2((stamps - self._epoch) / self.half_life)
        mounts = None
        if any(frame.mounts is not None for frame in batch):
            looked = np.tile(self.robot.mounts, (size, 1, 1))
            for k, frame in enumerate(batch):
                looked[k] = looked[k] if frame.mounts is None else frame.mounts
            mounts = looked.astype(np.float32), asked(looked)
        corner, end = at.first.min(axis=0), at.first.max(axis=0) + self._side
        rows = (at.first - corner).astype(np.int32)
        stamp, epoch = float(stamps.max()), self._epoch

        def read() -> Evidence:
            sums = self._window(at.ranges, traits, at.corner, at.theta, rows, weight, mounts)
            return Evidence(corner, end, sums, stamp, epoch)

        return read

    def fuse(self, evidence: Evidence) -> None:
        """Add what a batch brought.

        Raises:
            UsageError: the map would become too large.
        """
        self._grown.reserve(evidence.corner, evidence.end)
        if evidence.epoch > self._summed_epoch:
            self._renew(evidence.epoch)
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        cells = self._grown.window(evidence.corner, (rows, cols))
        for name, added in zip((*SUMS, "views"), evidence.sums, strict=True):
            cells[name] += np.asarray(added)[:rows, :cols]
        self._now = max(self._now, evidence.stamp)
        if self.half_life is None:
            self._read_out(cells)

    def _renew(self, epoch: float) -> None:
        if self.half_life is not None and self._summed_epoch > -np.inf:
            faded = np.float32(np.exp2((self._summed_epoch - epoch) / self.half_life))
            cells = self._grown.layers()
            for name in SUMS:
                cells[name] *= faded
        self._summed_epoch = epoch

    def _read_out(self, cells: Layers) -> None:
        sums = [cells[name] for name in SUMS]
        if self.half_life is None:
            cells["observed"] |= cells["views"] > 0
            cells["log_odds"][:] = self._network.fuse(*sums)
            return
        faded = np.float32(np.exp2((self._summed_epoch - self._now) / self.half_life))
        sums = [faded * layer for layer in sums]
        cells["observed"][:] = sums[0] + sums[1] > FORGOTTEN
        cells["log_odds"][:] = np.where(cells["observed"], self._network.fuse(*sums), np.float32(0))

    def grid(self) -> Grid:
        """The map so far: views of the growing arrays, not copies."""
        if self.half_life is not None:
            self._read_out(self._grown.layers())
        return self._grown.grid()

    def around(self, x: float, y: float, side_m: float) -> Grid:
        """A square of the map round a point, a copy.

        Args:
            x: of the point, m, world.
            y: likewise.
            side_m: side of the square, m; it is filled with what nobody spoke of where the map ends.
        """
        cells = round(side_m / self.resolution)
        corner = np.floor(np.array([y, x]) / self.resolution).astype(np.int64) - cells // 2
        if self.half_life is not None:
            self._read_out(self._grown.overlap(corner, (cells, cells)))
        return self._grown.part(corner, (cells, cells))


@partial(jax.jit, static_argnames=("resolution", "side", "span"))
def _window(weights, array, ranges, traits, corner, theta, at, weight, mounts, *, resolution, side, span):
    """Sums over scans (m) on a window of the global map, see SUMS.

    ``weights``, ``array``: of the network and of the robot, which arrays of one size share a compilation of;
    ``corner``, ``theta``: as in ``Placed``; ``at``: cell [row, col] of the window at which each patch begins;
    ``weight``: what each scan counts; ``mounts``: from where the sonars of each scan looked and which are asked for
    each bearing, None: as on the robot.
    """
    x, y = in_robot(corner, theta, jnp.arange(side) * resolution)
    if mounts is None:
        found = view(weights, array, ranges, traits, x, y)
    else:
        found = moved_view(weights, array, ranges, traits, x, y, *mounts)
    found = jax.lax.optimization_barrier(found)

    def add(sums, scan):
        found, at, weight = scan
        occupied = jnp.maximum(found, 0.0)
        free = occupied - found
        spoke = ((found != 0.0) & (weight > 0.0)).astype(jnp.int32)
        added = [weight * occupied, weight * free, weight * occupied**2, weight * free**2, spoke]
        part = [jax.lax.dynamic_slice(total, at, (side, side)) for total in sums]
        return tuple(map(lambda t, p, a: jax.lax.dynamic_update_slice(t, p + a, at), sums, part, added)), None

    blank = [jnp.zeros((span, span), jnp.float32) for _ in SUMS]
    return jax.lax.scan(add, (*blank, jnp.zeros((span, span), jnp.int32)), (found, at, weight))[0]
