"""The messages and topics of ROS 2 over DDS (Cyclone DDS), with no ROS installed.

What DDS exposes. A participant of DDS opens UDP ports: 7400 + 250 * domain for multicast discovery, the next but one
or so for unicast discovery and data. Nothing of what comes in is authenticated and nothing that goes out is
encrypted: whoever can send to these ports can publish ranges, transforms and odometry, which go into the map, and
whoever listens can read the map. So ``Network`` keeps to loopback unless another interface is named.

Cyclone DDS binds its sockets to the address 0.0.0.0 whatever interface its configuration names. On Linux ``Network``
therefore ties them to loopback itself (SO_BINDTODEVICE), or, where another interface is named, lets the kernel drop
what comes in through any but that and loopback (SO_ATTACH_FILTER), for the robot's own programs talk through both.
Elsewhere than on Linux a firewall has to do this, and ``Network.kept`` is False.

What comes in is bounded in size here (MAX_MESSAGE_BYTES) and judged in ``echogrid.live``. Cyclone DDS itself reads
the packets; a flood of them costs time and memory that nothing here can bound.

The names and types are those by which ROS 2 puts its messages on DDS: topic ``/map`` is ``rt/map``, type
``nav_msgs/msg/OccupancyGrid`` is ``nav_msgs::msg::dds_::OccupancyGrid_``, all structs are final.
"""

import ctypes
import os
import re
import socket
import stat
import struct
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint8, uint32
from cyclonedds.internal import DDS
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from echogrid.errors import UsageError
from echogrid.live.live_map import Heard, Picture
from echogrid.robot import MAX_SONARS
from echogrid.ros.messages import Choice

MAX_MESSAGE_BYTES = 256 * 1024
"""A longer message is refused: room for about 2,000 transforms."""

_MAX_SAMPLE_BYTES = 64 * 1024 * 1024
"""What Cyclone DDS takes or sends at most, a map among it."""

_LOG_FATAL, _MULTICAST = 1, ' multicast="true"'

_DEPTH = 4_000
"""Messages of a topic that wait here at most, while the network of the map is being compiled for instance."""


class Refused:
    """Stands for a message that was not even decoded."""

    sample_info: Any = None

    def __init__(self, reason: str):
        self.reason = reason


def _message(name: str, **fields: Any) -> Any:
    """A message of ROS as a final struct of DDS; made by a call, for tools that read hints choke on such classes."""
    package, kind = name.split("/")
    return make_idl_struct(kind, f"{package}.msg.dds_.{kind}_", fields)


def _bounded(kind: Any) -> Any:
    """Have a type's decoding refuse, not raise, so that one bad message takes no other with it."""
    decode = kind.deserialize

    def deserialize(data: bytes, *args: Any, **kwargs: Any) -> Any:
        if len(data) > MAX_MESSAGE_BYTES:
            return Refused("a message that is too long")
        try:
            return decode(data, *args, **kwargs)
        except Exception:  # strangers decide what is in it, and the decoder raises whatever its steps raise
            return Refused("a message that cannot be decoded")

    kind.deserialize = staticmethod(deserialize)
    return kind


Time = _message("builtin_interfaces/Time", sec=int32, nanosec=uint32)
Header = _message("std_msgs/Header", stamp=Time, frame_id=str)
Vector3 = _message("geometry_msgs/Vector3", x=float64, y=float64, z=float64)
Point = _message("geometry_msgs/Point", x=float64, y=float64, z=float64)
Quaternion = _message("geometry_msgs/Quaternion", x=float64, y=float64, z=float64, w=float64)
Transform = _message("geometry_msgs/Transform", translation=Vector3, rotation=Quaternion)
TransformStamped = _message("geometry_msgs/TransformStamped", header=Header, child_frame_id=str, transform=Transform)
TFMessage = _bounded(_message("tf2_msgs/TFMessage", transforms=sequence[TransformStamped]))
Pose = _message("geometry_msgs/Pose", position=Point, orientation=Quaternion)
PoseWithCovariance = _message("geometry_msgs/PoseWithCovariance", pose=Pose, covariance=array[float64, 36])
Twist = _message("geometry_msgs/Twist", linear=Vector3, angular=Vector3)
TwistWithCovariance = _message("geometry_msgs/TwistWithCovariance", twist=Twist, covariance=array[float64, 36])
Odometry = _bounded(
    _message(
        "nav_msgs/Odometry", header=Header, child_frame_id=str, pose=PoseWithCovariance, twist=TwistWithCovariance
    )
)

_RANGE = {
    "header": Header,
    "radiation_type": uint8,
    **dict.fromkeys(("field_of_view", "min_range", "max_range", "range"), float32),
}

