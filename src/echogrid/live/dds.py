"""The messages and topics of ROS 2 over DDS (Cyclone DDS), with no ROS installed.

How a domain is joined, and what that exposes: ``echogrid.live.participant``. Here what others publish goes into the
map, and whoever listens can read the map.

What comes in is bounded in size (``dds_types.MAX_MESSAGE_BYTES``) and judged in ``echogrid.live.hearing``. Cyclone
DDS itself reads the packets; a flood of them costs time and memory that nothing here can bound.
"""

import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from echogrid.errors import UsageError
from echogrid.live.dds_types import (
    OccupancyGrid,
    Odometry,
    PoseStamped,
    PoseWithCovarianceStamped,
    Range,
    RangeWithVariance,
    Refused,
    TFMessage,
    Twist,
    goal_message,
    occupancy_grid,
    pose_message,
    tf_message,
    twist_message,
)
from echogrid.live.driving import Goal, Velocity
from echogrid.live.hearing import Heard
from echogrid.live.live_map import Picture
from echogrid.live.participant import KEPT_QOS, STREAM_QOS, dds_topic, joined
from echogrid.live.placing import Correction, RobotPose
from echogrid.live.tf_topics import TfTopics
from echogrid.robot import MAX_SONARS
from echogrid.ros.messages import Choice

_DEPTH = 4_000
"""Messages of a topic that wait here at most, while a large map is read out for instance."""

SENSOR_QOS = Qos(
    Policy.Reliability.BestEffort,
    Policy.Durability.Volatile,
    Policy.History.KeepLast(_DEPTH),
    Policy.IgnoreLocal.Participant,
)
"""To hear ranges, /tf and odometry: it asks for least, so writers of every kind match, but its own."""

STATIC_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(_DEPTH),
)
"""To hear /tf_static, sent once, as ROS 2 sends it. Writers that keep nothing match ``SENSOR_QOS`` alone, so it is
heard at both qualities; what comes twice is the same."""

LOCAL_MAP_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(1),
)
"""To send the local map; readers that ask for less match as well."""

GOAL_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
)
"""To send /goal_pose: who comes late gets the last one."""

_FOUND_BY_TYPE: dict[str, tuple[Heard, Any, int]] = {
    "sensor_msgs::msg::dds_::Range_": (Heard.RANGE, Range, MAX_SONARS),
    "nav_msgs::msg::dds_::Odometry_": (Heard.ODOMETRY, Odometry, 16),
}
"""Types whose topics are looked for: what they are, how they are read, and how many topics there may be."""

_TF = "tf2_msgs::msg::dds_::TFMessage_"


@dataclass(frozen=True)
class _Reader:
    """A topic that is listened to."""

    reader: DataReader
    condition: ReadCondition
    heard: Heard
    topic: str


