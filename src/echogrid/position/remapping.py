"""The map of a robot that drives, made anew beside the driving when what is known of its poses has changed."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from threading import Thread
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.mapping.mapper import Mapper
from echogrid.position.growing import Graph, grown
from echogrid.position.online import OnlineSlam
from echogrid.robot import Robot

MOVED_M, MOVED_RAD = 0.06, np.deg2rad(2.0)
"""A map is made anew when a piece of the drive lies farther than this from where it was mapped."""

LEAST_S, REST = 1.0, 3.0
"""After a map was made it is not made again for so long, nor for so many times as long as it took."""

_AT_ONCE = 32
"""Scans that are mapped together."""


class Renewed(NamedTuple):
    """A map by all that is known."""

    mapper: Mapper
    path: Float[ndarray, "poses 2"]
    """The drive in it, m."""


class Remapping:
    """Looks after the map of a drive."""

    def __init__(self, finder: OnlineSlam, make: Callable[[Robot], Mapper]):
        """A map that is as it should be.

        Args:
            finder: knows the poses.
            make: makes an empty map for a robot.
        """
        self._finder, self._make = finder, make
        self._begin()

    def _begin(self) -> None:
        self._drive = self._finder.drives
        self._kept = 0
        self._fresh: dict[float, Float[ndarray, "3"]] = {}
        self._mapped: dict[float, Float[ndarray, "3"]] = {}
        self._judged: Graph | None = None
        self._due, self._moved = -np.inf, False
        self._making: _Making | None = None

    def note(self, frame: Frame) -> None:
        """Take note that a scan, the last that the finder took, goes into the map with its pose."""
        if self._finder.kept > self._kept:
            self._kept = self._finder.kept
            self._fresh[frame.stamp] = frame.pose

    def renewed(self, robot: Robot, now: float) -> Renewed | None:
        """A map to go on with in place of the one that there was, as soon as there is one.

        Args:
            robot: as it is now.
            now: the caller's clock, s.
        """
        if self._drive != self._finder.drives:
            self._begin()
            return self._whole(robot)
        if self._making is not None:
            if self._making.thread.is_alive():
                return None
            made, self._making = self._making, None
            self._due = now + max(LEAST_S, REST * made.seconds)
            if made.robot is robot:
                return self._taken(made)
        graph = self._finder.graph
        if graph is not None and graph is not self._judged:
            self._judged = graph
            self._moved = self._moved or self._have_moved(graph)
        if graph is not None and self._moved and now >= self._due:
            self._moved = False
            self._making = _Making(graph, self._make(robot), robot)
        return None

    def final(self, robot: Robot) -> Renewed:
        """The map by all that is known in the end; it is waited for."""
        if self._making is not None:
            self._making.thread.join()
        return self._whole(robot)

    def _whole(self, robot: Robot) -> Renewed:
        mapper = self._make(robot)
        frames = [grown(frame, robot) for frame in self._finder.scans()]
        mapper.add(frames)
        return Renewed(mapper, np.array([frame.pose[:2] for frame in frames]))

    def _taken(self, made: "_Making") -> Renewed | None:
        """A map that was made, with the scans that came since."""
        if made.mapper is None:
            return None
        rest = [grown(frame, made.robot) for frame in self._finder.scans(made.graph.taken)]
        made.mapper.add(rest)
        self._mapped = dict(zip(_middles(made.graph), made.graph.poses, strict=True))
        self._fresh = {frame.stamp: frame.pose for frame in rest}
        self._judged = None
        path = np.concatenate([made.poses, *(frame.pose[None] for frame in rest)])
        return Renewed(made.mapper, path[:, :2])

    def _have_moved(self, graph: Graph) -> bool:
        """Whether a piece lies elsewhere than where it was mapped."""
        placed = {}
        for stamp, pose in zip(_middles(graph), graph.poses, strict=True):
            before = self._mapped.get(stamp)
            placed[stamp] = self._fresh.get(stamp, pose) if before is None else before
        self._mapped = placed
        waiting = self._kept - graph.taken
        self._fresh = dict(list(self._fresh.items())[len(self._fresh) - waiting :] if waiting > 0 else ())
        off = graph.poses - np.array(list(placed.values()))
        return bool(np.any(np.hypot(off[:, 0], off[:, 1]) > MOVED_M) or np.any(np.abs(wrap(off[:, 2])) > MOVED_RAD))


def _middles(graph: Graph) -> list[float]:
    """The stamps (s) of the pieces' middles, by which they are known."""
    return [graph.frames[piece.middle].stamp for piece in graph.cut]


class _Making:
    """A map that is being made in a thread."""

    def __init__(self, graph: Graph, empty: Mapper, robot: Robot):
        self.graph, self.robot = graph, robot
        self.mapper: Mapper | None = None
        """The map; None where it could not be made."""
        self.poses: Float[ndarray, "frames 3"] = np.zeros((0, 3))
        """Of its scans."""
        self.seconds = 0.0
        """How long it took."""
        self.thread = Thread(target=self._run, args=(empty,), name="echogrid-map")
        self.thread.start()

    def _run(self, mapper: Mapper) -> None:
        begin = time.monotonic()
        self.poses = self.graph.frame_poses()
        frames = [
            replace(grown(frame, self.robot), pose=pose)
            for frame, pose in zip(self.graph.frames, self.poses, strict=True)
        ]
        with suppress(UsageError):  # it would be too large: the one that there is goes on
            for k in range(0, len(frames), _AT_ONCE):
                mapper.add(frames[k : k + _AT_ONCE])
            self.mapper = mapper
        self.seconds = time.monotonic() - begin
