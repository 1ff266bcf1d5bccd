"""A drive cut into pieces, each short enough for its odometry, and the local maps that pieces make."""

from collections.abc import Callable, Sequence
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
from echogrid.models.networks.set_network import SetNetwork, Views
from echogrid.position.echoes import FarEchoes, far_echoes, with_far_echoes
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


WARM = 2
"""Pieces before one whose scans are remembered when its own are read."""

MOST_READ, MOST_OWN = 400, 16
"""Pieces of which what was read is kept, about 0.15 MB each, and of which local maps of their own are."""


class _Read(NamedTuple):
    """What the scans of a piece say, wherever they were made."""

    views: Views
    far: FarEchoes


def _kept[K, V](kept: dict[K, V], key: K, most: int, made: Callable[[], V]) -> V:
    """What is kept under a key, or is made and kept; of more than so many the longest unwanted goes."""
    value = kept.pop(key) if key in kept else made()
    kept[key] = value
    if len(kept) > most:
        del kept[next(iter(kept))]
    return value


class LocalMaps:
    """The local maps of a drive: of any pieces, as seen from any pose, by the poses that the pieces have now.

    What was read of a piece is kept for when it is asked for again.
    """

    def __init__(self, frames: Sequence[Frame], cut: Sequence[Piece], robot: Robot):
        self._frames, self._cut, self._robot = frames, cut, robot
        model = sensor_model(DEFAULT)
        assert isinstance(model, SetNetwork)
        self._model = model
        self._read: dict[int, _Read] = {}
        self._way: dict[int, Float[ndarray, "own 3"]] = {}
        self._own: dict[tuple[int, bool], Field] = {}
        self.drive: Float[ndarray, "frames 3"] = np.zeros((0, 3))
        """Poses of all frames by odometry alone, for the way within a piece, which is short: it is taken but once."""

    def patch(self, seen_from: Float[ndarray, "3"]) -> "Patch":
        """An empty local map, in the frame of a pose (m, m, rad)."""
        return Patch(self, Mapper(self._robot, self._model), seen_from)

    def own(self, k: int, far: bool) -> Field:
        """What a piece alone saw, as seen from its own pose.

        Args:
            k: which.
            far: whether the echoes beyond the network's reach are told as well.
        """

        def made() -> Field:
            patch = self.patch(np.zeros(3))
            one, poses = range(k, k + 1), np.zeros((k + 1, 3))
            if far:
                return patch.farther(self.own(k, False), one, poses)
            patch.add(one, poses)
            return patch.field(poses, False)

        return _kept(self._own, (k, far), MOST_OWN, made)

    def forget_ways(self) -> None:
        """Take the ways within pieces from the drive as it is by now, and make what they alone saw anew."""
        self._own.clear()
        self._way.clear()

    def keep(self, number: dict[int, int]) -> None:
        """Go on with some of the pieces: their numbers from now on, by those that they had."""
        self._read = {number[k]: each for k, each in self._read.items() if k in number}
        self._way = {number[k]: each for k, each in self._way.items() if k in number}
        self._own = {(number[k], far): each for (k, far), each in self._own.items() if k in number}

    def piece(self, k: int) -> _Read:
        """What a piece says."""

        def read() -> _Read:
            first, (begin, end, _) = self._cut[max(0, k - WARM)].first, self._cut[k]
            views = self._model.views(self._robot, self._frames[first:end], begin - first)
            return _Read(views, far_echoes(self._frames[begin:end], self._robot))

        return _kept(self._read, k, MOST_READ, read)

    def way(self, k: int) -> Float[ndarray, "own 3"]:
        """Poses of the frames of a piece, as seen from its own."""
        if k not in self._way:
            piece = self._cut[k]
            self._way[k] = compose(inverse(self.drive[piece.middle]), self.drive[piece.first : piece.end])
        return self._way[k]

    @property
    def beam_width_rad(self) -> float:
        """Of the sonars."""
        return self._robot.beam_width_rad


class Patch:
    """A local map in the making."""

    def __init__(self, maps: LocalMaps, mapper: Mapper, seen_from: Float[ndarray, "3"]):
        self._maps, self._mapper, self._to = maps, mapper, inverse(seen_from)
        self.pieces = range(0)
        """Those that it holds."""

    def add(self, pieces: range, poses: Float[ndarray, "_ 3"]) -> None:
        """Add pieces of a drive, the first, or those that follow what it holds; with the poses of all."""
        at = compose(self._to, poses[pieces.start : pieces.stop])
        for k, pose in zip(pieces, at, strict=True):
            self._mapper.fuse(self._maps.piece(k).views.at(compose(pose, self._maps.way(k))))
        self.pieces = range(self.pieces.start if self.pieces else pieces.start, pieces.stop)

    def field(self, poses: Float[ndarray, "_ 3"], far: bool) -> Field:
        """What it says now; with far echoes besides, which its pieces heard at poses."""
        grid = self._mapper.grid()
        field = Field(np.where(grid.observed, 2 * sigmoid(grid.log_odds) - 1, 0.0), grid.origin, grid.resolution)
        return self.farther(field, self.pieces, poses) if far else field

    def farther(self, field: Field, pieces: range, poses: Float[ndarray, "_ 3"]) -> Field:
        """What ``field`` said of pieces without far echoes, and those besides."""
        far = [self._maps.piece(k).far for k in pieces]
        places = compose(self._to, poses[pieces.start : pieces.stop])
        at = [each.at(compose(pose, self._maps.way(k))) for k, pose, each in zip(pieces, places, far, strict=True)]
        ranges = np.concatenate([each.ranges for each in far])
        return with_far_echoes(field, np.concatenate(at), ranges, self._maps.beam_width_rad)


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
