"""Straight walls and corners in parts of a drive: what many echoes touch, however wide the beam.

An echo of range r heard at s lies somewhere on an arc. A wall whose normal n looks away from the sonar touches it
where n . p = n . s + r; a corner, post or edge at p where |p - s| = r. Each echo votes for all lines that touch its
arc (a Hough transform); where many votes lie, a line and a point are fitted and the better one is taken. The axis of
the sonar matters only for which lines it votes for, so that the ranges alone say where the sonars sit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from echogrid.geometry import wrap

STEP_RAD, STEP_M, WIDE_M = np.deg2rad(2.0), 0.03, 9.0
"""Bins of the votes, and how far from the middle of the part lines may lie."""

NEAR_M = 0.04
"""An echo is of a wall whose arc passes it by less."""

SOFT_M = 0.015
"""Misses beyond count less."""

LEAST_VOTES, MOST_WALLS, LEAST_LONG_M, LEAST_ROUND_RAD = 12, 10, 0.4, np.deg2rad(15)
"""Echoes that a wall has; walls of a part; how long a line is, and from how far apart a point is seen, at least."""


@dataclass(frozen=True)
class Walls:
    """Lines and points of a drive, and the echoes that touch them."""

    point: Bool[ndarray, "walls"]
    """Which are points."""
    place: Float[ndarray, "walls 2"]
    """Of a line the angle of the normal that points away from the robot, rad, and its distance from the world's
    origin, m; of a point x and y, m."""
    radius: Float[ndarray, "walls"]
    """Of a point, m: posts are round, and edges send back so little that they are read late (below 0). Of lines 0."""
    extent: Float[ndarray, "walls 2"]
    """Where a line begins and ends along itself (the normal turned by a quarter), m; of points 0."""
    span: Int[ndarray, "walls 2"]
    """First frame of the part of the drive that saw it, and that behind the last."""
    wall: Int[ndarray, "echoes"]
    """Of each echo that touches one, which."""
    frame: Int[ndarray, "echoes"]
    sonar: Int[ndarray, "echoes"]

    def seen(
        self, wall: Int[ndarray, "n"], at: Float[ndarray, "n 2"]
    ) -> tuple[Float[ndarray, "n"], Float[ndarray, "n 2"], Float[ndarray, "n"]]:
        """How walls are seen from places.

        Args:
            wall: which.
            at: m, world.

        Returns:
            Distance, m; the unit vector to the wall; where along the line its foot lies, m (of points 0).
        """
        place, point = self.place[wall], self.point[wall]
        n = np.stack([np.cos(place[:, 0]), np.sin(place[:, 0])], axis=1)
        to = place - at
        far = np.hypot(to[:, 0], to[:, 1])
        along = np.where(point, 0.0, at[:, 1] * n[:, 0] - at[:, 0] * n[:, 1])
        distance = np.where(point, far - self.radius[wall], place[:, 1] - np.sum(n * at, axis=1))
        return distance, np.where(point[:, None], to / np.maximum(far, 1e-6)[:, None], n), along

    def parts(self) -> list[tuple[int, int, Int[ndarray, "some"]]]:
        """The parts of the drive that saw walls: first frame, that behind the last, which walls."""
        spans = np.unique(self.span, axis=0).tolist()
        return [(first, last, np.flatnonzero((self.span == (first, last)).all(axis=1))) for first, last in spans]

    def near(self, frames: int, few: int) -> Bool[ndarray, "walls frames"]:
        """Where each was heard by some sonar not more than a few frames before or after."""
        heard = np.zeros((len(self.point), frames), dtype=bool)
        heard[self.wall, self.frame] = True
        return ndimage.binary_dilation(heard, np.ones((1, 2 * few + 1), dtype=bool))

    def faces(self, wall: Int[ndarray, "n"], along: Float[ndarray, "n"]) -> Bool[ndarray, "n"]:
        """Whether feet along lines (m, as of ``seen``) are on them; those of points always are."""
        low, high = self.extent[wall].T
        return self.point[wall] | (along > low) & (along < high)


class _Wall(NamedTuple):
    point: bool
    place: Float[ndarray, "2"]
    extent: Float[ndarray, "2"]
    members: Int[ndarray, "echoes"]
    cost: float


class _Echoes(NamedTuple):
    """Of one part of the drive."""

    at: Float[ndarray, "echoes 2"]
    """m, from the middle of the part."""
    axis: Float[ndarray, "echoes"]
    ranges: Float[ndarray, "echoes"]
    half_rad: float

    def of(self, miss: Float[ndarray, "echoes"], bearing: Float[ndarray, "echoes"], near: float) -> ndarray:
        """Which are near a wall that they see at a bearing."""
        return (np.abs(miss) < near) & (np.abs(wrap(self.axis - bearing)) < self.half_rad)


def find(
    sonars: Float[ndarray, "frames sonars 3"],
    ranges: Float[ndarray, "frames sonars"],
    parts: list[slice],
    half_rad: float,
    most: int = MOST_WALLS,
) -> Walls:
    """Walls in each part of a drive.

    Args:
        sonars: where each was and pointed, world, m, m, rad.
        ranges: m; only finite ones vote.
        parts: of the drive.
        half_rad: how far off its axis a sonar may have heard.
        most: walls of a part.
    """
    found: list[_Wall] = []
    spans, wall, frame, sonar = [], [], [], []
    for part in parts:
        f, s = np.nonzero(np.isfinite(ranges[part]))
        if len(f) < LEAST_VOTES:
            continue
        at = sonars[part][f, s]
        middle = at[:, :2].mean(axis=0)
        for one in _of_part(_Echoes(at[:, :2] - middle, at[:, 2], ranges[part][f, s], half_rad), most):
            wall.append(np.full(len(one.members), len(found)))
            found.append(_moved(one, middle))
            spans.append((part.start, part.stop))
            frame.append(f[one.members] + part.start)
            sonar.append(s[one.members])
    none = np.zeros(0, dtype=int)
    return Walls(
        np.array([one.point for one in found], dtype=bool),
        np.array([one.place for one in found]).reshape(-1, 2),
        np.zeros(len(found)),
        np.array([one.extent for one in found]).reshape(-1, 2),
        np.array(spans, dtype=int).reshape(-1, 2),
        *(np.concatenate(each) if each else none for each in (wall, frame, sonar)),
    )


def _moved(one: _Wall, by: Float[ndarray, "2"]) -> _Wall:
    if one.point:
        return one._replace(place=one.place + by)
    cos, sin = np.cos(one.place[0]), np.sin(one.place[0])
    place = np.array([one.place[0], one.place[1] + by[0] * cos + by[1] * sin])
    return one._replace(place=place, extent=one.extent + by[1] * cos - by[0] * sin)


def _of_part(echoes: _Echoes, most: int) -> Iterator[_Wall]:
    """Walls that many of the echoes touch, those of most votes first; each echo is of one."""
    offsets = np.arange(-echoes.half_rad, echoes.half_rad + 1e-9, STEP_RAD)
    angles, bins = round(2 * np.pi / STEP_RAD), int(2 * WIDE_M / STEP_M)
    a = np.rint((echoes.axis[:, None] + offsets) / STEP_RAD).astype(int) % angles
    normal = a * STEP_RAD
    across = echoes.at[:, :1] * np.cos(normal) + echoes.at[:, 1:] * np.sin(normal)
    b = np.floor((across + echoes.ranges[:, None] + WIDE_M) / STEP_M).astype(int)
    ok = (b >= 1) & (b < bins - 1)
    left = np.ones(len(b), dtype=bool)
    votes = np.bincount((a * bins + b)[ok], minlength=angles * bins).reshape(angles, bins)
    walls = 0
    for _ in range(3 * most):
        smooth = votes[:, :-1] + votes[:, 1:]
        top = int(np.argmax(smooth))
        if smooth.flat[top] < LEAST_VOTES or walls == most:
            return
        i, j = divmod(top, bins - 1)
        peak = ((a == i) & ((b == j) | (b == j + 1)) & ok).any(axis=1) & left
        line = _line(echoes, left, np.array([i * STEP_RAD, (j + 1) * STEP_M - WIDE_M]))
        point = _point(echoes, left, peak, i * STEP_RAD)
        made = peak
        if best := min((each for each in (line, point) if each), key=lambda each: each.cost, default=None):
            walls += 1
            made = peak.copy()
            made[best.members] = True
            yield best
        left &= ~made
        gone = made[:, None] & ok
        votes -= np.bincount((a * bins + b)[gone], minlength=angles * bins).reshape(angles, bins)
        ok &= ~made[:, None]


_GATES = (2 * NEAR_M, 1.5 * NEAR_M, NEAR_M, NEAR_M)


def _line(echoes: _Echoes, left: Bool[ndarray, "echoes"], start: Float[ndarray, "2"]) -> _Wall | None:
    """A line near a start (rad, m) fitted to the echoes that touch it."""
    theta, d = start
    members, miss, along = np.zeros(0, dtype=int), np.zeros(0), np.zeros(0)
    for near in _GATES:
        n = np.array([np.cos(theta), np.sin(theta)])
        misses = echoes.ranges - (d - echoes.at @ n)
        members = np.flatnonzero(left & echoes.of(misses, np.full(len(misses), theta), near))
        if len(members) < LEAST_VOTES:
            return None
        along, miss = echoes.at[members] @ np.array([-n[1], n[0]]), misses[members]
        weight = 1 / (1 + (miss / SOFT_M) ** 2)
        A = np.column_stack([np.ones(len(along)), -along])
        step = np.linalg.solve((A * weight[:, None]).T @ A + np.diag([1e-9, 1e-4]), (A * weight[:, None]).T @ miss)
        d, theta = d + step[0], theta + step[1]
    # A few feet at each end may be of something else.
    low, high = np.quantile(along, [0.02, 0.98])
    if high - low < LEAST_LONG_M:
        return None
    return _Wall(False, np.array([theta, d]), np.array([low, high]), members, _cost(miss))


def _point(
    echoes: _Echoes, left: Bool[ndarray, "echoes"], peak: Bool[ndarray, "echoes"], bearing: float
) -> _Wall | None:
    """A point fitted to the echoes that touch it, begun where some (a peak) heard something at a bearing (rad)."""
    n = np.array([np.cos(bearing), np.sin(bearing)])
    p = np.median(echoes.at[peak] + echoes.ranges[peak, None] * n, axis=0)
    members, miss, to = np.zeros(0, dtype=int), np.zeros(0), np.zeros((0, 2))
    for near in (3 * NEAR_M, *_GATES):
        way = p - echoes.at
        far = np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-3)
        misses = echoes.ranges - far
        members = np.flatnonzero(left & echoes.of(misses, np.arctan2(way[:, 1], way[:, 0]), near))
        if len(members) < LEAST_VOTES:
            return None
        to, miss = way[members] / far[members, None], misses[members]
        weight = 1 / (1 + (miss / SOFT_M) ** 2)
        p = p + np.linalg.solve((to * weight[:, None]).T @ to + 1e-3 * np.eye(2), (to * weight[:, None]).T @ miss)
    bearings = wrap(np.arctan2(to[:, 1], to[:, 0]) - bearing)
    if np.ptp(np.quantile(bearings, [0.05, 0.95])) < LEAST_ROUND_RAD:
        return None
    return _Wall(True, p, np.zeros(2), members, _cost(miss))


def _cost(miss: Float[ndarray, "n"]) -> float:
    """The less, the more echoes touch a wall and the better."""
    return -float(np.sum(1 - (miss / NEAR_M) ** 2))
