"""Where frames of ROS's tf lie to each other at a time: a tree of transforms, looked up in the plane.

Poses are composed in space and flattened last, so that a sensor mounted tilted or on a robot that rolls is placed
where it is. Between two samples of an edge the translation is interpolated linearly and the heading on the shorter
way, as tf2 does; but a correction that jumps holds until the next.
"""

import re
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from math import hypot, isfinite, remainder, sqrt, tau

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.ros.rigid import IDENTITY, Rigid, between, compose, inverse, planar

MAX_FRAMES = 2_000
"""Frames that are kept apart; names beyond are refused, for they are made up."""

MAX_SAMPLES = 20_000
"""Samples that an edge keeps."""

KEEP_S = 60.0
"""How long before its newest sample an edge is remembered."""

JUMP_S, JUMP_M, JUMP_RAD = 2.0, 0.3, 0.35
"""Over a gap longer than the first in which a frame moved by more than one of the others nothing is interpolated, nor
over any gap if the frame is one that is corrected, such as odom in map."""

_SOON_S = 0.002

_STANDS = re.compile(r"(?:^|[_-])v?(map|odom|odometry|world|earth)(?:[_-]|$)")

_DEPTH = 64

_FAR_M = 1e7
"""A translation beyond is no place."""


def stands_still(frame: str) -> bool:
    """Whether the name of a frame says that it does not move: map, odom, world, ``r1/odom``, ``odom_frame``."""
    last = frame.rsplit("/", 1)[-1]
    return _STANDS.search(last) is not None and "base" not in last


class _Edge:
    """A frame in its parent, over time."""

    __slots__ = ("corrects", "parent", "poses", "stamps", "static", "weak")

    def __init__(self, parent: str, static: bool, weak: bool, corrects: bool):
        self.parent, self.static, self.weak = parent, static, weak
        # Of a frame that does not move, such as odom in map: what changes is what is known, and by jumps.
        self.corrects = corrects
        self.stamps: list[float] = []
        self.poses: list[Rigid] = []

    def put(self, stamp: float, pose: Rigid) -> None:
        if self.static:
            self.stamps, self.poses = [stamp], [pose]
            return
        if not self.stamps or stamp > self.stamps[-1]:
            self.stamps.append(stamp)
            self.poses.append(pose)
        else:
            at = bisect_left(self.stamps, stamp)
            if self.stamps[at] == stamp:
                self.poses[at] = pose
            else:
                self.stamps.insert(at, stamp)
                self.poses.insert(at, pose)
        if len(self.stamps) > MAX_SAMPLES or len(self.stamps) % 512 == 0:
            old = max(bisect_left(self.stamps, self.stamps[-1] - KEEP_S) - 1, len(self.stamps) - MAX_SAMPLES, 0)
            del self.stamps[:old], self.poses[:old]

    def at(self, stamp: float, reach: float, hold: bool) -> Rigid | None:
        stamps, poses = self.stamps, self.poses
        if self.static:
            return poses[0]
        after = bisect_right(stamps, stamp)
        if after and stamps[after - 1] == stamp:
            return poses[after - 1]
        if after == 0:
            return poses[0] if stamps[0] - stamp <= reach else None
        if after == len(stamps):
            if stamp - stamps[-1] > reach:
                return poses[-1] if hold and self.corrects else None
            if after == 1:
                return poses[0]
            if stamps[-1] - stamps[-2] < _SOON_S:
                return poses[-1]  # so near to each other two samples tell no speed
            after -= 1  # what it did last it is taken to go on with
        start, end = stamps[after - 1], stamps[after]
        a, b = poses[after - 1], poses[after]
        # What corrects was never on the way of its jump, however soon it came.
        if (self.corrects or end - start > JUMP_S) and moved(planar(a), planar(b)):
            return b if stamp > end else a if self.corrects else None
        return between(a, b, (stamp - start) / (end - start))


