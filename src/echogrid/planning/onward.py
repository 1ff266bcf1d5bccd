"""Walls go on where a robot is deaf: what it heard last, before it came nearer than its sonars hear."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, transform, wrap
from echogrid.grid import Grid, logit
from echogrid.robot import Robot

DEAF_M = 0.1
"""A robot that hears up to so near to its footprint, m, needs no more."""

NEAR_M, LINE_M = 0.1, 0.3
"""What is heard within so much more than the shortest range, m, may not be heard in the next scan, but nearer; and
what is heard within the second tells how it lies."""

SPAN_M, OFF_M, OFF_RAD = 0.25, 0.05, 0.2
"""Echoes along a line so long, m, and off it by no more than the second, or the third where they are far, are a wall,
twice so far from the last at most. Those of a post lie at one place, as exactly as sonars tell in which direction:
at a door nothing goes on."""

ALONG_M, THICK_M = 0.4, 0.04
"""So far it is taken to go on, and so much nearer than it was heard, m: walls of maps are thicker than they are as
well, and that is margin."""

BESIDE_RAD, RECENT_S = np.deg2rad(45.0), 2.0
"""Not where another sonar that looks so near to the same way heard something nearer, at most so long ago, s: the one
that looks at a wall most nearly across it hears it nearest."""

SAME_M = 0.02
"""Echoes so near to each other are kept once."""

KEPT_M = 0.5
"""Farther than this from the footprint it is forgotten, m: there the robot hears."""

FREE_P = 0.05
"""What is occupied with less than this is free all the same: it was heard from afar."""

OCCUPIED = 3.0
"""Log-odds that what is occupied near the robot has in the map at least."""

_CELL_M = 0.04


def taken_at(grid: Grid, places: Float[ndarray, "n 2"], free_p: float = 0.0) -> Grid:
    """A copy of a map by which places (m) are occupied, but those that it takes for free with p < ``free_p``."""
    index = grid.index_of(places)
    cells = tuple(index[np.all((index >= 0) & (index < grid.shape), axis=1)].T)
    log_odds, observed = grid.log_odds.copy(), grid.observed.copy()
    if free_p > 0:
        unsure = ~observed[cells] | (log_odds[cells] > logit(free_p))
        cells = tuple(axis[unsure] for axis in cells)
    log_odds[cells], observed[cells] = np.maximum(log_odds[cells], OCCUPIED), True
    return replace(grid, log_odds=log_odds, observed=observed)


class Onward:
    """What lies beside a robot in the range in which it is deaf, as a wall that goes on.

    A smooth wall is heard at the foot of the perpendicular alone. A robot that comes up to it at an angle hears the
    foot move along until it is too near; by the map the wall ends there, and what it drives towards looks free.
    """

    def __init__(self, robot: Robot) -> None:
        """Nothing heard.

        Args:
            robot: its sonars and its footprint.
        """
        self._echoes: Float[ndarray, "n 2"] = np.empty((0, 2))
        self._cells: Int[ndarray, "n 2"] = np.empty((0, 2), int)
        self.equip(robot)

    def equip(self, robot: Robot) -> None:
        """Go on with another array."""
        self.robot = robot
        self._ranges, self._stamps = np.full(robot.sonars, np.inf), np.full(robot.sonars, -np.inf)

    def add(self, frames: Sequence[Frame]) -> None:
        """Take scans, in their order, posed by odometry."""
        robot = self.robot
        if robot.deaf_m < DEAF_M:
            return
        for frame in frames:
            ranges = robot.clean(frame.ranges)
            fired = ~np.isnan(ranges)
            self._ranges[fired], self._stamps[fired] = ranges[fired], frame.stamp
            for sonar in np.flatnonzero(ranges < robot.min_range_m + LINE_M).tolist():
                if self._nearest(sonar):
                    self._hear(frame, sonar)
            off, reach = np.linalg.norm(self._places() - frame.pose[:2], axis=1), robot.footprint_radius_m
            # Where the robot stands there is no wall.
            self._cells = self._cells[(off > reach) & (off < reach + KEPT_M)]
            off = np.linalg.norm(self._echoes - frame.pose[:2], axis=1)
            self._echoes = self._echoes[off < reach + KEPT_M + LINE_M]

    def forget(self) -> None:
        """The robot is elsewhere."""
        self._echoes, self._cells = np.empty((0, 2)), np.empty((0, 2), int)
        self.equip(self.robot)

    def laid_over(self, grid: Grid, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]) -> Grid:
        """A map with that in it, a copy where there is any.

        Args:
            grid: the map.
            pose: of the robot in it, m, m, rad.
            odometry: likewise, by odometry.
        """
        if not len(self._cells):
            return grid
        return taken_at(grid, transform(compose(pose, inverse(odometry)), self._places()), FREE_P)

    def _nearest(self, sonar: int) -> bool:
        """Whether a sonar that was heard just now heard something nearer than those beside it."""
        axes = self.robot.mounts[:, 2]
        beside = np.abs(wrap(axes - axes[sonar])) < BESIDE_RAD
        beside &= self._stamps > self._stamps[sonar] - RECENT_S
        return bool(self._ranges[sonar] <= np.min(self._ranges[beside]))

    def _places(self) -> Float[ndarray, "n 2"]:
        return (self._cells + 0.5) * _CELL_M

    def _hear(self, frame: Frame, sonar: int) -> None:
        """Take an echo that is near, and what goes on from there."""
        mounts = self.robot.mounts if frame.mounts is None else frame.mounts
        x, y, axis = mounts[sonar]
        far = self._ranges[sonar]
        echo = transform(frame.pose, np.array([x + far * np.cos(axis), y + far * np.sin(axis)]))
        before = self._echoes
        if not len(before) or np.min(np.linalg.norm(before - echo, axis=1)) > SAME_M:
            self._echoes = np.vstack([before, echo])
        if far >= self.robot.min_range_m + NEAR_M or not len(before):
            return
        heading = frame.pose[2] + axis
        inward = np.array([np.cos(heading), np.sin(heading)])
        for way in (1.0, -1.0):
            self._go_on(before, echo, inward, way * np.array([-inward[1], inward[0]]))

    def _go_on(
        self,
        before: Float[ndarray, "n 2"],
        echo: Float[ndarray, "2"],
        inward: Float[ndarray, "2"],
        aside: Float[ndarray, "2"],
    ) -> None:
        """Let a wall go on from an echo, if echoes before it lie along one.

        Args:
            before: those, m.
            echo: the last, m.
            inward: from the sonar to it, a unit vector.
            aside: across that, to where the wall is to go on.
        """
        behind = (echo - before) @ aside
        line = np.abs((before - echo) @ inward) < np.maximum(OFF_M, OFF_RAD * behind)
        line &= (behind > 0) & (behind < 2 * SPAN_M)
        if np.max(behind[line], initial=0.0) < SPAN_M:
            return
        on = echo - before[line][np.argmax(behind[line])]
        steps = np.arange(0.0, ALONG_M + _CELL_M / 2, _CELL_M / 2)[:, None]
        points = echo - THICK_M * inward + steps * on / np.linalg.norm(on)
        self._cells = np.unique(np.vstack([self._cells, np.floor(points / _CELL_M).astype(int)]), axis=0)
