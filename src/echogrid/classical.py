"""The classical sensor models, one reading at a time.

Where a source leaves a number open it is a field of the model, and its default was chosen by one search that is the
same for all models (experiments/tune.py); ``reach_m`` and ``no_echo`` are such numbers of every model. No echo, where
it is used, is a reading at the maximum range of which nothing came back. Formulas: docs/method.md.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy import ndarray

from echogrid.beam import Beam, Cells
from echogrid.grid import Layers, logit
from echogrid.robot import Robot

Told = tuple[Cells, Bool[Array, "side side"]]

EVIDENCE = {"evidence": np.float32(0)[...]}
"""The one layer of the models that add up log-odds."""


def _heard_m(beam: Beam) -> Float[Array, ""]:
    """How far the beam was free: the reading, or the maximum range without an echo."""
    return jnp.where(jnp.isfinite(beam.reading), beam.reading, beam.max_range)


def _added(cells: Cells, evidence: Float[Array, "side side"], spoken: Bool[Array, "side side"]) -> Told:
    return {"evidence": cells["evidence"] + jnp.where(spoken, evidence, 0.0)}, spoken


@dataclass(frozen=True)
class _Short:
    """What the models share that trust readings up to a reach."""

    reach_m: float
    """Cells farther from the sonar are left alone."""
    no_echo: bool
    """Whether a reading without echo frees the cells before the maximum range."""

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``."""
        return min(self.reach_m, robot.max_range_m)


@dataclass(frozen=True)
class Cone(_Short):
    """The simple inverse model (Thrun, Burgard & Fox, Probabilistic Robotics, table 9.2)."""

    reach_m: float = 1.3
    no_echo: bool = False
    p_occupied: float = 0.607
    p_free: float = 0.459
    thickness_m: float = 0.138
    """Depth of the arc that is called occupied (alpha)."""
    name: str = "cone"

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return EVIDENCE

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``; only the sonar whose axis is nearest tells of a cell."""
        heard, half = _heard_m(beam), self.thickness_m / 2
        spoken = beam.inside(self.reach_m) & beam.nearest & (beam.distance <= heard + half)
        struck = jnp.isfinite(beam.reading) & (jnp.abs(beam.distance - heard) < half)
        spoken &= struck | (beam.distance <= heard)
        return _added(cells, jnp.where(struck, logit(self.p_occupied), logit(self.p_free)), spoken)

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return cells["evidence"]


@dataclass(frozen=True)
class MoravecElfes(_Short):
    """Moravec & Elfes 1985: how sure it is that a cell is empty and that it is occupied, kept apart.

    The evidence for occupied is spread over the arc so that it sums to one, after the cells that are known to be
    empty have been taken out of it. A reading is used as it comes; the source takes all for empty first. Cells nearer
    than the minimum range are taken to be as empty as one at it, and the cone is as wide as the robot's beam.
    """

    reach_m: float = 0.8
    no_echo: bool = False
    error_m: float = 0.0942
    """Mean range error (epsilon)."""
    name: str = "moravec-elfes"

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``; an arc is weighed as a whole, also where it lies beyond ``reach_m``."""
        return min(self.reach_m + 2 * self.error_m, robot.max_range_m)

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"empty": np.float32(0)[...], "occupied": np.float32(0)[...]}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, inside = _heard_m(beam), beam.inside(self.reach_m)
        across = 1 - (beam.off_axis / beam.half_width) ** 2
        depth = jnp.maximum(heard - self.error_m - beam.min_range, 1e-6)
        along = 1 - (jnp.maximum(beam.distance - beam.min_range, 0.0) / depth) ** 2
        before = inside & (beam.distance <= heard - self.error_m)
        p_empty = jnp.where(before, along * across, 0.0)
        empty = cells["empty"] + p_empty - cells["empty"] * p_empty
        arc = beam.inside(np.inf) & jnp.isfinite(beam.reading) & (jnp.abs(beam.distance - heard) <= self.error_m)
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
        return _of_probability((1 + np.where(occupied >= empty, occupied, -empty)) / 2)


