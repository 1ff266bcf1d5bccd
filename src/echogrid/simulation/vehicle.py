"""A robot that drives through a world as it is told: wheels, odometry that drifts, sonars in turn, a bumper."""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.simulate import Simulator, disturb
from echogrid.simulation.world import World

TICK_S = 0.04
"""From one group of sonars to the next: what an echo of 5 m takes, and some rest."""

AT_ONCE = 4
"""Sonars that fire together, as far from each other on the robot as there are."""

_PARTS = 4
"""Steps of the motion in a tick."""

_TOUCH_M, _OFF_M = 0.001, 0.01
"""A robot that comes so near to a wall touches it, until it is so far from it again."""


@dataclass(frozen=True)
class Limits:
    """What wheels can do; the defaults are those of a careful robot of the size of a Pioneer."""

    speed_m_s: float = 0.4
    turn_rad_s: float = 1.2
    acceleration_m_s2: float = 0.6
    turn_acceleration_rad_s2: float = 3.0


@dataclass(frozen=True)
class Slip:
    """How wheels mislead: standard deviations of what dead reckoning gets wrong."""

    scale: float = 0.01
    """Of the scale of distances, the same for a drive."""
    bias_deg_m: float = 1.0
    """Of the heading's drift a metre, the same for a drive, degrees/m."""
    turning: float = 0.01
    """Of the scale of turns, the same for a drive."""
    noise: float = 0.03
    """Of the way after a metre, m; a random walk."""
    noise_deg_m: float = 1.0
    """Of the heading after a metre, degrees; a random walk."""
    noise_deg_turn: float = 1.0
    """Of the heading after a turn of one radian, degrees; a random walk."""


