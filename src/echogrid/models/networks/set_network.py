"""The set network as a sensor model: its weights, and the sums of its views that the cells of its map keep."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, override

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.grid import GrowingGrid, Layers
from echogrid.models.batches import BATCH, WINDOW_M, in_robot, near_each_other, placed
from echogrid.models.model import Evidence, Fusion, Model
from echogrid.models.networks.memory import Memory
from echogrid.models.networks.polar_map import REACH_M, array_of, asked, ends_within, moved_view, view
from echogrid.models.networks.set_layers import Weights, fused, initial
from echogrid.models.networks.weights import read_weights, write_weights
from echogrid.robot import Robot

FORMAT = "echogrid-set-1"
"""Of the weights file."""

CAUTION = 0.8
"""Log-odds added to what the views say: to miss a wall is worse than to miss free floor. Training weighs both alike;
this was chosen on development rooms, where it wipes about half as many walls."""

MAX_UNITS = 2048
"""Units of the widest network that is read."""

SIZES = (1, 8, BATCH)
"""Batches of these sizes are compiled for: one scan alone is not to wait for many."""

SUMS = ("occupied", "free", "occupied2", "free2")
"""Layers of the map: evidence for and against a surface, and of its squares."""

FORGOTTEN = 0.05
"""Evidence, in log-odds, that has faded below this is none; one clear view of a surface or of a floor is 1 to 4."""

_RENEW = 32.0
"""Half-lives after which the sums are brought back to scale, long before float32 overflows."""


@dataclass(frozen=True)
class SetNetwork(Model):
    """The set network with its weights."""

    weights: Weights
    recipe: dict[str, Any]
    """How the weights were made."""
    name: str = "set-network"

    cell_m = 0.04
    """Fine enough that where a cell lies on a wall does not matter."""

    def __repr__(self) -> str:
        return f"SetNetwork({self.name!r}, {sum(np.size(value) for value in self.weights.values())} weights)"

    @override
    def told(self) -> dict[str, Any]:
        return {"weights": self.recipe}

    @override
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        return _Sums(robot, self, resolution, half_life)

    def fuse(
        self,
        occupied: Float[ndarray, "rows cols"],
        free: Float[ndarray, "rows cols"],
        occupied2: Float[ndarray, "rows cols"],
        free2: Float[ndarray, "rows cols"],
    ) -> Float[ndarray, "rows cols"]:
        """``fused``, for the cells of a map, and CAUTION besides where anything is known."""
        total = fused(self.weights, occupied, free, occupied2, free2, np)
        return np.where(occupied + free > 0, total + CAUTION * np.tanh(np.abs(total)), np.float32(0))

    def save(self, path: str | Path) -> None:
        """Write the weights and their recipe (NPZ, no pickle)."""
        arrays = {name: np.asarray(value, dtype=np.float32) for name, value in self.weights.items()}
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
        shapes = {name: value.shape for name, value in initial(np.random.default_rng(0), units).items()}
        fits = {name: value.shape for name, value in data.items()} == shapes
        if (
            not isinstance(recipe, dict)
            or not fits
            or not all(v.dtype.kind == "f" and np.isfinite(v).all() for v in data.values())
        ):
            raise InputError(
                path, "weights of other shapes, not finite, or without a recipe", "the arrays of a set network"
            )
        return SetNetwork(data, recipe, Path(path).stem)


class _Told(NamedTuple):
    """What a batch of scans adds to its window of the map."""

    sums: Sequence[Float[Array, "span span"]]
    """See SUMS, and last the scans that spoke; cells past the window's end are to be left out."""
    stamp: float
    """Time of the last scan, s."""
    epoch: float
    """Time at which evidence counts as it is, s; what is later counts more, where evidence fades."""