@dataclass(frozen=True)
class Elfes(_Short):
    """Elfes 1989, Matthies & Elfes 1988: Gaussian error in range and angle, and Bayes' rule in each cell.

    A cell at distance z that is occupied sends the echo with a probability that falls off as a Gaussian of its
    bearing; the reading is then normal about z. Otherwise the reading is that of something else, which may be
    anywhere. p(r | occupied) = a N(r; z, sigma) + (1 - a Phi((r - z) / sigma)) / range, p(r | empty) = 1 / range.
    """

    reach_m: float = 1.6
    no_echo: bool = False
    p_hit: float = 0.193
    """Probability that an occupied cell on the axis sends the echo (a)."""
    sigma_m: float = 0.0449
    """Standard deviation of the range."""
    sigma_rad: float = 0.0746
    """Standard deviation of the bearing."""
    name: str = "elfes"

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return EVIDENCE

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        struck = self.p_hit * jnp.exp(-((beam.off_axis / self.sigma_rad) ** 2) / 2)
        off = (_heard_m(beam) - beam.distance) / self.sigma_m
        density = jnp.exp(-(off**2) / 2) / (self.sigma_m * np.sqrt(2 * np.pi)) * beam.max_range
        density = jnp.where(jnp.isfinite(beam.reading), density, 0.0)
        evidence = jnp.log(struck * density + 1 - struck * _normal_cdf(off))
        return _added(cells, evidence, beam.inside(self.reach_m) & (off > -3))

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return cells["evidence"]


@dataclass(frozen=True)
class Nav2:
    """The RangeSensorLayer of Nav2, as shipped: cells of 8 bits, truncated at each update.

    A reading sets the cell at its end to 233 of 254 before the cells of the cone are updated by Bayes' rule. Without
    ``no_echo`` a missing echo is dropped; with it (clear_on_max_reading) it clears the axis-parallel box round the
    cone. Source: navigation2, range_sensor_layer.cpp, with its defaults (inflate_cone 1).
    """

    phi_m: float = 1.2
    """Distance at which half of the evidence has faded."""
    no_echo: bool = False
    name: str = "nav2"

    LETHAL, TARGET, BEYOND = 254.0, 233.0, 1.2

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``."""
        return self.BEYOND * robot.max_range_m

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"cost": np.float32(127)[...]}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, phi = _heard_m(beam), beam.distance
        echo = jnp.isfinite(beam.reading)
        row, col = jnp.arange(phi.shape[0])[:, None], jnp.arange(phi.shape[1])[None, :]

        def cell_at(distance: Array, turn: Array) -> tuple[Array, Array]:
            to = beam.axis + turn
            place = beam.at + distance / beam.cell * jnp.stack([jnp.cos(to), jnp.sin(to)])
            return jnp.floor(place[1]), jnp.floor(place[0])

        ends = [cell_at(jnp.float32(0), jnp.float32(0))]
        ends += [cell_at(self.BEYOND * heard, turn) for turn in (-beam.half_width, beam.half_width)]
        low, high = (tuple(f(jnp.stack(v)) for v in zip(*ends, strict=True)) for f in (jnp.min, jnp.max))
        box = (row >= low[0]) & (row <= high[0]) & (col >= low[1]) & (col <= high[1])

        target_row, target_col = cell_at(heard, jnp.float32(0))
        target = (row == target_row) & (col == target_col)
        prior = jnp.where(target, self.TARGET, cells["cost"]) / self.LETHAL
        sensor = jnp.where(echo, self._sensor(beam, heard), 0.0)
        told = sensor * prior / jnp.maximum(sensor * prior + (1 - sensor) * (1 - prior), 1e-9)
        # The small term keeps a product that is whole in exact arithmetic from being truncated to the one below.
        cost = jnp.floor(told * self.LETHAL + 1e-3)
        changed = box & (sensor != 0.5)
        cost = jnp.where(changed, cost, jnp.where(target, self.TARGET, cells["cost"]))
        return {"cost": cost}, changed | target

    def _sensor(self, beam: Beam, r: Array) -> Float[Array, "side side"]:
        phi, theta = beam.distance, beam.off_axis
        gamma = jnp.where(jnp.abs(theta) > beam.half_width, 0.0, 1 - (theta / beam.half_width) ** 2)
        strength = gamma * (1 - (1 + jnp.tanh(2 * (phi - self.phi_m))) / 2)
        width = beam.cell * r
        free = (1 - strength) / 2
        rising = strength / 2 * ((phi - (r - 2 * width)) / width) ** 2 + free
        arc = strength * (0.5 - ((r - phi) / width) ** 2 / 2) + 0.5
        edges = [phi < r - 2 * width, phi < r - width, phi < r + width]
        # Where the strength is 0 the three are 0.5, and the cell stays as it is.
        return jnp.where(strength == 0, 0.5, jnp.select(edges, [free, rising, arc], 0.5))

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return _of_probability(cells["cost"] / self.LETHAL)


@dataclass(frozen=True)
class Himm(_Short):
    """HIMM (Borenstein & Koren 1991): counters of 0 to 15 on the acoustic axis, up 3 at the echo, down 1 before.

    Without the source's growth operator, which raises a cell more where its neighbours are high.
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
        heard = _heard_m(beam)
        ahead = beam.distance * jnp.cos(beam.off_axis)
        on_axis = (jnp.abs(beam.distance * jnp.sin(beam.off_axis)) <= beam.cell / 2) & (ahead > 0)
        on_axis &= beam.distance <= self.reach_m
        at_echo = on_axis & jnp.isfinite(beam.reading) & (jnp.abs(ahead - heard) <= beam.cell / 2)
        before = on_axis & (ahead < heard - beam.cell / 2)
        step = jnp.where(at_echo, self.UP, jnp.where(before, -self.DOWN, 0))
        spoken = at_echo | before
        count = jnp.clip(cells["count"] + step, 0, self.MOST)
        return {"count": count, "told": cells["told"] | spoken}, spoken

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """The share of ``certain``; a cell that no reading has told of is not free, though its count is 0 too."""
        share = np.minimum(cells["count"] / self.certain, 1.0)
        return _of_probability(np.where(cells["told"], share, 0.5))