@dataclass
class Vehicle:
    """A robot in a world, in time of its own.

    It goes on by ticks: in each the wheels follow the velocity that was last commanded as fast as they can, and one
    group of sonars fires. All groups have fired after ``cycle`` ticks.
    """

    world: World
    robot: Robot
    pose: Float[ndarray, "3"]
    """Where it truly is, m, m, rad."""
    seed: int = 0
    physics: Physics = field(default_factory=Physics)
    limits: Limits = field(default_factory=Limits)
    slip: Slip = field(default_factory=Slip)

    def __post_init__(self) -> None:
        self._simulator = Simulator(self.world, self.robot, self.physics)
        self._rng, self._wheels = (np.random.default_rng([self.seed, part]) for part in (1, 2))
        self._scale = float(1.0 + self.physics.range_scale * self._rng.standard_normal())
        self._wrong = self._wheels.standard_normal(3) * [
            self.slip.scale, np.deg2rad(self.slip.bias_deg_m), self.slip.turning
        ]  # fmt: skip
        self._ticks = 0
        self._asked, self.velocity = np.zeros(2), np.zeros(2)
        self.pose = np.array(self.pose, dtype=float)
        self.odometry = self.pose.copy()
        """Where its wheels say that it is, m, m, rad; it begins at the truth."""
        self.touching, self.bumps, self.way_m = False, 0, 0.0
        self.least_m = self._room_m = self.clearance(self.pose[:2])
        if self.least_m < _TOUCH_M:
            x, y = self.pose[:2]
            found = f"{self.least_m + self.robot.footprint_radius_m:.2f} m from the nearest wall"
            raise UsageError(
                f"world {self.world.name}: start ({x:.2f}, {y:.2f}) m: found {found}, "
                f"expected the footprint of {self.robot.name}, {self.robot.footprint_radius_m:g} m"
            )

    @property
    def time_s(self) -> float:
        """Since the beginning."""
        return self._ticks * TICK_S

    @property
    def groups(self) -> list[Int[ndarray, "n"]]:
        """Which sonars fire in each tick of a cycle."""
        cycle = -(-self.robot.sonars // AT_ONCE)
        return [np.arange(first, self.robot.sonars, cycle) for first in range(cycle)]

    def clearance(self, p_world: Float[ndarray, "2"]) -> float:
        """Room between the footprint at a place and the nearest wall or cylinder, m; below 0 it would be in it."""
        return float(self.world.clearance(p_world[None])[0]) - self.robot.footprint_radius_m

    def command(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Ask for a velocity, forward and counter-clockwise; what wheels cannot do is cut.

        Raises:
            UsageError: no finite numbers; the robot is asked to stop.
        """
        asked = np.array([speed_m_s, turn_rad_s], dtype=float)
        if not np.isfinite(asked).all():
            self._asked = np.zeros(2)
            raise UsageError(f"command: found {speed_m_s:g} m/s, {turn_rad_s:g} rad/s, expected finite numbers")
        most = np.array([self.limits.speed_m_s, self.limits.turn_rad_s])
        self._asked = np.clip(asked, -most, most)

    def go_on(self, ticks: int) -> list[Frame]:
        """Drive for some ticks: a frame each, posed by the truth, with ``odom``; the sonars of one group fired.

        Raises:
            MissingError: JAX is not installed.
        """
        poses, odometry, groups, stamps = [], [], [], []
        for _ in range(ticks):
            self._move()
            poses.append(self.pose.copy())
            odometry.append(self.odometry.copy())
            groups.append(self.groups[self._ticks % len(self.groups)])
            self._ticks += 1
            stamps.append(self.time_s)
        ranges = self._heard(np.array(poses), groups)
        return [
            Frame(stamp, pose, heard, odom)
            for stamp, pose, heard, odom in zip(stamps, poses, ranges, odometry, strict=True)
        ]

    def _heard(
        self, poses: Float[ndarray, "ticks 3"], groups: list[Int[ndarray, "n"]]
    ) -> Float[ndarray, "ticks sonars"]:
        """What the sonars of each tick hear, under the no-echo rule; nan of those that did not fire."""
        fired = np.full((len(poses), self.robot.sonars), False)
        for row, group in zip(fired, groups, strict=True):
            row[group] = True
        # Groups may differ by one sonar: what is missing is heard from the first one again, and dropped.
        most = max(map(len, self.groups))
        which = np.array([np.resize(group, most) for group in groups])
        true = self._simulator.heard(compose(poses[:, None], self.robot.mounts[which]), self._rng)
        quiet = replace(self.physics, range_scale=0.0)
        told = disturb(true * self._scale, quiet, self.robot.max_range_m, self._rng)
        ranges = np.full(fired.shape, np.nan)
        np.put_along_axis(ranges, which, told, axis=1)
        return np.where(fired, self.robot.clean(ranges), np.nan)

    def _move(self) -> None:
        """Let a tick pass."""
        most = np.array([self.limits.acceleration_m_s2, self.limits.turn_acceleration_rad_s2]) * TICK_S / _PARTS
        before = self.pose.copy()
        for _ in range(_PARTS):
            self.velocity = self.velocity + np.clip(self._asked - self.velocity, -most, most)
            self._step(TICK_S / _PARTS)
        self._reckon(before)

    def _step(self, seconds: float) -> None:
        (speed, turn), (x, y, theta) = self.velocity, self.pose
        heading = theta + turn * seconds / 2
        there = np.array([x + speed * seconds * np.cos(heading), y + speed * seconds * np.sin(heading)])
        then = self.clearance(there) if speed else self._room_m
        if then < _TOUCH_M and then < self._room_m:
            self.bumps += not self.touching
            self.touching = True
            self.velocity = np.array([0.0, turn])
            there, then = self.pose[:2], self._room_m
        elif then >= _OFF_M:
            self.touching = False
        self._room_m = then
        self.least_m = min(self.least_m, then)
        self.way_m += float(np.linalg.norm(there - self.pose[:2]))
        self.pose = np.array([*there, float(wrap(theta + turn * seconds))])

    def _reckon(self, before: Float[ndarray, "3"]) -> None:
        """Let the wheels count what was driven since a pose."""
        way = float((self.pose[:2] - before[:2]) @ [np.cos(before[2]), np.sin(before[2])])
        turn = float(wrap(self.pose[2] - before[2]))
        scale, bias, turning = self._wrong
        along, aside, spun = self._wheels.standard_normal(3)
        far = abs(way)
        told_way = way * (1 + scale) + self.slip.noise * np.sqrt(far) * along
        told_turn = turn * (1 + turning) + bias * far
        told_turn += np.deg2rad(self.slip.noise_deg_m) * np.sqrt(far) * aside
        told_turn += np.deg2rad(self.slip.noise_deg_turn) * np.sqrt(abs(turn)) * spun
        x, y, theta = self.odometry
        heading = theta + told_turn / 2
        self.odometry = np.array(
            [x + told_way * np.cos(heading), y + told_way * np.sin(heading), float(wrap(theta + told_turn))]
        )
