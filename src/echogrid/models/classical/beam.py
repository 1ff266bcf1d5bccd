"""One reading at a time: the cells before a sonar.

The classical models each have a calculus of their own (probabilities, masses, fuzzy sets, counters), which is kept
in the cells of the global map. A model is asked what a reading makes of the cells that it may tell of.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Cells = dict[str, Array]
"""What a model keeps in each cell of a square, by name; arrays [row, col] or [row, col, channel]."""

Scalar = Float[Array, ""]
Square = Float[Array, "side side"]

PATTERN_STEP = np.deg2rad(0.5)
"""From one entry of a beam's pattern to the next, rad."""


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

    def echo(self) -> Bool[Array, ""]:
        """Whether anything came back."""
        return jnp.isfinite(self.reading)

    def heard(self) -> Scalar:
        """How far the beam was free, m: the reading, or the maximum range without an echo."""
        return jnp.where(self.echo(), self.reading, self.max_range)

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

    def arc(self, half_depth: float) -> Bool[Array, "side side"]:
        """Cells in the cone as far away as the echo, give or take half the depth (m) of the arc."""
        return self.inside(np.inf) & self.echo() & (jnp.abs(self.distance - self.reading) <= half_depth)

    def density(self, sigma: Square | float) -> Square:
        """Density of the echo if it came from each cell, 1/m: normal about the cell's distance; 0 without an echo."""
        off = (self.heard() - self.distance) / sigma
        return jnp.where(self.echo(), jnp.exp(-(off**2) / 2) / (sigma * np.sqrt(2 * np.pi)), 0.0)

    def amplitude(self) -> Square:
        """One-way amplitude of the transducer towards each cell, 1 on the axis (circular piston)."""
        step = jnp.abs(self.off_axis) / PATTERN_STEP
        return jnp.interp(step, jnp.arange(len(self.pattern)), self.pattern)
