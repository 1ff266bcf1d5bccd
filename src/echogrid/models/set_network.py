"""The set network: one set of weights for any array.

It asks, for a bearing round the robot, the sonars that look nearest to it, as a set: a token a sonar, one encoder
for all, attention and relations between their readings. It answers with the evidence along the whole bearing, as
profiles before and behind each echo, so that walls come out as sharp as the readings are, whatever the cells.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.files import replacing
from echogrid.geometry import wrap
from echogrid.models.memory import FAR_M, NEIGHBOUR_RAD, SAME_M, TRAITS
from echogrid.models.network import LOOK_RAD, read_weights

TOKENS = 6
"""Sonars that are asked for a bearing."""

LIMIT = 4.0
"""Log-odds at which the evidence of one scan levels off."""

AT_M = 1.2
"""The sonars of a bearing are those whose axes point nearest to its point at this distance from the robot."""

STEPS_M = np.array([-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.45])
"""Knots of the profile of an echo: distance beyond it. Before the first the profile is flat, at the last it is 0."""

RINGS_M = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 2.5])
"""Knots of the profile that is not bound to an echo: distance from the robot."""

FUSE_UNITS = 12
"""Units of the layer that fuses views."""

HIDDEN_UNITS = 24
"""Units of each layer."""

FEATURES = 17
"""Numbers that the encoder is told of a token."""

BEARINGS, RINGS, RING_M = 64, 52, 0.05
"""The local map: bearings round the robot, and rings of this width up to REACH_M and one beyond."""

REACH_M = (RINGS - 2) * RING_M
"""How far from the robot the network speaks."""

CAUTION = 0.8
"""Log-odds added to what the views say: to miss a wall is worse than to miss free floor. Training weighs both alike;
this was chosen on development rooms, where it wipes about half as many walls."""

UNDER = -2.0
"""Log-odds of the floor under the robot."""

FORMAT = "echogrid-set-1"
"""Of the weights file."""

Weights = dict[str, Any]
"""Arrays by name; see ``initial``."""

Rows = Float[Array, "_ tokens n"]
"""Numbers of each token, the bearings last."""


class Tokens(NamedTuple):
    """The sonars of bearings and their readings. The first axis is the sonar, the last the bearings, for speed."""

    reading: Float[Array, "tokens n"]
    """m; inf = no echo, nan = not fired or no such sonar."""
    max_range: Float[Array, "n"]
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


def asked(mounts: Float[ndarray, "*n sonars 3"]) -> Int[ndarray, "*n bearings tokens"]:
    """The sonars that are asked for each bearing of the local map, see ``nearest``."""
    return nearest(mounts, np.arange(BEARINGS) * (2 * np.pi / BEARINGS))


def along(mounts, bearing):
    """Axes and places of sonars (first axis) as seen along bearings: axis, ahead, aside of ``Tokens``.

    Turned so that the nearest has the bearing on its left: a mirrored scene is the same scene.
    """
    cos, sin = jnp.cos(bearing), jnp.sin(bearing)
    x, y, axis = mounts
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    axis = axis - bearing
    axis = jnp.arctan2(jnp.sin(axis), jnp.cos(axis))
    off = jnp.arctan2(-aside[0], AT_M - ahead[0]) - axis[0]
    sign = jnp.where(off < 0, -1.0, 1.0)
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
        "wp": dense(h, len(_STEP_BENDS), 0.05),
        "bp": zero(len(_STEP_BENDS)),
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
    bends, bias = w["wp"] @ _STEP_BENDS, w["bp"] @ _STEP_BENDS
    profiles = jnp.where(echo, _dense(bends, h2) + bias[:, None, None], 0.0)
    bends, bias = w["wr"] @ _RING_BENDS, w["br"] @ _RING_BENDS
    rings = _dense(bends, jnp.maximum(_dense(w["w3"], pooled) + w["b3"][:, None], 0.0)) + bias[:, None]
    return profiles, rings


def _bends(knots: Float[ndarray, "knots"]) -> Float[ndarray, "knots bends"]:
    """From values at knots to the piecewise linear function through them, flat outside, as ``_bent`` takes it."""
    slopes = np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, None]
    changes = np.diff(np.pad(slopes, [(1, 1), (0, 0)]), axis=0)
    return np.concatenate([np.eye(len(knots))[:1], changes]).T.astype(np.float32)


# An echo's profile ends at 0.
_STEP_BENDS = _bends(STEPS_M)[:-1]
_RING_BENDS = _bends(RINGS_M)


def fused[A: (Array, ndarray)](w: Weights, occupied: A, free: A, occupied2: A, free2: A, xp: Any = jnp) -> A:
    """Log-odds of points from the sums of all views' evidence for a surface and against it, and of its squares.

    Where views are independent the difference of the sums is Bayes' rule; they are not: what tells mirrors from
    free space is how much of either there is. ``xp``: numpy or jax.numpy.
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


