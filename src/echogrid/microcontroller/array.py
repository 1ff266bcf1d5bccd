"""What a robot's array fixes of the local map: who is asked for each bearing, and where each of them looks."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.models.model import CONE_RAD, LOOK_RAD
from echogrid.models.networks.set_core import BEARINGS, RING_M, RINGS, ends_within
from echogrid.models.networks.set_layers import AT_M, TIE_RAD, nearest
from echogrid.robot import Robot


class Seen(NamedTuple):
    """The array as seen along the local map's bearings, turned so that the nearest sonar has each on its left."""

    sonar: Int[ndarray, "bearings tokens"]
    """Those that look nearest to the bearing, the nearest first; -1: no more."""
    axis: Float32[ndarray, "bearings tokens"]
    """Relative to the bearing, rad."""
    ahead: Float32[ndarray, "bearings tokens"]
    """Place along the bearing, m."""
    aside: Float32[ndarray, "bearings tokens"]
    """Place across it, to the left, m."""
    first: Int[ndarray, "bearings tokens"]
    """Of the rings at which the sonar looks."""
    end: Int[ndarray, "bearings tokens"]
    """Behind the last of them."""
    after: Float32[ndarray, "bearings tokens"]
    """How far from the robot's middle the sonar can tell of the sector up to the next bearing, m; 0: nowhere, or all
    sonars reach past the local map."""
    before: Float32[ndarray, "bearings tokens"]
    """Likewise of that from the bearing before."""


def seen(robot: Robot) -> Seen:
    """An array, its sonars at their own mounts."""
    bearing = (np.arange(BEARINGS) * (2 * np.pi / BEARINGS))[:, None]
    sonar = nearest(robot.mounts, bearing[:, 0])
    there = sonar >= 0
    x, y, axis = np.moveaxis(robot.mounts[sonar], -1, 0)
    ahead, aside = np.cos(bearing) * x + np.sin(bearing) * y, np.cos(bearing) * y - np.sin(bearing) * x
    axis = _on_the_right(wrap(axis - bearing))
    off = np.arctan2(-aside[:, :1], AT_M - ahead[:, :1]) - axis[:, :1]
    sign = np.where(off < -TIE_RAD, -1.0, 1.0)
    axis, ahead, aside = (
        np.where(there, each, 0.0).astype(np.float32) for each in (_on_the_right(sign * axis), ahead, sign * aside)
    )
    ends = ends_within(robot.mounts, robot.max_ranges_m)
    reach = np.where(there, robot.max_ranges_m[sonar], -1.0) if ends else np.where(there, np.inf, -1.0)
    after = before = np.zeros(sonar.shape, np.float32)
    if ends:
        leaves = [_leaves(robot.mounts[sonar], reach, bearing + k * 2 * np.pi / BEARINGS) for k in (-1, 0, 1)]
        before, after = (np.where(there, np.minimum(*leaves[k : k + 2]), 0.0).astype(np.float32) for k in (0, 1))
    return Seen(sonar, axis, ahead, aside, *_rings(axis, ahead, aside, reach), after, before)


def _on_the_right(axis: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
    """An axis in [-half a turn, half a turn), whatever rounding makes of one that looks away from the bearing."""
    return np.where(axis > np.pi - TIE_RAD, axis - 2 * np.pi, axis)


def _rings(
    axis: Float[ndarray, "bearings tokens"],
    ahead: Float[ndarray, "bearings tokens"],
    aside: Float[ndarray, "bearings tokens"],
    reach: Float[ndarray, "bearings tokens"],
) -> tuple[Int[ndarray, "bearings tokens"], Int[ndarray, "bearings tokens"]]:
    """``first`` and ``end``: a bearing crosses what a sonar looks at once, for that is convex. reach: m."""
    forward, left = (np.arange(RINGS) + 0.5) * RING_M - ahead[..., None], -aside[..., None]
    distance = np.hypot(forward, left)
    looks = forward * np.cos(axis[..., None]) + left * np.sin(axis[..., None]) >= np.cos(LOOK_RAD) * distance
    looks &= distance <= reach[..., None] + RING_M
    first = np.argmax(looks, axis=-1)
    return first, first + np.sum(looks, axis=-1)


def _leaves(
    mounts: Float[ndarray, "bearings tokens 3"],
    reach: Float[ndarray, "bearings tokens"],
    bearing: Float[ndarray, "*n"],
) -> Float[ndarray, "bearings tokens"]:
    """Where rays from the robot's middle leave what lies within range (m) and cone of sonars; 0: they do not enter.

    That is convex, so that between two rays nothing of it lies farther out than the nearer end of both but by a hair.
    """
    x, y, axis = np.moveaxis(mounts, -1, 0)
    cos, sin = np.cos(bearing), np.sin(bearing)
    ahead, aside = cos * x + sin * y, cos * y - sin * x
    half = np.sqrt(np.maximum(reach**2 - aside**2, 0.0))
    enter, leave = ahead - half, ahead + half
    for side in (CONE_RAD, -CONE_RAD):
        # Of the cone's edge: how far inside of it the middle lies, and how fast the ray goes inside.
        edge = axis + side - np.pi / 2 * np.sign(side)
        inside, into = -(np.cos(edge) * x + np.sin(edge) * y), np.cos(edge - bearing)
        crosses = -inside / np.where(np.abs(into) < 1e-6, 1e-6, into)
        leave = np.where(into < 0, np.minimum(leave, crosses), leave)
        enter = np.where(into < 0, enter, np.maximum(enter, crosses))
    return np.where((leave > enter) & (leave > 0) & (half > 0), leave, 0.0)
