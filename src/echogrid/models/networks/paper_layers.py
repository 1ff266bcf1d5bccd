"""The paper's network in JAX: what training differentiates, and the compiled core is held to."""

import jax
import jax.numpy as jnp
from jax.nn import sigmoid
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.local_map import LOCAL_CELLS
from echogrid.models.networks.paper_network import LIMIT, Layers, place_features


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
        place_features(off_axis, distance, jnp),
    ]
    p = sigmoid(forward(layers, jnp.concatenate(coded, axis=-1)))
    spoken = looked_at(reading, off_axis)
    return jnp.where(spoken, p, prior), spoken


def looked_at(reading: Float[Array, "*n zone"], off_axis: Float[Array | ndarray, "*#n zone"]) -> Bool[Array, "*n"]:
    """Whether a sonar of the zone that fired looks at the point."""
    return jnp.any(~jnp.isnan(reading) & (jnp.abs(off_axis) <= LOOK_RAD), axis=-1)


def surrounding(
    x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> tuple[list[Int[Array, "*n"]], list[Float[Array, "*n"]], Bool[Array, "*n"]]:
    """The four local cells whose centres surround each point, their weights by eq. 4, and whether there are four.

    Args:
        x: forward, in cells, counted from the centre of the first cell; see ``in_cells``.
        y: to the left, likewise.

    Returns:
        For each of the four its flat index, and its weight 1/distance as a share of their sum (at a centre that
        cell alone); whether the point lies within the outermost centres. Lists, for arrays with a short last
        axis are slow.
    """
    col, row = (jnp.clip(jnp.floor(place), 0, LOCAL_CELLS - 2) for place in (x, y))
    u, v = x - col, y - row
    inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
    first = (row * LOCAL_CELLS + col).astype(jnp.int32)
    steps = [(0, 0), (1, 0), (0, 1), (1, 1)]
    near = [jax.lax.rsqrt((u - du) ** 2 + (v - dv) ** 2 + 1e-12) for du, dv in steps]
    total = near[0] + near[1] + near[2] + near[3]
    return [first + du + LOCAL_CELLS * dv for du, dv in steps], [weight / total for weight in near], inside
