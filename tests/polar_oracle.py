"""The set network's polar map in JAX, its encoder that of the training: what the compiled core is held to."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.models.model import CONE_RAD, LOOK_RAD
from echogrid.models.networks.set_core import BEARINGS, LEAST_RAD, REACH_M, RING_M, RINGS, UNDER, ends_within
from echogrid.models.networks.set_encoder import Tokens, along, encode, evidence
from echogrid.models.networks.set_layers import TOKENS, Weights, nearest


def asked(mounts: Float[ndarray, "*n sonars 3"]) -> Int[ndarray, "*n bearings tokens"]:
    """The sonars that are asked for each bearing of the local map, see ``nearest``."""
    return nearest(mounts, np.arange(BEARINGS) * (2 * np.pi / BEARINGS))


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
    footprint: float
    """Radius of the robot, m."""
    max_range: Float[Array | ndarray, "sonars"]
    """Of each sonar, m."""
    ends: Float[Array | ndarray, "2 tokens bearings"] | None
    """How far from the robot's middle (m; 0: nowhere) each sonar can tell of the sector up to the next bearing, and
    of that from the one before. None where all sonars reach past the local map."""
    beam: float
    """Half the beam width, rad."""


def array_of(
    mounts: Float[ndarray, "sonars 3"],
    max_range: Float[ndarray, "sonars"] | float,
    footprint_radius: float,
    beam_width: float,
    ends: bool = False,
) -> Mounted:
    """Prepare for an array.

    Args:
        mounts: m and rad (nan: no such sonar).
        max_range: of each sonar or of all, m.
        footprint_radius: of the robot, m.
        beam_width: of the sonars, rad.
        ends: whether what a sonar tells is to end at its range even if that lies past the local map, as for an array
            whose sonars move.
    """
    bearing = np.arange(BEARINGS) * (2 * np.pi / BEARINGS)
    sonar = asked(mounts).T
    there = sonar >= 0
    placed = np.asarray(along(np.moveaxis(mounts[sonar], -1, 0), bearing))
    axis, ahead, aside = np.where(there, placed, 0.0).astype(np.float32)
    ring = (np.arange(RINGS) + 0.5) * RING_M
    forward, left = ring - ahead[..., None], -aside[..., None]
    off = np.abs(wrap(np.arctan2(left, forward) - axis[..., None]))
    distance = np.hypot(forward, left).astype(np.float32)
    looks = there[..., None] & (off <= LOOK_RAD)
    own = np.broadcast_to(np.float32(max_range), len(mounts))
    exits = None
    if ends or ends_within(mounts, max_range):
        looks &= distance <= own[sonar][..., None] + RING_M
        exits = np.where(there, np.asarray(_ends(mounts[sonar], own[sonar])), 0.0).astype(np.float32)
    looks = looks.astype(np.float32)
    under = ring < footprint_radius
    return Mounted(
        sonar,
        axis,
        ahead,
        aside,
        distance,
        looks,
        under,
        footprint_radius,
        own,
        exits,
        max(beam_width / 2, LEAST_RAD),
    )


def _ends(mounts: Float[Array | ndarray, "tokens bearings 3"], reach: Float[Array | ndarray, "tokens bearings"]):
    """``Mounted.ends`` of the sonars asked for each bearing: where rays leave what lies within range and cone.

    That is convex, so that between two rays nothing of it lies farther out than the nearer end of both but by a hair.
    """
    x, y, axis = jnp.moveaxis(jnp.asarray(mounts), -1, 0)

    def leaves(bearing):
        cos, sin = np.cos(bearing), np.sin(bearing)
        ahead, aside = cos * x + sin * y, cos * y - sin * x
        half = jnp.sqrt(jnp.maximum(reach**2 - aside**2, 0.0))
        enter, leave = ahead - half, ahead + half
        for side in (CONE_RAD, -CONE_RAD):
            # Of the cone's edge: how far inside of it the middle lies, and how fast the ray goes inside.
            edge = axis + side - np.pi / 2 * np.sign(side)
            inside, into = -(jnp.cos(edge) * x + jnp.sin(edge) * y), jnp.cos(edge - bearing)
            crosses = -inside / jnp.where(jnp.abs(into) < 1e-6, 1e-6, into)
            leave = jnp.where(into < 0, jnp.minimum(leave, crosses), leave)
            enter = jnp.where(into < 0, enter, jnp.maximum(enter, crosses))
        return jnp.where((leave > enter) & (leave > 0) & (half > 0), leave, 0.0)

    step = 2 * np.pi / BEARINGS
    before, here, after = (leaves((np.arange(BEARINGS) + k) * step) for k in (-1, 0, 1))
    return jnp.stack([jnp.minimum(here, after), jnp.minimum(before, here)])


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
    distance, ends = jnp.hypot(forward, left), array.ends
    looks = there[..., None] & (off <= LOOK_RAD)
    if ends is not None:
        own = jnp.asarray(array.max_range)[array.sonar]
        looks &= distance <= own[..., None] + RING_M
        ends = jnp.where(there, _ends(jnp.asarray(mounts)[array.sonar], own), 0.0)
    looks = jnp.where(looks, 1.0, 0.0)
    return array._replace(axis=axis, ahead=ahead, aside=aside, distance=distance, looks=looks, ends=ends)


def _bearing_of(x, y):
    """Bearing of points in units of the local map's bearings, in [0, BEARINGS); exact to 0.2 degrees."""
    across, along_ = jnp.abs(y), jnp.abs(x)
    z = jnp.minimum(across, along_) / (jnp.maximum(across, along_) + 1e-9)
    a = z * (np.pi / 4 + 0.273 * (1 - z))
    a = jnp.where(across > along_, np.pi / 2 - a, a)
    a = jnp.where(x < 0, np.pi - a, a)
    a = jnp.where(y < 0, 2 * np.pi - a, a)
    return a * (BEARINGS / (2 * np.pi))