def moved(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    """Whether two poses (m, m, rad) lie so far apart that none between them can be told if a gap of time does too."""
    (x0, y0, yaw0), (x1, y1, yaw1) = a, b
    return hypot(x1 - x0, y1 - y0) > JUMP_M or abs(remainder(yaw1 - yaw0, tau)) > JUMP_RAD


class Transforms:
    """The transforms heard so far, of bounded number."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._before: dict[str, str] = {}
        self.in_turn: dict[str, tuple[str, str, int]] = {}
        """Frames that are told in two parents in turn: both parents, and how often a frame came back to one."""

    def put(
        self,
        parent: str,
        child: str,
        stamp: float,
        translation: Sequence[float],
        rotation: Sequence[float],
        static: bool = False,
        weak: bool = False,
    ) -> str | None:
        """Take the pose of a frame in its parent.

        Args:
            parent: name of the frame; a leading slash counts for nothing.
            child: likewise.
            stamp: s.
            translation: x, y, z of the child's origin in the parent, m.
            rotation: quaternion x, y, z, w of the child's axes in the parent.
            static: holds at all times.
            weak: gives way to any transform of this child that is not weak (odometry beside tf).

        Returns:
            None if it was taken, else why not, in a few words.
        """
        parent, child = parent.lstrip("/"), child.lstrip("/")
        if not parent or not child or parent == child:
            return "a transform without two frames"
        numbers = (*translation, *rotation)
        if not all(isfinite(v) for v in numbers) or max(map(abs, numbers)) > _FAR_M:
            return "a transform that is not finite"
        x, y, z, w = rotation
        norm = sqrt(x * x + y * y + z * z + w * w)
        if not 0.5 < norm < 2.0:
            return "a rotation that is no unit quaternion"
        edge = self._edges.get(child)
        if edge is None or edge.parent != parent or edge.static != static or edge.weak != weak:
            if edge is not None and weak and edge.static:
                return self._put_at_root(parent, child, stamp, translation, rotation)
            # Odometry of a frame that hangs on another by what is static is that of the other.
            hangs = static and edge is not None and edge.weak and edge.parent != parent
            if edge is not None and ((weak and not edge.weak) or (static and not edge.static and not hangs)):
                return None
            if edge is None and len(self._edges) >= MAX_FRAMES:
                return f"a transform of frame number {MAX_FRAMES + 1}"
            if (edge is None or edge.parent != parent) and child in self.line(parent):
                return "a transform that closes a circle"
            if edge is not None and edge.parent != parent and not static:
                self._note_turn(child, edge.parent, parent)
            edge = self._edges[child] = _Edge(parent, static, weak, stands_still(child))
        tx, ty, tz = translation
        edge.put(float(stamp), Rigid((tx, ty, tz), (x / norm, y / norm, z / norm, w / norm)))
        return None

    def _put_at_root(
        self, parent: str, child: str, stamp: float, translation: Sequence[float], rotation: Sequence[float]
    ) -> str | None:
        """Take odometry of a frame that hangs on another, as base_link on base_footprint, for that of the other."""
        carried = self._carried(child)
        root = carried[-1]
        below = None if parent in carried else self.rigid(child, root, stamp)
        if below is None:
            return None
        x, y, z = translation
        qx, qy, qz, qw = rotation
        pose = compose(Rigid((x, y, z), (qx, qy, qz, qw)), below)
        return self.put(parent, root, stamp, pose.translation, pose.rotation, weak=True)

    def _carried(self, frame: str) -> list[str]:
        """A frame and those that it hangs on by what is static, up to the one that moves."""
        line = self.line(frame)
        still = (
            number for number, name in enumerate(line) if name not in self._edges or not self._edges[name].static
        )
        return line[: next(still, len(line) - 1) + 1]

    def _note_turn(self, child: str, old: str, new: str) -> None:
        if self._before.get(child) == new:
            self.in_turn[child] = old, new, self.in_turn.get(child, ("", "", 0))[2] + 1
        self._before[child] = old

    def still(self) -> "Transforms":
        """A copy with those transforms alone that do not change with time."""
        copy = Transforms()
        copy._edges = {child: edge for child, edge in self._edges.items() if edge.static}
        return copy

    def is_weak(self, frame: str) -> bool:
        """Whether a frame's place in its parent gives way to any other that is told."""
        return frame in self._edges and self._edges[frame].weak

    def __contains__(self, frame: str) -> bool:
        return frame in self._edges or any(edge.parent == frame for edge in self._edges.values())

    def children(self) -> list[str]:
        """Names of all frames that have a parent."""
        return list(self._edges)

    def line(self, frame: str) -> list[str]:
        """A frame, its parent, that one's parent, up to the root."""
        names = [frame.lstrip("/")]
        while names[-1] in self._edges and len(names) < _DEPTH:
            names.append(self._edges[names[-1]].parent)
        return names

    def moves(self, target: str, source: str) -> bool:
        """Whether any edge between two frames is not static."""
        edges = self._edges_between(target, source)
        return edges is None or any(not edge.static for side in edges for edge in side)

    def _edges_between(self, target: str, source: str) -> tuple[list[_Edge], list[_Edge]] | None:
        """The edges from the target up to the common frame, and from the source up to it."""
        up, down = self.line(target), self.line(source)
        shared = next((name for name in down if name in up), None)
        if shared is None:
            return None
        to, of = ([self._edges[name] for name in line[: line.index(shared)]] for line in (up, down))
        return to, of

    def known(self, target: str, source: str) -> tuple[float, float] | None:
        """From when until when (s) one frame is known in another; all time if nothing between them moves, None if
        nothing joins them.
        """
        edges = self._edges_between(target, source)
        if edges is None:
            return None
        moving = [edge.stamps for side in edges for edge in side if not edge.static]
        return max((s[0] for s in moving), default=-np.inf), min((s[-1] for s in moving), default=np.inf)

    def rigid(self, target: str, source: str, stamp: float, reach: float = 0.0, hold: bool = False) -> Rigid | None:
        """T_target_source at a time (s), or None where it is not known.

        Args:
            target: name of a frame.
            source: likewise.
            stamp: s.
            reach: how far outside of its samples an edge still holds, s: before the first as it was then, after the
                last as it went on.
            hold: whether the last correction of a frame that does not move, such as odom in map, holds for ever.
        """
        edges = self._edges_between(target, source)
        if edges is None:
            return None
        up, down = edges
        result = None
        for edge in reversed(up):
            pose = edge.at(stamp, reach, hold)
            if pose is None:
                return None
            result = pose if result is None else compose(result, pose)
        result = None if result is None else inverse(result)
        for edge in reversed(down):
            pose = edge.at(stamp, reach, hold)
            if pose is None:
                return None
            result = pose if result is None else compose(result, pose)
        return result or IDENTITY

    def pose(
        self, target: str, source: str, stamp: float, reach: float = 0.0, hold: bool = False
    ) -> Float[ndarray, "3"] | None:
        """``rigid`` in the plane: x, y (m), bearing (rad) of the source in the target, or None."""
        found = self.rigid(target, source, stamp, reach, hold)
        return None if found is None else np.array(planar(found))