@dataclass(frozen=True)
class Muriel(_Short):
    """MURIEL (Konolige 1997): the first echo, no reading twice from one place, and specular readings discounted.

    An occupied cell at z gives the reading x the density a(z) N(x; z, d(z)) + F, and a reading D is the first echo:
    p(D | C) = f(D | C) (1 - integral of f up to D); p(D | not C) = F (1 - F D). A reading that has passed through
    cells that were seen occupied at normal incidence is specular with probability P_s, and its evidence becomes
    log(P_s + (1 - P_s) exp(evidence)). a(z) falls off the axis as the transducer's two-way amplitude; the normal is
    widened by the depth of a cell; P_s grows with how sure the passed cell is, and off the axis falls with it.
    """

    reach_m: float = 1.6
    no_echo: bool = True
    strength: float = 0.48
    """a(z) on the axis at z = 0; it falls to 0 at 4 m."""
    background: float = 0.285
    """F: density of readings from elsewhere, 1/m."""
    specular: float = 0.376
    """P_s of a reading that passed through a surely occupied cell."""
    name: str = "muriel"

    BEARINGS, DEPTH_M, DEPTHS = 24, 0.3, 14
    """A cell takes one reading for each 15 degrees of bearing and 30 cm of distance to the sonar."""

    def blank(self) -> Layers:
        """See ``ReadingModel``; ``taken`` has a bit for each bearing, a word for each distance."""
        return EVIDENCE | {"normal": np.float32(0)[...], "taken": np.zeros(self.DEPTHS, dtype=np.uint32)}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, z = _heard_m(beam), beam.distance
        inside = beam.inside(self.reach_m)
        spread = 0.01 + 0.015 * z
        strength = self.strength * jnp.maximum(0.0, 1 - z / 4) * beam.amplitude() ** 2
        off = (heard - z) / spread
        # A cell is as deep as the map has it: the echo comes from somewhere within.
        blur = jnp.sqrt(spread**2 + beam.cell**2 / 12)
        density = jnp.exp(-(((heard - z) / blur) ** 2) / 2) / (blur * np.sqrt(2 * np.pi))
        density = jnp.where(jnp.isfinite(beam.reading), density, 0.0)
        before = strength * _normal_cdf(off) + self.background * heard
        first = jnp.maximum(1 - before, 1e-3) / jnp.maximum(1 - self.background * heard, 1e-3)
        evidence = jnp.log((strength * density + self.background) / self.background * first)
        evidence = jnp.where(off > -4, evidence, 0.0)

        passed = inside & (z < heard - 2 * blur)
        p_normal = 1 / (1 + jnp.exp(-cells["normal"]))
        wall = jnp.where(passed & (cells["normal"] > 0), (2 * p_normal - 1) * beam.amplitude(), 0.0)
        p_specular = self.specular * jnp.max(wall)
        evidence = jnp.log(p_specular + (1 - p_specular) * jnp.exp(evidence))

        sector = jnp.floor(jnp.mod(beam.bearing, 2 * np.pi) / (2 * np.pi) * self.BEARINGS).astype(jnp.uint32)
        ring = jnp.minimum(z / self.DEPTH_M, self.DEPTHS - 1).astype(jnp.int32)
        bit = jnp.left_shift(jnp.uint32(1), jnp.minimum(sector, self.BEARINGS - 1))
        mark = jnp.where(ring[..., None] == jnp.arange(self.DEPTHS), bit[..., None], jnp.uint32(0))
        fresh = jnp.all(cells["taken"] & mark == 0, axis=-1)
        spoken = inside & (off > -4) & fresh
        told = jnp.where(spoken, evidence, 0.0)
        head_on = jnp.abs(beam.off_axis) <= np.deg2rad(7.5)
        return {
            "evidence": cells["evidence"] + told,
            "normal": cells["normal"] + jnp.where(head_on, told, 0.0),
            "taken": jnp.where(spoken[..., None], cells["taken"] | mark, cells["taken"]),
        }, spoken

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return cells["evidence"]


