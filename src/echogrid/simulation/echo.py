"""Echo paths through a world, and the first echo above the threshold.

A fan of specular rays finds which walls a pulse meets one after another; each echo's range, bearing and
level are then exact (image sources), and only its visibility is resolved to the width of a ray, which is kept
below the first Fresnel zone. A path comes home in one of three ways:

- it closes on the sensor after 1 to 3 mirror reflections (a plane, a corner, the long multiple reflections);
- it returns on itself from an edge or a cylinder, seen directly or through up to 3 mirrors;
- it returns on itself from the diffuse part of a rough wall, seen directly or through mirrors.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from echogrid.simulation.acoustics import BEAM_ENTRIES, CHORD_STEP, Acoustics
from echogrid.simulation.scene import RAYS, Scene

BOUNCES = 3
"""Highest order of mirror reflections that is followed."""

FAN_RAD = np.deg2rad(73.5)
"""Width of the fan: beyond it no beam pattern reaches the threshold."""

# Up to these angles off the normal a wall ends an axis ray: a smooth one, and one that is rougher than _ROUGH_M.
_SQUARE, _OBLIQUE = np.cos(np.deg2rad(12.5)), np.cos(np.deg2rad(60.0))
_ROUGH_M = 4e-4
_FAR = 1e6
_NOTHING = 1e9


class _Rays(NamedTuple):
    """A leg of the fan. Each field has one value a ray; directions are unit vectors."""

    x: Float[Array, "m"]
    y: Float[Array, "m"]
    ux: Float[Array, "m"]
    uy: Float[Array, "m"]
    vx: Float[Array, "m"]
    """The sensor's image, from which this leg seems to come."""
    vy: Float[Array, "m"]
    parity: Float[Array, "m"]
    """-1 after an odd number of mirrors: left and right are swapped."""
    run: Float[Array, "m"]
    """Length of the path so far, m."""
    loss: Float[Array, "m"]
    """One-way loss at the mirrors met so far, dB (negative)."""
    left: Int[Array, "m"]
    """The wall at which this leg begins; -1: none."""


class _Hit(NamedTuple):
    """The wall that each ray meets first."""

    wall: Int[Array, "m"]
    distance: Float[Array, "m"]
    """From the leg's begin, m; _FAR where there is no wall."""
    normal_x: Float[Array, "m"]
    normal_y: Float[Array, "m"]
    offset: Float[Array, "m"]
    """Hessian form of the wall's line, with the normal."""
    roughness: Float[Array, "m"]
    towards: Float[Array, "m"]
    """Cosine between the ray and the normal, either sign."""


def _first_hit(scene: Scene, rays: _Rays) -> _Hit:
    nx, ny = scene.normal[:, :1], scene.normal[:, 1:]
    dx, dy = scene.along[:, :1], scene.along[:, 1:]
    t = (scene.offset[:, None] - (rays.x * nx + rays.y * ny)) / (rays.ux * nx + rays.uy * ny)
    s = (rays.x + t * rays.ux) * dx + (rays.y + t * rays.uy) * dy - scene.begin[:, None]
    # A mirror does not meet itself again; its neighbour in a corner may be as near as rounding goes.
    other = jnp.arange(len(scene.length))[:, None] != rays.left
    ok = other & (t > -1e-5) & (s >= 0) & (s <= scene.length[:, None])
    t = jnp.maximum(t, 0.0)
    wall, found = _nearest(ok, t)
    hx, hy, offset = scene.normal[wall, 0], scene.normal[wall, 1], scene.offset[wall]
    towards = rays.ux * hx + rays.uy * hy
    distance = jnp.where(found, (offset - (rays.x * hx + rays.y * hy)) / towards, _FAR)
    return _Hit(wall, distance, hx, hy, offset, scene.roughness[wall], towards)


