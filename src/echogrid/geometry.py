"""Poses in the plane and angles.

A pose is ``(x, y, theta)``: metres and radians, theta counter-clockwise from the x axis. ``T_a_b`` maps
coordinates of frame b to frame a. All functions broadcast over leading axes and take numpy arrays.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def wrap(angle: Float[ndarray, "*n"] | float) -> Float[ndarray, "*n"]:
    """Bring an angle in radians into [-pi, pi)."""
    return np.asarray((np.asarray(angle, dtype=float) + np.pi) % (2 * np.pi) - np.pi)


def wrapped(poses: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Poses (m, m, rad) whose headings lie in [-pi, pi)."""
    return np.column_stack([poses[:, :2], wrap(poses[:, 2])])


def transform(T_a_b: Float[ndarray, "*#n 3"], p_b: Float[ndarray, "*#n 2"]) -> Float[ndarray, "*n 2"]:
    """Map points (m) of frame b to frame a by the pose of b in a."""
    cos, sin = np.cos(T_a_b[..., 2]), np.sin(T_a_b[..., 2])
    x = T_a_b[..., 0] + cos * p_b[..., 0] - sin * p_b[..., 1]
    y = T_a_b[..., 1] + sin * p_b[..., 0] + cos * p_b[..., 1]
    return np.stack([x, y], axis=-1)


def compose(T_a_b: Float[ndarray, "*#n 3"], T_b_c: Float[ndarray, "*#n 3"]) -> Float[ndarray, "*n 3"]:
    """Chain two poses: ``T_a_c = T_a_b T_b_c``, heading wrapped into [-pi, pi)."""
    p_a = transform(T_a_b, T_b_c[..., :2])
    theta = wrap(T_a_b[..., 2] + T_b_c[..., 2])
    return np.concatenate([p_a, theta[..., None]], axis=-1)


def inverse(T_a_b: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    """The pose of a in b."""
    cos, sin = np.cos(T_a_b[..., 2]), np.sin(T_a_b[..., 2])
    x, y = T_a_b[..., 0], T_a_b[..., 1]
    return np.stack([-cos * x - sin * y, sin * x - cos * y, wrap(-T_a_b[..., 2])], axis=-1)