def _readings(array: Mounted, ranges: Float[Array, "scans sonars"]) -> Float[Array, "tokens scans bearings"]:
    """Of the sonars asked for each bearing, nan where there is none."""
    padded = jnp.pad(ranges, [(0, 0), (0, 1)], constant_values=jnp.nan)
    return jnp.moveaxis(padded[:, array.sonar], 0, 1)


def told_until(array: Mounted, ranges: Float[Array, "scans sonars"]) -> Float[Array, "scans bearings"]:
    """How far from the robot's middle (m) the sonars that fired can tell, from each bearing to the next."""
    fired = ~jnp.isnan(_readings(array, ranges))
    after, before = (jnp.max(jnp.where(fired, end[:, None], 0.0), axis=0) for end in jnp.asarray(array.ends))
    told = jnp.maximum(after, jnp.roll(before, -1, axis=1))
    return jnp.clip(told, array.footprint, REACH_M)


def local_map(
    w: Weights, array: Mounted, ranges: Float[Array, "scans sonars"], traits: Float[Array, "scans traits"]
) -> Float[Array, "scans bearings rings"]:
    """What scans (m) tell of the points of the local map: log-odds; 0 where no sonar that fired looks."""
    scans = len(ranges)
    reading = _readings(array, ranges)
    spread = lambda v: jnp.broadcast_to(v[:, None], reading.shape).reshape(TOKENS, -1)  # noqa: E731
    told = Tokens(
        reading.reshape(TOKENS, -1),
        spread(jnp.asarray(array.max_range)[array.sonar]),
        jnp.full((1, scans * BEARINGS), array.beam, jnp.float32),
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
    scan = jnp.arange(len(x), dtype=jnp.int32).reshape(-1, *[1] * (x.ndim - 1))
    first = scan * ((BEARINGS + 1) * RINGS) + i * RINGS + j
    take = lambda at: table.at[at].get(mode="promise_in_bounds")  # noqa: E731
    low = (1 - v) * take(first) + v * take(first + 1)
    high = (1 - v) * take(first + RINGS) + v * take(first + RINGS + 1)
    reach = REACH_M
    if array.ends is not None:
        reach = told_until(array, ranges).reshape(-1).at[scan * BEARINGS + i].get(mode="promise_in_bounds")
    return jnp.where(distance <= reach, (1 - u) * low + u * high, 0.0)


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