def _nearest(ok: Bool[Array, "n m"], distance: Float[Array, "n m"]) -> tuple[Int[Array, "m"], Bool[Array, "m"]]:
    """For each ray the index of the nearest of n things that are ok, and whether there is any.

    The order of positive floats is the order of their bits: the index rides in the lowest bits, so that one
    vectorised minimum finds it (distances are compared to 1e-5 of their value).
    """
    count = distance.shape[0]
    mask = (1 << max(count - 1, 1).bit_length()) - 1
    bits = jax.lax.bitcast_convert_type(jnp.where(ok, distance, _FAR), jnp.int32)
    best = jnp.min((bits & ~mask) | jnp.arange(count, dtype=jnp.int32)[:, None], axis=0)
    return best & mask, jax.lax.bitcast_convert_type(best, jnp.float32) < 0.5 * _FAR


def _spreading(ac: Acoustics, r: Float[Array, "..."]) -> Float[Array, "..."]:
    """Level (dB above the threshold) of a smooth plane on the axis at range r."""
    ramp = ac.gain_ramp_db * jnp.clip((r - 1.0) / 9.7, 0.0, 1.0)
    return jnp.asarray(ac.level_db - 20 * jnp.log10(r) - 2 * ac.absorption * (r - 1.0) + ramp)


def _beam(ac: Acoustics, cos: Float[Array, "m"]) -> Float[Array, "m"]:
    """One-way level of the beam in a direction, given the cosine of its angle off the axis."""
    chord = jnp.sqrt(jnp.maximum(2 - 2 * cos, 0.0))
    return jnp.asarray(ac.beam_db)[jnp.minimum(chord / CHORD_STEP + 0.5, BEAM_ENTRIES - 1).astype(jnp.int32)]


def _fan_beam(
    ac: Acoustics, fan: Float[Array, "rays"], step: float
) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """One-way level of the beam along each ray of the fan, and its slope within the ray's width, dB/rad."""
    low, high = _beam(ac, jnp.cos(fan - step / 2)), _beam(ac, jnp.cos(fan + step / 2))
    return _beam(ac, jnp.cos(fan)), (high - low) / step


def _crossing(ac: Acoustics, ok: Bool[Array, "..."], r: Float[Array, "..."], level: Float[Array, "..."]):
    """Range at which an echo is read: where it crosses the threshold; _NOTHING below the threshold."""
    late = ac.walk * jnp.exp(-0.1151 * level)
    return jnp.where(ok & (level >= 0) & (r > 0.02), r + late, _NOTHING)


def _seen_from_image(rays: _Rays, x, y, half_width):
    """Distance from the leg's image source to a point, its offset from the ray, and whether the ray covers it."""
    px, py = x - rays.vx, y - rays.vy
    distance = jnp.sqrt(px * px + py * py) + 1e-9
    sideways = (rays.ux * py - rays.uy * px) / distance
    ahead = rays.ux * px + rays.uy * py > 0
    return distance, sideways, ahead & (jnp.abs(sideways) <= half_width * 1.0001)


