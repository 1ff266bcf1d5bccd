"""Thrun's forward model: the map that makes the whole log likely, found by expectation maximisation.

The other models ask what a reading says of a cell, each cell by itself. This one asks which map explains all
readings: an echo has one cause, so cells that share a cone compete for it. Source: Thrun, Learning Occupancy Grid
Maps with Forward Sensor Models, Autonomous Robots 15 (2003).
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, override

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.grid import P_MIN, GrowingGrid, covered, logit
from echogrid.models.batches import apart
from echogrid.models.model import Evidence, Fusion, Model
from echogrid.robot import Robot

MAX_PAIRS = 20_000_000
"""Pairs of a reading and a cell in its cone, all held in memory at once: 115 bytes each, 2.3 GB at this many."""

_CHUNK = 500_000
"""Cells of the squares round the cones that are laid out together."""

_MOST_ROUNDS, _LEAST_GAIN, _APART = 200, 1e-6, 5
"""Rounds of flips at most; the least gain of a flip; cells within which one flip is made at a time."""


class Cones(NamedTuple):
    """Pairs of a reading and a cell in its cone, reading by reading, in each by distance."""

    cell: Int[ndarray, "pairs"]
    """Flat index of the cell in the map."""
    reading: Int[ndarray, "pairs"]
    density: Float[ndarray, "pairs"]
    """N(z; d, sigma): density of the reading if this cell is its cause, 1/m; 0 if the cell cannot be."""
    start: Int[ndarray, "readings+1"]
    """First pair of each reading, and the end of the last."""
    echo: Bool[ndarray, "readings"]
    """Whether the reading ended within reach; if not, all that is known is that nothing before sent it back."""
    uniform: float
    """Density of a random reading, 1/m."""


@dataclass(frozen=True)
class ForwardModel(Model):
    """A reading is random, or the echo of the k-th occupied cell in its cone, or nothing came back.

    p(z | m) = p_random / z_max + (1 - p_random) sum_k p_hit (1 - p_hit)^(k - 1) N(z; d_k, sigma), and for no echo
    p_random + (1 - p_random) (1 - p_hit)^K. Cells are flipped as long as that raises p(Z | m) p(m); the expectation
    over the causes is taken anew for each flip considered, so that each step raises the likelihood itself (Neal &
    Hinton 1998). What is left between a cell's two states, all others kept, less the prior is its log-odds.
    Formulas from memory of the literature.
    """

    reach_m: float = 1.0
    """Cells farther from the sonar are left out, and those beyond its maximum range."""
    p_hit: float = 0.186
    """Probability that an occupied cell in the cone sends the echo, if none before it did."""
    p_random: float = 0.0218
    sigma_m: float = 0.077
    p_occupied: float = 0.0295
    """Prior of each cell."""
    weight: float = 0.463
    """Share of the log-odds that is believed: readings from one place repeat each other."""
    no_echo: bool = True
    """Whether readings without echo are used."""
    name: str = "em"

    @override
    def told(self) -> dict[str, Any]:
        return {"parameters": asdict(self)}

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        self.refuse_fading(half_life)
        return _WholeLog(robot, self, resolution)

    def cones(
        self,
        robot: Robot,
        poses: Float[ndarray, "frames 3"],
        ranges: Float[ndarray, "frames sonars"],
        low: Int[ndarray, "2"],
        cols: int,
        resolution: float,
    ) -> Cones:
        """The pairs of a log, on a map of so many columns that begins at the cell ``low`` [row, col].

        Raises:
            UsageError: there are more than MAX_PAIRS.
        """
        sonars = compose(poses[:, None, :], robot.mounts[None]).reshape(-1, 3)
        z = ranges.reshape(-1)
        used = np.isfinite(z) | (np.isinf(z) & self.no_echo)
        sonars, z = sonars[used], z[used]
        chunk = max(_CHUNK // len(self._square(robot, resolution)[0]), 1)
        parts, pairs = [], 0
        for first in range(0, max(len(z), 1), chunk):
            some = slice(first, first + chunk)
            cell, reading, density = self._pairs(robot, sonars[some], z[some], low, cols, resolution)
            parts.append((cell, reading + first, density))
            pairs += len(cell)
            if pairs > MAX_PAIRS:
                raise UsageError(
                    f"map: found more than {MAX_PAIRS} pairs of a reading and a cell in its cone, expected fewer for "
                    f"{self.name}, which keeps the whole log in memory (use larger cells or a shorter log)"
                )
        cell, reading, density = (np.concatenate(column) for column in zip(*parts, strict=True))
        start = np.searchsorted(reading, np.arange(len(z) + 1))
        return Cones(cell, reading, density, start, z <= self._reach(robot), 1 / robot.max_range_m)

    def _pairs(
        self,
        robot: Robot,
        sonars: Float[ndarray, "readings 3"],
        z: Float[ndarray, "readings"],
        low: Int[ndarray, "2"],
        cols: int,
        resolution: float,
    ) -> tuple[Int[ndarray, "pairs"], Int[ndarray, "pairs"], Float[ndarray, "pairs"]]:
        """Cell, reading and density of each pair, see ``Cones``."""
        reach = self._reach(robot)
        row, col = self._square(robot, resolution)
        home = np.floor(sonars[:, :2] / resolution).astype(np.int64)
        x = (home[:, :1] + col + 0.5) * resolution - sonars[:, :1]
        y = (home[:, 1:] + row + 0.5) * resolution - sonars[:, 1:2]
        distance = np.hypot(x, y)
        inside = np.abs(wrap(np.arctan2(y, x) - sonars[:, 2:])) <= robot.beam_width_rad / 2
        # What lies behind the echo is not known.
        inside &= distance <= np.minimum(z + 3 * self.sigma_m, reach)[:, None]
        reading, k = np.nonzero(inside)
        order = np.lexsort((distance[reading, k], reading))
        reading, k = reading[order], k[order]
        cell = (home[reading, 1] + row[k] - low[0]) * cols + home[reading, 0] + col[k] - low[1]
        off = (z[reading] - distance[reading, k]) / self.sigma_m
        density = np.exp(-(off**2) / 2) / (self.sigma_m * np.sqrt(2 * np.pi))
        return cell, reading, np.where(z[reading] <= reach, density, 0.0)

    def _square(self, robot: Robot, resolution: float) -> tuple[Int[ndarray, "cells"], Int[ndarray, "cells"]]:
        """Steps in rows and columns to the cells that may be in reach."""
        span = int(np.ceil(self._reach(robot) / resolution)) + 1
        steps = np.arange(-span, span + 1)
        row, col = np.meshgrid(steps, steps, indexing="ij")
        return row.ravel(), col.ravel()

    def _reach(self, robot: Robot) -> float:
        return min(self.reach_m, robot.max_range_m)

    def settle(self, cones: Cones, stood: Bool[ndarray, "rows cols"]) -> Float[ndarray, "rows cols"]:
        """Flip cells until no flip raises the likelihood; the log-odds of each cell given all others."""
        from scipy.ndimage import maximum_filter

        occupied = np.zeros(stood.shape, dtype=bool)
        likelihood, gain = self._flips(cones, occupied)
        for _ in range(_MOST_ROUNDS):
            wanted = np.where(stood, -np.inf, gain)
            # Flips that share readings spoil each other: of neighbours the best goes first.
            apart = (wanted > _LEAST_GAIN) & (wanted == maximum_filter(wanted, size=_APART))
            chosen = np.flatnonzero(apart)
            chosen = chosen[np.argsort(-wanted.reshape(-1)[chosen], kind="stable")]
            while len(chosen):
                flipped = occupied.copy()
                flipped.reshape(-1)[chosen] ^= True
                new_likelihood, new_gain = self._flips(cones, flipped)
                if new_likelihood > likelihood:
                    occupied, likelihood, gain = flipped, new_likelihood, new_gain
                    break
                # The better half of them; the best alone always raises it.
                chosen = chosen[: len(chosen) // 2]
            if not len(chosen):
                break
        # Less the prior, as all maps have it: a cell of which the readings say nothing is at 0.
        evidence = np.where(occupied, -gain, gain) - logit(self.p_occupied)
        return (self.weight * evidence).astype(np.float32)

    def _flips(self, cones: Cones, occupied: Bool[ndarray, "rows cols"]) -> tuple[float, Float[ndarray, "rows cols"]]:
        """The likelihood log p(Z | m) + log p(m) but for a constant, and what the flip of each cell would add."""
        on = occupied.reshape(-1)[cones.cell]
        log_miss = np.log1p(-self.p_hit)
        struck = _running(on.astype(float), cones)
        survival = np.exp(log_miss * (struck - on))
        here = self.p_hit * survival * cones.density
        so_far = _running(on * here, cones)
        of_hits = _whole(so_far, cones)
        passing = np.exp(log_miss * _whole(struck, cones))
        known = 1 - self.p_random
        # A reading that ended within reach has its density, one that went beyond has the probability to pass.
        hit_share = known * np.where(cones.echo, of_hits, 0.0)
        total = hit_share + np.where(cones.echo, self.p_random * cones.uniform, self.p_random + known * passing)

        r = cones.reading
        behind = of_hits[r] - so_far
        ahead = so_far - on * here
        factor = np.where(on, np.exp(-log_miss), np.exp(log_miss))
        hits = ahead + np.where(on, 0.0, here) + factor * behind
        flipped = np.where(
            cones.echo[r],
            self.p_random * cones.uniform + known * hits,
            self.p_random + known * factor * passing[r],
        )
        gain = np.bincount(cones.cell, np.log(flipped / total[r]), minlength=occupied.size).reshape(occupied.shape)
        prior = float(logit(self.p_occupied))
        gain = gain + np.where(occupied, -prior, prior)
        return float(np.sum(np.log(total)) + prior * np.sum(occupied)), gain


def _running(values: Float[ndarray, "pairs"], cones: Cones) -> Float[ndarray, "pairs"]:
    """Sum within each reading up to each pair, that pair with it."""
    total = np.cumsum(values)
    return total - np.append(0.0, total)[cones.start[cones.reading]]


def _whole(running: Float[ndarray, "pairs"], cones: Cones) -> Float[ndarray, "readings"]:
    """The running sum at the last pair of each reading, 0 for a reading without pairs."""
    held = cones.start[1:] > cones.start[:-1]
    whole = np.zeros(len(held))
    whole[held] = running[cones.start[1:][held] - 1]
    return whole


class _WholeLog(Fusion):
    """The whole log is one batch."""

    side_by_side = False

    def __init__(self, robot: Robot, model: ForwardModel, resolution: float):
        self.blank = {}
        self._model, self._resolution = model, resolution
        self._made = False
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        mounted = float(np.max(np.hypot(self.robot.mounts[:, 0], self.robot.mounts[:, 1])))
        self._reach = mounted + self._model.reach_m + 2 * self._resolution
        self.reach_cells = int(np.ceil(self._reach / self._resolution)) + 1

    @override
    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        kept = list(apart(frames, self.robot))
        if kept:
            yield kept

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        if self._made:
            found = f"more scans for {self._model.name} after its map was made"
            raise UsageError(f"map: found {found}, expected all scans at once, for it reads the log as a whole")
        poses, ranges = np.array([frame.pose for frame in batch]), np.array([frame.ranges for frame in batch])
        low = np.floor((poses[:, 1::-1].min(axis=0) - self._reach) / self._resolution).astype(np.int64)
        high = np.ceil((poses[:, 1::-1].max(axis=0) + self._reach) / self._resolution).astype(np.int64)
        # Whether there is room for the map is known only when it is to be fused.
        return lambda: Evidence(low, high, (poses, ranges))

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        poses, ranges = evidence.told
        stood = covered(poses, self.robot.footprint_radius_m, evidence.corner, (rows, cols), self._resolution)
        cones = self._model.cones(self.robot, poses, ranges, evidence.corner, cols, self._resolution)
        told = np.bincount(cones.cell, minlength=stood.size).reshape(stood.shape) > 0
        cells = grown.window(evidence.corner, (rows, cols))
        cells["log_odds"][:] = np.where(stood, logit(P_MIN), self._model.settle(cones, stood))
        cells["observed"][:] = told | stood
        self._made = True
