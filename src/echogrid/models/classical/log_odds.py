"""The classical sensor models that keep a probability in each cell, or log-odds, one reading at a time.

Where a source leaves a number open it is a field of the model, and its default was chosen by one search that is the
same for all models (experiments/paper/tune.py); ``reach_m`` and ``no_echo`` are such numbers of every model. No echo,
where it is used, is a reading at the maximum range of which nothing came back. Formulas: docs/method.md.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Bool, Float, UInt32
from numpy import ndarray

from echogrid.grid import Layers, logit
from echogrid.models.classical.beam import Beam, Cells, Scalar, Square
from echogrid.models.classical.sweep import ReadingModel
from echogrid.robot import Robot

Told = tuple[Cells, Bool[Array, "side side"]]
"""The cells after a reading, and those of which it told."""


@dataclass(frozen=True)
class ShortReach(ReadingModel):
    """What the models share that trust readings up to a reach."""

    reach_m: float
    """Cells farther from the sonar are left alone."""
    no_echo: bool
    """Whether a reading without echo frees the cells before the maximum range."""

    def reach(self, robot: Robot) -> float:
        """See ``ReadingModel``."""
        return min(self.reach_m, robot.max_range_m)


@dataclass(frozen=True)
class SumOfLogOdds(ShortReach):
    """What the models share whose cells add up what each reading says, as log-odds."""

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        return {"evidence": np.float32(0)[...]}

    def added(self, cells: Cells, evidence: Square, spoken: Bool[Array, "side side"]) -> Told:
        """The sums after the evidence of a reading."""
        return {"evidence": cells["evidence"] + jnp.where(spoken, evidence, 0.0)}, spoken

    def log_odds(self, cells: Layers) -> Float[ndarray, "rows cols"]:
        """See ``ReadingModel``."""
        return cells["evidence"]


@dataclass(frozen=True)
class Cone(SumOfLogOdds):
    """The simple inverse model (Thrun, Burgard & Fox, Probabilistic Robotics, table 9.2)."""

    reach_m: float = 1.6
    no_echo: bool = False
    p_occupied: float = 0.582
    p_free: float = 0.439
    thickness_m: float = 0.226
    """Depth of the arc that is called occupied (alpha)."""
    name: str = "cone"

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``; only the sonar whose axis is nearest tells of a cell."""
        heard, half = beam.heard(), self.thickness_m / 2
        spoken = beam.inside(self.reach_m) & beam.nearest & (beam.distance <= heard + half)
        struck = beam.arc(half)
        spoken &= struck | (beam.distance <= heard)
        return self.added(cells, jnp.where(struck, logit(self.p_occupied), logit(self.p_free)), spoken)


@dataclass(frozen=True)
class ConeNoEcho(Cone):
    """The same, with numbers of its own for readings without echo."""

    reach_m: float = 0.8
    no_echo: bool = True
    p_occupied: float = 0.722
    p_free: float = 0.42
    thickness_m: float = 0.148
    name: str = "cone-no-echo"


@dataclass(frozen=True)
class Elfes(SumOfLogOdds):
    """Elfes 1989, Matthies & Elfes 1988: Gaussian error in range and angle, and Bayes' rule in each cell.

    A cell at distance z that is occupied sends the echo with a probability that falls off as a Gaussian of its
    bearing; the reading is then normal about z. Otherwise the reading is that of something else, which may be
    anywhere. p(r | occupied) = a N(r; z, sigma) + (1 - a Phi((r - z) / sigma)) / range, p(r | empty) = 1 / range.
    Formulas from memory of the literature.
    """

    reach_m: float = 0.8
    no_echo: bool = True
    p_hit: float = 0.102
    """Probability that an occupied cell on the axis sends the echo (a)."""
    sigma_m: float = 0.0485
    """Standard deviation of the range."""
    sigma_rad: float = 0.22
    """Standard deviation of the bearing."""
    name: str = "elfes"

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        struck = self.p_hit * jnp.exp(-((beam.off_axis / self.sigma_rad) ** 2) / 2)
        off = (beam.heard() - beam.distance) / self.sigma_m
        density = beam.density(self.sigma_m) * beam.max_range
        evidence = jnp.log(struck * density + 1 - struck * ndtr(off))
        return self.added(cells, evidence, beam.inside(self.reach_m) & (off > -3))


