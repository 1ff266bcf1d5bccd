"""The command that is a robot: robot."""

import sys
import time
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from echogrid.cli.arguments import WORLD, check_physics, check_seed, robot_arg, start_pose
from echogrid.cli.network import domain_of, interface_of, stopped, where
from echogrid.errors import UsageError, escaped
from echogrid.extras import need
from echogrid.files import check_writable, replacing
from echogrid.frame import Frame
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.world import World

if TYPE_CHECKING:
    from echogrid.live.base import Base
    from echogrid.live.base_topics import BaseTopics
    from echogrid.simulation.vehicle import Vehicle

MOST_SPEED = 50.0
"""Times as fast as real time."""

BEHIND, BEHIND_S = 0.8, 5.0
"""A simulation that goes at less than this share of its speed for so long falls behind."""

WAIT_S = 0.05
"""How long a signal to stop waits at most."""

MOST_FRAMES = 4_000_000
"""That are kept for the log: 44 h of the robot's time."""


@dataclass(frozen=True)
class SimulatedRobot:
    """A simulated robot on a network of ROS 2, without ROS: to try everything with before there is one.

    Hears geometry_msgs/Twist on /cmd_vel, and stops where none comes for 0.5 s. Publishes sensor_msgs/Range on
    /sonar/s0, ..., nav_msgs/Odometry on /odom, odom -> base_link on /tf, the mounts on /tf_static, and /clock.
    Ctrl-C, SIGTERM and SIGHUP are its ordinary end.

    It keeps to loopback, unless you name an interface.
    """

    world: Annotated[Positional[str], WORLD]
    robot: Annotated[str, robot_arg()]
    start: Annotated[str | None, arg(metavar="X,Y,DEG")] = None
    """Where it begins: m, m, degrees. Default: the start of the world, else its roomiest place."""
    walls: Literal["smooth", "rough", "as-given"] = "as-given"
    """Make all walls smooth or rough."""
    speed: Annotated[float, arg(metavar="TIMES")] = 1.0
    """So many times as fast as real time; stamps go by /clock."""
    seed: int = 0
    """The same seed gives the same wheels, and the same ears."""
    slip: Annotated[float, arg(metavar="TIMES")] = 1.0
    """So many times as wrong as usual are its wheels (about 1 degree of heading and 3 cm after a metre); 0: exact."""
    out: Annotated[Path | None, arg(metavar="LOG")] = None
    """Write the log of its drive (CSV) in the end, with its truth beside it. Default: none."""
    interface: Annotated[str | None, arg(metavar="NAME|any")] = None
    """Network interface: lo, eth0, ... or any. Default: what CYCLONEDDS_URI says if it is set, else lo."""
    domain: Annotated[int | None, arg(metavar="ID")] = None
    """DDS domain. Default: ROS_DOMAIN_ID, else 0."""
    cmd_vel_topic: str = "/cmd_vel"
    """Where commands come."""
    physics: Physics = field(default_factory=Physics)

    def run(self) -> None:
        """Be a robot until stopped."""
        domain = domain_of(self.domain)
        check_physics(self.physics)
        check_seed(self.seed)
        if not 0.1 <= self.speed <= MOST_SPEED:
            raise UsageError(f"--speed: found {self.speed:g}, expected 0.1 to {MOST_SPEED:g}")
        if not 0 <= self.slip <= 10:
            raise UsageError(f"--slip: found {self.slip:g}, expected 0 to 10")
        need("robot", "train")
        need("robot", "ros2")
        from echogrid.live.base import Base
        from echogrid.live.base_topics import BaseTopics

        if self.out:
            check_writable(self.out)
            check_writable(self._truth)
        world, robot = World.load(self.world).with_walls(self.walls), Robot.load(self.robot)
        base = Base(self._vehicle(world, robot), float(np.round(time.time(), 3)))
        frames: list[Frame] = []
        with stopped() as stop:
            interface = interface_of(self.interface)
            topics = BaseTopics(domain, interface, base, self.cmd_vel_topic)
            name = f"{robot.name} in {world.name}"
            _say(f"{name}: domain {domain}, {where(interface, topics.kept)}; hears {self.cmd_vel_topic}")
            _be(base, topics, self.speed, stop, frames if self.out else None)
        if self.out:
            self._write(world, robot, frames)
        print(escaped(f"{robot.name} in {world.name}: {base.told()}"))

    def _vehicle(self, world: World, robot: Robot) -> "Vehicle":
        """The robot where it begins, and what simulates it compiled."""
        from echogrid.live.base import AT_ONCE
        from echogrid.planning.explore import Reachable
        from echogrid.simulation.drive import start_of
        from echogrid.simulation.vehicle import Slip, Vehicle

        start = np.array([*start_of(world, robot.footprint_radius_m + 0.1), 0.0])
        start = start if self.start is None else start_pose(self.start)
        Reachable.of(world, robot, start[:2])  # refuses worlds with holes, and places without room
        slip = Slip(*(self.slip * each for each in astuple(Slip())))
        for ticks in (1, AT_ONCE):
            Vehicle(world, robot, start, self.seed, self.physics).go_on(ticks)
        return Vehicle(world, robot, start, self.seed, self.physics, slip=slip)

    @property
    def _truth(self) -> Path:
        assert self.out is not None
        return self.out.with_suffix(".truth.npz")

    def _write(self, world: World, robot: Robot, frames: list[Frame]) -> None:
        from echogrid.cli.planning import rounded
        from echogrid.logs.csv_log import write_csv
        from echogrid.output.map_file import write_truth
        from echogrid.simulation.drive import truth_of

        if not frames:
            return
        assert self.out is not None
        with replacing(self._truth) as truth, replacing(self.out) as log:
            write_csv(log, map(rounded, frames), robot.sonars)
            write_truth(truth, truth_of(world, np.array([frame.pose for frame in frames])))