Range = _bounded(_message("sensor_msgs/Range", **_RANGE))
"""As it was up to ROS 2 Humble. It reads the longer message of later releases as well, where the writer does not say
what its type looks like, and ROS 2's do not."""

RangeWithVariance = _bounded(_message("sensor_msgs/Range", **_RANGE, variance=float32))
"""From ROS 2 Iron on."""

MapMetaData = _message(
    "nav_msgs/MapMetaData", map_load_time=Time, resolution=float32, width=uint32, height=uint32, origin=Pose
)
OccupancyGrid = _message("nav_msgs/OccupancyGrid", header=Header, info=MapMetaData, data=sequence[int8])


def _serialize(self: Any, *args: Any, **kwargs: Any) -> bytes:
    """As of any message, but for the cells, which would take a call each."""
    cells = np.asarray(self.data, dtype=np.int8)
    bare = IdlStruct.serialize(replace(self, data=[]), *args, **kwargs)
    return bare[:-4] + struct.pack("=I", cells.size) + cells.tobytes()


OccupancyGrid.serialize = _serialize

SENSOR_QOS = Qos(
    Policy.Reliability.BestEffort,
    Policy.Durability.Volatile,
    Policy.History.KeepLast(_DEPTH),
)
"""To hear ranges, /tf and odometry: it asks for least, so writers of every kind match."""

STATIC_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(_DEPTH),
)
"""To hear /tf_static, sent once, as ROS 2 sends it."""

MAP_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=100_000_000),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
)
"""To send /map: who comes late gets the last one."""

LOCAL_MAP_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(1),
)
"""To send the local map; readers that ask for less match as well."""

_FOUND_BY_TYPE: dict[str, tuple[Heard, Any, int]] = {
    "sensor_msgs::msg::dds_::Range_": (Heard.RANGE, Range, MAX_SONARS),
    "nav_msgs::msg::dds_::Odometry_": (Heard.ODOMETRY, Odometry, 16),
}
"""Types whose topics are looked for: what they are, how they are read, and how many topics there may be."""


@dataclass(frozen=True)
class _Reader:
    """A topic that is listened to."""

    reader: DataReader
    condition: ReadCondition
    heard: Heard
    topic: str


def dds_topic(name: str) -> str:
    """The name on DDS of a topic of ROS 2.

    Raises:
        UsageError: no such name is allowed.
    """
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name) or len(name) > 200:
        raise UsageError(f"live: found the topic {name!r}, expected a name such as /sonar/front")
    return f"rt{name}"