class Mounted(NamedTuple):
    """What a robot's array fixes of the local map; a JAX pytree, so that arrays of one size share a compilation."""

    sonar: Int[Array | ndarray, "tokens bearings"]
    """Column of the readings, of which one more than there are sonars is nan."""
    axis: Float[Array | ndarray, "tokens bearings"]
    ahead: Float[Array | ndarray, "tokens bearings"]
    aside: Float[Array | ndarray, "tokens bearings"]
    distance: Float[Array | ndarray, "tokens bearings rings"]
    """From each sonar to each point, m."""
    looks: Float[Array | ndarray, "tokens bearings rings"]
    """1 where the sonar looks at the point."""
    under: Bool[ndarray, "rings"]
    """Rings on which the robot itself stands."""
    max_range: float


def array_of(mounts: Float[ndarray, "sonars 3"], max_range: float, footprint_radius: float) -> Mounted:
    """Prepare for an array: mounts in m and rad (nan: no such sonar)."""
    bearing = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    sonar = asked(mounts).T
    there = sonar >= 0
    placed = np.asarray(along(np.moveaxis(mounts[sonar], -1, 0), bearing))
    axis, ahead, aside = np.where(there, placed, 0.0).astype(np.float32)
    ring = (np.arange(RINGS) + 0.5) * RING_M
    forward, left = ring - ahead[..., None], -aside[..., None]
    off = np.abs(wrap(np.arctan2(left, forward) - axis[..., None]))
    distance = np.hypot(forward, left).astype(np.float32)
    looks = (there[..., None] & (off <= LOOK_RAD)).astype(np.float32)
    return Mounted(sonar, axis, ahead, aside, distance, looks, ring < footprint_radius, max_range)


def moved(
    array: Mounted, mounts: Float[Array | ndarray, "sonars 3"], sonar: Int[Array | ndarray, "bearings tokens"]
) -> Mounted:
    """The array with its sonars at other mounts (m, m, rad), and those asked for each bearing as of ``asked``."""
    bearing = jnp.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    array = array._replace(sonar=sonar.T)
    there = array.sonar >= 0
    axis, ahead, aside = along(jnp.moveaxis(jnp.asarray(mounts)[array.sonar], -1, 0), bearing)
    axis, ahead, aside = (jnp.where(there, value, 0.0) for value in (axis, ahead, aside))
    ring = (np.arange(RINGS) + 0.5) * RING_M
    forward, left = ring - ahead[..., None], -aside[..., None]
    off = jnp.arctan2(left, forward) - axis[..., None]
    off = jnp.abs(jnp.arctan2(jnp.sin(off), jnp.cos(off)))
    looks = jnp.where(there[..., None] & (off <= LOOK_RAD), 1.0, 0.0)
    return array._replace(axis=axis, ahead=ahead, aside=aside, distance=jnp.hypot(forward, left), looks=looks)


def _bearing_of(x, y):
    """Bearing of points in units of the local map's bearings, in [0, BEARINGS); exact to 0.2 degrees."""
    across, along_ = jnp.abs(y), jnp.abs(x)
    z = jnp.minimum(across, along_) / (jnp.maximum(across, along_) + 1e-9)
    a = z * (np.pi / 4 + 0.273 * (1 - z))
    a = jnp.where(across > along_, np.pi / 2 - a, a)
    a = jnp.where(x < 0, np.pi - a, a)
    a = jnp.where(y < 0, 2 * np.pi - a, a)
    return a * (BEARINGS / (2 * np.pi))


