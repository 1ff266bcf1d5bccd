"""Where a robot that drives now is in a map that is known, told as AMCL tells it."""

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple, override

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import Grid
from echogrid.live.placing import Correction, Placing, RobotPose
from echogrid.live.sonar_array import SonarArray
from echogrid.position.beside import Beside
from echogrid.position.localiser import Event, Localiser
from echogrid.robot import Robot

MOST_WAITING = 2_000
"""Scans that wait to be heard."""

MOST_EVENTS = 100
"""That wait to be told."""

_SAID = {
    "sure": "one place remained",
    "lost": "the place did not explain what was heard: it is looked for anywhere again",
    "jump": "the odometry jumps or starts anew: the robot is taken to have stayed where it was",
    "anew": "time goes back, and the odometry with it: the drive begins again where it began",
}

LEAST_SPREAD = np.array([0.05, 0.05, np.deg2rad(3.0)])
"""Standard deviations of a pose that somebody tells are taken to be no less, m, m, rad."""


class _Put(NamedTuple):
    """Somebody tells where the robot is."""

    correction: Float[ndarray, "3"]
    """T_map_odom, m, m, rad."""
    spread: Float[ndarray, "3"]
    """Standard deviations, m, m, rad."""


class _Told(NamedTuple):
    """What is known by a scan."""

    stamp: float
    """s"""
    pose: Float[ndarray, "3"]
    """The likeliest, m, m, rad."""
    correction: Float[ndarray, "3"]
    """T_map_odom, m, m, rad."""
    covariance: Float[ndarray, "3 3"]
    """Of all guesses about the pose."""
    sure: bool
    """Whether one place remains."""


class _Tracking:
    """The localiser; it lives in the thread."""

    def __init__(self, grid: Grid, robot: Robot, start: Float[ndarray, "3"] | None):
        self._grid, self._robot, self._start = grid, robot, start
        self._localiser: Localiser | None = None
        self._odometry = np.zeros(3)
        self.events: deque[Event] = deque(maxlen=MOST_EVENTS)
        """What happened and was not told yet."""
        self.refused: deque[str] = deque(maxlen=MOST_EVENTS)
        """Why poses that somebody told were not taken, and was not told yet."""

    def __call__(self, task: Frame | _Put | Robot) -> _Told | None:
        if self._localiser is None:  # it looks round in the whole map, which takes its time
            self._localiser = Localiser(self._grid, self._robot, self._start)
        if isinstance(task, Robot):
            self._localiser.equip(task)
        elif isinstance(task, _Put):
            self._put(self._localiser, task)
        else:
            return self._heard(self._localiser, task)
        return None

    def _put(self, localiser: Localiser, told: _Put) -> None:
        try:
            localiser.put(compose(told.correction, self._odometry), told.spread)
        except UsageError as error:
            self.refused.append(str(error))

    def _heard(self, localiser: Localiser, frame: Frame) -> _Told:
        self._odometry = frame.pose
        estimate = localiser.add(frame)
        self.events.extend(localiser.events)
        localiser.events.clear()
        pose = estimate.pose
        covariance = estimate.covariance if estimate.sure else localiser.particles.about(pose)
        return _Told(frame.stamp, pose, compose(pose, inverse(frame.pose)), covariance, estimate.sure)


class Known(Placing):
    """The robot is found in a map that is known; what its sonars hear is mapped by its odometry alone."""

    def __init__(
        self, array: SonarArray, grid: Grid, start: Float[ndarray, "3"] | None, frame: str, tolerance: float
    ):
        """A robot that has not moved.

        Args:
            array: its sonars.
            grid: the map.
            start: about where it is, m, m, rad; None: anywhere.
            frame: of the map.
            tolerance: how long a correction holds, s.
        """
        self.frame = array.fixed
        """In which what is heard is mapped."""
        self._array, self._map, self._tolerance = array, frame, tolerance
        self._tracking = _Tracking(grid, array.robot, start)
        self._beside = Beside(self._tracking, "echogrid-localise")
        self._told: _Told | None = None
        self.late = 0
        """Scans that were too many to keep up with."""

    @property
    @override
    def where(self) -> Float[ndarray, "3"] | None:
        return self._told.pose if self._told and self._told.sure else None

    @override
    def place(self, frame: Frame) -> Frame:
        if self._beside.waiting < MOST_WAITING:
            self._beside.put(frame)
        else:
            self.late += 1
        return frame

    def put(self, correction: Float[ndarray, "3"], spread: Float[ndarray, "3"]) -> None:
        """Be told where the frame of the odometry lies (m, m, rad), and with which standard deviations."""
        self._beside.put(_Put(correction, np.maximum(spread, LEAST_SPREAD)))

    @override
    def equip(self) -> None:
        self._beside.put(self._array.robot)

    @override
    def renewed(self, now: float) -> None:
        """The map stays."""

    @override
    def final(self) -> None:
        """The map stays; what waits is heard."""
        self._beside.wait()

    @override
    def sent(self) -> list[Correction | RobotPose]:
        told = self._beside.found
        if told is None or told is self._told:
            return []
        self._told = told
        sent: list[Correction | RobotPose] = [RobotPose(self._map, told.stamp, told.pose, told.covariance)]
        if told.sure:  # who does not know where the robot is does not say it
            sent.append(Correction(self._map, self._array.fixed, told.stamp + self._tolerance, told.correction))
        return sent

    @override
    def notices(self) -> Iterator[str]:
        while self._tracking.refused:
            yield f"initial pose not taken: {self._tracking.refused.popleft()}"
        while self._tracking.events:
            event = self._tracking.events.popleft()
            yield f"at {event.stamp:.2f} s {_SAID[event.what]}"

    @override
    def status(self) -> str:
        told = self._told
        if told is None:
            return "not heard enough to say where the robot is"
        x, y, theta = told.pose.tolist()
        place = f"{x:.2f}, {y:.2f} m, {np.rad2deg(theta):.0f} degrees"
        off = np.sqrt(np.trace(told.covariance[:2, :2]))
        late = f"; {self.late} scans too many to keep up with" if self.late else ""
        return (f"at {place}, to {off:.2f} m" if told.sure else f"not sure where: likeliest at {place}") + late

    @override
    def settings(self) -> dict[str, Any]:
        where = self.where
        return {"place": None if where is None else where.round(4).tolist()}
