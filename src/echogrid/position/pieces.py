"""A drive cut into pieces, each short enough for its odometry, and the local maps that pieces make."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.grid import sigmoid
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.position.echoes import with_far_echoes
from echogrid.position.matching import Field
from echogrid.position.motion import lengths
from echogrid.robot import Robot

PIECE_M, PIECE_RAD = 0.5, 1.0
"""A piece ends after so much way, or so much turning, or a part of each."""

LEAST_FRAMES = 3
"""Scans that a piece has at least."""


class Piece(NamedTuple):
    """Frames ``first <= i < end`` of a drive; the pose of the middle one is the pose of the piece."""

    first: int
    end: int
    middle: int


def pieces(step: Float[ndarray, "steps 3"]) -> list[Piece]:
    """Cut a drive of steps from frame to frame (m, m, rad)."""
    way, turn = lengths(step)
    amount = np.concatenate([[0.0], np.cumsum(np.abs(way) / PIECE_M + turn / PIECE_RAD)])
    cut = np.unique(np.searchsorted(amount, np.arange(0, amount[-1] + 1)))
    cut = np.append(cut[cut < len(amount)], len(amount))
    if len(cut) > 2 and cut[-1] - cut[-2] < LEAST_FRAMES:
        cut = np.delete(cut, -2)
    return [Piece(a, b, (a + b) // 2) for a, b in pairwise(cut.tolist())]


class LocalMaps:
    """The local maps of a drive: of any pieces, as seen from any pose, by the poses that the pieces have now."""

    def __init__(self, frames: Sequence[Frame], cut: Sequence[Piece], robot: Robot):
        self._frames, self._cut, self._robot = frames, cut, robot
        self._model = sensor_model(DEFAULT)

    def of(
        self,
        pieces: range,
        seen_from: Float[ndarray, "3"],
        poses: Float[ndarray, "pieces 3"],
        drive: Float[ndarray, "frames 3"],
        far: bool,
    ) -> Field:
        """What some pieces of the drive saw.

        Args:
            pieces: which.
            seen_from: pose whose frame the map is in, m, m, rad.
            poses: of all pieces.
            drive: poses of all frames by odometry alone, for the way within a piece.
            far: whether the echoes beyond the network's reach are told as well.
        """
        frames, at = self._posed(pieces, seen_from, poses, drive)
        mapper = Mapper(self._robot, self._model)
        mapper.add([Frame(f.stamp, pose, f.ranges, None, f.mounts) for f, pose in zip(frames, at, strict=True)])
        grid = mapper.grid()
        field = Field(np.where(grid.observed, 2 * sigmoid(grid.log_odds) - 1, 0.0), grid.origin, grid.resolution)
        return with_far_echoes(field, frames, at, self._robot) if far else field

    def farther(
        self,
        field: Field,
        pieces: range,
        seen_from: Float[ndarray, "3"],
        poses: Float[ndarray, "pieces 3"],
        drive: Float[ndarray, "frames 3"],
    ) -> Field:
        """What ``of`` told of some pieces, and their far echoes besides; arguments as there."""
        return with_far_echoes(field, *self._posed(pieces, seen_from, poses, drive), self._robot)

    def _posed(
        self,
        pieces: range,
        seen_from: Float[ndarray, "3"],
        poses: Float[ndarray, "pieces 3"],
        drive: Float[ndarray, "frames 3"],
    ) -> tuple[Sequence[Frame], Float[ndarray, "own 3"]]:
        """The frames of some pieces, and where they are as seen from a pose."""
        frames = self._frames[self._cut[pieces.start].first : self._cut[pieces.stop - 1].end]
        return frames, compose(inverse(seen_from), np.concatenate([self._within(k, poses, drive) for k in pieces]))

    def _within(
        self, k: int, poses: Float[ndarray, "pieces 3"], drive: Float[ndarray, "frames 3"]
    ) -> Float[ndarray, "own 3"]:
        piece = self._cut[k]
        return compose(poses[k], compose(inverse(drive[piece.middle]), drive[piece.first : piece.end]))


def spread_over(
    cut: Sequence[Piece], poses: Float[ndarray, "pieces 3"], drive: Float[ndarray, "frames 3"]
) -> Float[ndarray, "frames 3"]:
    """Poses of all frames: those of the pieces at their middles, and between them the drive by odometry, with what
    it is off by at the next one spread evenly over the frames.
    """
    middle: Int[ndarray, "pieces"] = np.array([piece.middle for piece in cut])
    out = np.empty_like(drive)
    out[: middle[0]] = compose(poses[0], compose(inverse(drive[middle[0]]), drive[: middle[0]]))
    out[middle[-1] :] = compose(poses[-1], compose(inverse(drive[middle[-1]]), drive[middle[-1] :]))
    for k, (a, b) in enumerate(pairwise(middle.tolist())):
        way = compose(inverse(drive[a]), drive[a:b])
        off = compose(inverse(poses[k]), poses[k + 1]) - compose(inverse(drive[a]), drive[b])
        off[2] = wrap(off[2])
        out[a:b] = compose(poses[k], way + np.linspace(0, 1, b - a, endpoint=False)[:, None] * off)
    return out