@dataclass(frozen=True)
class DempsterShafer(_Short):
    """Dempster's rule over {empty, occupied} (Pagac, Nebot & Durrant-Whyte 1998).

    Each of the n cells of the arc gets the mass 1/n for occupied, each cell before it the mass rho for empty, and
    all that is left says nothing. Read out as the pignistic probability m(occupied) + m(either) / 2.
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

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"empty": np.float32(0)[...], "occupied": np.float32(0)[...]}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, inside = _heard_m(beam), beam.inside(self.reach_m)
        half = self.thickness_m / 2
        arc = beam.inside(np.inf) & jnp.isfinite(beam.reading) & (jnp.abs(beam.distance - heard) <= half)
        on_arc = arc & inside
        before = inside & (beam.distance < heard - half)
        # An arc of a single cell would be certain, and no later reading could move it.
        occupied = jnp.where(on_arc, 1 / jnp.maximum(jnp.sum(arc), 2), 0.0)
        empty = jnp.where(before, self.rho, 0.0)
        old_empty, old_occupied = cells["empty"], cells["occupied"]
        either, old_either = 1 - empty - occupied, 1 - old_empty - old_occupied
        agreed = jnp.maximum(1 - old_empty * occupied - old_occupied * empty, 1e-6)
        told = {
            "empty": (old_empty * (empty + either) + old_either * empty) / agreed,
            "occupied": (old_occupied * (occupied + either) + old_either * occupied) / agreed,
        }
        return told, before | on_arc

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return _of_probability((1 + cells["occupied"] - cells["empty"]) / 2)


@dataclass(frozen=True)
class Fuzzy(_Short):
    """Fuzzy sets of empty and of occupied cells, united by Dombi's union (Oriolo, Ulivi & Vendittelli 1998).

    The union of m_1, m_2, ... is 1 / (1 + S^(-1/lambda)) with S the sum of (m / (1 - m))^lambda, so S is what a
    cell keeps. The safe cells E^2 (1 - O) (1 - E O) (1 - (1 - E)(1 - O)) are for planning; the map is read out as
    (1 + O - E) / 2. The angular profile is that of the robot's own transducer, within its beam.
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

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"empty": np.float32(0)[...], "occupied": np.float32(0)[...]}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, d, inside = _heard_m(beam), beam.distance, beam.inside(self.reach_m)
        echo = jnp.isfinite(beam.reading)
        fades = jnp.where(inside, beam.amplitude() * (1 - jnp.tanh(2 * (d - self.visibility_m))) / 2, 0.0)
        ramp = jnp.clip((heard - d) / self.depth_m, 0.0, 1.0) ** 2
        empty = self.k_empty * fades * ramp
        arc = jnp.maximum(0.0, 1 - ((heard - d) / self.depth_m) ** 2)
        occupied = jnp.where(echo, self.k_occupied * fades * arc, 0.0)
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
        return _of_probability((1 + occupied - empty) / 2)


