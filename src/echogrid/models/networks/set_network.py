"""The set network as a sensor model: its weights, and the sums of its views that the cells of its map keep."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, override

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid import _core
from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.grid import GrowingGrid, Layers
from echogrid.models.batches import near_each_other, placed
from echogrid.models.model import Evidence, Fusion, Model
from echogrid.models.networks import set_core, surroundings
from echogrid.models.networks.memory import Memory, Recent
from echogrid.models.networks.set_core import REACH_M, ends_within
from echogrid.models.networks.set_layers import Weights, fused, initial, saturated
from echogrid.models.networks.weights import read_weights, write_weights
from echogrid.robot import Robot

FORMAT = "echogrid-set-2"
"""Of the weights file."""

MAX_UNITS = 2048
"""Units of the widest network that is read."""

SUMS = ("occupied", "free", "occupied2", "free2", "looks")
"""Layers of the map: evidence for and against a surface, and of its squares, and what the looks at a cell count."""

FORGOTTEN = 0.05
"""Evidence, in log-odds, that has faded below this is none; one clear view of a surface or of a floor is 1 to 4."""

STOOD = -4.0
"""Log-odds, at most, of floor on which the robot has stood, whatever is said of it."""

STOOD_SHARE, STOOD_STEP_M, STOOD_GAP_M = 0.9, 0.08, 0.6
"""Of the footprint's radius: what of it is sure to have been over the floor, for poses are not exact. The way between
two scans is followed in such steps, or in those that fit a smaller or a much larger robot, if it is no longer than
the last."""

STRIP = 256
"""Rows of the map that are read out at once."""

_RENEW = 32.0
"""Half-lives after which the sums are brought back to scale, long before float32 overflows."""


@dataclass(frozen=True)
class SetNetwork(Model):
    """The set network with its weights."""

    weights: Weights
    """Of what reads a scan and fuses views."""
    around: Weights | None
    """Of what reads a cell with its surroundings (``surroundings``); None: each is read alone."""
    recipe: dict[str, Any]
    """How the weights were made."""
    name: str = "set-network"

    cell_m = 0.04
    """Fine enough that where a cell lies on a wall does not matter."""
    p_min = 0.005
    """It is calibrated: of cells of which it says 0.02 or less, about one in a thousand holds a surface."""

    @cached_property
    def core(self) -> _core.SetNetwork:
        """It in the compiled core."""
        return set_core.network(self.weights, self.around)

    def __repr__(self) -> str:
        values = [*self.weights.values(), *(self.around or {}).values()]
        return f"SetNetwork({self.name!r}, {sum(map(np.size, values))} weights)"

    @override
    def told(self) -> dict[str, Any]:
        return {"weights": self.recipe}

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        return _Sums(robot, self, half_life)

    def views(self, robot: Robot, frames: Sequence[Frame], skip: int = 0) -> "Views":
        """Read scans of a robot that follow each other, but the first so many: these are only remembered.

        Ranges are those that ``Robot.clean`` leaves.
        """
        return _Sums(robot, self, None).views(frames, skip)()

    def save(self, path: str | Path) -> None:
        """Write the weights and their recipe (NPZ, no pickle)."""
        parts = self.weights | (self.around or {})
        arrays = {name: np.asarray(value, dtype=np.float32) for name, value in parts.items()}
        write_weights(path, FORMAT, self.recipe, arrays)

    @staticmethod
    def load(path: str | Path) -> "SetNetwork":
        """Read weights.

        Raises:
            InputError: not a weights file of this format.
            UsageError: there is no such file.
        """
        data = read_weights(path, FORMAT)
        del data["format"]
        try:
            recipe = json.loads(str(data.pop("recipe")))
            units = data["b1"].size
        except (KeyError, ValueError, RecursionError):
            recipe, units = None, 0
        units = max(1, min(units, MAX_UNITS))  # more fit no file, but would fill the memory here
        own, around = initial(np.random.default_rng(0), units), surroundings.initial(np.random.default_rng(0))
        if not data.keys() & around.keys():
            around = {}
        fits = {name: value.shape for name, value in data.items()} == {
            name: value.shape for name, value in (own | around).items()
        }
        if (
            not isinstance(recipe, dict)
            or not fits
            or not all(v.dtype.kind == "f" and np.isfinite(v).all() for v in data.values())
        ):
            raise InputError(
                path, "weights of other shapes, not finite, or without a recipe", "the arrays of a set network"
            )
        own, around = ({name: data[name] for name in part} for part in (own, around))
        return SetNetwork(own, around or None, recipe, Path(path).stem)


def stood_step(radius: float) -> float:
    """Steps (m) in which the way of a disc of a radius (m) is followed.

    A small one would leave gaps, a large one has many cells.
    """
    return max(min(STOOD_STEP_M, radius / 2), radius / 10)


class _Told(NamedTuple):
    """What a batch of scans adds to its window of the map."""

    add: Callable[[Sequence[Float[ndarray, "rows cols"]], Int[ndarray, "rows cols"]], None]
    """Adds it to the window's layers, see SUMS, and to its ``views``, the scans that spoke."""
    stamp: float
    """Time of the last scan, s."""
    epoch: float
    """Time at which evidence counts as it is, s; what is later counts more, where evidence fades."""
    poses: Float[ndarray, "scans 2"]
    """Where the robot stood, m."""
    radius: float
    """What is sure to have been under it, m."""


