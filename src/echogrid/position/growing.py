"""A drive whose pieces come one after the other, and what is known of it by a time."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, wrapped
from echogrid.position.contradictions import Compared, cells
from echogrid.position.drive import Drive, MatchEdge
from echogrid.position.forgetting import chained_variance, handed_on, to_forget
from echogrid.position.motion import PARAMETERS, chained, corrected, steps
from echogrid.position.pieces import LocalMaps, Piece, spread_over
from echogrid.robot import Robot

MOST_PIECES, FORGOTTEN = 1500, 150
"""Of a drive that are known at a time; where there are more so many are forgotten."""

JUMPED = np.array([0.2, 0.2, 0.3])
"""Standard deviations (m, m, rad) of a way on which the odometry jumped: the robot may have moved meanwhile."""

LOOKED_AT = 16
"""After so many pieces it is looked whether what was seen at different times lies together."""

BENT_AT, BENT = (16, 24, 32, 48, 64, 96, 128, 192, 256), np.deg2rad(0.5)
"""Pieces after which the heading bias is looked for once more, as long as no loop tells it better, and by how much
(rad/m) what is found must differ from what is known."""


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
    together: Compared
    """How what the first of the pieces saw lies together, all but those that came since it was looked at last."""

    def frame_poses(self, last: int | None = None) -> Float[ndarray, "frames 3"]:
        """Poses of the frames in the map; of the last so many alone, which costs no more than they do."""
        begin = max(0, len(self.frames) - (len(self.frames) if last is None else last))
        piece = max(0, bisect_right(self.cut, begin, key=lambda piece: piece.first) - 2)
        first = self.cut[piece].first
        cut = [Piece(a - first, b - first, c - first) for a, b, c in self.cut[piece:]]
        return wrapped(spread_over(cut, self.poses[piece:], self.drive[first:])[begin - first :])


class Growing(Drive):
    """A drive that grows by pieces."""

    loop_gap = 20  # no match is made again here: what a wrong one bends stays bent

    def __init__(self, frames: Sequence[Frame], robot: Robot):
        """A drive of one piece, of these frames, whose poses are by odometry."""
        self.robot = robot
        self._kept, self._taken = list(frames), len(frames)
        # Variances of odometry that jumped, or past what is forgotten.
        self._merged: dict[int, Float[ndarray, "3"]] = {}
        self._together, self._tried = Compared(*np.zeros((3, 1), dtype=int)), 0
        super().__init__(self._kept, np.array([frame.pose for frame in frames], dtype=float), robot)
        self._first = self._kept[self.cut[0].middle].pose
        for k in range(1, self.count):
            self.place(k)

    def extend(self, frames: Sequence[Frame], jumped: bool = False) -> None:
        """Place the next piece; of the way to it odometry may tell little, for it jumped."""
        begin, end = len(self._kept), len(self._kept) + len(frames)
        way = np.array([frame.pose for frame in [self._kept[-1], *frames]], dtype=float)
        self._kept.extend(frames)
        self._taken += len(frames)
        bias = np.array([0.0, self._bias, 0.0])
        self._step = np.concatenate([self._step, corrected(steps(way), bias)])
        self.cut.append(Piece(begin, end, (begin + end) // 2))
        self.count += 1
        self.poses = np.concatenate([self.poses, np.zeros((1, 3))])
        if jumped:
            self._merged[self.count - 2] = JUMPED**2
        self._correct()
        self._information = self._odometry_information()
        self.place(self.count - 1)
        self._cells.append(cells(self._own(self.count - 1, False)))
        if self.count in BENT_AT and not any(edge.loop for edge in self.matches):
            self._unbend()
        if self.count > MOST_PIECES:
            self._forget(FORGOTTEN)
        if self.count % LOOKED_AT == 0:
            self._look_back()

    def _look_back(self) -> None:
        """See whether what was seen at different times lies together; what did not before was tried in vain."""
        self._together = self.compared()
        if self._together.doubtful.sum() > self._tried:
            self._together = self.reconcile()
        self._tried = int(self._together.doubtful.sum())

    def _unbend(self) -> None:
        """Place all pieces anew with the heading bias with which what was seen lies together best, if that is not
        what is known of it.
        """
        known, step = self.drift[1], self._step
        self._step = steps(np.array([frame.pose for frame in self._kept], dtype=float))
        found = self._bends()
        if abs(found - known) < BENT:
            self._step = step
            return
        self._bias, self.parameters = found, np.zeros(PARAMETERS)
        self._step = corrected(self._step, np.array([0.0, found, 0.0]))
        self._correct()
        self._maps.forget_ways()
        self._near, self._solution, self._compass = None, None, None
        self.matches, self._headings = [], {}
        self._seen.clear()
        self._walls.clear()
        for k in range(1, self.count):
            self.place(k)

    def _odometry_information(self) -> Float[ndarray, "pairs 3 3"]:
        information = super()._odometry_information()
        for pair, variance in self._merged.items():
            information[pair] = np.diag(1 / variance) / self._trust**2
        return information

    def _forget(self, count: int) -> None:
        """Forget so many pieces where others saw the same; what ties them is handed to the pieces before them."""
        gone = set(to_forget(self.poses, count))
        stay = [k for k in range(self.count) if k not in gone]
        number = {k: n for n, k in enumerate(stay)}
        self._merged = self._without(gone, number)
        self.matches = self._handed_on(gone, number)
        self._headings = {number[k]: heading for k, heading in self._headings.items() if k in number}
        self._walls = {number[k]: points for k, points in self._walls.items() if k in number}
        self._cells = [self._cells[k] for k in stay]
        self._maps.keep(number)
        self._near = None
        self._seen.clear()
        cut = [self.cut[k] for k in stay]
        frames = np.concatenate([np.arange(piece.first, piece.end) for piece in cut])
        self._step = steps(chained(np.zeros(3), self._step)[frames])
        self._kept[:] = [self._kept[k] for k in frames.tolist()]
        begin, self.cut[:] = 0, []
        for piece in cut:
            end = begin + piece.end - piece.first
            self.cut.append(Piece(begin, end, begin + piece.middle - piece.first))
            begin = end
        self.poses, self.count = self.poses[stay], len(stay)
        self._correct()
        self._information = self._odometry_information()
        self._solve(self.count)
        self._together = self.compared()

    def _without(self, gone: set[int], number: dict[int, int]) -> dict[int, Float[ndarray, "3"]]:
        """Variances of the odometry past pieces that are forgotten, by the number of the pair."""
        variance = 1 / (self._information[:, [0, 1, 2], [0, 1, 2]] * self._trust**2)
        merged = {number[k]: each for k, each in self._merged.items() if k in number and k + 1 in number}
        for k in gone:
            way = float(np.hypot(*self._measured[k][:2]))
            merged[number[k - 1]] = chained_variance(variance[k - 1], variance[k], way)
        return merged

    def _handed_on(self, gone: set[int], number: dict[int, int]) -> list[MatchEdge]:
        """The matches of those pieces that stay; of several between the same two the last."""
        found = {}
        for edge in self.matches:
            if edge.second in gone and not edge.loop:
                continue  # its neighbours have their own
            first, second = (k - 1 if k in gone else k for k in (edge.first, edge.second))
            if first < second:
                pose, information = handed_on(edge, self.poses, first, second)
                key = number[first], number[second]
                found[*key, edge.loop] = MatchEdge(*key, pose, information, edge.loop)
        return list(found.values())

    def graph(self) -> Graph:
        """As it is now, in the frame of the odometry's first poses."""
        poses = compose(self._first, self.poses)
        loops = sum(edge.loop for edge in self.matches)
        return Graph(
            self._kept[:], tuple(self.cut), poses, self.by_odometry, self.drift, loops, self._taken, self._together
        )

    def equip(self, robot: Robot) -> None:
        """Go on with a robot that has got more sonars, behind those that it had."""
        self.robot = robot
        self._kept[:] = [grown(frame, robot) for frame in self._kept]
        self._maps = LocalMaps(self._kept, self.cut, robot)
        self._maps.drive = self.by_odometry
        self._near = None


def grown(frame: Frame, robot: Robot) -> Frame:
    """A frame of a robot that has got more sonars since, which did not fire in it."""
    missing = robot.sonars - len(frame.ranges)
    if not missing:
        return frame
    ranges = np.concatenate([frame.ranges, np.full(missing, np.nan)])
    mounts = None if frame.mounts is None else np.concatenate([frame.mounts, robot.mounts[-missing:]])
    return replace(frame, ranges=ranges, mounts=mounts)
