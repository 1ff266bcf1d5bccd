"""Where the robot is in the map, while it drives: found with the map, as its odometry drifts."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, override

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.live.sonar_array import SonarArray
from echogrid.mapping.mapper import Mapper
from echogrid.position.corrected import at_odds, stretched
from echogrid.position.online import OnlineSlam
from echogrid.position.remapping import Remapping, Renewed
from echogrid.robot import Robot


class Correction(NamedTuple):
    """Where the frame of the odometry lies in that of the map, as tf is to say it."""

    parent: str
    child: str
    stamp: float
    """Until when it holds, s: that of the last scan and the tolerance."""
    pose: Float[ndarray, "3"]
    """m, m, rad."""


class RobotPose(NamedTuple):
    """Where the robot is in the map, as AMCL says it."""

    frame: str
    """Of the map."""
    stamp: float
    """s"""
    pose: Float[ndarray, "3"]
    """m, m, rad."""
    covariance: Float[ndarray, "3 3"]
    """m, m, rad."""


class Placing(Protocol):
    """Finds where the robot is in the map while it drives."""

    frame: str
    """In which what is heard is mapped."""

    @property
    def where(self) -> Float[ndarray, "3"] | None:
        """Of the robot in the map, m, m, rad; None where that is not known."""
        ...

    def place(self, frame: Frame) -> Frame:
        """A scan, whose pose is by odometry, as it is to be mapped.

        Raises:
            UsageError: it cannot be one of the robot's; nothing is changed.
        """
        ...

    def equip(self) -> None:
        """Go on with the array as it has grown."""

    def renewed(self, now: float) -> Renewed | None:
        """The map by what is known now, if it is another one, by the caller's clock (s)."""

    def final(self) -> Renewed | None:
        """The map by all that is known in the end, if it is another one."""

    def sent(self) -> Sequence[Correction | RobotPose]:
        """What is to be published since it was asked last."""
        ...

    def notices(self) -> Iterator[str]:
        """What the user should know and was not told yet."""
        ...

    def status(self) -> str:
        """How it goes."""
        ...

    def settings(self) -> dict[str, Any]:
        """What run.yaml says of it."""
        ...


class Slam(Placing):
    """The robot is found by the map that it makes."""

    def __init__(self, array: SonarArray, make: Callable[[Robot], Mapper], frame: str, tolerance: float):
        """A robot that has not moved; the map begins where its odometry does.

        Args:
            array: its sonars.
            make: makes an empty map.
            frame: of the map.
            tolerance: how long a correction holds, s.
        """
        self.frame = frame
        """In which the map lies."""
        self._array, self._tolerance = array, tolerance
        self._finder = OnlineSlam(array.robot)
        self._remapping = Remapping(self._finder, make)
        self._newest: float | None = None
        self._doubts_told: set[tuple[int, str]] = set()

    @property
    @override
    def where(self) -> Float[ndarray, "3"]:
        return self._finder.pose

    @property
    def correction(self) -> Float[ndarray, "3"]:
        """T_map_odom, m, m, rad."""
        return self._finder.correction

    @property
    def drives(self) -> int:
        """How many other drives began after the first."""
        return self._finder.drives

    @override
    def place(self, frame: Frame) -> Frame:
        placed = replace(frame, pose=self._finder.add(frame), odom=frame.pose)
        self._remapping.note(placed)
        self._newest = frame.stamp
        return placed

    @override
    def equip(self) -> None:
        self._finder.equip(self._array.robot)

    @override
    def renewed(self, now: float) -> Renewed | None:
        return self._remapping.renewed(self._array.robot, now)

    @override
    def final(self) -> Renewed:
        self._finder.wait()
        return self._remapping.final(self._array.robot)

    @override
    def sent(self) -> list[Correction]:
        if self._newest is None:
            return []
        stamp, self._newest = self._newest + self._tolerance, None
        return [Correction(self.frame, self._array.fixed, stamp, self._finder.correction)]

    @override
    def notices(self) -> Iterator[str]:
        while self._finder.jumps:
            jump = self._finder.jumps.popleft()
            if jump.anew:
                yield (
                    f"at {jump.stamp:.2f} s time goes back, and the odometry with it (a bag that is played again, a "
                    f"simulation that began anew): a new map begins"
                )
            else:
                yield f"at {jump.stamp:.2f} s the odometry jumps or starts anew: the drive goes on from where it was"
        if (graph := self._finder.graph) is None:
            return
        placed = graph.poses[: len(graph.together.alike)]
        doubts = {"odds": lambda: at_odds(placed, graph.together), "size": lambda: stretched(graph.parameters)}
        for name, asked in doubts.items():
            if (self.drives, name) not in self._doubts_told and (notes := asked()):
                self._doubts_told.add((self.drives, name))
                yield from notes

    @override
    def status(self) -> str:
        graph = self._finder.graph
        x, y, turn = self._finder.correction.tolist()
        loops = graph.loops if graph else 0
        off = f"{np.hypot(x, y):.2f} m and {np.rad2deg(abs(turn)):.0f} degrees"
        return f"{loops} {'loop' if loops == 1 else 'loops'} closed, {self._array.fixed} is {off} off {self.frame}"

    @override
    def settings(self) -> dict[str, Any]:
        graph = self._finder.graph
        if graph is None:
            return {"slam": True, "loops": 0, "odometry": None}
        way, bias, turn = graph.parameters.tolist()
        right = {"way_times": 1 + way, "turns_times": 1 + turn, "heading_deg_m": np.rad2deg(bias).item()}
        return {
            "slam": True,
            "loops": graph.loops,
            "odometry": {name: round(each, 5) for name, each in right.items()},
        }
