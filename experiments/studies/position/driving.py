"""A robot with a speed and a turning rate that follows a way: poses at the times of its scans."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.geometry import wrap
from experiments.studies.position.plans import spaced

RATE_HZ = 10.0
LOOK_AHEAD_M = 0.25
TURN_RAD_S = 1.0
"""It turns no faster."""
_SPEED_UP_M_S2 = 0.5
_STEPS = 4
"""Of the motion between two scans."""


def driven(way: Float[ndarray, "n 2"], speed: float) -> Float[ndarray, "scans 3"]:
    """Poses (m, m, rad) at RATE_HZ of a robot that goes along a way at up to ``speed`` m/s.

    It steers for a point a little ahead on the way (pure pursuit: Coulter 1992), is slower the more that lies to
    the side, and turns on the spot for what lies behind. It begins with a second of standing still.
    """
    line, dt = spaced(way, 0.02), 1 / RATE_HZ / _STEPS
    ahead = round(LOOK_AHEAD_M / 0.02)
    towards = line[min(ahead, len(line) - 1)] - line[0]
    x, y, theta = *line[0], float(np.arctan2(towards[1], towards[0]))
    v, here = 0.0, 0
    poses = [[x, y, theta]] * round(RATE_HZ)
    for step in range(10_000_000):
        window = line[here : here + 2 * ahead]
        here += int(np.argmin(np.hypot(window[:, 0] - x, window[:, 1] - y)))
        goal = line[min(here + ahead, len(line) - 1)]
        if here >= len(line) - 2:
            break
        off = float(wrap(np.arctan2(goal[1] - y, goal[0] - x) - theta))
        wanted = speed * max(0.0, np.cos(off)) ** 2 if abs(off) < 1.0 else 0.0
        v += float(np.clip(wanted - v, -4 * _SPEED_UP_M_S2 * dt, _SPEED_UP_M_S2 * dt))
        theta = float(wrap(theta + np.clip(3.0 * off, -TURN_RAD_S, TURN_RAD_S) * dt))
        x, y = x + v * np.cos(theta) * dt, y + v * np.sin(theta) * dt
        if step % _STEPS == _STEPS - 1:
            poses.append([x, y, theta])
    return np.array(poses)


def length_of(poses: Float[ndarray, "n 3"]) -> float:
    """How far a drive went, m."""
    return float(np.sum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
