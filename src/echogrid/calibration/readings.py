"""A drive as arrays: where the robot was when each sonar fired, and what the sonar read."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.position.motion import jumped, steps
from echogrid.robot import Robot

REACH_M = 4.0
"""Longer echoes are not looked at: what they hit is seldom told from the rest."""

WINDOW_M, METRES_A_RAD = 3.0, 0.5
"""A drive is looked at in parts so long, in which odometry has hardly drifted; what a radian of turning counts."""

LEAST_FRAMES = 12
"""Of fewer frames a part says nothing."""


@dataclass(frozen=True)
class Readings:
    """All readings of a drive."""

    stamps: Float[ndarray, "frames"]
    """s"""
    poses: Float[ndarray, "frames sonars 3"]
    """The robot in the world when each sonar fired, m, m, rad."""
    ranges: Float[ndarray, "frames sonars"]
    """m; inf no echo, nan not fired or not valid."""

    @property
    def sonars(self) -> int:
        """Number of sonars."""
        return self.ranges.shape[1]

    @property
    def fresh(self) -> Bool[ndarray, "frames sonars"]:
        """Which are not the same to the last bit as the same sonar's reading before."""
        again = np.zeros(self.ranges.shape, dtype=bool)
        again[1:] = self.ranges[1:] == self.ranges[:-1]
        return ~again | ~np.isfinite(self.ranges)

    def near(self) -> Float[ndarray, "frames sonars"]:
        """Fresh echoes within REACH_M, m; all else is nan."""
        return np.where(self.fresh & (self.ranges < REACH_M), self.ranges, np.nan)

    def without(self, sonars: list[int]) -> "Readings":
        """The same, but some sonars are not valid."""
        ranges = self.ranges.copy()
        ranges[:, sonars] = np.nan
        return replace(self, ranges=ranges)

    def only(self, parts: list[slice]) -> "Readings":
        """The same, but only some parts of the drive are valid."""
        ranges = np.full_like(self.ranges, np.nan)
        for part in parts:
            ranges[part] = self.ranges[part]
        return replace(self, ranges=ranges)


def gather(frames: Iterable[Frame], robot: Robot, name: str = "log") -> Readings:
    """Go through the frames of a drive.

    Args:
        frames: whose ranges keep the limits of the robot.
        robot: whose mounts tell, where a frame has mounts of its own, where the robot was when each sonar fired.
        name: of the log, for messages.

    Raises:
        InputError: there are no frames, or no echo at all.
    """
    stamps, poses, ranges = [], [], []
    home = inverse(robot.mounts)
    for frame in frames:
        stamps.append(frame.stamp)
        own = np.zeros((robot.sonars, 3)) if frame.mounts is None else compose(frame.mounts, home)
        poses.append(compose(frame.pose[None], own))
        ranges.append(frame.ranges)
    if not stamps:
        raise InputError(name, "no frames", "at least one")
    found = Readings(np.array(stamps), np.array(poses), np.array(ranges))
    if not np.isfinite(found.ranges).any():
        raise InputError(name, "no echo of any sonar", "ranges in m to tell something by")
    return found


def windows(readings: Readings, long_m: float = WINDOW_M) -> list[slice]:
    """The drive cut in parts of about ``long_m``, and where the pose jumps; parts of too few frames are left out."""
    poses = readings.poses[:, 0]
    step = steps(poses)
    jumps = jumped(step, np.diff(readings.stamps))
    went = np.hypot(step[:, 0], step[:, 1]) + METRES_A_RAD * np.abs(wrap(step[:, 2]))
    out, first, way = [], 0, 0.0
    for i, (jump, one) in enumerate(zip(np.asarray(jumps).tolist(), went.tolist(), strict=True)):
        way += one
        if jump or way >= long_m:
            out.append(slice(first, i + 1))
            first, way = i + 1, 0.0
    out.append(slice(first, len(poses)))
    return [part for part in out if part.stop - part.start >= LEAST_FRAMES]


def some(parts: list[slice], most: int) -> list[slice]:
    """At most so many parts, spread over the drive."""
    if len(parts) <= most:
        return parts
    return [parts[i] for i in np.linspace(0, len(parts) - 1, most).round().astype(int).tolist()]