def configuration(interface: str) -> str:
    """The configuration of Cyclone DDS (XML) that keeps to an interface; ``any``: all that are there.

    Raises:
        UsageError: no such interface.
    """
    names = [name for _, name in socket.if_nameindex()]
    if interface == "any":
        # Whatever is up; its own programs are reached through any of them, and through loopback where it is alone.
        chosen = [name for name in names if name != "lo"] or names
    elif interface in names:
        chosen = [interface]
    else:
        raise UsageError(f"live: found no interface {interface!r}, expected any or one of {', '.join(names)}")
    required = "false" if interface == "any" else "true"
    listed = "".join(
        # Loopback can multicast, though its flags do not say so.
        f'<NetworkInterface name="{name}" presence_required="{required}"{_MULTICAST if name == "lo" else ""}/>'
        for name in chosen
    )
    return (
        f'<CycloneDDS><Domain Id="any"><General><Interfaces>{listed}</Interfaces></General>'
        f"<Internal><MaxSampleSize>{_MAX_SAMPLE_BYTES}B</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


class Network:
    """The ROS 2 topics of one domain: those that are heard and those that are sent."""

    def __init__(self, domain: int, interface: str | None, choice: Choice, map_topic: str, local_topic: str):
        """Join a domain.

        Args:
            domain: its number.
            interface: name of a network interface, or ``any``; None: what the configuration in CYCLONEDDS_URI says.
            choice: the topics of ranges and odometry to hear; those of tf are always heard.
            map_topic: where the map goes, as ROS 2 names it.
            local_topic: where the local map goes.

        Raises:
            UsageError: there is no such interface or topic, or DDS cannot be started.
        """
        self.refused: Counter[str] = Counter()
        """Messages and topics that were not taken, by reason."""
        self.kept = False
        """Whether the kernel lets nothing in but through the interface that was named."""
        self._choice = choice
        self._readers: dict[tuple[str, type], _Reader] = {}
        self._held: list[tuple[int, Heard, str, Any]] = []
        sent = [dds_topic(name) for name in (map_topic, local_topic)]
        before = _sockets()
        try:
            # None leaves it to Cyclone DDS, which looks at CYCLONEDDS_URI.
            self._domain = Domain(domain, None if interface is None else configuration(interface))
            if interface is not None and interface != "any":
                self.kept = _keep_to(interface, _sockets() - before)
            self._participant = DomainParticipant(domain)
            if interface is not None:
                # Each message of a stranger that Cyclone DDS cannot read would be a line on stderr.
                DDS._dll_handle.dds_set_log_mask(_LOG_FATAL)
        except DDSException as error:
            found = f"DDS that does not start ({error})"
            raise UsageError(
                f"live: found {found}, expected a domain of 0 to 232 and an interface that is up"
            ) from None
        self._waitset = WaitSet(self._participant)
        self._discovery = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        # Transforms first: a range that comes with them finds its pose.
        self._listen("rt/tf_static", TFMessage, STATIC_QOS, Heard.STATIC)
        self._listen("rt/tf", TFMessage, SENSOR_QOS, Heard.TF)
        self._map, self._local = (
            DataWriter(self._participant, Topic(self._participant, name, OccupancyGrid), qos)
            for name, qos in zip(sent, (MAP_QOS, LOCAL_MAP_QOS), strict=True)
        )

    def _listen(self, name: str, kind: Any, qos: Qos, heard: Heard) -> None:
        if (name, kind) not in self._readers:
            reader = DataReader(self._participant, Topic(self._participant, name, kind), qos)
            condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
            self._waitset.attach(condition)
            self._readers[name, kind] = _Reader(reader, condition, heard, name.removeprefix("rt"))

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

    def take(self) -> list[tuple[Heard, str, Any]]:
        """What has come, as it was sent: of which kind, on which topic (ROS 2's name), and the message."""
        found, self._held, begin = self._held, [], time.time_ns()
        for reader in self._readers.values():
            try:
                samples = reader.reader.take(_DEPTH)
            except Exception:  # as in _bounded, but for what is no message
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
        return [(heard, topic, sample) for _, heard, topic, sample in found]

    def discover(self) -> None:
        """Listen to the topics of ranges and odometry that have got a writer."""
        try:
            endpoints = self._discovery.take(_DEPTH)
        except Exception:  # the description of an endpoint comes from strangers too
            self.refused["descriptions of writers that cannot be taken"] += 1
            return
        for endpoint in endpoints:
            if endpoint.type_name in _FOUND_BY_TYPE and endpoint.topic_name:
                self._follow(endpoint.topic_name, *_FOUND_BY_TYPE[endpoint.type_name], endpoint.type_id is not None)

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

    def send(self, picture: Picture) -> None:
        """Send a map, or a local map."""
        sec, nanosec = divmod(round(picture.stamp * 1e9), 10**9)
        rows, cols = picture.cells.shape
        stamp = Time(sec, nanosec)
        origin = Pose(Point(*picture.origin, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        info = MapMetaData(stamp, picture.resolution, cols, rows, origin)
        message = OccupancyGrid(Header(stamp, picture.frame), info, picture.cells.ravel())
        with suppress(DDSException):  # a reader that takes nothing costs the others no more than this map
            (self._local if picture.local else self._map).write(message)


def _sockets() -> set[int]:
    """Descriptors of this process's UDP sockets; empty elsewhere than on Linux."""
    found = set()
    with suppress(FileNotFoundError):
        for name in os.listdir("/proc/self/fd"):
            with suppress(OSError):
                if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                    found.add(int(name))
    return found


def _keep_to(interface: str, descriptors: set[int]) -> bool:
    """Let nothing into sockets but through an interface; whether that could be done for all."""
    if sys.platform != "linux" or not descriptors:
        return False
    for descriptor in descriptors:
        try:
            with socket.socket(fileno=os.dup(descriptor)) as each:
                if each.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                if interface == "lo":
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
                else:
                    _only_from(each, [socket.if_nametoindex(name) for name in ("lo", interface)])
        except OSError:  # a kernel before 5.7 lets only root do so
            return False
    return True


def _only_from(each: socket.socket, indices: list[int]) -> None:
    """Attach a classic BPF program that drops what came in through any other interface."""
    load, equal, answer, index = 0x20, 0x15, 0x06, 0xFFFFF000 + 8  # SKF_AD_OFF + SKF_AD_IFINDEX
    tests = [struct.pack("HBBI", equal, len(indices) - i, 0, number) for i, number in enumerate(indices)]
    program = b"".join(
        [struct.pack("HBBI", load, 0, 0, index), *tests]
        + [struct.pack("HBBI", answer, 0, 0, length) for length in (0, 0xFFFFFFFF)]
    )
    memory = ctypes.create_string_buffer(program, len(program))
    fprog = struct.pack("HL", len(program) // 8, ctypes.addressof(memory))
    each.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, fprog)


_SO_ATTACH_FILTER = 26
"""Not among the constants of Python's socket module."""
