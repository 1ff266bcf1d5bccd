"""The paper's network: a perceptron that is asked, for a point, the sonars that look nearest to it."""

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, override

import jax.numpy as jnp
import numpy as np
from jax.nn import sigmoid
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.geometry import wrap
from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.local_map import Bound, Interpreter
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


def reading_features(reading: Float[Array, "*n zone"]) -> Float[Array, "*n 3*zone"]:
    """What the network is told of the readings (m) of a zone: echo or no echo, and the range.

    A sonar that did not fire is neither; ranges far beyond the local map are all alike.
    """
    echo = jnp.isfinite(reading)
    coded = [echo, jnp.isinf(reading), jnp.where(echo, jnp.minimum(reading, 4.0) / 2, 0.0)]
    return jnp.concatenate(coded, axis=-1, dtype=jnp.float32)


def beyond_features(
    reading: Float[Array, "*n zone"], distance: Float[Array | ndarray, "*#n zone"]
) -> Float[Array, "*n 2*zone"]:
    """How far each echo lies beyond the point, coarse and fine; 0 without an echo."""
    echo = jnp.isfinite(reading)
    beyond = jnp.where(echo, reading, 0.0) - distance
    coarse = jnp.where(echo, jnp.clip(beyond / 0.6, -1.0, 1.0), 0.0)
    fine = jnp.where(echo, jnp.maximum(0.0, 1.0 - jnp.abs(beyond) / 0.2), 0.0)
    return jnp.concatenate([coarse, fine], axis=-1)


def place_features(
    off_axis: Float[Array | ndarray, "*n zone"], distance: Float[Array | ndarray, "*n zone"]
) -> Float[Array, "*n zone+1"]:
    """Where the point lies in its zone: its bearing off each axis, and its distance."""
    mean = jnp.mean(distance, axis=-1, keepdims=True)
    return jnp.concatenate([jnp.clip(off_axis / 0.8, -2.0, 2.0), mean], axis=-1)


def inputs(zone: int = ZONE) -> int:
    """Number of the network's inputs: of the readings, of what lies beyond, and of the place, in this order."""
    return 3 * zone + 2 * zone + (zone + 1)


Layers = list[tuple[Float[Array | ndarray, "_ _"], Float[Array | ndarray, "_"]]]


def forward(layers: Layers, x: Float[Array, "*n fan_in"]) -> Float[Array, "*n"]:
    """The multilayer perceptron: log-odds that a point is occupied, under the training prior."""
    w, b = layers[0]
    return after_first(layers, x @ w + b)


def after_first(layers: Layers, x: Float[Array, "*n hidden"]) -> Float[Array, "*n"]:
    """The perceptron from the sums of its first layer on. Its output levels off at LIMIT: no look is certain."""
    for w, b in layers[1:-1]:
        x = jnp.maximum(x, 0.0) @ w + b
    w, b = layers[-1]
    x = jnp.maximum(x, 0.0)
    return LIMIT * jnp.tanh((x @ w + b)[..., 0] / LIMIT)


def look(
    layers: Layers,
    prior: float,
    reading: Float[Array, "*n zone"],
    off_axis: Float[Array, "*n zone"],
    distance: Float[Array, "*n zone"],
) -> tuple[Float[Array, "*n"], Bool[Array, "*n"]]:
    """Occupancy probability of points under the training prior, and whether a sonar that fired looks at them.

    Where none looks the probability is the prior itself.
    """
    coded = [
        reading_features(reading),
        beyond_features(reading, distance),
        place_features(off_axis, distance),
    ]
    p = sigmoid(forward(layers, jnp.concatenate(coded, axis=-1)))
    spoken = looked_at(reading, off_axis)
    return jnp.where(spoken, p, prior), spoken


def looked_at(reading: Float[Array, "*n zone"], off_axis: Float[Array | ndarray, "*#n zone"]) -> Bool[Array, "*n"]:
    """Whether a sonar of the zone that fired looks at the point."""
    return jnp.any(~jnp.isnan(reading) & (jnp.abs(off_axis) <= LOOK_RAD), axis=-1)


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
        # A missing sonar reads as one that did not fire: a column of nan behind the last sonar.
        sonar = np.where(zone.sonar >= 0, zone.sonar, robot.sonars)
        # The first layer is a sum: the part of the place is fixed, the part of the readings is the same for
        # all points that share a zone, and only what lies beyond differs from point to point.
        zones, zone_of_point = np.unique(sonar, axis=0, return_inverse=True)
        w, b = self.layers[0]
        w_reading, w_beyond, w_place = w[: 3 * self.zone], w[3 * self.zone : 5 * self.zone], w[5 * self.zone :]
        place = place_features(off_axis, distance) @ w_place + b
        zone_of_point = zone_of_point.ravel()

        def interpret(ranges: Float[Array, "scans sonars"]):
            padded = jnp.pad(ranges, [(0, 0), (0, 1)], constant_values=jnp.nan)
            reading = padded[:, sonar]
            shared = reading_features(padded[:, zones]) @ w_reading
            sums = beyond_features(reading, distance) @ w_beyond + shared[:, zone_of_point] + place
            spoken = looked_at(reading, off_axis)
            return jnp.where(spoken, sigmoid(after_first(self.layers, sums)), self.prior), spoken

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
