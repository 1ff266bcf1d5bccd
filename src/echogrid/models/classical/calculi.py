"""The classical sensor models with a calculus of their own: two certainties, counters, masses, fuzzy sets.

They take one reading at a time, and leave the same numbers open as the models of ``classical``.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.grid import Layers
from echogrid.models.classical.beam import Beam, Cells
from echogrid.models.classical.log_odds import ShortReach, Told, of_probability
from echogrid.robot import Robot


@dataclass(frozen=True)
class ForAndAgainst(ShortReach):
    """What the models share whose cells keep apart what speaks for a surface and against it."""

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"empty": np.float32(0)[...], "occupied": np.float32(0)[...]}


@dataclass(frozen=True)
class MoravecElfes(ForAndAgainst):
    """Moravec & Elfes 1985: how sure it is that a cell is empty and that it is occupied, kept apart.

    The evidence for occupied is spread over the arc so that it sums to one, after the cells that are known to be
    empty have been taken out of it. A reading is used as it comes; the source takes all for empty first. Cells nearer
    than the minimum range are taken to be as empty as one at it, and the cone is as wide as the robot's beam.
    Formulas from memory of the literature.
    """

    reach_m: float = 0.8
    no_echo: bool = False
    error_m: float = 0.0942
    """Mean range error (epsilon)."""
    name: str = "moravec-elfes"

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``; an arc is weighed as a whole, also where it lies beyond ``reach_m``."""
        return min(self.reach_m + 2 * self.error_m, robot.max_range_m)

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, inside = beam.heard(), beam.inside(self.reach_m)
        across = 1 - (beam.off_axis / beam.half_width) ** 2
        depth = jnp.maximum(heard - self.error_m - beam.min_range, 1e-6)
        along = 1 - (jnp.maximum(beam.distance - beam.min_range, 0.0) / depth) ** 2
        before = inside & (beam.distance <= heard - self.error_m)
        p_empty = jnp.where(before, along * across, 0.0)
        empty = cells["empty"] + p_empty - cells["empty"] * p_empty
        arc = beam.arc(self.error_m)
        shape = 1 - ((beam.distance - heard) / self.error_m) ** 2
        p_occupied = jnp.where(arc, shape * across * (1 - empty), 0.0)
        p_occupied = p_occupied / jnp.maximum(jnp.sum(p_occupied), 1e-6)
        on_arc = arc & inside
        p_occupied = jnp.where(on_arc, p_occupied, 0.0)
        occupied = cells["occupied"] + p_occupied - cells["occupied"] * p_occupied
        return {"empty": empty, "occupied": occupied}, before | on_arc

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """The map's number in [-1, 1], brought to [0, 1]."""
        empty, occupied = cells["empty"], cells["occupied"]
        return of_probability((1 + np.where(occupied >= empty, occupied, -empty)) / 2)