@dataclass(frozen=True)
class Nav2(ReadingModel):
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
        heard = beam.heard()
        target = beam.is_cell(*beam.cell_at(heard))
        prior = jnp.where(target, self.TARGET, cells["cost"])
        sensor = jnp.where(beam.echo(), self._sensor(beam, heard), 0.0)
        changed = self._box(beam, heard) & (sensor != 0.5)
        return {"cost": jnp.where(changed, self._bayes(prior, sensor), prior)}, changed | target

    def _box(self, beam: Beam, heard: Scalar) -> Bool[Array, "side side"]:
        """The axis-parallel box round the sonar and the ends of the cone's two sides."""
        far, half = self.BEYOND * heard, beam.half_width
        ends = jnp.array([beam.cell_at(jnp.float32(0)), beam.cell_at(far, -half), beam.cell_at(far, half)])
        low, high = jnp.min(ends, axis=0), jnp.max(ends, axis=0)
        row, col = jnp.indices(beam.distance.shape)
        return (row >= low[0]) & (row <= high[0]) & (col >= low[1]) & (col <= high[1])

    def _bayes(self, cost: Square, sensor: Square) -> Square:
        prior = cost / self.LETHAL
        told = sensor * prior / jnp.maximum(sensor * prior + (1 - sensor) * (1 - prior), 1e-9)
        # The small term keeps a product that is whole in exact arithmetic from being truncated to the one below.
        return jnp.floor(told * self.LETHAL + 1e-3)

    def _sensor(self, beam: Beam, r: Scalar) -> Square:
        """P(occupied | the echo at r)."""
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
        return of_probability(cells["cost"] / self.LETHAL)


@dataclass(frozen=True)
class Nav2Clearing(Nav2):
    """The same, with clear_on_max_reading."""

    no_echo: bool = True
    name: str = "nav2-clearing"


@dataclass(frozen=True)
class Nav2Tuned(Nav2):
    """The same, with the one number of its sensor model from the search."""

    phi_m: float = 0.605
    name: str = "nav2-tuned"


@dataclass(frozen=True)
class Muriel(SumOfLogOdds):
    """MURIEL (Konolige 1997): the first echo, no reading twice from one place, and specular readings discounted.

    An occupied cell at z gives the reading x the density a(z) N(x; z, d(z)) + F, and a reading D is the first echo:
    p(D | C) = f(D | C) (1 - integral of f up to D); p(D | not C) = F (1 - F D). A reading that has passed through
    cells that were seen occupied at normal incidence is specular with probability P_s, and its evidence becomes
    log(P_s + (1 - P_s) exp(evidence)). a(z) falls off the axis as the transducer's two-way amplitude; the normal is
    widened by the depth of a cell; P_s grows with how sure the passed cell is, and off the axis falls with it.

    f is a density, so F times the maximum range must stay below 1, and a with it: a larger F is taken for 0.9 over
    the maximum range, a larger a for 0.9 of what F leaves. What is said of 2-D (the beam, the places that are taken,
    P_s) is from memory of the literature.
    """

    reach_m: float = 1.0
    no_echo: bool = False
    strength: float = 0.757
    """a(z) on the axis at z = 0; it falls to 0 at 4 m."""
    background: float = 0.11
    """F: density of readings from elsewhere, 1/m; at most 0.9 over the maximum range counts."""
    specular: float = 0.985
    """P_s of a reading that passed through a surely occupied cell."""
    name: str = "muriel"

    BEARINGS, DEPTH_M, DEPTHS = 24, 0.3, 14
    """A cell takes one reading for each 15 degrees of bearing and 30 cm of distance to the sonar."""

    def blank(self) -> Layers:
        """See ``ReadingModel``; ``taken`` has a bit for each bearing, a word for each distance."""
        return super().blank() | {"normal": np.float32(0)[...], "taken": np.zeros(self.DEPTHS, dtype=np.uint32)}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        evidence, near = self._evidence(beam)
        p_specular = self._p_specular(cells["normal"], beam)
        evidence = jnp.log(p_specular + (1 - p_specular) * jnp.exp(evidence))
        place = self._place(beam)
        fresh = jnp.all(cells["taken"] & place == 0, axis=-1)
        spoken = beam.inside(self.reach_m) & near & fresh
        told, _ = self.added(cells, evidence, spoken)
        head_on = spoken & (jnp.abs(beam.off_axis) <= np.deg2rad(7.5))
        normal = cells["normal"] + jnp.where(head_on, evidence, 0.0)
        taken = jnp.where(spoken[..., None], cells["taken"] | place, cells["taken"])
        return told | {"normal": normal, "taken": taken}, spoken

    def _spread(self, beam: Beam) -> Square:
        """Standard deviation of the reading, m. A cell is as deep as the map has it: the echo is from within."""
        return jnp.sqrt((0.01 + 0.015 * beam.distance) ** 2 + beam.cell**2 / 12)

    def _evidence(self, beam: Beam) -> tuple[Square, Bool[Array, "side side"]]:
        """Log of p(D | C) / p(D | not C) of a reading that is not specular, and the cells not far behind it."""
        heard, z, spread = beam.heard(), beam.distance, self._spread(beam)
        background = jnp.minimum(self.background, 0.9 / beam.max_range)
        strength = self.strength * jnp.maximum(0.0, 1 - z / 4) * beam.amplitude() ** 2
        strength = jnp.minimum(strength, 0.9 * (1 - background * beam.max_range))
        off = (heard - z) / spread
        first = 1 - strength * ndtr(off) / (1 - background * heard)
        near = off > -4
        return jnp.where(near, jnp.log((strength * beam.density(spread) / background + 1) * first), 0.0), near

    def _p_specular(self, normal: Square, beam: Beam) -> Scalar:
        """P_s of the reading, from the surest wall that it has passed through."""
        passed = beam.inside(self.reach_m) & (beam.distance < beam.heard() - 2 * self._spread(beam))
        sure = 2 / (1 + jnp.exp(-normal)) - 1
        return self.specular * jnp.max(jnp.where(passed & (normal > 0), sure * beam.amplitude(), 0.0))

    def _place(self, beam: Beam) -> UInt32[Array, "side side depths"]:
        """The bit of the sonar's place, seen from each cell."""
        sector = jnp.floor(jnp.mod(beam.bearing, 2 * np.pi) / (2 * np.pi) * self.BEARINGS).astype(jnp.uint32)
        ring = jnp.minimum(beam.distance / self.DEPTH_M, self.DEPTHS - 1).astype(jnp.int32)
        bit = jnp.left_shift(jnp.uint32(1), jnp.minimum(sector, self.BEARINGS - 1))
        return jnp.where(ring[..., None] == jnp.arange(self.DEPTHS), bit[..., None], jnp.uint32(0))


