"""Where a robot is while it drives, from its ranges and odometry that drifts: pieces are placed beside the driving.

The graph is that of ``slam``, made piece by piece. A scan costs a composition of poses; what a piece costs (matches,
loops, the solution of the graph) is paid in a thread.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from threading import Condition, Thread
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.doubts import FASTEST_M_S, FASTEST_RAD_S, JUMP_M, JUMP_RAD
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.position.motion import chained, corrected, lengths, steps
from echogrid.position.pieces import PIECE_M, PIECE_RAD, LocalMaps, Piece, spread_over
from echogrid.position.slam import Drive
from echogrid.robot import Robot

LEAP_S = 10.0
"""Scans farther apart than this are not of one drive, if the pose jumps with them."""

STOOD_M, STOOD_RAD, STOOD = 0.02, np.deg2rad(1.0), 30
"""A robot that got no farther stands; so many scans are kept of the place."""


BENT_AT = (16, 32)
"""Pieces after which the heading bias is looked for by how straight it makes the walls."""

LEAST_FRAMES = 3
"""Scans that a piece has at least."""


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


class Jump(NamedTuple):
    """What a robot did that none can do."""

    stamp: float
    """s"""
    anew: bool
    """Time went back as well: another drive began, of which no place is known yet. Otherwise the odometry starts
    anew or jumps, and the drive goes on from where it was."""


class _Task(NamedTuple):
    """What the thread is to do."""

    drive: int
    """Number of the drive."""
    frames: list[Frame]
    """Of the next piece."""
    robot: Robot
    """As it is by then."""


def _done(task: _Task, drive: Growing | None) -> Growing:
    """A drive, at first None, after a task."""
    if drive is not None and task.robot is not drive.robot:
        drive.equip(task.robot)
    if drive is None:
        return Growing(task.frames, task.robot)
    drive.extend(task.frames)
    return drive


class OnlineSlam:
    """Finds the poses of a robot that drives, scan by scan.

    finder = OnlineSlam(robot)
    for frame in scans:
        pose = finder.add(frame)
    """

    def __init__(self, robot: Robot):
        """A robot that has not moved; the map's frame is that of its odometry when it begins.

        Raises:
            UsageError: no such robot.
        """
        check_robot(robot)
        self._robot = robot
        self.jumps: list[Jump] = []
        """What happened so far."""
        self.drives = 0
        """How many other drives began after the first."""
        self._graph: Graph | None = None
        self._condition = Condition()
        self._todo: deque[_Task] = deque()
        self._busy, self._closed = False, False
        self._failed: Exception | None = None
        self._last: Frame | None = None
        self._begin(np.zeros(3))
        self._thread = Thread(target=self._work, name="echogrid-slam", daemon=True)
        self._thread.start()

    def _begin(self, at: Float[ndarray, "3"]) -> None:
        """Begin a drive where the odometry says."""
        self._at, self._pose = at, at
        self._parameters = np.zeros(3)
        self._piece: list[Frame] = []
        self._amount = 0.0
        self._stood = 0
        self._recent: deque[Frame] = deque()  # those from the middle of the last piece placed on, by odometry
        self.kept = 0
        self._graph = self._anchored = None

    @property
    def pose(self) -> Float[ndarray, "3"]:
        """Of the robot in the map at the last scan, m, m, rad."""
        return self._pose

    @property
    def correction(self) -> Float[ndarray, "3"]:
        """T_map_odom: the pose of the odometry's frame in the map, as of the last scan."""
        return np.zeros(3) if self._last is None else compose(self._pose, inverse(self._last.pose))

    @property
    def graph(self) -> Graph | None:
        """All that was placed so far; None: nothing yet."""
        return self._graph

    def add(self, frame: Frame) -> Float[ndarray, "3"]:
        """Go on to a scan, whose pose is by odometry; the robot's pose in the map.

        Raises:
            UsageError: it cannot be one of the robot's; nothing is changed.
        """
        (frame,) = cleaned(list(fitting([frame], self._robot)), self._robot)
        if self._failed is not None:
            raise self._failed
        self._go_to(frame)
        self._keep(frame)
        self._last = frame
        if (graph := self._graph) is not self._anchored and graph is not None:
            self._anchor(graph)
        return self._pose

    def equip(self, robot: Robot) -> None:
        """Go on with a robot that has got more sonars, behind those that it had."""
        self._piece = [grown(frame, robot) for frame in self._piece]
        self._robot = robot

    def wait(self) -> None:
        """Return when all whole pieces were placed, and the robot's pose is by them."""
        with self._condition:
            self._condition.wait_for(lambda: self._failed or not (self._todo or self._busy))
        if self._failed is not None:
            raise self._failed
        if self._graph is not None:
            self._anchor(self._graph)

    def close(self) -> None:
        """End; what waits is not placed any more."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()
        self._thread.join()

    # In the thread of the caller.

    def _go_to(self, frame: Frame) -> None:
        if self._last is None:
            self._begin(np.array(frame.pose, dtype=float))
            return
        step = compose(inverse(self._last.pose), frame.pose)
        took = frame.stamp - self._last.stamp
        way, turn = float(np.hypot(step[0], step[1])), abs(float(step[2]))
        if way > max(JUMP_M, FASTEST_M_S * took) or turn > max(JUMP_RAD, FASTEST_RAD_S * took):
            self.jumps.append(Jump(frame.stamp, took <= 0))
            if took <= 0:
                self.drives += 1
                with self._condition:
                    self._todo.clear()
                    self._begin(np.array(frame.pose, dtype=float))
                return
            step = np.zeros(3)
        self._at = compose(self._at, step)
        self._pose = compose(self._pose, corrected(step[None], self._parameters)[0])

    def _keep(self, frame: Frame) -> None:
        """Add a scan to the piece that is driven now, if the robot does not merely stand."""
        way, turn = 0.0, 0.0
        if self._recent:
            step = compose(inverse(self._recent[-1].pose), self._at)
            way, turn = (float(each[0]) for each in lengths(step[None]))
            if abs(way) < STOOD_M and turn < STOOD_RAD:
                self._stood += 1
                if self._stood > STOOD:
                    return
            else:
                self._stood = 0
        self._amount += abs(way) / PIECE_M + turn / PIECE_RAD
        if self._amount >= 1 and len(self._piece) >= LEAST_FRAMES:
            self._put(_Task(self.drives, self._piece, self._robot))
            self._piece, self._amount = [], self._amount % 1
        kept = replace(frame, pose=self._at)
        self._piece.append(kept)
        self._recent.append(kept)
        self.kept += 1

    def _anchor(self, graph: Graph) -> None:
        """Let the robot's pose be by what was placed last, and by the odometry since."""
        self._anchored, self._parameters = graph, graph.parameters
        since = self.kept - graph.taken + len(graph.frames) - graph.cut[-1].middle
        while len(self._recent) > since:
            self._recent.popleft()
        self._pose = self._since(graph)[-1]

    def _since(self, graph: Graph) -> Float[ndarray, "recent 3"]:
        """Poses in the map of the recent scans, and the last one, which is where the robot is."""
        way = np.array([*(frame.pose for frame in self._recent), self._at])
        return wrapped(chained(graph.poses[-1], corrected(steps(way), graph.parameters)))

    def scans(self, begin: int = 0) -> list[Frame]:
        """The scans that were kept from one on, with poses in the map by all that is known now.

        Args:
            begin: number of the first; those that were forgotten are left out.
        """
        if (graph := self._anchored) is None:
            return list(self._recent)[begin:]
        last = min(max(graph.taken - begin, 0), len(graph.frames))
        placed = zip(graph.frames[len(graph.frames) - last :], graph.frame_poses(last), strict=True)
        behind = len(graph.frames) - graph.cut[-1].middle + max(begin - graph.taken, 0)
        rest = zip(list(self._recent)[behind:], self._since(graph)[behind:-1], strict=True)
        return [replace(frame, pose=pose) for frame, pose in [*placed, *rest]]

    def _put(self, task: "_Task") -> None:
        with self._condition:
            self._todo.append(task)
            self._condition.notify_all()

    # In the thread beside it.

    def _work(self) -> None:
        drive: Growing | None = None
        number = -1
        while (task := self._next()) is not None:
            try:
                if task.drive != number:
                    drive, number = None, task.drive
                drive = _done(task, drive)
            except Exception as error:  # it is the caller's: raised at the next scan
                self._failed = error
            with self._condition:
                if task.drive == self.drives and drive is not None:
                    self._graph = drive.graph()
                self._busy = False
                self._condition.notify_all()

    def _next(self) -> "_Task | None":
        with self._condition:
            self._condition.wait_for(lambda: self._closed or self._todo)
            if self._closed or self._failed:
                return None
            self._busy = True
            return self._todo.popleft()
