"""Where a robot is while it drives, from its ranges and odometry that drifts: pieces are placed beside the driving.

The graph is that of ``slam``, made piece by piece. A scan costs a composition of poses; what a piece costs (matches,
loops, the solution of the graph) is paid in a thread.
"""

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrapped
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.position.beside import Beside
from echogrid.position.growing import Graph, Growing, grown
from echogrid.position.motion import broken, chained, corrected, lengths, steps
from echogrid.position.pieces import LEAST_FRAMES, PIECE_M, PIECE_RAD
from echogrid.robot import Robot

STOOD_M, STOOD_RAD, STOOD = 0.02, np.deg2rad(1.0), 30
"""A robot that got no farther stands; so many scans are kept of the place."""

MOST_JUMPS = 1000
"""Of the odometry that are remembered."""

MOST_WAITING, MOST_FRAMES = 100, 400
"""Where more pieces wait to be placed the one that is driven grows, up to so many scans; no further is kept."""


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
    jumped: bool
    """Whether the odometry jumped just before."""


class _Placing:
    """Places pieces; it lives in the thread."""

    def __init__(self) -> None:
        self._number, self._drive = -1, None

    def __call__(self, task: _Task) -> tuple[int, Graph]:
        """Place a piece; the number of its drive, and all that is known of it."""
        if self._drive is None or task.drive != self._number:
            self._number, self._drive = task.drive, Growing(task.frames, task.robot)
        else:
            if task.robot is not self._drive.robot:
                self._drive.equip(task.robot)
            self._drive.extend(task.frames, task.jumped)
        return self._number, self._drive.graph()


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
        self.jumps: deque[Jump] = deque(maxlen=MOST_JUMPS)
        """What happened so far."""
        self.drives = 0
        """How many other drives began after the first."""
        self._beside = Beside(_Placing(), "echogrid-slam")
        self._last: Frame | None = None
        self._begin(np.zeros(3))

    def _begin(self, at: Float[ndarray, "3"]) -> None:
        """Begin a drive where the odometry says."""
        self._at, self._pose = at, at
        self._parameters = np.zeros(3)
        self._piece: list[Frame] = []
        self._amount, self._jumped = 0.0, False
        self._stood = 0
        self._recent: deque[Frame] = deque()  # those from the middle of the last piece placed on, by odometry
        self.kept = 0
        """Scans that were kept of this drive."""
        self._anchored: Graph | None = None

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
        drive, graph = self._beside.found or (self.drives, None)
        return graph if drive == self.drives else None

    @property
    def waiting(self) -> int:
        """Pieces that are not placed yet."""
        return self._beside.waiting

    def add(self, frame: Frame) -> Float[ndarray, "3"]:
        """Go on to a scan, whose pose is by odometry; the robot's pose in the map.

        Raises:
            UsageError: it cannot be one of the robot's; nothing is changed.
        """
        (frame,) = cleaned(list(fitting([frame], self._robot)), self._robot)
        self._go_to(frame)
        self._keep(frame)
        self._last = frame
        if (graph := self.graph) is not self._anchored and graph is not None:
            self._anchor(graph)
        return self._pose

    def equip(self, robot: Robot) -> None:
        """Go on with a robot that has got more sonars, behind those that it had."""
        self._piece = [grown(frame, robot) for frame in self._piece]
        self._robot = robot

    def wait(self) -> None:
        """Return when all whole pieces were placed, and the robot's pose is by them."""
        self._beside.wait()
        if (graph := self.graph) is not None:
            self._anchor(graph)

    def close(self) -> None:
        """End; what waits is not placed any more."""
        self._beside.close()

    def _go_to(self, frame: Frame) -> None:
        if self._last is None:
            self._begin(np.array(frame.pose, dtype=float))
            return
        took = frame.stamp - self._last.stamp
        if broken(self._last.pose, frame.pose, took):
            self.jumps.append(Jump(frame.stamp, took <= 0))
            if took <= 0:
                self.drives += 1
                self._beside.drop()
                self._begin(np.array(frame.pose, dtype=float))
                return
            step = np.zeros(3)
            self._end_piece()
            self._jumped = True
        else:
            step = compose(inverse(self._last.pose), frame.pose)
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
        late = self.waiting > MOST_WAITING
        if late and len(self._piece) >= MOST_FRAMES:
            return
        self._amount += abs(way) / PIECE_M + turn / PIECE_RAD
        if self._amount >= 1 and not late:
            self._end_piece()
        kept = replace(frame, pose=self._at)
        self._piece.append(kept)
        self._recent.append(kept)
        self.kept += 1

    def _end_piece(self) -> None:
        """Have what was driven placed, if it is a piece."""
        if len(self._piece) >= LEAST_FRAMES:
            self._beside.put(_Task(self.drives, self._piece, self._robot, self._jumped))
            self._piece, self._amount, self._jumped = [], self._amount % 1, False

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
        frames, poses = self.placed(begin)
        return [replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True)]

    def placed(self, begin: int = 0) -> tuple[list[Frame], Float[ndarray, "scans 3"]]:
        """Likewise as they were kept, and those poses beside them, which costs less."""
        recent = list(self._recent)
        if (graph := self._anchored) is None:
            return recent[begin:], np.array([frame.pose for frame in recent[begin:]]).reshape(-1, 3)
        last = min(max(graph.taken - begin, 0), len(graph.frames))
        behind = len(graph.frames) - graph.cut[-1].middle + max(begin - graph.taken, 0)
        frames = [*graph.frames[len(graph.frames) - last :], *recent[behind:]]
        return frames, np.concatenate([graph.frame_poses(last), self._since(graph)[behind:-1]])
