"""The set network's encoder and evidence in JAX: what training differentiates, and the compiled core is held to."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from echogrid.models.networks.memory import FAR_M, NEIGHBOUR_RAD, SAME_M
from echogrid.models.networks.set_layers import (
    AT_M,
    BEAM_RAD,
    LIMIT,
    RING_BENDS,
    RINGS_M,
    STEP_BENDS,
    STEPS_M,
    TIE_RAD,
    Weights,
)

Rows = Float[Array, "_ tokens n"]
"""Numbers of each token, the bearings last."""


class Tokens(NamedTuple):
    """The sonars of bearings and their readings. The first axis is the sonar, the last the bearings, for speed."""

    reading: Float[Array, "tokens n"]
    """m; inf = no echo, nan = not fired or no such sonar."""
    max_range: Float[Array, "#tokens n"]
    beam: Float[Array, "#tokens n"]
    """Half the beam width, rad."""
    axis: Float[Array, "tokens n"]
    """Of the sonar relative to the bearing, rad."""
    ahead: Float[Array, "tokens n"]
    """Place of the sonar along the bearing, m."""
    aside: Float[Array, "tokens n"]
    """Place of the sonar across the bearing, to the left, m."""
    traits: Float[Array, "traits n"]
    """What the surroundings are like, see ``Memory``."""


def along(mounts, bearing):
    """Axes and places of sonars (first axis) as seen along bearings: axis, ahead, aside of ``Tokens``.

    Turned so that the nearest has the bearing on its left: a mirrored scene is the same scene. Of a sonar that looks
    away from the bearing the axis is minus half a turn.
    """
    cos, sin = jnp.cos(bearing), jnp.sin(bearing)
    x, y, axis = mounts
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    axis = axis - bearing
    axis = _on_the_right(jnp.arctan2(jnp.sin(axis), jnp.cos(axis)))
    off = jnp.arctan2(-aside[0], AT_M - ahead[0]) - axis[0]
    sign = jnp.where(off < -TIE_RAD, -1.0, 1.0)
    return _on_the_right(sign * axis), ahead, sign * aside


def _on_the_right(axis):
    """An axis in [-half a turn, half a turn), whatever rounding makes of one that looks away from the bearing."""
    return jnp.where(axis > jnp.pi - TIE_RAD, axis - 2 * jnp.pi, axis)


def _compared(t: Tokens, place, fired):
    """How the reading of each token compares with those of sonars that look nearly the same way.

    How many agree with it to some centimetres, and how much farther they read, fine and coarse.
    """
    same = fine = coarse = 0.0
    for j in range(place.shape[0]):
        near = fired[j] * jnp.exp(-(((t.axis - t.axis[j]) / NEIGHBOUR_RAD) ** 2))
        apart = place[j] - place
        same = same + near * jnp.maximum(1 - jnp.abs(apart) / SAME_M, 0.0)
        fine = fine + near * jnp.clip(apart / 0.25, -1.0, 1.0)
        coarse = coarse + near * jnp.clip(apart, -1.0, 1.0)
    return same - 1, fine, coarse


def features(t: Tokens) -> Rows:
    """What the encoder is told of each token [f, tokens, n]."""
    fired = ~jnp.isnan(t.reading)
    echo = jnp.isfinite(t.reading)
    r = jnp.clip(jnp.where(echo, t.reading, t.max_range), 0.01, FAR_M)
    place = t.ahead + jnp.sqrt(jnp.maximum(r * r - t.aside * t.aside, 0.01))
    # The bearing's point at the range of the echo, off the sonar's axis; the angle's sine is aside / r.
    sine = jnp.clip(t.aside / r, -1.0, 1.0)
    off = -(sine + sine**3 / 6) - t.axis
    first = jnp.min(jnp.where(echo, place, FAR_M + 1.0), axis=0)
    after = place - first
    same, fine, coarse = jax.lax.optimization_barrier(_compared(t, place, fired))
    told = [
        echo,
        fired & ~echo,
        jnp.sin(t.axis),
        jnp.cos(t.axis),
        jnp.exp(-((off / 0.1) ** 2)),
        jnp.exp(-((off / 0.25) ** 2)),
        jnp.exp(-((off / 0.5) ** 2)),
        off,
        r / 2,
        jnp.exp(-r / 0.5),
        jnp.maximum(1 - after / 0.1, 0.0),
        jnp.minimum(after, 0.5) * 2,
        t.ahead * 3,
        t.aside * 3,
        same,
        fine,
        coarse,
        jnp.log(t.beam / BEAM_RAD),
        jnp.exp(-((off / t.beam) ** 2)),
        jnp.minimum(t.max_range, FAR_M) / FAR_M,
    ]
    return jnp.stack([jnp.where(fired, jnp.asarray(v, jnp.float32), 0.0) for v in told])


def _dense(w, x):
    """Weights [m, k] on x [m, ..., n]."""
    return (w.T @ x.reshape(x.shape[0], -1)).reshape(w.shape[1], *x.shape[1:])


def _over_tokens(x: Rows) -> Float[Array, "_ n"]:
    """Sum over the tokens; written out, for the compiler's sums over an axis that is not the last are slow."""
    total = x[:, 0]
    for k in range(1, x.shape[1]):
        total = total + x[:, k]
    return total