@dataclass(frozen=True)
class Himm(ShortReach):
    """HIMM (Borenstein & Koren 1991): counters of 0 to 15, up 3 in the cell of the echo, down 1 on the axis before.

    Without the source's growth operator, which raises a cell more where its neighbours are high. Formulas from
    memory of the literature.
    """

    reach_m: float = 0.8
    no_echo: bool = False
    certain: float = 3.0
    """Count from which a cell is taken to be as surely occupied as at 15; 0 is surely free."""
    name: str = "himm"

    MOST, UP, DOWN = 15, 3, 1

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"count": np.float32(0)[...], "told": np.False_[...]}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``; the axis is the cells whose centre lies within half a cell of it."""
        heard, within = beam.heard(), beam.distance <= self.reach_m
        end = beam.is_cell(*beam.cell_at(heard))
        at_echo = within & end & beam.echo()
        ahead, aside = beam.distance * jnp.cos(beam.off_axis), beam.distance * jnp.sin(beam.off_axis)
        before = within & ~end & (jnp.abs(aside) <= beam.cell / 2) & (ahead > 0) & (ahead < heard)
        step = jnp.where(at_echo, self.UP, jnp.where(before, -self.DOWN, 0))
        spoken = at_echo | before
        count = jnp.clip(cells["count"] + step, 0, self.MOST)
        return {"count": count, "told": cells["told"] | spoken}, spoken

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """The share of ``certain``; a cell that no reading has told of is not free, though its count is 0 too."""
        share = np.minimum(cells["count"] / self.certain, 1.0)
        return of_probability(np.where(cells["told"], share, 0.5))


@dataclass(frozen=True)
class DempsterShafer(ForAndAgainst):
    """Dempster's rule over {empty, occupied} (Pagac, Nebot & Durrant-Whyte 1998).

    Each of the n cells of the arc gets the mass 1/n for occupied, each cell before it the mass rho for empty, and
    all that is left says nothing. Read out as the pignistic probability m(occupied) + m(either) / 2. Under Dempster's
    rule the commonalities q(A), the mass of A and of all that holds it, multiply: a cell keeps the sums of the
    logarithms of q(empty) and q(occupied), which ask for no order and do not run out of digits. No reading has mass
    for both, so that q(either) = q(empty) q(occupied). Formulas from memory of the literature.
    """

    reach_m: float = 1.6
    no_echo: bool = False
    rho: float = 0.129
    """Mass for empty of a cell that the beam has passed."""
    thickness_m: float = 0.184
    """Depth of the arc."""
    name: str = "dempster-shafer"

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``; an arc is weighed as a whole, also where it lies beyond ``reach_m``."""
        return min(self.reach_m + self.thickness_m, robot.max_range_m)

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, inside = beam.heard(), beam.inside(self.reach_m)
        half = self.thickness_m / 2
        arc = beam.arc(half)
        on_arc = arc & inside
        before = inside & (beam.distance < heard - half)
        # An arc of a single cell would be certain, and no later reading could move it.
        occupied = 1 / jnp.maximum(jnp.sum(arc), 2)
        told = {
            "empty": cells["empty"] + jnp.where(on_arc, jnp.log1p(-occupied), 0.0),
            "occupied": cells["occupied"] + jnp.where(before, np.log1p(-self.rho), 0.0),
        }
        return told, before | on_arc

    def masses(self, cells: Layers) -> tuple[Float[ndarray, "rows cols"], Float[ndarray, "rows cols"]]:
        """m(empty) and m(occupied) of each cell."""
        log_empty, log_occupied = (cells[name].astype(float) for name in ("empty", "occupied"))
        # All three over the larger: they may be too small for numbers.
        most = np.maximum(log_empty, log_occupied)
        empty, occupied, either = (
            np.exp(log_q - most) for log_q in (log_empty, log_occupied, log_empty + log_occupied)
        )
        agreed = empty + occupied - either
        return (empty - either) / agreed, (occupied - either) / agreed

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``: log of (q(occupied) - q(either) / 2) / (q(empty) - q(either) / 2)."""
        log_empty, log_occupied = (cells[name].astype(float) for name in ("empty", "occupied"))
        occupied = log_occupied + np.log1p(-np.exp(log_empty) / 2)
        empty = log_empty + np.log1p(-np.exp(log_occupied) / 2)
        return (occupied - empty).astype(np.float32)


@dataclass(frozen=True)
class Fuzzy(ForAndAgainst):
    """Fuzzy sets of empty and of occupied cells, united by Dombi's union (Oriolo, Ulivi & Vendittelli 1998).

    The union of m_1, m_2, ... is 1 / (1 + S^(-1/lambda)) with S the sum of (m / (1 - m))^lambda, so S is what a
    cell keeps. The safe cells E^2 (1 - O) (1 - E O) (1 - (1 - E)(1 - O)) are for planning; the map is read out as
    (1 + O - E) / 2. The angular profile is that of the robot's own transducer, within its beam. Formulas from memory
    of the literature.
    """

    reach_m: float = 1.3
    no_echo: bool = False
    k_empty: float = 0.0167
    k_occupied: float = 0.864
    depth_m: float = 0.157
    """Half the width of the arc (Delta)."""
    visibility_m: float = 2.57
    """Distance at which half of the evidence has faded."""
    union: float = 0.547
    """Dombi's lambda."""
    name: str = "fuzzy"

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, d, inside = beam.heard(), beam.distance, beam.inside(self.reach_m)
        fades = jnp.where(inside, beam.amplitude() * (1 - jnp.tanh(2 * (d - self.visibility_m))) / 2, 0.0)
        ramp = jnp.clip((heard - d) / self.depth_m, 0.0, 1.0) ** 2
        empty = self.k_empty * fades * ramp
        arc = jnp.maximum(0.0, 1 - ((heard - d) / self.depth_m) ** 2)
        occupied = jnp.where(beam.echo(), self.k_occupied * fades * arc, 0.0)
        told = {
            "empty": cells["empty"] + (empty / (1 - empty)) ** self.union,
            "occupied": cells["occupied"] + (occupied / (1 - occupied)) ** self.union,
        }
        return told, inside & ((empty > 0) | (occupied > 0))

    def sets(self, cells: Layers) -> tuple[Float[ndarray, "rows cols"], Float[ndarray, "rows cols"]]:
        """Membership of each cell in the empty and in the occupied cells."""
        power = 1 / self.union
        empty, occupied = (cells[name].astype(float) ** power for name in ("empty", "occupied"))
        return empty / (1 + empty), occupied / (1 + occupied)

    def safe(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """Membership of each cell in the safe cells."""
        empty, occupied = self.sets(cells)
        return empty**2 * (1 - occupied) * (1 - empty * occupied) * (1 - (1 - empty) * (1 - occupied))

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        empty, occupied = self.sets(cells)
        return of_probability((1 + occupied - empty) / 2)
