"""Where a robot that explores is in its map, and the map: by poses that are given, or found together with the map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol, override

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.grid import Grid
from echogrid.mapping.mapper import Mapper
from echogrid.metrics import laid_onto
from echogrid.planning.nearby import Nearby
from echogrid.planning.onward import Onward
from echogrid.position.corrected import LEAST_SONARS
from echogrid.position.online import OnlineSlam
from echogrid.position.remapping import MOVED_M, MOVED_RAD
from echogrid.robot import Robot


class Placing(Protocol):
    """Maps scans, and says where the robot is in the map."""

    mapper: Mapper
    """Of the map; another one where it was made anew."""
    pose: Float[ndarray, "3"]
    """Of the robot in it, m, m, rad."""
    made: int
    """How often the map was made anew."""

    def add(self, frames: Sequence[Frame]) -> list[Frame]:
        """Map scans, which have true poses and those of the odometry; they come back as they were mapped."""
        ...

    def with_near(self, grid: Grid) -> Grid:
        """The map, or a part of it, with what was heard near the robot a moment ago."""
        ...

    def off(self) -> Float[ndarray, "3"]:
        """T_map_world that lays the way as it was mapped best onto the true one, m, m, rad."""
        ...

    def end(self) -> list[Frame]:
        """Settle the map by all that is known; the scans that are in it, as they were mapped."""
        ...


class Given(Placing):
    """True poses are given."""

    def __init__(self, mapper: Mapper):
        """An empty map."""
        self.mapper, self.pose, self.made = mapper, np.zeros(3), 0
        self._onward = Onward(mapper.robot)
        self._frames: list[Frame] = []

    @override
    def add(self, frames: Sequence[Frame]) -> list[Frame]:
        self.mapper.add(frames)
        self._onward.add(frames)
        self.pose = frames[-1].pose
        self._frames += frames
        return list(frames)

    @override
    def with_near(self, grid: Grid) -> Grid:
        return self._onward.laid_over(grid, self.pose, self.pose)

    @override
    def off(self) -> Float[ndarray, "3"]:
        return np.zeros(3)

    @override
    def end(self) -> list[Frame]:
        return self._frames


class Found(Placing):
    """Poses are found by SLAM, of odometry alone. What that takes the computer takes no time of the robot."""

    def __init__(self, robot: Robot, make: Callable[[Robot], Mapper]):
        """A robot that has not moved.

        Args:
            robot: its sonars.
            make: makes an empty map.

        Raises:
            UsageError: it has too few sonars.
        """
        if robot.sonars < LEAST_SONARS:
            found = f"{robot.sonars} {'sonar' if robot.sonars == 1 else 'sonars'}"
            raise UsageError(f"robot {robot.name}: found {found}, expected at least {LEAST_SONARS} to find poses by")
        self._robot, self._make, self.mapper = robot, make, make(robot)
        self._finder, self._nearby = OnlineSlam(robot), Nearby(robot)
        self.pose = self._odometry = np.zeros(3)
        self._graph: object = None
        self._mapped: dict[float, Float[ndarray, "3"]] = {}
        self._heard: dict[float, Frame] = {}
        self.made = 0

    @override
    def add(self, frames: Sequence[Frame]) -> list[Frame]:
        heard, placed = [_by_odometry(frame) for frame in frames], []
        for frame, told in zip(frames, heard, strict=True):
            placed.append(replace(told, pose=self._finder.add(told), odom=frame.odom))
            self._mapped[frame.stamp], self._heard[frame.stamp] = placed[-1].pose, frame
        self.mapper.add(placed)
        self._nearby.add(heard)
        self._odometry = heard[-1].pose
        self._finder.wait()
        self.pose = self._finder.pose
        if self._finder.graph is not self._graph:
            self._graph = self._finder.graph
            self._settle(MOVED_M, MOVED_RAD)
        return placed

    def _settle(self, moved_m: float, moved_rad: float) -> None:
        """Make the map anew if a scan lies farther than this from where it was mapped."""
        scans, poses = self._finder.placed()
        off = poses - np.array([self._mapped[scan.stamp] for scan in scans])
        if np.max(np.hypot(off[:, 0], off[:, 1])) <= moved_m and np.max(np.abs(wrap(off[:, 2]))) <= moved_rad:
            return
        scans = [replace(scan, pose=pose) for scan, pose in zip(scans, poses, strict=True)]
        self.mapper = self._make(self._robot)
        self.mapper.add(scans)
        self.made += 1
        self._mapped = {scan.stamp: scan.pose for scan in scans}

    @override
    def with_near(self, grid: Grid) -> Grid:
        return self._nearby.laid_over(grid, self.pose, self._odometry)

    @override
    def off(self) -> Float[ndarray, "3"]:
        poses = np.array(list(self._mapped.values()))
        moved = laid_onto(poses, np.array([self._heard[stamp].pose for stamp in self._mapped]))
        return compose(poses[0], inverse(moved[0]))

    @override
    def end(self) -> list[Frame]:
        self._finder.wait()
        self._settle(0.0, 0.0)
        self._finder.close()
        return [replace(scan, odom=self._heard[scan.stamp].odom) for scan in self._finder.scans()]


def _by_odometry(frame: Frame) -> Frame:
    assert frame.odom is not None
    return replace(frame, pose=frame.odom, odom=None)
