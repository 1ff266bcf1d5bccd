"""One reading at a time: the cells before a sonar, and the sweep of a model over them.

The classical models each have a calculus of their own (probabilities, masses, fuzzy sets, counters), which is kept
in the cells of the global map. A model is asked what a reading makes of the cells that it may tell of; the sweep
finds them. Nothing is resampled: distances are those of the global cells' own centres.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.geometry import compose
from echogrid.grid import Layers
from echogrid.robot import Robot, Transducer
from echogrid.simulation.acoustics import bessel_beam, speed_of_sound

Cells = dict[str, Array]
"""What a model keeps in each cell of a square, by name; arrays [row, col] or [row, col, channel]."""

Scalar = Float[Array, ""]
Square = Float[Array, "side side"]

_PATTERN_STEP = np.deg2rad(0.5)


class Beam(NamedTuple):
    """A reading and the square of cells round the cone of its sonar. Arrays are indexed [row, col]."""

    reading: Scalar
    """m; inf = no echo."""
    min_range: Scalar
    """m."""
    max_range: Scalar
    """m."""
    half_width: Scalar
    """Half the full width of the cone, rad."""
    cell: Scalar
    """Side of a cell, m."""
    pattern: Float[Array, "angles"]
    """One-way amplitude of the transducer in steps of 0.5 degrees off the axis; see ``amplitude``."""
    axis: Scalar
    """Where the sonar points in the world, rad."""
    at: Float[Array, "2"]
    """Where the sonar is: x, y in cells; the cell [row, col] of the square covers [col, col + 1) x [row, row + 1)."""
    distance: Square
    """From the sonar to each cell's centre, m."""
    bearing: Square
    """Of each cell's centre from the sonar, in the world, rad."""
    off_axis: Square
    """The bearing less the axis, rad, in [-pi, pi)."""
    nearest: Bool[Array, "side side"]
    """Whether no sonar beside this one has its axis nearer to the cell."""

    def heard(self) -> Scalar:
        """How far the beam was free, m: the reading, or the maximum range without an echo."""
        return jnp.where(jnp.isfinite(self.reading), self.reading, self.max_range)

    def cell_at(self, distance: Scalar, turn: Scalar | float = 0.0) -> tuple[Scalar, Scalar]:
        """Row and column of the cell at a distance (m) from the sonar, so far (rad) off the axis."""
        to = self.axis + turn
        place = jnp.floor(self.at + distance / self.cell * jnp.stack([jnp.cos(to), jnp.sin(to)]))
        return place[1], place[0]

    def is_cell(self, row: Scalar, col: Scalar) -> Bool[Array, "side side"]:
        """The cell of that row and column alone."""
        rows, cols = jnp.indices(self.distance.shape)
        return (rows == row) & (cols == col)

    def inside(self, reach: float) -> Bool[Array, "side side"]:
        """Cells in the cone no farther than ``reach`` (m), nor than the maximum range."""
        near = self.distance <= jnp.minimum(reach, self.max_range)
        return (jnp.abs(self.off_axis) <= self.half_width) & near

    def amplitude(self) -> Square:
        """One-way amplitude of the transducer towards each cell, 1 on the axis (circular piston)."""
        step = jnp.abs(self.off_axis) / _PATTERN_STEP
        return jnp.interp(step, jnp.arange(len(self.pattern)), self.pattern)


@runtime_checkable
class ReadingModel(Protocol):
    """A sensor model that takes one reading after the other and keeps what it knows in the cells of the map."""

    @property
    def name(self) -> str:
        """Name for reports."""
        ...

    @property
    def no_echo(self) -> bool:
        """Whether a reading without echo tells it anything; if not, ``update`` is not asked about one."""
        ...

    def reach(self, robot: Robot) -> float:
        """Farthest cell that a reading may tell of, m from the sonar."""
        ...

    def blank(self) -> Layers:
        """What a cell holds of which no reading has told: for each layer a number or a vector."""
        ...

    def update(self, cells: Cells, beam: Beam) -> tuple[Cells, Bool[Array, "side side"]]:
        """The cells after a reading, and the cells of which it told. Traced by JAX."""
        ...

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """What the cells hold, as log-odds of being occupied."""
        ...


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
    return bessel_beam(transducer, speed_of_sound(20.0), np.arange(181) * _PATTERN_STEP)


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