def first_echo(
    scene: Scene,
    ac: Acoustics,
    p_world: Float[Array, "sonars 2"],
    axis: Float[Array, "sonars"],
    level_offset: Float[Array, "sonars"],
    rays: int = RAYS,
) -> Float[Array, "sonars"]:
    """Range (m) that each sonar reads without range noise: its first echo above the threshold, or inf.

    Args:
        scene: the world.
        ac: the acoustics.
        p_world: where each sonar is, m.
        axis: where it points, rad.
        level_offset: dB added to all echoes of a sonar (fluctuation of the level).
        rays: rays of the fan, an odd number; more resolve visibility finer.
    """
    step = FAN_RAD / rays
    fan = (jnp.arange(rays) - (rays - 1) / 2) * step
    sonars = axis.shape[0]
    spread = lambda v: jnp.repeat(v, rays)  # noqa: E731
    bearing = (axis[:, None] + fan).reshape(-1)
    sx, sy = spread(p_world[:, 0]), spread(p_world[:, 1])
    axis_x, axis_y = spread(jnp.cos(axis)), spread(jnp.sin(axis))
    gain = spread(level_offset)
    beam, slope = (jnp.tile(v, sonars) for v in _fan_beam(ac, fan, step))
    zero = jnp.zeros_like(bearing)
    leg = _Rays(
        sx, sy, jnp.cos(bearing), jnp.sin(bearing), sx, sy, zero + 1.0, zero, zero, jnp.full_like(zero, -1, jnp.int32)
    )
    best = jnp.full_like(bearing, _NOTHING)
    way = jnp.full_like(bearing, _NOTHING)

    for order in range(BOUNCES + 1):
        # Without the barrier the compiler computes parts of a leg again for each of its uses (1.7 times slower).
        leg = jax.lax.optimization_barrier(leg)
        hit = _first_hit(scene, leg)
        to_wall, cylinder = _cylinder_in_front(scene, leg, hit.distance)
        end = leg.run + to_wall

        if order > 0:
            distance, sideways, covered = _seen_from_image(leg, sx, sy, step / 2)
            home = covered & (distance > leg.run) & (distance < end)
            departure = beam + slope * leg.parity * sideways
            arrival = _beam(ac, ((leg.vx - sx) * axis_x + (leg.vy - sy) * axis_y) / distance)
            level = _spreading(ac, distance / 2) + leg.loss + departure + arrival + gain
            best = jnp.minimum(best, _crossing(ac, home, distance / 2, level))

        best = jnp.minimum(best, _target_echo(scene, ac, leg, end, beam, slope, gain, step))

        rayleigh = (4 * jnp.pi * hit.roughness * hit.towards / ac.wavelength) ** 2
        level = _spreading(ac, end) + _diffuse(ac, rayleigh, jnp.abs(hit.towards), end)
        level = level + 2 * (leg.loss + beam) + gain
        best = jnp.minimum(best, _crossing(ac, (end < 0.5 * _FAR) & ~cylinder, end, level))

        limit = jnp.where(hit.roughness > _ROUGH_M, _OBLIQUE, _SQUARE)
        square = (jnp.abs(hit.towards) > limit) & (end < 0.5 * _FAR) & ~cylinder
        way = jnp.where(square, jnp.minimum(way, end), way)

        if order < BOUNCES:
            behind = leg.vx * hit.normal_x + leg.vy * hit.normal_y - hit.offset
            leg = _Rays(
                leg.x + to_wall * leg.ux,
                leg.y + to_wall * leg.uy,
                leg.ux - 2 * hit.towards * hit.normal_x,
                leg.uy - 2 * hit.towards * hit.normal_y,
                leg.vx - 2 * behind * hit.normal_x,
                leg.vy - 2 * behind * hit.normal_y,
                -leg.parity,
                jnp.where(cylinder, _FAR, end),
                leg.loss - 4.343 * rayleigh - ac.reflection_loss_db,
                hit.wall,
            )

    nearest = jnp.min(best.reshape(sonars, rays), axis=1)
    along_axis = way.reshape(sonars, rays)[:, rays // 2]
    nearest = jnp.where(ac.axis_ray & (nearest > 0.5 * _NOTHING), along_axis, nearest)
    return jnp.where(nearest < 0.5 * _NOTHING, nearest, jnp.inf)


def _diffuse(
    ac: Acoustics, rayleigh: Float[Array, "m"], cos: Float[Array, "m"], r: Float[Array, "m"]
) -> Float[Array, "m"]:
    """What a wall sends straight back along a ray, dB relative to the echo of a plane.

    The Lambert part of a rough wall, of as much of it as the beam and the burst light up; and the facets of an
    uneven wall that happen to face the sensor (geometrical optics of a surface with Gaussian slopes).
    """
    scattered = 1 - jnp.exp(-rayleigh)
    tan2 = jnp.maximum(1 - cos * cos, 1e-6) / jnp.maximum(cos * cos, 1e-6)
    lit = jnp.minimum(1.0, ac.pulse / (2 * r * ac.patch_rad * jnp.sqrt(tan2)))
    lambert = ac.patch_db + 10 * jnp.log10(jnp.maximum(scattered * cos * lit, 1e-9))
    return jnp.maximum(lambert, ac.facet_db - 2.17 * tan2 / ac.facet_slope**2)


def _cylinder_in_front(
    scene: Scene, leg: _Rays, to_wall: Float[Array, "m"]
) -> tuple[Float[Array, "m"], Bool[Array, "m"]]:
    """Shorten the legs that a cylinder stops; what bounces off a cylinder is spread too thin to follow."""
    px, py = scene.centre[:, :1] - leg.x, scene.centre[:, 1:] - leg.y
    ahead = px * leg.ux + py * leg.uy
    half = scene.radius[:, None] ** 2 - (px * px + py * py - ahead * ahead)
    reach = ahead - jnp.sqrt(jnp.maximum(half, 0.0))
    stops = (half > 0) & (scene.radius[:, None] > 0) & (reach > 0)
    to_cylinder = jnp.min(jnp.where(stops, reach, _FAR), axis=0)
    return jnp.minimum(to_wall, to_cylinder), to_cylinder < to_wall


def _target_echo(
    scene: Scene,
    ac: Acoustics,
    leg: _Rays,
    end: Float[Array, "m"],
    beam: Float[Array, "m"],
    slope: Float[Array, "m"],
    gain: Float[Array, "m"],
    step: float,
) -> Float[Array, "m"]:
    """Range of the nearest edge or cylinder that each leg covers, if it is heard, or _NOTHING."""
    cx, cy, radius = scene.centre[:, :1], scene.centre[:, 1:], scene.radius[:, None]
    distance, _, covered = _seen_from_image(leg, cx, cy, step / 2)
    reach = distance - radius
    # An edge ends the wall it belongs to, so the ray beside it may stop a little before it.
    unhidden = (reach > leg.run) & (reach < end + 0.03 + distance * step)
    px, py = leg.vx - cx, leg.vy - cy
    h = scene.hidden
    # Inside the hidden sector: counter-clockwise of its first wall and clockwise of its last.
    in_sector = (h[:, 0:1] * py - h[:, 1:2] * px > 0) & (px * h[:, 3:4] - py * h[:, 2:3] > 0)
    target, found = _nearest(covered & unhidden & (radius >= 0) & ~in_sector, jnp.maximum(reach, 0.0))

    radius = scene.radius[target]
    distance, sideways, _ = _seen_from_image(leg, scene.centre[target, 0], scene.centre[target, 1], step / 2)
    r = jnp.maximum(distance - radius, 0.02)
    edge = ac.edge_db - 10 * jnp.log10(r)
    cylinder = 10 * jnp.log10(jnp.maximum(radius, 1e-6) / (jnp.maximum(radius, 1e-6) + r))
    strength = jnp.where(radius > 0, cylinder, edge)
    two_way = 2 * (leg.loss + beam + slope * leg.parity * sideways)
    return _crossing(ac, found, r, _spreading(ac, r) + strength + two_way + gain)


@partial(jax.jit, static_argnames="rays")
def scans_ranges(scene, ac, p_world, axis, level_offset, rays):
    """``first_echo`` of many frames: leading axis of the last three array arguments."""
    flat = first_echo(scene, ac, p_world.reshape(-1, 2), axis.reshape(-1), level_offset.reshape(-1), rays)
    return flat.reshape(axis.shape)


@jax.jit
def drives_ranges(
    scene: Scene,
    ac: Acoustics,
    p_world: Float[Array, "drives frames sonars 2"],
    axis: Float[Array, "drives frames sonars"],
    level_offset: Float[Array, "drives frames sonars"],
) -> Float[Array, "drives frames sonars"]:
    """Ranges of many drives, each in its own scene under its own acoustics (leading axes ``drives``).

    One after another: on a CPU that is five times as fast as a vectorisation over scenes.
    """
    return jax.lax.map(lambda one: scans_ranges(*one, rays=RAYS), (scene, ac, p_world, axis, level_offset))