@dataclass(frozen=True)
class LimCho(SumOfLogOdds):
    """Specular reflection probability (Lim & Cho 1992, 1994): a cell also knows which way its surface may face.

    The source's formulas are not public; these follow its idea. Long readings count less, by the range confidence
    exp(-R / R0). Each cell keeps the probabilities of 12 orientations; a surface sends the sound back within the half
    width of the beam of its normal, and with p_s otherwise. An echo teaches the orientation by Bayes' rule;
    a beam that passes tells of a cell as far as its surface would have sent it back, at most 20 to 1.
    """

    reach_m: float = 2.0
    no_echo: bool = False
    p_occupied: float = 0.748
    """Of a cell on the arc."""
    thickness_m: float = 0.193
    fading_m: float = 2.57
    """R0."""
    p_specular: float = 0.23
    """p_s: that a surface that faces elsewhere sends the sound back."""
    name: str = "lim-cho"

    ORIENTATIONS = 12

    def blank(self) -> Layers:
        """See ``ReadingModel``."""
        even = np.full(self.ORIENTATIONS, 1 / self.ORIENTATIONS, dtype=np.float32)
        return super().blank() | {"orientation": even}

    def update(self, cells: Cells, beam: Beam) -> Told:
        """See ``ReadingModel``."""
        heard, half = beam.heard(), self.thickness_m / 2
        inside = beam.inside(self.reach_m)
        struck = inside & beam.arc(half)
        passed = inside & (beam.distance <= heard - half)
        orientation, p_back = cells["orientation"], self._p_back(beam)
        seen = jnp.sum(orientation * p_back, axis=-1)
        trust = jnp.exp(-heard / self.fading_m)
        evidence = trust * jnp.where(struck, logit(self.p_occupied), jnp.log(jnp.maximum(1 - seen, 0.05)))
        learned = orientation * p_back / seen[..., None]
        told, spoken = self.added(cells, evidence, struck | passed)
        return told | {"orientation": jnp.where(struck[..., None], learned, orientation)}, spoken

    def _p_back(self, beam: Beam) -> Float[Array, "side side orientations"]:
        """Probability that a surface of each orientation sends the sound back."""
        step = 2 * np.pi / self.ORIENTATIONS
        normal = jnp.arange(self.ORIENTATIONS) * step
        off = jnp.abs(jnp.mod(beam.bearing[..., None] - normal, 2 * np.pi) - np.pi)
        # An orientation stands for all within half a step of it.
        last = jnp.minimum(off + step / 2, beam.half_width)
        share = jnp.maximum(0.0, last - jnp.maximum(off - step / 2, -beam.half_width)) / step
        return self.p_specular + (1 - self.p_specular) * share


def of_probability(p: Float[ndarray, "rows cols"]) -> Float[ndarray, "rows cols"]:
    """Log-odds of probabilities, those of 0 and 1 being within a millionth of them."""
    return logit(np.clip(p.astype(float), 1e-6, 1 - 1e-6)).astype(np.float32)
