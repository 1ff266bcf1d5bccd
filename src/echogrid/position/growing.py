"""A drive whose pieces come one after the other, and what is known of it by a time."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.position.motion import corrected, steps
from echogrid.position.pieces import LocalMaps, Piece, spread_over
from echogrid.position.slam import Drive
from echogrid.robot import Robot

BENT_AT = (16, 32)
"""Pieces after which the heading bias is looked for by how straight it makes the walls."""


class Graph(NamedTuple):
    """What was placed by a time; nothing in it changes."""

    frames: Sequence[Frame]
    """Scans that were kept, with poses by odometry."""
    cut: Sequence[Piece]
    poses: Float[ndarray, "pieces 3"]
    """Of the pieces in the map, m, m, rad."""
    drive: Float[ndarray, "frames 3"]
    """By odometry less its systematic error, from anywhere."""
    parameters: Float[ndarray, "3"]
    """What corrects the odometry, see ``motion.corrected``."""
    loops: int
    """How many were closed."""
    taken: int
    """How many scans were kept by then, with those that were forgotten."""

    def frame_poses(self, last: int | None = None) -> Float[ndarray, "frames 3"]:
        """Poses of the frames in the map; of the last so many alone, which costs no more than they do."""
        begin = max(0, len(self.frames) - (len(self.frames) if last is None else last))
        piece = max(0, bisect_right(self.cut, begin, key=lambda piece: piece.first) - 2)
        first = self.cut[piece].first
        cut = [Piece(a - first, b - first, c - first) for a, b, c in self.cut[piece:]]
        return wrapped(spread_over(cut, self.poses[piece:], self.drive[first:])[begin - first :])


def wrapped(poses: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Poses whose headings lie in [-pi, pi)."""
    return np.column_stack([poses[:, :2], wrap(poses[:, 2])])


class Growing(Drive):
    """A drive that grows by pieces."""

    def __init__(self, frames: Sequence[Frame], robot: Robot):
        """A drive of one piece, of these frames, whose poses are by odometry."""
        self.robot = robot
        self._kept, self._taken = list(frames), len(frames)
        super().__init__(self._kept, np.array([frame.pose for frame in frames], dtype=float), robot)
        self._first = self._kept[self.cut[0].middle].pose
        for k in range(1, self.count):
            self.place(k)

    def extend(self, frames: Sequence[Frame]) -> None:
        """Place the next piece."""
        begin, end = len(self._kept), len(self._kept) + len(frames)
        way = np.array([frame.pose for frame in [self._kept[-1], *frames]], dtype=float)
        self._kept.extend(frames)
        self._taken += len(frames)
        bias = np.array([0.0, self._bias, 0.0])
        self._step = np.concatenate([self._step, corrected(steps(way), bias)])
        self.cut.append(Piece(begin, end, (begin + end) // 2))
        self.count += 1
        self.poses = np.concatenate([self.poses, np.zeros((1, 3))])
        self._correct()
        self._information = self._odometry_information()
        self.place(self.count - 1)
        if self.count in BENT_AT:
            self._unbend()

    def _unbend(self) -> None:
        """Begin anew with the heading bias that makes walls straightest, if it makes them much straighter."""
        poses = self.poses
        bias = self._straight()
        self.poses = poses
        if bias:
            self._bias += bias
            self.parameters[1] -= bias
            self._step = corrected(self._step, np.array([0.0, bias, 0.0]))
            self._correct()
            self._solve(self.count)

    def graph(self) -> Graph:
        """As it is now, in the frame of the odometry's first poses."""
        poses = compose(self._first, self.poses)
        loops = sum(edge.loop for edge in self.matches)
        return Graph(self._kept[:], tuple(self.cut), poses, self.by_odometry, self.drift, loops, self._taken)

    def equip(self, robot: Robot) -> None:
        """Go on with a robot that has got more sonars, behind those that it had."""
        self.robot = robot
        self._kept[:] = [grown(frame, robot) for frame in self._kept]
        self._maps = LocalMaps(self._kept, self.cut, robot)


def grown(frame: Frame, robot: Robot) -> Frame:
    """A frame of a robot that has got more sonars since, which did not fire in it."""
    missing = robot.sonars - len(frame.ranges)
    if not missing:
        return frame
    ranges = np.concatenate([frame.ranges, np.full(missing, np.nan)])
    mounts = None if frame.mounts is None else np.concatenate([frame.mounts, robot.mounts[-missing:]])
    return replace(frame, ranges=ranges, mounts=mounts)