def _pool(h: Rows, scores: Rows, fired: Bool[Array, "tokens n"]) -> Float[Array, "_ n"]:
    """Two weighted means over the tokens of h [f, tokens, n]; scores [2, tokens, n]."""
    e = jnp.exp(jnp.clip(scores, -10.0, 10.0)) * fired
    # Without the barriers the compiler works the same out again for each feature.
    share = jax.lax.optimization_barrier(e / (_over_tokens(e) + 1e-6)[:, None])
    return jnp.concatenate([_over_tokens(share[i] * h) for i in range(2)])


def encode(w: Weights, t: Tokens) -> tuple[Rows, Float[Array, "bends n"]]:
    """The echoes' profiles [bends, tokens, n] and the profile by distance [bends, n], log-odds; see ``_bent``."""
    fired, echo = ~jnp.isnan(t.reading), jnp.isfinite(t.reading)
    f = jax.lax.optimization_barrier(features(t))
    h = jax.lax.optimization_barrier(jnp.maximum(_dense(w["w1"], f) + w["b1"][:, None, None], 0.0) * fired)
    pooled = _pool(h, _dense(w["a1"], h), fired)
    h2 = _dense(w["w2"], h) + (_dense(w["w2p"], pooled) + _dense(w["w2t"], t.traits - 0.5))[:, None]
    h2 = jax.lax.optimization_barrier(jnp.maximum(h2 + w["b2"][:, None, None], 0.0))
    pooled = _pool(h2, _dense(w["a2"], h2), fired)
    bends, bias = w["wp"] @ STEP_BENDS, w["bp"] @ STEP_BENDS
    profiles = jnp.where(echo, _dense(bends, h2) + bias[:, None, None], 0.0)
    bends, bias = w["wr"] @ RING_BENDS, w["br"] @ RING_BENDS
    rings = _dense(bends, jnp.maximum(_dense(w["w3"], pooled) + w["b3"][:, None], 0.0)) + bias[:, None]
    return profiles, rings


def _bent(bends, knots, x):
    """Piecewise linear function that begins with bends[0] and changes its slope by bends[i + 1] at knots[i]."""
    total = bends[0]
    for bend, knot in zip(bends[1:], knots, strict=True):
        total = total + bend * jnp.maximum(x - knot, 0.0)
    return total


def evidence(profiles, rings, beyond, distance):
    """Evidence for a surface at points of a bearing, log-odds [n].

    Args:
        profiles: from ``encode``.
        rings: likewise.
        beyond: how far each token's echo lies before the point, m [tokens, n]; any number without an echo.
        distance: of the point from the robot, m [n].
    """
    total = _bent(list(rings), RINGS_M, distance)
    for k in range(len(beyond)):
        total = total + _bent(list(profiles[:, k]), STEPS_M, beyond[k])
    return LIMIT * jnp.tanh(total / LIMIT)