class _Sums(Fusion):
    """Evidence is summed window by window, and read out by the layer that fuses views; it fades if it is asked to."""

    def __init__(self, robot: Robot, network: SetNetwork, resolution: float, half_life: float | None):
        self.blank = dict.fromkeys(SUMS, np.float32(0)[...]) | {"views": np.int32(0)[...]}
        self._network, self._resolution, self._half_life = network, resolution, half_life
        self._side = int(np.ceil(2 * REACH_M / resolution)) + 2
        self.reach_cells = self._side
        span = self._side + int(np.ceil(WINDOW_M / resolution)) + 1
        self._sizes = {"resolution": resolution, "side": self._side, "span": span}
        self._epoch, self._summed_epoch, self._now = -np.inf, -np.inf, -np.inf
        super().__init__(robot)

    @override
    def equip(self, robot: Robot) -> None:
        super().equip(robot)
        self._window = self._window_of(ends_within(robot.mounts, robot.max_ranges_m))
        self._memory = Memory(robot.mounts, self._half_life)

    def _window_of(self, ends: bool) -> Callable:
        """``_window`` for the robot; ``ends``: whether what a sonar tells ends within the local map."""
        array = array_of(self.robot.mounts, self.robot.max_ranges_m, self.robot.footprint_radius_m, ends)
        given = jax.tree.map(jnp.asarray, (self._network.weights, array))
        return partial(_window, *given, **self._sizes)

    @override
    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        return near_each_other(frames, np.inf if self._half_life is None else _RENEW * self._half_life)

    @override
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        stamps = np.array([frame.stamp for frame in batch])
        recalled = self._memory.take(
            np.array([frame.pose for frame in batch]), np.array([frame.ranges for frame in batch]), stamps
        )
        size = BATCH if filled else next(size for size in SIZES if size >= len(batch))
        at = placed(batch, size, self._side, self._resolution)
        fill = size - len(batch)
        traits = np.pad(recalled.traits, [(0, fill), (0, 0)], constant_values=np.float32(0.5))
        weight = np.pad(recalled.weight, (0, fill))
        if self._half_life is not None:
            if (stamps[0] - self._epoch) / self._half_life > _RENEW:
                self._epoch = float(stamps[0])
            # Rather than let all that was summed fade, what is new counts more.
            weight[: len(batch)] *= np.exp2((stamps - self._epoch) / self._half_life)
        window, mounts = self._window, self._mounts(batch, size)
        if mounts is not None and ends_within(mounts[0], self.robot.max_ranges_m):
            window = self._window_of(True)
        corner, end = at.first.min(axis=0), at.first.max(axis=0) + self._side
        rows = (at.first - corner).astype(np.int32)
        stamp, epoch = float(stamps.max()), self._epoch

        def work() -> Evidence:
            sums = window(at.ranges, traits, at.corner, at.theta, rows, weight, mounts)
            return Evidence(corner, end, _Told(sums, stamp, epoch))

        return work

    def _mounts(self, batch: Sequence[Frame], size: int) -> tuple[ndarray, ndarray] | None:
        """From where the sonars of each scan looked, and which are asked for each bearing; None: as on the robot."""
        if all(frame.mounts is None for frame in batch):
            return None
        looked = np.tile(self.robot.mounts, (size, 1, 1))
        for k, frame in enumerate(batch):
            looked[k] = looked[k] if frame.mounts is None else frame.mounts
        return looked.astype(np.float32), asked(looked)

    @override
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        told: _Told = evidence.told
        if told.epoch > self._summed_epoch:
            self._renew(grown, told.epoch)
        rows, cols = (int(n) for n in evidence.end - evidence.corner)
        cells = grown.window(evidence.corner, (rows, cols))
        for name, added in zip((*SUMS, "views"), told.sums, strict=True):
            cells[name] += np.asarray(added)[:rows, :cols]
        self._now = max(self._now, told.stamp)
        if self._half_life is None:
            cells["observed"] |= cells["views"] > 0
            cells["log_odds"][:] = self._network.fuse(*(cells[name] for name in SUMS))

    def _renew(self, grown: GrowingGrid, epoch: float) -> None:
        """Bring the sums to another epoch, so that they do not grow without end."""
        if self._half_life is not None and self._summed_epoch > -np.inf:
            faded = np.float32(np.exp2((self._summed_epoch - epoch) / self._half_life))
            cells = grown.layers()
            for name in SUMS:
                cells[name] *= faded
        self._summed_epoch = epoch

    @override
    def read_out(self, cells: Layers) -> None:
        if self._half_life is None:
            return
        faded = np.float32(np.exp2((self._summed_epoch - self._now) / self._half_life))
        sums = [faded * cells[name] for name in SUMS]
        cells["observed"][:] = sums[0] + sums[1] > FORGOTTEN
        cells["log_odds"][:] = np.where(cells["observed"], self._network.fuse(*sums), np.float32(0))


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
