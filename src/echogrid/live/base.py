"""A simulated robot as programs of ROS know a base: it hears commands, and stops where none come."""

from collections import Counter
from collections.abc import Iterable
from math import degrees, isfinite
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.simulation.vehicle import TICK_S, Vehicle

SILENT_S = 0.5
"""A base that has heard no command for so long, by its own clock, stops."""

AT_ONCE = 4
"""Ticks that are driven in one go at most; what takes a shape of its own is compiled anew."""

NO_NUMBER = "a command that is no finite number: the robot stops"
SIDEWAYS = "a command to go sideways, up or over, which wheels cannot: that part is passed over"


class Base:
    """The robot, its clock, and what it was told."""

    def __init__(self, vehicle: Vehicle, begin_s: float):
        """A robot that stands.

        Args:
            vehicle: it.
            begin_s: what its clock says now, s.
        """
        self.vehicle = vehicle
        self.refused: Counter[str] = Counter()
        """Commands that were not followed, or not wholly, by reason."""
        self.commands = 0
        """How many were."""
        self._begin, self._start = begin_s, vehicle.pose.copy()
        self._heard_s = -np.inf
        self._from: dict[Any, float] = {}
        self._said: set[str] = set()

    @property
    def stamp(self) -> float:
        """Its clock, s."""
        return self._begin + self.vehicle.time_s

    def pose(self, odometry: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
        """What its wheels say in their own frame, which begins where the robot did (m, m, rad)."""
        return compose(inverse(self._start), odometry)

    def fired(self, frame: Frame) -> Iterable[tuple[int, float]]:
        """The sonars that fired in a tick, and their ranges (m; +inf no echo, -inf too near to be measured)."""
        tick = round(frame.stamp / TICK_S) - 1
        for number in self.vehicle.groups[tick % len(self.vehicle.groups)].tolist():
            value = float(frame.ranges[number])
            yield number, value if value == value else -np.inf

    def take(self, twist: Any, source: Any = None) -> None:
        """Take a command (``geometry_msgs/Twist``); whatever it holds, it does no harm.

        Args:
            twist: the command; anything may be in it.
            source: who sent it, where that is known.
        """
        try:
            speed, turn = float(twist.linear.x), float(twist.angular.z)
            others = [float(getattr(twist.linear, axis)) for axis in "yz"]
            others += [float(getattr(twist.angular, axis)) for axis in "xy"]
        except Exception:  # strangers decide what is in it
            speed = turn = np.nan
            others = []
        self._heard_s = self.vehicle.time_s
        if not (isfinite(speed) and isfinite(turn)):
            self.refused[NO_NUMBER] += 1
            self.vehicle.command(0.0, 0.0)
            return
        if any(others):
            self.refused[SIDEWAYS] += 1
        self.commands += 1
        self.vehicle.command(speed, turn)
        if speed or turn:  # who only says stop disturbs nobody
            self._note(source)

    def _note(self, source: Any) -> None:
        """Take note of who commands: two at once drive it to and fro."""
        now = self.vehicle.time_s
        self._from = {who: when for who, when in self._from.items() if now - when < SILENT_S}
        self._from[source] = now

    def go_on(self, ticks: int) -> list[Frame]:
        """Drive for some ticks, AT_ONCE at most; a frame each, as of ``Vehicle.go_on``.

        Raises:
            MissingError: JAX is not installed.
        """
        if self.vehicle.time_s - self._heard_s >= SILENT_S - 1e-9:
            self.vehicle.command(0.0, 0.0)
        return self.vehicle.go_on(ticks)

    def notices(self) -> list[str]:
        """What the user should know and was not told yet: the first of each kind; the rest is counted."""
        said = [f"found {why} (more are counted)" for why in self.refused]
        if len(self._from) > 1:
            said.append(f"commands come from {len(self._from)} programs at once: stop all but one")
        if self.vehicle.bumps:
            x, y, _ = self.vehicle.pose.tolist()
            said.append(f"touches something for the first time, at ({x:.2f}, {y:.2f}) m of the world")
        fresh = [text for text in said if _kind(text) not in self._said]
        self._said |= {_kind(text) for text in fresh}
        return fresh

    def told(self) -> str:
        """How its drive went, in one line."""
        vehicle = self.vehicle
        x, y, theta = self.pose(vehicle.pose).tolist()
        count = vehicle.bumps
        bumps = f"{count or 'no'} {'collision' if count == 1 else 'collisions'}"
        least = f"{max(vehicle.least_m, 0):.2f} m or more beside it"
        drove = f"{vehicle.way_m:.1f} m in {vehicle.time_s:.0f} s, {bumps}, {least}"
        ends = f"it ends {np.hypot(x, y):.2f} m and {abs(degrees(theta)):.0f} degrees from its start"
        return f"{drove}; {ends}" + "".join(f"; {n} x {why}" for why, n in self.refused.most_common(3))


def _kind(text: str) -> str:
    return text[:20]