def local_map(
    w: Weights, array: Mounted, ranges: Float[Array, "scans sonars"], traits: Float[Array, "scans traits"]
) -> Float[Array, "scans bearings rings"]:
    """What scans (m) tell of the points of the local map: log-odds; 0 where no sonar that fired looks."""
    scans = len(ranges)
    padded = jnp.pad(ranges, [(0, 0), (0, 1)], constant_values=jnp.nan)
    reading = jnp.moveaxis(padded[:, array.sonar], 0, 1)
    spread = lambda v: jnp.broadcast_to(v[:, None], reading.shape).reshape(TOKENS, -1)  # noqa: E731
    told = Tokens(
        reading.reshape(TOKENS, -1),
        jnp.full(scans * BEARINGS, array.max_range, jnp.float32),
        spread(array.axis),
        spread(array.ahead),
        spread(array.aside),
        jnp.repeat(traits.T, BEARINGS, axis=1),
    )
    told = jax.lax.optimization_barrier(told)
    profiles, rings = jax.lax.optimization_barrier(encode(w, told))
    profiles = profiles.reshape(-1, TOKENS, scans, BEARINGS, 1)
    rings = rings.reshape(-1, scans, BEARINGS, 1)
    # Without an echo any number serves, for the profile is 0.
    heard, fired = jax.lax.optimization_barrier(
        (
            jnp.where(jnp.isfinite(reading), reading, 0.0)[..., None],
            jnp.where(jnp.isnan(reading), 0.0, 1.0)[..., None],
        )
    )
    beyond = array.distance[:, None] - heard
    ring = jnp.asarray((np.arange(RINGS) + 0.5) * RING_M, jnp.float32)
    found = jax.lax.optimization_barrier(evidence(profiles, rings, beyond, ring))
    spoken = sum(array.looks[k] * fired[k] for k in range(TOKENS))
    return jnp.where(array.under, UNDER, jnp.where(spoken > 0, found, 0.0))


def view(
    w: Weights,
    array: Mounted,
    ranges: Float[Array, "scans sonars"],
    traits: Float[Array, "scans traits"],
    x: Float[Array, "scans *n"],
    y: Float[Array, "scans *n"],
) -> Float[Array, "scans *n"]:
    """What scans (m) tell of points (robot frame, m): log-odds; 0 = nothing, as beyond REACH_M."""
    table = local_map(w, array, ranges, traits)
    # The first bearing comes again behind the last.
    table = jnp.concatenate([table, table[:, :1]], axis=1).reshape(-1)
    distance = jnp.sqrt(x * x + y * y)
    bearing, out = _bearing_of(x, y), distance / RING_M - 0.5
    table, bearing, out = jax.lax.optimization_barrier((table, bearing, out))
    i = jnp.clip(bearing.astype(jnp.int32), 0, BEARINGS - 1)
    j = jnp.clip(out.astype(jnp.int32), 0, RINGS - 2)
    u, v = bearing - i, jnp.clip(out - j, 0.0, 1.0)
    first = jnp.arange(len(x), dtype=jnp.int32).reshape(-1, *[1] * (x.ndim - 1)) * ((BEARINGS + 1) * RINGS)
    first = first + i * RINGS + j
    take = lambda at: table.at[at].get(mode="promise_in_bounds")  # noqa: E731
    low = (1 - v) * take(first) + v * take(first + 1)
    high = (1 - v) * take(first + RINGS) + v * take(first + RINGS + 1)
    return jnp.where(distance <= REACH_M, (1 - u) * low + u * high, 0.0)


def moved_view(
    w: Weights,
    array: Mounted,
    ranges: Float[Array, "scans sonars"],
    traits: Float[Array, "scans traits"],
    x: Float[Array, "scans *n"],
    y: Float[Array, "scans *n"],
    mounts: Float[Array, "scans sonars 3"],
    sonar: Int[Array, "scans bearings tokens"],
) -> Float[Array, "scans *n"]:
    """``view`` of scans whose sonars looked from mounts of their own; see ``moved``."""

    def one(ranges, traits, x, y, mounts, sonar):
        return view(w, moved(array, mounts, sonar), ranges[None], traits[None], x[None], y[None])[0]

    return jax.vmap(one)(ranges, traits, x, y, mounts, sonar)


@dataclass(frozen=True)
class SetNetwork:
    """The set network with its weights."""

    weights: Weights
    recipe: dict[str, Any]
    """How the weights were made."""
    name: str = "set-network"

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
        with replacing(Path(path)) as temporary, temporary.open("wb") as file:
            np.savez(file, allow_pickle=False, format=FORMAT, recipe=json.dumps(self.recipe), **arrays)

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
        shapes = {name: value.shape for name, value in initial(np.random.default_rng(0), max(units, 1)).items()}
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
