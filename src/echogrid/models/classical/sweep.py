"""One reading after the other: the sweep of a classical model over the cells before each sonar.

Nothing is resampled: distances are those of the global cells' own centres.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.grid import P_MIN, GrowingGrid, Layers, covered, logit
from echogrid.models.batches import BATCH, WINDOW_M
from echogrid.models.classical.beam import PATTERN_STEP, Beam, Cells, Scalar
from echogrid.models.model import Evidence, Fusion, Model
from echogrid.robot import Robot, Transducer
from echogrid.simulation.acoustics import speed_of_sound
from echogrid.simulation.beam_patterns import bessel_beam


@dataclass(frozen=True)
class ReadingModel(Model):
    """A sensor model that takes one reading after the other and keeps what it knows in the cells of the map."""

    @property
    @abstractmethod
    def no_echo(self) -> bool:
        """Whether a reading without echo tells it anything; if not, ``update`` is not asked about one."""

    @abstractmethod
    def reach(self, robot: Robot) -> float:
        """Farthest cell that a reading may tell of, m from the sonar."""

    @abstractmethod
    def blank(self) -> Layers:
        """What a cell holds of which no reading has told: for each layer a number or a vector."""

    @abstractmethod
    def update(self, cells: Cells, beam: Beam) -> tuple[Cells, Bool[Array, "side side"]]:
        """The cells after a reading, and the cells of which it told. Traced by JAX."""

    @abstractmethod
    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """What the cells hold, as log-odds of being occupied."""

    @override
    def told(self) -> dict[str, Any]:
        return {"parameters": asdict(self)}

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        self.refuse_fading(half_life)
        return _Sweep(robot, self, resolution)


class _Sonar(NamedTuple):
    """What all readings of a robot share."""

    min_range: Scalar
    max_range: Scalar
    half_width: Scalar
    cell: Scalar
    pattern: Float[Array, "angles"]


class Reading(NamedTuple):
    """Readings in the order in which they are taken; arrays with a leading axis of readings."""

    range: Float[ndarray, "*n"]
    """m; inf = no echo, nan = not fired."""
    at: Float[ndarray, "*n 2"]
    """The sonar, x, y in cells of the window."""
    axis: Float[ndarray, "*n"]
    """Where it points, rad."""
    beside_at: Float[ndarray, "*n 2 2"]
    """Likewise of the two sonars whose axes are next to this one's."""
    beside_axis: Float[ndarray, "*n 2"]


Sweep = Callable[[Layers, Reading], Layers]
"""Window of the map, readings -> the window after them."""


def reading_of(
    robot: Robot,
    poses: Float[ndarray, "frames 3"],
    ranges: Float[ndarray, "frames sonars"],
    corner: Int[ndarray, "2"],
    resolution: float,
) -> Reading:
    """The readings of frames, scan by scan, relative to a window of the map.

    Args:
        robot: whose mounts are in the order of the readings.
        poses: T_world_robot, m and rad.
        ranges: m.
        corner: the window's first cell [row, col], counted from the world's origin.
        resolution: side of a cell, m.
    """
    mounts = compose(poses[:, None, :], robot.mounts[None])
    at = (mounts[..., :2] / resolution - corner[::-1]).astype(np.float32)
    axis = np.mod(mounts[..., 2], 2 * np.pi).astype(np.float32)
    by_axis = np.argsort(np.mod(robot.mounts[:, 2], 2 * np.pi), kind="stable")
    place = np.argsort(by_axis)
    beside = np.stack([by_axis[place - 1], by_axis[(place + 1) % robot.sonars]], axis=-1)
    fields = ranges.astype(np.float32), at, axis, at[:, beside], axis[:, beside]
    return Reading(*(field.reshape(-1, *field.shape[2:]) for field in fields))


def square_side(robot: Robot, model: ReadingModel, resolution: float) -> int:
    """Side of a square of cells that holds the cone of a reading, however it is turned."""
    # From the middle of the axis of a cone of length 1 to the corners of its arc, which turn with it.
    half = np.sqrt(1.25 - np.cos(min(robot.beam_width_rad / 2, np.pi / 2)))
    return int(np.ceil(2 * half * model.reach(robot) / resolution)) + 3


def margin_cells(robot: Robot, model: ReadingModel, resolution: float) -> int:
    """How far from the robot's place the squares of its readings reach, in cells."""
    mounted = float(np.max(np.hypot(robot.mounts[:, 0], robot.mounts[:, 1])))
    reach = mounted + model.reach(robot) / 2
    return int(np.ceil(reach / resolution)) + square_side(robot, model, resolution) // 2 + 2


