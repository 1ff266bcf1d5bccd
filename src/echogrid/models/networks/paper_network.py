"""The paper's network: a perceptron that is asked, for a point, the sonars that look nearest to it."""

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, override

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid import _core
from echogrid.errors import InputError
from echogrid.geometry import wrap
from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.local_map import UNSPOKEN, Bound, Interpreter
from echogrid.models.networks.weights import read_weights, write_weights
from echogrid.robot import Robot

LIMIT = 4.0
"""Log-odds at which the network's output levels off."""

ZONE, MOST_ZONE = 4, 8
"""Sonars that the network reads for a point: the paper's four, and the most that weights may ask for."""

FORMAT = "echogrid-mlp-1"
"""Of the weights file."""


class Zone(NamedTuple):
    """The sonars that look nearest to each point, from right to left as seen along the axes."""

    sonar: Int[ndarray, "*n zone"]
    """Index of the sonar; -1: the array has fewer than the zone."""
    off_axis: Float[ndarray, "*n zone"]
    """Bearing of the point from the sonar, off its axis, rad; pi for a missing sonar."""
    distance: Float[ndarray, "*n zone"]
    """From the sonar to the point, m."""


def zone_of(mounts: Float[ndarray, "sonars 3"], p_robot: Float[ndarray, "*n 2"], zone: int = ZONE) -> Zone:
    """Find the zone, of so many sonars, of points (m) in the frame in which the mounts are given."""
    to = p_robot[..., None, :] - mounts[:, :2]
    off_axis = wrap(np.arctan2(to[..., 1], to[..., 0]) - mounts[:, 2])
    distance = np.hypot(to[..., 0], to[..., 1])
    missing = zone - len(mounts)
    if missing > 0:
        pad = [(0, 0)] * (off_axis.ndim - 1) + [(0, missing)]
        off_axis = np.pad(off_axis, pad, constant_values=np.pi)
        distance = np.pad(distance, pad, constant_values=1.0)
    nearest = np.argpartition(np.abs(off_axis), zone - 1, axis=-1)[..., :zone]
    # From the sonar that has the point farthest to its left to the one that has it farthest to its right.
    order = np.argsort(np.take_along_axis(-off_axis, nearest, axis=-1), axis=-1)
    nearest = np.take_along_axis(nearest, order, axis=-1)
    return Zone(
        np.where(nearest < len(mounts), nearest, -1),
        np.take_along_axis(off_axis, nearest, axis=-1),
        np.take_along_axis(distance, nearest, axis=-1),
    )


def place_features(off_axis: Float[Any, "*n zone"], distance: Float[Any, "*n zone"], xp: Any = np) -> Any:
    """Where the point lies in its zone: its bearing off each axis, and its distance [*n, zone + 1].

    ``xp``: numpy or jax.numpy.
    """
    mean = xp.mean(distance, axis=-1, keepdims=True)
    return xp.concatenate([xp.clip(off_axis / 0.8, -2.0, 2.0), mean], axis=-1)


def inputs(zone: int = ZONE) -> int:
    """Number of the network's inputs: of the readings, of what lies beyond, and of the place, in this order."""
    return 3 * zone + 2 * zone + (zone + 1)


Layers = list[tuple[Float[Any, "_ _"], Float[Any, "_"]]]


@dataclass(frozen=True)
class Network(Interpreter):
    """The paper's multilayer perceptron over the zone of a point, with its weights."""

    layers: Layers
    """Weights and biases: input -> two hidden layers (ReLU) -> log-odds."""
    prior: float  # ty: ignore[incompatible-attribute-override] - frozen here, read alone there
    """Share of occupied points that it was trained under; subtracted from each view by the mapper."""
    recipe: dict[str, Any]
    """How the weights were made."""
    name: str = "network"

    def __repr__(self) -> str:
        return f"Network({self.name!r}, {sum(np.size(part) for layer in self.layers for part in layer)} weights)"

    @property
    def zone(self) -> int:
        """Sonars that it reads for a point."""
        return (len(self.layers[0][0]) - 1) // 6

    @override
    def told(self) -> dict[str, Any]:
        return {"weights": self.recipe}

    @override
    def bind(self, robot: Robot, p_robot: Float[ndarray, "points 2"]) -> Bound:
        zone = zone_of(robot.mounts, p_robot, self.zone)
        off_axis, distance = zone.off_axis.astype(np.float32), zone.distance.astype(np.float32)
        (w, b), (w1, b1), (w2, b2) = self.layers
        # The first layer is a sum, of which the part of the place is fixed.
        place = place_features(off_axis, distance) @ w[5 * self.zone :] + b
        weights = [np.ascontiguousarray(part, np.float32).ravel() for part in (w[: 5 * self.zone], w1, b1, w2, b2)]
        # A missing sonar reads as one that did not fire.
        sonar = np.where(zone.sonar >= 0, zone.sonar, robot.sonars)
        core = _core.PaperNetwork(
            weights,
            robot.sonars,
            np.ascontiguousarray(sonar.T, np.int32),
            np.ascontiguousarray(distance.T),
            np.ascontiguousarray(-(np.abs(off_axis) <= LOOK_RAD).T.astype(np.int32)),
            np.ascontiguousarray(place.T, np.float32),
            self.prior,
        )

        def interpret(ranges: Float[ndarray, "scans sonars"]):
            told = core.look(np.ascontiguousarray(ranges, np.float32))
            spoken = told > self.prior - UNSPOKEN / 2
            return np.where(spoken, told, np.float32(self.prior)), spoken

        return interpret

    def save(self, path: str | Path) -> None:
        """Write the weights and their recipe (NPZ, no pickle)."""
        arrays = {f"{k}{i}": np.asarray(v) for i, wb in enumerate(self.layers) for k, v in zip("wb", wb, strict=True)}
        write_weights(path, FORMAT, self.recipe, {"prior": np.array(self.prior), **arrays})

    @staticmethod
    def load(path: str | Path) -> "Network":
        """Read weights.

        Raises:
            InputError: not a weights file of this format.
        """
        data = read_weights(path, FORMAT)
        count = sum(key.startswith("w") for key in data)
        try:
            layers: Layers = [(data[f"w{i}"], data[f"b{i}"]) for i in range(count)]
            prior, recipe = float(data["prior"]), json.loads(str(data["recipe"]))
        except (KeyError, ValueError, TypeError):
            layers, prior, recipe = [], 0.0, {}
        sizes = [*layers[0][0].shape[:1], *(n for w, _ in layers for n in w.shape[1:])] if layers else []
        fits = len(layers) == 3 and len(sizes) == 4 and sizes[-1] == 1 and 0 < prior < 1
        fits = fits and sizes[0] in map(inputs, range(1, MOST_ZONE + 1))
        for (w, b), (fan_in, fan_out) in zip(layers, pairwise(sizes), strict=False):
            fits = fits and w.shape == (fan_in, fan_out) and b.shape == (fan_out,)
            fits = fits and w.dtype.kind == b.dtype.kind == "f"
            fits = fits and bool(np.isfinite(w).all() and np.isfinite(b).all())
        if not fits:
            wanted = f"two hidden layers from {inputs(1)}, {inputs(2)}, .. or {inputs(MOST_ZONE)} inputs to 1 output"
            raise InputError(path, f"layers {sizes}", wanted)
        return Network(layers, prior, recipe, Path(path).stem)
