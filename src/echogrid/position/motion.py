"""Odometry as a witness: what it says of the way between two poses, and how far it is to be believed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.doubts import FASTEST_M_S, FASTEST_RAD_S, JUMP_M, JUMP_RAD
from echogrid.geometry import compose, inverse, wrap


@dataclass(frozen=True)
class Drift:
    """How far odometry may be off, as standard deviations."""

    scale: float = 0.02
    """Of the length of the way, constant in a drive."""
    bias: float = np.deg2rad(1.5)
    """Of the heading, rad a metre, constant in a drive."""
    turning: float = 0.02
    """Of the angle turned, constant in a drive."""
    way: float = 0.04
    """Of the way, m, after one metre; it grows with the root of the length."""
    side: float = 0.02
    """Across the way, likewise."""
    heading: float = np.deg2rad(1.5)
    """Of the heading, rad, after one metre, likewise."""
    turned: float = np.deg2rad(1.5)
    """Of the heading, rad, after turning one radian, likewise."""
    still: tuple[float, float] = (0.002, np.deg2rad(0.1))
    """Of a step in which the robot did not move, m and rad."""


QUIET_S, ZERO_M, ZERO_RAD, LEFT_M, LEFT_RAD = 1.0, 0.02, 0.02, 0.1, 0.1
"""Odometry that says nothing for longer than the first, and then is as near to 0 as the next two, and was farther off
than the last before, counts from there: its base was restarted. A robot that is driven home comes seldom so near."""

PARAMETERS = 3
"""Of a drive: error of scale, heading bias (rad/m), error of turning."""


def steps(poses: Float[ndarray, "frames 3"]) -> Float[ndarray, "less 3"]:
    """Each pose (m, rad) as seen from the one before."""
    return compose(inverse(poses[:-1]), poses[1:])


def lengths(step: Float[ndarray, "*n 3"]) -> tuple[Float[ndarray, "*n"], Float[ndarray, "*n"]]:
    """Signed way (m; back is negative) and angle turned (rad) of steps."""
    way = np.hypot(step[..., 0], step[..., 1])
    return np.where(step[..., 0] < 0, -way, way), np.abs(step[..., 2])


def jumped(step: Float[ndarray, "*n 3"], took: Float[ndarray, "*n"] | float) -> Bool[ndarray, "*n"] | np.bool:
    """Whether steps (m, m, rad) are such as no robot does in a time (s); none at all where time goes back."""
    way, turn = np.hypot(step[..., 0], step[..., 1]), np.abs(step[..., 2])
    return (way > np.maximum(JUMP_M, FASTEST_M_S * took)) | (turn > np.maximum(JUMP_RAD, FASTEST_RAD_S * took))


def restarted(
    before: Float[ndarray, "*n 3"], after: Float[ndarray, "*n 3"], took: Float[ndarray, "*n"] | float
) -> Bool[ndarray, "*n"] | np.bool:
    """Whether odometry began again at 0 between two poses (m, m, rad), after a silence (s)."""
    left = (np.hypot(before[..., 0], before[..., 1]) > LEFT_M) | (np.abs(wrap(before[..., 2])) > LEFT_RAD)
    there = (np.hypot(after[..., 0], after[..., 1]) < ZERO_M) & (np.abs(wrap(after[..., 2])) < ZERO_RAD)
    return left & there & (took > QUIET_S)


def broken(before: Float[ndarray, "3"], after: Float[ndarray, "3"], took: float) -> bool:
    """Whether odometry that says one pose (m, m, rad) and, a time (s) later, another tells nothing of the way."""
    return bool(jumped(compose(inverse(before), after), took) or restarted(before, after, took))


def corrected(step: Float[ndarray, "n 3"], parameters: Float[ndarray, "3"]) -> Float[ndarray, "n 3"]:
    """Steps of odometry less its systematic error."""
    scale, bias, turning = parameters
    way, _ = lengths(step)
    turn = step[..., 2] * (1 + turning) + bias * way
    return np.stack([step[..., 0] * (1 + scale), step[..., 1] * (1 + scale), turn], axis=-1)


def chained(first: Float[ndarray, "3"], step: Float[ndarray, "n 3"]) -> Float[ndarray, "more 3"]:
    """The poses that steps lead to, from the first on."""
    theta = first[2] + np.concatenate([[0.0], np.cumsum(step[:, 2])])
    cos, sin = np.cos(theta[:-1]), np.sin(theta[:-1])
    x = first[0] + np.concatenate([[0.0], np.cumsum(cos * step[:, 0] - sin * step[:, 1])])
    y = first[1] + np.concatenate([[0.0], np.cumsum(sin * step[:, 0] + cos * step[:, 1])])
    return np.stack([x, y, theta], axis=-1)
