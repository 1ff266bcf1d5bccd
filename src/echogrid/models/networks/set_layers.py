"""The set network: one set of weights for any array.

It asks, for a bearing round the robot, the sonars that look nearest to it, as a set: a token a sonar, one encoder
for all, attention and relations between their readings. It answers with the evidence along the whole bearing, as
profiles before and behind each echo, so that walls come out as sharp as the readings are, whatever the cells.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.models.networks.memory import FAR_M, NEIGHBOUR_RAD, SAME_M, TRAITS

TOKENS = 6
"""Sonars that are asked for a bearing."""

LIMIT = 4.0
"""Log-odds at which the evidence of one scan levels off."""

AT_M = 1.2
"""The sonars of a bearing are those whose axes point nearest to its point at this distance from the robot."""

TIE_RAD = 1e-5
"""A sonar that looks so nearly along a bearing, or away from it, has one side of it, whatever rounding makes of it."""

STEPS_M = np.array([-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.45])
"""Knots of the profile of an echo: distance beyond it. Before the first the profile is flat, at the last it is 0."""

RINGS_M = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 2.5])
"""Knots of the profile that is not bound to an echo: distance from the robot."""

FUSE_UNITS = 12
"""Units of the layer that fuses views."""

HIDDEN_UNITS = 24
"""Units of each layer."""

LOOKS = 24.0
"""Looks at a point after which more of them, from wherever they come, hardly make the map surer. Views of one place
repeat each other's errors, and a wall that is driven past thirty times is the same wall."""

BEAM_RAD = 0.22
"""Half a common beam width, which a token's is compared with."""

FEATURES = 20
"""Numbers that the encoder is told of a token."""

Weights = dict[str, Any]
"""Arrays by name; see ``initial``."""

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


def nearest(
    mounts: Float[ndarray, "*n sonars 3"], bearing: Float[ndarray, "bearings"]
) -> Int[ndarray, "*n bearings tokens"]:
    """Indices of the sonars whose axes point nearest to each bearing, the nearest first; -1: no more."""
    x, y, axis = (mounts[..., None, :, k] for k in range(3))
    off = np.arctan2(AT_M * np.sin(bearing)[:, None] - y, AT_M * np.cos(bearing)[:, None] - x) - axis
    off = np.abs(wrap(off))
    missing = max(0, TOKENS - off.shape[-1])
    off = np.pad(np.where(np.isnan(off), 9.0, off), [(0, 0)] * (off.ndim - 1) + [(0, missing)], constant_values=9.0)
    # Ties are broken by the index, whatever rounding makes of them.
    index = np.argsort(np.round(off, 6), axis=-1, kind="stable")[..., :TOKENS]
    return np.where(np.take_along_axis(off, index, axis=-1) < 9.0, index, -1)


def along(mounts, bearing):
    """Axes and places of sonars (first axis) as seen along bearings: axis, ahead, aside of ``Tokens``.

    Turned so that the nearest has the bearing on its left: a mirrored scene is the same scene.
    """
    cos, sin = jnp.cos(bearing), jnp.sin(bearing)
    x, y, axis = mounts
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    axis = axis - bearing
    axis = jnp.arctan2(jnp.sin(axis), jnp.cos(axis))
    axis = jnp.where(axis < TIE_RAD - np.pi, axis + 2 * np.pi, axis)
    off = jnp.arctan2(-aside[0], AT_M - ahead[0]) - axis[0]
    sign = jnp.where(off < -TIE_RAD, -1.0, 1.0)
    return sign * axis, ahead, sign * aside


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


def initial(rng: np.random.Generator, hidden: int = HIDDEN_UNITS) -> Weights:
    """Random weights; the network begins by saying nothing."""
    h = hidden

    def dense(m: int, n: int, gain: float = 1.4) -> Float[ndarray, "m n"]:
        return (gain / np.sqrt(m) * rng.standard_normal((m, n))).astype(np.float32)

    zero = lambda n: np.zeros(n, dtype=np.float32)  # noqa: E731
    return {
        "w1": dense(FEATURES, h),
        "b1": zero(h),
        "a1": dense(h, 2, 1.0),
        "w2": dense(h, h),
        "w2p": dense(2 * h, h, 0.7),
        "w2t": dense(TRAITS, h, 0.7),
        "b2": zero(h),
        "a2": dense(h, 2, 1.0),
        "wp": dense(h, len(STEP_BENDS), 0.05),
        "bp": zero(len(STEP_BENDS)),
        "w3": dense(2 * h, h),
        "b3": zero(h),
        "ws": np.ones(1, dtype=np.float32),
        "wf": dense(4, FUSE_UNITS, 1.0),
        "bf": np.linspace(0.5, -3.0, FUSE_UNITS, dtype=np.float32),
        "wz": dense(FUSE_UNITS, 1, 0.02),
        "wr": dense(h, len(RINGS_M), 0.05),
        "br": zero(len(RINGS_M)),
    }


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


def _bends(knots: Float[ndarray, "knots"]) -> Float[ndarray, "knots bends"]:
    """From values at knots to the piecewise linear function through them, flat outside, as ``_bent`` takes it."""
    slopes = np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, None]
    changes = np.diff(np.pad(slopes, [(1, 1), (0, 0)]), axis=0)
    return np.concatenate([np.eye(len(knots))[:1], changes]).T.astype(np.float32)


# An echo's profile ends at 0.
STEP_BENDS = _bends(STEPS_M)[:-1]
RING_BENDS = _bends(RINGS_M)


def saturated[A: (Array, ndarray)](looks: A, *sums: A, xp: Any = jnp) -> tuple[A, ...]:
    """Sums of evidence, brought down to what so many looks are worth; see LOOKS."""
    share = -LOOKS * xp.expm1(-looks / LOOKS) / xp.maximum(looks, 1e-6)
    return tuple(share * total for total in sums)


def fused[A: (Array, ndarray)](w: Weights, occupied: A, free: A, occupied2: A, free2: A, xp: Any = jnp) -> A:
    """Log-odds of points from the sums of all views' evidence for a surface and against it, and of its squares.

    Where views are independent the difference of the sums is Bayes' rule; they are not: what tells mirrors from
    free space is how much of either there is. The sums are ``saturated``. ``xp``: numpy or jax.numpy.
    """
    told = [xp.log1p(v) for v in (occupied, free, occupied2, free2)]
    total = w["ws"][0] * (occupied - free)
    for i in range(FUSE_UNITS):
        total = total + w["wz"][i, 0] * xp.maximum(
            sum(w["wf"][j, i] * v for j, v in enumerate(told)) + w["bf"][i], 0.0
        )
    return total


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