def sweeper(robot: Robot, model: ReadingModel, resolution: float) -> Sweep:
    """The function that takes readings into a window of the map.

    The window must hold the squares of all the readings: ``margin_cells`` round each pose.
    """
    side = square_side(robot, model, resolution)
    pattern = _pattern(robot.transducer)
    numbers = (robot.min_range_m, robot.max_range_m, robot.beam_width_rad / 2, resolution)
    sonar = _Sonar(*(jnp.float32(number) for number in numbers), jnp.asarray(pattern, dtype=jnp.float32))
    reach = model.reach(robot)

    def sweep(cells: Layers, reading: Reading) -> Layers:
        swept = _sweep(model, side, reach, cells, sonar, reading)
        return {name: np.asarray(layer) for name, layer in swept.items()}

    return sweep


def _pattern(transducer: Transducer) -> Float[ndarray, "181"]:
    return bessel_beam(transducer, speed_of_sound(20.0), np.arange(181) * PATTERN_STEP)


@partial(jax.jit, static_argnames=("model", "side", "reach"))
def _sweep(model: ReadingModel, side: int, reach: float, cells: Cells, sonar: _Sonar, reading: Reading) -> Cells:
    rows = jnp.arange(side, dtype=jnp.float32)[:, None] + 0.5
    cols = jnp.arange(side, dtype=jnp.float32)[None, :] + 0.5

    def tell(cells, one):
        middle = one.at + reach / 2 / sonar.cell * jnp.stack([jnp.cos(one.axis), jnp.sin(one.axis)])
        first = jnp.round(middle - side / 2)
        x, y = cols - (one.at - first)[0], rows - (one.at - first)[1]
        bearing = jnp.arctan2(y, x)
        off_axis = _wrapped(bearing - one.axis)
        near = jnp.ones((side, side), dtype=bool)
        for k in range(2):
            to = one.beside_at[k] - first
            off = _wrapped(jnp.arctan2(rows - to[1], cols - to[0]) - one.beside_axis[k])
            near &= jnp.abs(off_axis) <= jnp.abs(off)
        distance = jnp.hypot(x, y) * sonar.cell
        beam = Beam(one.range, *sonar, one.axis, one.at - first, distance, bearing, off_axis, near)
        corner = first.astype(jnp.int32)[::-1]
        square = {
            name: jax.lax.dynamic_slice(layer, (*corner, *[0] * (layer.ndim - 2)), (side, side, *layer.shape[2:]))
            for name, layer in cells.items()
        }
        observed = square.pop("observed")
        square, spoken = model.update(square, beam)
        square["observed"] = observed | spoken
        return {
            name: jax.lax.dynamic_update_slice(layer, square[name], (*corner, *[0] * (layer.ndim - 2)))
            for name, layer in cells.items()
        }

    def step(cells, one):
        silent = jnp.isnan(one.range) if model.no_echo else ~jnp.isfinite(one.range)
        return jax.lax.cond(silent, lambda cells, _: cells, tell, cells, one), None

    return jax.lax.scan(step, cells, reading)[0]


def _wrapped(angle: Array) -> Array:
    return angle - 2 * np.pi * jnp.round(angle / (2 * np.pi))


class _Sweep(Fusion):
    """Readings are taken into windows of the map that the drive passes."""

    side_by_side = False

    def __init__(self, robot: Robot, model: ReadingModel, resolution: float):
        self._model, self._resolution = model, resolution
        self._layers = model.blank()
        self.blank = self._layers | {"stood": np.False_[...]}
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        self._sweep = sweeper(robot, self._model, self._resolution)
        self._margin = margin_cells(robot, self._model, self._resolution)
        self.reach_cells = self._side = round(WINDOW_M / self._resolution) + 2 * self._margin + 1

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        robot, margin, side = self.robot, self._margin, self._side

        def work() -> Evidence:
            poses = np.array([frame.pose for frame in batch])
            corner = np.floor(poses[:, 1::-1].min(axis=0) / self._resolution).astype(np.int64) - margin
            # The last batch is filled up, so that one compilation serves all.
            fill = [(0, BATCH - len(batch)), (0, 0)]
            ranges = np.pad([frame.ranges for frame in batch], fill, constant_values=np.nan)
            readings = reading_of(robot, np.pad(poses, fill, mode="edge"), ranges, corner, self._resolution)
            # Each reading meets the cells as those before it have left them: the sweep is for ``fuse``.
            return Evidence(corner, corner + side, (poses, readings))

        return work

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        poses, readings = evidence.told
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        shape = rows, cols
        cells = grown.window(evidence.corner, shape)
        swept = self._sweep({name: cells[name] for name in (*self._layers, "observed")}, readings)
        for name, layer in swept.items():
            cells[name][:] = layer
        cells["stood"] |= covered(poses, self.robot.footprint_radius_m, evidence.corner, shape, self._resolution)
        cells["observed"] |= cells["stood"]
        log_odds = self._model.log_odds({name: cells[name] for name in self._layers})
        # Whatever a model makes of the echoes, where the robot has stood there is nothing.
        cells["log_odds"][:] = np.where(cells["stood"], np.minimum(log_odds, logit(P_MIN)), log_odds)
