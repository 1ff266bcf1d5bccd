"""The topics of a simulated robot: ranges, odometry, transforms and the time go out, commands come in."""

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from echogrid.frame import Frame
from echogrid.live.base import Base
from echogrid.live.dds_types import (
    Clock,
    Odometry,
    RangeWithVariance,
    Refused,
    TFMessage,
    Twist,
    clock_message,
    odometry_message,
    range_message,
    transform_message,
)
from echogrid.live.participant import KEPT_QOS, STREAM_QOS, dds_topic, joined

ODOM, BASE = "odom", "base_link"

_COMMAND_QOS = Qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, Policy.History.KeepLast(10))
"""A flood of commands is not queued: the newest count."""


class BaseTopics:
    """The robot in a domain of ROS 2."""

    def __init__(self, domain: int, interface: str | None, base: Base, command_topic: str):
        """Join a domain, and say where the sonars sit.

        Args:
            domain: its number.
            interface: as of ``participant.joined``.
            base: the robot.
            command_topic: where commands come, as ROS 2 names it.

        Raises:
            UsageError: there is no such interface or topic, or DDS cannot be started.
        """
        name = dds_topic(command_topic, "robot")
        self._joined = joined(domain, interface, "robot")
        self.kept = self._joined.kept
        """As of ``Joined``."""
        self._base, self._robot = base, base.vehicle.robot
        self._commands = DataReader(self._joined.participant, self._topic(name, Twist), _COMMAND_QOS)
        self._waitset = WaitSet(self._joined.participant)
        self._waitset.attach(ReadCondition(self._commands, ViewState.Any | InstanceState.Any | SampleState.NotRead))
        self._ranges = [
            self._writer(f"rt/sonar/s{number}", RangeWithVariance) for number in range(self._robot.sonars)
        ]
        self._tf, self._odometry = self._writer("rt/tf", TFMessage), self._writer("rt/odom", Odometry)
        self._clock = self._writer("rt/clock", Clock)
        mounts = {self._frame(number): mount for number, mount in enumerate(self._robot.mounts)}
        static = self._writer("rt/tf_static", TFMessage, KEPT_QOS)
        static.write(transform_message(base.stamp, BASE, mounts))
        self._static = static

    def _topic(self, name: str, kind: Any) -> Topic:
        return Topic(self._joined.participant, name, kind)

    def _writer(self, name: str, kind: Any, qos: Qos = STREAM_QOS) -> DataWriter:
        return DataWriter(self._joined.participant, self._topic(name, kind), qos)

    def _frame(self, sonar: int) -> str:
        return f"sonar_{sonar}"

    def wait(self, seconds: float) -> None:
        """Return when a command has come, or after some time."""
        self._waitset.wait(int(seconds * 1e9))

    def commands(self) -> Iterator[tuple[Any, Any]]:
        """Commands that have come (``geometry_msgs/Twist``, or what is none), and who sent each."""
        try:
            samples = self._commands.take(10)
        except Exception:  # what no decoder of Cyclone DDS takes
            yield None, None
            return
        for sample in samples:
            if isinstance(sample, Refused):
                yield None, None
            elif sample.sample_info.valid_data:
                yield sample, sample.sample_info.publication_handle

    def send(self, frame: Frame) -> None:
        """Say what there was in a tick: the time, where the wheels say that the robot is, what its sonars heard."""
        stamp = self._base.stamp - self._base.vehicle.time_s + frame.stamp
        assert frame.odom is not None
        pose = self._base.pose(frame.odom)
        with suppress(DDSException):  # a reader that takes nothing costs the others no more than this message
            self._clock.write(clock_message(stamp))
            self._tf.write(transform_message(stamp, ODOM, {BASE: pose}))
            self._odometry.write(odometry_message(stamp, ODOM, BASE, pose, self._base.vehicle.velocity))
            for number, range_m in self._base.fired(frame):
                self._ranges[number].write(range_message(stamp, self._frame(number), self._robot, range_m))