@dataclass(frozen=True)
class LimCho(_Short):
    """Specular reflection probability (Lim & Cho 1992, 1994): a cell also knows which way its surface may face.

    The source's formulas are not public; these follow its idea. Long readings count less, by the range confidence
    exp(-R / R0). Each cell keeps the probabilities of 12 orientations; a surface sends the sound back within the half
    width of the beam of its normal, and with p_s otherwise. An echo teaches the orientation by Bayes' rule;
    a beam that passes tells of a cell as far as its surface would have sent it back, at most 20 to 1.
    """

    reach_m: float = 1.0
    no_echo: bool = True
    p_occupied: float = 0.812
    """Of a cell on the arc."""
    thickness_m: float = 0.153
    fading_m: float = 1.25
    """R0."""
    p_specular: float = 0.251
    """p_s: that a surface that faces elsewhere sends the sound back."""
    name: str = "lim-cho"

    ORIENTATIONS = 12

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        even = np.full(self.ORIENTATIONS, 1 / self.ORIENTATIONS, dtype=np.float32)
        return EVIDENCE | {"orientation": even}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, half = _heard_m(beam), self.thickness_m / 2
        inside = beam.inside(self.reach_m)
        struck = inside & jnp.isfinite(beam.reading) & (jnp.abs(beam.distance - heard) < half)
        passed = inside & (beam.distance <= heard - half)
        step = 2 * np.pi / self.ORIENTATIONS
        normal = jnp.arange(self.ORIENTATIONS) * step
        off = jnp.abs(jnp.mod(beam.bearing[..., None] - normal, 2 * np.pi) - np.pi)
        # An orientation stands for all within half a step of it.
        last = jnp.minimum(off + step / 2, beam.half_width)
        share = jnp.maximum(0.0, last - jnp.maximum(off - step / 2, -beam.half_width)) / step
        p_back = self.p_specular + (1 - self.p_specular) * share
        orientation = cells["orientation"]
        seen = jnp.sum(orientation * p_back, axis=-1)
        trust = jnp.exp(-heard / self.fading_m)
        evidence = trust * jnp.where(struck, logit(self.p_occupied), jnp.log(jnp.maximum(1 - seen, 0.05)))
        learned = orientation * p_back / seen[..., None]
        told, spoken = _added(cells, evidence, struck | passed)
        return told | {"orientation": jnp.where(struck[..., None], learned, orientation)}, spoken

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return cells["evidence"]


def _of_probability(p: ndarray) -> Float[ndarray, "rows cols"]:
    return logit(np.clip(p.astype(float), 1e-6, 1 - 1e-6)).astype(np.float32)


def _normal_cdf(x: Array) -> Array:
    from jax.scipy.special import ndtr

    return ndtr(x)