@dataclass(frozen=True)
class Views:
    """Scans that were read; what they tell is added to a map from wherever they are taken to have been made."""

    tables: _core.PolarTables
    weight: Float[ndarray, "scans"]
    stamp: float
    epoch: float
    radius: float
    """See ``_Told``."""
    cell_m: float
    side: int
    """Of a scan's patch, cells."""

    def at(self, poses: Float[ndarray, "scans 3"]) -> Evidence:
        """What they tell if they were made at poses, m, m, rad."""
        at = placed(poses, self.side, self.cell_m)
        add = partial(self.tables.add, at.centre, at.theta, at.first, self.weight, self.cell_m)
        return Evidence(at.corner, at.end, _Told(add, self.stamp, self.epoch, poses[:, :2], self.radius))


class _Sums(Fusion):
    """Evidence is summed window by window, and read out where somebody looks; it fades if it is asked to."""

    def __init__(self, robot: Robot, network: SetNetwork, half_life: float | None):
        self.blank = dict.fromkeys((*SUMS, "stood"), np.float32(0)[...]) | {"views": np.int32(0)[...]}
        self.cell_m = cell = network.cell_m
        self._network, self._half_life = network, half_life
        self._core = network.core
        self._least = 0.0 if half_life is None else FORGOTTEN
        self._side = int(np.ceil(2 * REACH_M / cell)) + 2
        self.reach_cells = self._side
        self._epoch, self._summed_epoch, self._now = -np.inf, -np.inf, -np.inf
        self._stale: tuple[ndarray, ndarray] | None = None
        self._last: ndarray | None = None
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        self._ends = ends_within(robot.mounts, robot.max_ranges_m)
        self._array = self._array_of(self._ends)
        self._begun = set_core.begun(self._network.around, self.array)
        self._memory, self._recent = Memory(robot.mounts, self._half_life), Recent(robot.mounts)
        self._other_array = True

    def _array_of(self, ends: bool) -> _core.SonarArray:
        robot = self.robot
        return set_core.sonar_array(
            robot.mounts, robot.max_ranges_m, robot.footprint_radius_m, robot.beam_width_rad, ends
        )

    @override
    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        return near_each_other(frames, np.inf if self._half_life is None else _RENEW * self._half_life)

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        views, poses = self.views(batch), np.array([frame.pose for frame in batch])
        return lambda: views().at(poses)

    def views(self, batch: Sequence[Frame], skip: int = 0) -> Callable[[], Views]:
        """Note a batch; what is returned works out, in any thread, what its scans say, but for the first so many."""
        batch, new = self._recent.completed(batch)
        stamps, poses = np.array([frame.stamp for frame in batch]), np.array([frame.pose for frame in batch])
        ranges = np.array([frame.ranges for frame in batch])
        recalled = self._memory.take(poses, ranges, stamps, new)
        weight = recalled.weight
        if self._half_life is not None:
            if (stamps[0] - self._epoch) / self._half_life > _RENEW:
                self._epoch = float(stamps[0])
            # Rather than let all that was summed fade, what is new counts more.
            weight = weight * np.exp2((stamps - self._epoch) / self._half_life).astype(np.float32)
        array, mounts = self._array, self._mounts(batch[skip:])
        if mounts is not None and not self._ends and ends_within(mounts, self.robot.max_ranges_m):
            array = self._array_of(True)
        ranges, traits, weight = ranges[skip:], recalled.traits[skip:], weight[skip:]
        stamp, epoch = float(stamps.max()), self._epoch
        radius = STOOD_SHARE * self.robot.footprint_radius_m
        cell_m, side = self._network.cell_m, self._side

        def work() -> Views:
            tables = self._core.tables(array, ranges, traits, mounts)
            return Views(tables, weight, stamp, epoch, radius, cell_m, side)

        return work

    def _mounts(self, batch: Sequence[Frame]) -> Float[ndarray, "scans sonars 3"] | None:
        """From where the sonars of each scan looked; None: as on the robot."""
        if all(frame.mounts is None for frame in batch):
            return None
        own = self.robot.mounts
        return np.array([own if frame.mounts is None else frame.mounts for frame in batch], dtype=float)

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        told: _Told = evidence.told
        if told.epoch > self._summed_epoch:
            self._renew(grown, told.epoch)
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        cells = grown.window(evidence.corner, (rows, cols))
        told.add([cells[name] for name in SUMS], cells["views"])
        self._now = max(self._now, told.stamp)
        self.changed(evidence.corner, evidence.end)
        self._stand(grown, told)

    @override
    def changed(self, corner: Int[ndarray, "2"], end: Int[ndarray, "2"]) -> None:
        low, high = self._stale or (corner, end)
        self._stale = np.minimum(low, corner), np.maximum(high, end)

    def _stand(self, grown: GrowingGrid, told: _Told) -> None:
        """Note the floor on which the robot has stood, and over which it has come."""
        came = self._last is not None
        way = np.concatenate([self._last[None], told.poses]) if came else told.poses
        self._last = told.poses[-1]
        if told.radius <= 0:
            return
        step = stood_step(told.radius)
        weight = 1.0 if self._half_life is None else np.exp2((told.stamp - told.epoch) / self._half_life)
        # A robot may be larger than what its sonars tell of.
        begin, size = grown.reserved()
        stood, begin = grown.window(begin, size)["stood"], _pair(begin)
        cell = self._network.cell_m
        found = _core.stand(way, came, told.radius, cell, step, STOOD_GAP_M, weight, stood, begin)
        if found:
            self.changed(np.array(found[:2]), np.array(found[2:]))

    def _renew(self, grown: GrowingGrid, epoch: float) -> None:
        """Bring the sums to another epoch, so that they do not grow without end."""
        if self._half_life is not None and self._summed_epoch > -np.inf:
            faded = np.float32(np.exp2((self._summed_epoch - epoch) / self._half_life))
            cells = grown.layers()
            for name in (*SUMS, "stood"):
                cells[name] *= faded
        self._summed_epoch = epoch

    @override
    def read_out(self, grown: GrowingGrid, corner: Int[ndarray, "2"], shape: tuple[int, int]) -> None:
        if self._stale is None:
            return
        begin, size = grown.reserved()
        low, high = begin, begin + size
        if self._half_life is None and not self._other_array:  # else all of it changes
            pack, reach = surroundings.PACK, surroundings.REACH
            # Whole squares: a cell reaches as far as the one beside it in its square.
            low = np.maximum(low, (self._stale[0] - reach) // pack * pack)
            high = np.minimum(high, -(-(self._stale[1] + reach) // pack) * pack)
        first, last = np.maximum(corner, low), np.minimum(corner + shape, high)
        for row in range(int(first[0]), int(last[0]), STRIP):
            self._read(grown, np.array([row, first[1]]), np.array([min(row + STRIP, last[0]), last[1]]))
        if np.all(first <= low) and np.all(last >= high) and self._half_life is None:
            self._stale, self._other_array = None, False

    def _read(self, grown: GrowingGrid, low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> None:
        """Bring ``log_odds`` and ``observed`` of a rectangle of cells up to date."""
        if np.any(high <= low):
            return
        pack, reach = surroundings.PACK, surroundings.REACH
        begin = (low - reach) // pack * pack
        squares = -(-(high + reach - begin) // pack)
        faded = 1.0 if self._half_life is None else np.exp2((self._summed_epoch - self._now) / self._half_life)
        held_at, size = grown.reserved(begin, (pack * int(squares[0]), pack * int(squares[1])))
        held = grown.window(held_at, size)
        cells = grown.window(low, (int(high[0] - low[0]), int(high[1] - low[1])))
        self._core.read_out(
            [held[name] for name in (*SUMS, "stood")],
            _pair(held_at - begin),
            _pair(squares),
            self._begun,
            faded,
            self._least,
            STOOD,
            cells["log_odds"],
            cells["observed"],
            _pair(low - begin),
        )

    def telling(self, cells: Layers) -> Float[ndarray, "rows cols features"]:
        """What ``surroundings`` is told of cells."""
        *sums, looks = (cells[name] for name in SUMS)
        sums = saturated(looks, *sums)
        alone = np.where(cells["looks"] > 0, fused(self._network.weights, *sums), np.float32(0))
        return surroundings.features(sums, looks, alone, (cells["stood"] > self._least).astype(np.float32))

    @property
    def array(self) -> Float[ndarray, "told"]:
        """What ``surroundings`` is told of the robot's sonars."""
        robot = self.robot
        return surroundings.told_of(robot.beam_width_rad, robot.max_range_m, robot.mounts)


def _pair(values: Int[ndarray, "2"]) -> tuple[int, int]:
    return int(values[0]), int(values[1])
