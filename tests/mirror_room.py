"""Drives in a room of mirrors, in closed form: walls are heard along their normals, and corners, within the beam."""

import numpy as np

from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.robot import TRANSDUCERS, Robot

ROOM = np.array([[0, 0], [6, 0], [6, 4], [3.5, 4], [3.5, 3], [0, 3]], dtype=float)
"""Corners, m, counter-clockwise; that at (3.5, 3) juts into the room."""

HALF_DEG = 11.0


def ring(sonars=8, radius=0.2):
    axis = wrap(np.arange(sonars) * 2 * np.pi / sonars + 0.2)
    mounts = np.column_stack([radius * np.cos(axis), radius * np.sin(axis), axis])
    mounts[:, 0] *= 1.3  # no turn or mirror maps it to itself
    mounts[0, 2] += 0.1
    return Robot("ring", 0.25, TRANSDUCERS["polaroid-600"], 0.1, 5.0, np.deg2rad(25.0), mounts)


def drive(frames=420):
    """Poses on a winding way, turning much, m, m, rad."""
    t = np.linspace(0, 2 * np.pi, frames)
    x, y = 2.9 + 2.1 * np.cos(t), 1.5 + 0.8 * np.sin(2 * t)
    heading = np.arctan2(np.gradient(y), np.gradient(x)) + 0.6 * np.sin(9 * t)
    return np.column_stack([x, y, wrap(heading)])


def ranges_of(sonars, late=0.0):
    """Ranges of sonars at poses (m, m, rad) of any shape, m; inf where nothing sends back.

    At the beam's edge walls are read too far away by a share (late), the less the nearer to the axis.
    """
    at, axis, half_rad = sonars[..., :2], sonars[..., 2], np.deg2rad(HALF_DEG)
    best = np.full(axis.shape, np.inf)
    for p, q in zip(ROOM, np.roll(ROOM, -1, axis=0), strict=True):
        along = (q - p) / np.linalg.norm(q - p)
        outward = np.array([along[1], -along[0]])
        distance = (p - at) @ outward
        foot = (at - p) @ along
        off = np.abs(wrap(np.arctan2(outward[1], outward[0]) - axis))
        seen = (foot > 0) & (foot < np.linalg.norm(q - p)) & (distance > 0) & (off < half_rad)
        read = distance * (1 + late * (off / half_rad) ** 4)
        best = np.where(seen & (read < best), read, best)
    for corner in ROOM:
        to = corner - at
        off = np.abs(wrap(np.arctan2(to[..., 1], to[..., 0]) - axis))
        best = np.where(off < half_rad, np.minimum(best, np.hypot(to[..., 0], to[..., 1])), best)
    return best


def frames_of(robot, scale=1.0, noise=0.003, poses=None, seed=0, late=0.0):
    """A drive of a robot whose ranges are wrong by a scale and white noise (m)."""
    poses, rng = drive() if poses is None else poses, np.random.default_rng(seed)
    ranges = ranges_of(compose(poses[:, None], robot.mounts[None]), late)
    ranges = robot.clean(np.round(scale * ranges + noise * rng.standard_normal(ranges.shape), 4))
    return [Frame(0.1 * i, pose, row) for i, (pose, row) in enumerate(zip(poses, ranges, strict=True))]


def changed(frames, change):
    """The frames with their ranges (frames x sonars) changed."""
    ranges = change(np.array([frame.ranges for frame in frames]))
    return [Frame(frame.stamp, frame.pose, row) for frame, row in zip(frames, ranges, strict=True)]
