"""Poses in space: how they are chained, turned round, flattened and interpolated."""

from collections.abc import Sequence
from math import atan2, sqrt
from typing import NamedTuple

import numpy as np


class Rigid(NamedTuple):
    """A pose in space: translation (m) and rotation (unit quaternion x, y, z, w)."""

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


IDENTITY = Rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def compose(a: Rigid, b: Rigid) -> Rigid:
    """T_x_z from T_x_y and T_y_z."""
    x, y, z = _turned(a.rotation, b.translation)
    ax, ay, az = a.translation
    return Rigid((ax + x, ay + y, az + z), _product(a.rotation, b.rotation))


def inverse(a: Rigid) -> Rigid:
    """T_y_x from T_x_y."""
    x, y, z, w = a.rotation
    back = (-x, -y, -z, w)
    tx, ty, tz = _turned(back, a.translation)
    return Rigid((-tx, -ty, -tz), back)


def planar(a: Rigid) -> tuple[float, float, float]:
    """A pose in the plane: x, y (m) and the bearing (rad) of the frame's x axis."""
    x, y, z, w = a.rotation
    return a.translation[0], a.translation[1], atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def slope(a: Rigid) -> float:
    """How far the x axis of a frame points up (1) or down (-1); 0 in the plane."""
    x, y, z, w = a.rotation
    return 2 * (x * z - w * y)


def between(a: Rigid, b: Rigid, share: float) -> Rigid:
    """The pose that lies a share of the way from one to another: on a straight line, on the shorter turn."""
    (ax, ay, az), (bx, by, bz) = a.translation, b.translation
    q, r = a.rotation, b.rotation
    sign = 1.0 if sum(u * v for u, v in zip(q, r, strict=True)) >= 0 else -1.0
    # The heading turns evenly, which the mean of two quaternions would not do; the tilt is small.
    yaw0, yaw1 = planar(a)[2], planar(b)[2]
    turned = (yaw1 - yaw0 + np.pi) % (2 * np.pi) - np.pi
    x, y, z, w = (u + share * (sign * v - u) for u, v in zip(q, r, strict=True))
    norm = sqrt(x * x + y * y + z * z + w * w) or 1.0
    mixed = Rigid(
        (ax + share * (bx - ax), ay + share * (by - ay), az + share * (bz - az)),
        (x / norm, y / norm, z / norm, w / norm),
    )
    half = (yaw0 + share * turned - planar(mixed)[2]) / 2
    return Rigid(mixed.translation, _product((0.0, 0.0, np.sin(half), np.cos(half)), mixed.rotation))


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def _turned(q: Sequence[float], v: Sequence[float]) -> tuple[float, float, float]:
    x, y, z, w = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )
