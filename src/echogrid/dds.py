"""The messages and topics of ROS 2 over DDS (Cyclone DDS), with no ROS installed.

What DDS exposes. A participant of DDS opens UDP ports: 7400 + 250 * domain for multicast discovery, one beside it, and
one of the system's choice, on which data arrive. Nothing of what comes in is authenticated and nothing that goes out
is encrypted: whoever can send to these ports can publish ranges, transforms and odometry, which go into the map, and
whoever listens can read the map. So ``Network`` keeps to loopback unless another interface is named. Cyclone DDS binds
its sockets to the address 0.0.0.0 whatever interface its configuration names; on Linux ``Network`` therefore ties them
to loopback itself (SO_BINDTODEVICE), or, where an interface is named, lets the kernel drop what comes in through any
other (SO_ATTACH_FILTER; programs on the same machine still get through). Elsewhere than on Linux a firewall has to do
this, and ``Network.kept`` is False.

What comes in is bounded in size here (MAX_MESSAGE_BYTES) and judged in ``echogrid.live``. Cyclone DDS itself reads the
packets; a flood of them costs time and memory that nothing here can bound.

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
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float32, float64, int8, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from echogrid.errors import UsageError
from echogrid.live import Heard, Picture

MAX_MESSAGE_BYTES = 256 * 1024
"""A longer message is refused: room for about 2,000 transforms."""

MAX_TOPICS = 512
"""Topics of ranges that are listened to at most."""

_MAX_SAMPLE_BYTES = 64 * 1024 * 1024
"""What Cyclone DDS takes or sends at most, a map among it."""

_DEPTH = 4_000
"""Messages of a topic that wait here at most, while the network of the map is being compiled for instance."""

_ANSWERS = 64
"""Messages that are taken at a time."""


class Refused:
    """Stands for a message that was not even decoded."""

    sample_info: Any = None

    def __init__(self, reason: str):
        self.reason = reason


class _Bounded:
    """Comes before IdlStruct: decoding refuses in place of raising, so that one bad message takes no other with it."""

    @classmethod
    def deserialize(cls, data: bytes, *args: Any, **kwargs: Any) -> Any:
        if len(data) > MAX_MESSAGE_BYTES:
            return Refused("a message that is too long")
        try:
            return super().deserialize(data, *args, **kwargs)  # ty: ignore[unresolved-attribute]
        except Exception:  # strangers decide what is in it, and the decoder raises whatever its steps raise
            return Refused("a message that cannot be decoded")


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """builtin_interfaces/Time."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """std_msgs/Header."""

    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    """geometry_msgs/Vector3."""

    x: float64
    y: float64
    z: float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    """geometry_msgs/Point."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    """geometry_msgs/Quaternion."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    """geometry_msgs/Transform."""

    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    """geometry_msgs/TransformStamped."""

    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(_Bounded, IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    """tf2_msgs/TFMessage."""

    transforms: sequence[TransformStamped]


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    """geometry_msgs/Pose."""

    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    """geometry_msgs/PoseWithCovariance."""

    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    """geometry_msgs/Twist."""

    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    """geometry_msgs/TwistWithCovariance."""

    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(_Bounded, IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    """nav_msgs/Odometry."""

    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class Range(_Bounded, IdlStruct, typename="sensor_msgs.msg.dds_.Range_"):
    """sensor_msgs/Range as it was up to ROS 2 Humble.

    It reads the longer message of later releases as well, where the writer does not say what its type looks like,
    and ROS 2's do not.
    """

    header: Header
    radiation_type: uint8
    field_of_view: float32
    min_range: float32
    max_range: float32
    range: float32


@dataclass
class RangeWithVariance(_Bounded, IdlStruct, typename="sensor_msgs.msg.dds_.Range_"):
    """sensor_msgs/Range from ROS 2 Iron on."""

    header: Header
    radiation_type: uint8
    field_of_view: float32
    min_range: float32
    max_range: float32
    range: float32
    variance: float32


@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs.msg.dds_.MapMetaData_"):
    """nav_msgs/MapMetaData."""

    map_load_time: Time
    resolution: float32
    width: uint32
    height: uint32
    origin: Pose


@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs.msg.dds_.OccupancyGrid_"):
    """nav_msgs/OccupancyGrid."""

    header: Header
    info: MapMetaData
    data: sequence[int8]

    def serialize(self, *args: Any, **kwargs: Any) -> bytes:
        """As of any message, but for the cells, which would take a call each."""
        cells = np.asarray(self.data, dtype=np.int8)
        bare = IdlStruct.serialize(replace(self, data=[]), *args, **kwargs)
        return bare[:-4] + struct.pack("=I", cells.size) + cells.tobytes()


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

RANGE_TYPE = "sensor_msgs::msg::dds_::Range_"


def dds_topic(name: str) -> str:
    """The name on DDS of a topic of ROS 2.

    Raises:
        UsageError: no such name is allowed.
    """
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name) or len(name) > 200:
        raise UsageError(f"live: found the topic {name!r}, expected a name such as /sonar/front")
    return f"rt{name}"


def configuration(interface: str) -> str:
    """The configuration of Cyclone DDS (XML) that keeps to an interface; ``any``: all that can multicast.

    Raises:
        UsageError: no such interface.
    """
    if interface == "any":
        chosen = '<NetworkInterface autodetermine="true"/>'
    else:
        names = [name for _, name in socket.if_nameindex()]
        if interface not in names:
            raise UsageError(f"live: found no interface {interface!r}, expected any or one of {', '.join(names)}")
        # Loopback can multicast, though its flags do not say so.
        multicast = ' multicast="true"' if interface == "lo" else ""
        chosen = f'<NetworkInterface name="{interface}"{multicast}/>'
    return (
        f"<CycloneDDS><Domain Id=\"any\"><General><Interfaces>{chosen}</Interfaces></General>"
        f"<Internal><MaxSampleSize>{_MAX_SAMPLE_BYTES}B</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


@dataclass(frozen=True)
class Topics:
    """Names of topics in ROS 2."""

    ranges: tuple[str, ...] = ()
    """sensor_msgs/Range; none: all that there are."""
    odometry: tuple[str, ...] = ("/odom",)
    """nav_msgs/Odometry."""
    map: str = "/map"
    """Where the map goes."""
    local_map: str = "/local_map"
    """Where the local map goes."""


class Network:
    """The ROS 2 topics of one domain: those that are heard and those that are sent."""

    def __init__(self, domain: int, interface: str | None, topics: Topics):
        """Join a domain.

        Args:
            domain: its number.
            interface: name of a network interface, or ``any``; None: what the configuration in CYCLONEDDS_URI says.
            topics: what to hear and to send.

        Raises:
            UsageError: there is no such interface or topic, or DDS cannot be started.
        """
        self.refused: Counter[str] = Counter()
        """Messages and topics that were not taken, by reason."""
        self.kept = False
        """Whether the kernel lets nothing in but through the interface that was named."""
        ranges = [dds_topic(name) for name in topics.ranges]
        odometry = [dds_topic(name) for name in topics.odometry]
        map_topic, local_topic = dds_topic(topics.map), dds_topic(topics.local_map)
        before = _sockets()
        try:
            # None leaves it to Cyclone DDS, which looks at CYCLONEDDS_URI.
            self._domain = Domain(domain, None if interface is None else configuration(interface))
            if interface is not None and interface != "any":
                self.kept = _keep_to(interface, _sockets() - before)
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise UsageError(
                f"live: found DDS that cannot start ({error}), expected a domain of 0 to 232 and an interface that is up"
            ) from None
        self._waitset = WaitSet(self._participant)
        self._readers: dict[tuple[str, type], tuple[DataReader, ReadCondition, Heard, str]] = {}
        self._found_by_type = not ranges
        self._discovery = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._waitset.attach(self._discovery)
        self._listen("rt/tf_static", TFMessage, STATIC_QOS, Heard.STATIC)
        self._listen("rt/tf", TFMessage, SENSOR_QOS, Heard.TF)
        for name in odometry:
            self._listen(name, Odometry, SENSOR_QOS, Heard.ODOMETRY)
        self._named = set(ranges)
        for name in ranges:
            self._listen(name, Range, SENSOR_QOS, Heard.RANGE)
        self._map = DataWriter(self._participant, Topic(self._participant, map_topic, OccupancyGrid), MAP_QOS)
        self._local = DataWriter(
            self._participant, Topic(self._participant, local_topic, OccupancyGrid), LOCAL_MAP_QOS
        )

    def _listen(self, name: str, kind: type[IdlStruct], qos: Qos, heard: Heard) -> None:
        if (name, kind) in self._readers:
            return
        reader = DataReader(self._participant, Topic(self._participant, name, kind), qos)
        condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
        self._waitset.attach(condition)
        self._readers[name, kind] = reader, condition, heard, name.removeprefix("rt")

    @property
    def range_topics(self) -> list[str]:
        """The topics of ranges that are listened to, in ROS 2's names."""
        return sorted({name for _, _, heard, name in self._readers.values() if heard is Heard.RANGE})

    def wait(self, seconds: float) -> None:
        """Return when something has come, or after some time."""
        self._waitset.wait(int(seconds * 1e9))

    def take(self) -> Iterator[tuple[Heard, str, Any]]:
        """What has come: of which kind, on which topic (ROS 2's name), and the message."""
        self._discover()
        # Transforms first: a range that comes with them finds its pose.
        for reader, _, heard, name in list(self._readers.values()):
            while True:
                try:
                    samples = reader.take(_ANSWERS)
                except Exception:  # as in _Bounded, but for what is no message
                    self.refused["messages that cannot be taken"] += 1
                    break
                for sample in samples:
                    if isinstance(sample, Refused):
                        self.refused[sample.reason] += 1
                    elif sample.sample_info.valid_data:
                        yield heard, name, sample
                if len(samples) < _ANSWERS:
                    break

    def _discover(self) -> None:
        try:
            endpoints = self._discovery.take(_ANSWERS)
        except Exception:  # the description of an endpoint comes from strangers too
            self.refused["descriptions of writers that cannot be taken"] += 1
            return
        for endpoint in endpoints:
            name = endpoint.topic_name or ""
            if endpoint.type_name != RANGE_TYPE or not (self._found_by_type or name in self._named):
                continue
            if len(self._readers) >= MAX_TOPICS:
                self.refused["topics of ranges beyond the first"] += 1
                continue
            try:
                dds_topic(name.removeprefix("rt"))
                self._listen(name, Range, SENSOR_QOS, Heard.RANGE)
                if endpoint.type_id is not None:
                    self._listen(name, RangeWithVariance, SENSOR_QOS, Heard.RANGE)
            except (UsageError, DDSException):
                self.refused["topics of ranges whose name cannot be"] += 1

    def send(self, picture: Picture) -> None:
        """Send a map, or a local map."""
        sec, nanosec = divmod(round(picture.stamp * 1e9), 10**9)
        rows, cols = picture.cells.shape
        stamp = Time(sec, nanosec)
        origin = Pose(Point(*picture.origin, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        info = MapMetaData(stamp, picture.resolution, cols, rows, origin)
        message = OccupancyGrid(Header(stamp, picture.frame), info, picture.cells.ravel())
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
        with socket.socket(fileno=os.dup(descriptor)) as each:
            if each.family not in (socket.AF_INET, socket.AF_INET6):
                continue
            if interface == "lo":
                each.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
            else:
                _only_from(each, [socket.if_nametoindex(name) for name in ("lo", interface)])
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