class Network:
    """The ROS 2 topics of one domain: those that are heard and those that are sent."""

    def __init__(
        self,
        domain: int,
        interface: str | None,
        choice: Choice,
        map_topic: str,
        local_topic: str,
        localises: bool = False,
        goal_topic: str | None = None,
        command_topic: str | None = None,
    ):
        """Join a domain.

        Args:
            domain: its number.
            interface: name of a network interface, or ``any``; None: what the configuration in CYCLONEDDS_URI says.
            choice: the topics of ranges and odometry to hear; those of tf are always heard.
            map_topic: where the map goes, as ROS 2 names it.
            local_topic: where the local map goes.
            localises: whether /initialpose is heard, and /amcl_pose sent.
            goal_topic: where the next place to go to is sent, if it is.
            command_topic: where velocities are sent, if they are.

        Raises:
            UsageError: there is no such interface or topic, or DDS cannot be started.
        """
        self.refused: Counter[str] = Counter()
        """Messages and topics that were not taken, by reason."""
        self._choice = choice
        self._readers: dict[tuple[str, type, str], _Reader] = {}
        self._tf = TfTopics()
        self._held: list[tuple[int, Heard, str, Any]] = []
        self._sent_tf: DataWriter | None = None
        sent = [dds_topic(name) for name in (map_topic, local_topic)]
        driven = [None if name is None else dds_topic(name) for name in (goal_topic, command_topic)]
        self._joined = joined(domain, interface)
        self.kept = self._joined.kept
        """Whether the kernel lets nothing in but through the interface that was named."""
        self._participant = self._joined.participant
        self._waitset = WaitSet(self._participant)
        self._discovery = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        # Transforms first: a range that comes with them finds its pose.
        for name in ("/tf_static", "/tf"):
            self._listen_to_tf(name)
        self._poses: DataWriter | None = None
        if localises:
            self._listen("rt/initialpose", PoseWithCovarianceStamped, SENSOR_QOS, Heard.INITIAL)
            topic = Topic(self._participant, "rt/amcl_pose", PoseWithCovarianceStamped)
            self._poses = DataWriter(self._participant, topic, KEPT_QOS)
        self._map, self._local = (
            DataWriter(self._participant, Topic(self._participant, name, OccupancyGrid), qos)
            for name, qos in zip(sent, (KEPT_QOS, LOCAL_MAP_QOS), strict=True)
        )
        if command_topic is not None:
            self._listen(dds_topic(command_topic), Twist, SENSOR_QOS, Heard.COMMAND)
        self._goals, self._commands = (
            DataWriter(self._participant, Topic(self._participant, name, kind), qos) if name else None
            for name, kind, qos in zip(driven, (PoseStamped, Twist), (GOAL_QOS, LOCAL_MAP_QOS), strict=True)
        )

    def _listen(self, name: str, kind: Any, qos: Qos, heard: Heard) -> None:
        key = name, kind, str(qos[Policy.Durability])
        if key not in self._readers:
            reader = DataReader(self._participant, Topic(self._participant, name, kind), qos)
            condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
            self._waitset.attach(condition)
            self._readers[key] = _Reader(reader, condition, heard, name.removeprefix("rt"))

    def _listen_to_tf(self, topic: str) -> None:
        static = topic.endswith("/tf_static")
        for qos in (STATIC_QOS, SENSOR_QOS) if static else (SENSOR_QOS,):
            self._listen(f"rt{topic}", TFMessage, qos, Heard.STATIC if static else Heard.TF)

    def _topics(self, heard: Heard) -> list[str]:
        return sorted({reader.topic for reader in self._readers.values() if reader.heard is heard})

    @property
    def ranges(self) -> list[str]:
        """The topics of ranges that are listened to, as ROS 2 names them."""
        return self._topics(Heard.RANGE)

    def wait(self, seconds: float) -> None:
        """Return when something has come, or after some time."""
        if not self._held:
            self._waitset.wait(int(seconds * 1e9))

    def take(self) -> list[tuple[Heard, str, Any, int]]:
        """What has come, as it was sent: of which kind, on which topic (ROS 2's name), the message, and a number for
        who sent it.
        """
        found, self._held, begin = self._held, [], time.time_ns()
        for reader in self._readers.values():
            try:
                samples = reader.reader.take(_DEPTH)
            except Exception:  # as in dds_types, but for what is no message
                self.refused["messages that cannot be taken"] += 1
                continue
            for sample in samples:
                if isinstance(sample, Refused):
                    self.refused[sample.reason] += 1
                elif sample.sample_info.valid_data:
                    sent = sample.sample_info.source_timestamp
                    # What came since waits, so that no topic runs ahead of those that were looked at before it.
                    (found if sent < begin else self._held).append((sent, reader.heard, reader.topic, sample))
        found.sort(key=itemgetter(0))
        return [(heard, topic, sample, sample.sample_info.publication_handle) for _, heard, topic, sample in found]

    def discover(self) -> None:
        """Listen to the topics of ranges, odometry and transforms that have got a writer."""
        before, new = self.ranges, False
        try:
            endpoints = self._discovery.take(_DEPTH)
        except Exception:  # the description of an endpoint comes from strangers too
            self.refused["descriptions of writers that cannot be taken"] += 1
            return
        for endpoint in endpoints:
            if endpoint.type_name in _FOUND_BY_TYPE and endpoint.topic_name:
                self._follow(endpoint.topic_name, *_FOUND_BY_TYPE[endpoint.type_name], endpoint.type_id is not None)
            elif endpoint.type_name == _TF and endpoint.topic_name:
                new |= self._find_tf(endpoint.topic_name, endpoint.qos)
        if not new and before == self.ranges:  # while topics turn up it is not known whose transforms are wanted
            try:
                for topic in self._tf.wanted(self.ranges):
                    self._listen_to_tf(topic)
            except DDSException:
                self.refused["topics that cannot be listened to"] += 1

    def _find_tf(self, name: str, qos: Qos) -> bool:
        """Take note of a topic of transforms; whether it is new."""
        topic = name.removeprefix("rt")
        with suppress(UsageError):
            return name == dds_topic(topic) and self._tf.add(topic, Policy.Durability.Volatile in qos)
        return False

    def lack(self) -> list[str]:
        """Why transforms may be missing, where they are: what is to be said of it."""
        return self._tf.lack(self.ranges)

    def _follow(self, name: str, heard: Heard, kind: Any, most: int, typed: bool) -> None:
        topic = name.removeprefix("rt")
        if name == topic or not self._choice.takes(topic):
            return
        if len(self._topics(heard)) >= most and topic not in self._topics(heard):
            self.refused[f"topics of {heard.value} beyond the first {most}"] += 1
            return
        try:
            dds_topic(topic)
            self._listen(name, kind, SENSOR_QOS, heard)
            if typed and heard is Heard.RANGE:
                self._listen(name, RangeWithVariance, SENSOR_QOS, heard)
        except (UsageError, DDSException):
            self.refused["topics that cannot be listened to"] += 1

    def send(self, what: Picture | Correction | RobotPose | Goal | Velocity) -> None:
        """Send a map, a local map, a transform, where the robot is, where it is to go, or how fast to drive."""
        with suppress(DDSException):  # a reader that takes nothing costs the others no more than this message
            if isinstance(what, Correction):
                self._transforms().write(tf_message(what))
            elif isinstance(what, RobotPose):
                if self._poses is not None:
                    self._poses.write(pose_message(what))
            elif isinstance(what, Goal):
                if self._goals is not None:
                    self._goals.write(goal_message(what))
            elif isinstance(what, Velocity):
                if self._commands is not None:
                    self._commands.write(twist_message(what))
            else:
                (self._local if what.local else self._map).write(occupancy_grid(what))

    def _transforms(self) -> DataWriter:
        """Where transforms are sent: where those of the robot come from."""
        if self._sent_tf is None:
            names = [name for name in self._tf.wanted(self.ranges) if name.endswith("/tf")]
            topic = Topic(self._participant, dds_topic(names[0] if names else "/tf"), TFMessage)
            self._sent_tf = DataWriter(self._participant, topic, STREAM_QOS)
        return self._sent_tf