def _be(base: "Base", topics: "BaseTopics", speed: float, stop: list[int], frames: list[Frame] | None) -> None:
    """Drive, hear and tell until stopped."""
    from echogrid.live.base import AT_ONCE
    from echogrid.simulation.vehicle import TICK_S

    pacer = _Pacer(speed)
    while not stop:
        left = pacer.wait_s(base.vehicle.time_s + TICK_S, time.monotonic())
        if left > 0:
            topics.wait(min(left, WAIT_S))
        for twist, source in topics.commands():
            base.take(twist, source)
        due = int(pacer.due_s(base.vehicle.time_s, time.monotonic()) / TICK_S + 1e-6)
        if due > 0:
            for frame in base.go_on(AT_ONCE if due >= AT_ONCE else 1):
                topics.send(frame)
                if frames is not None and len(frames) < MOST_FRAMES:
                    frames.append(frame)
        for notice in base.notices():
            _say(notice)
        if (lag := pacer.lag()) and not pacer.said:
            pacer.said = True
            _say(f"falls behind: {lag:.1f} times real time, not {speed:g}; give a lower --speed")


class _Pacer:
    """Keeps a simulation's time to real time, or to a multiple of it; what it falls behind by is not made up."""

    def __init__(self, speed: float):
        self._speed, self._begin, self.said = speed, time.monotonic(), False
        self._lost, self._window = 0.0, (self._begin, 0.0)
        self._time = 0.0

    def _should(self, now: float) -> float:
        return (now - self._begin) * self._speed - self._lost

    def wait_s(self, time_s: float, now: float) -> float:
        """How long to wait until the simulation's time (s) comes."""
        return (time_s - self._should(now)) / self._speed

    def due_s(self, time_s: float, now: float) -> float:
        """How much of its time is due, s."""
        due = self._should(now) - time_s
        if due > self._speed * WAIT_S + 1.0:  # it cannot keep up, or was put to sleep
            self._lost += due - self._speed * WAIT_S
            due = self._speed * WAIT_S
        self._time = time_s
        return due

    def lag(self) -> float | None:
        """By how many times real time it goes, where that is too slow; None where it is not, or not known yet."""
        now, (since, then) = time.monotonic(), self._window
        if now - since < BEHIND_S:
            return None
        self._window = now, self._time
        rate = (self._time - then) / (now - since)
        return rate if rate < BEHIND * self._speed else None


def _say(text: str) -> None:
    print(f"robot: {escaped(text)}", file=sys.stderr, flush=True)
