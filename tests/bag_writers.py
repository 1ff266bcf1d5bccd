"""Bags for tests: messages as plain mappings, what robots say in them, and writers of each format.

A message is a mapping of its fields by name, as far as they are not zero; stamps are seconds. The same messages go to
rosbags (ROS 1, sqlite3, MCAP), to mcap-ros2-support and, as JSON, to Debian's rosbag.
"""

import json
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap_ros2.writer import Writer as McapWriter
from numpy import ndarray
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from echogrid.frame import Frame
from echogrid.logs.formats import load_log
from echogrid.robot import Robot
from echogrid.ros.messages import CLOUD, CLOUD2, ODOMETRY, RANGE, SONAR_ARRAY, TF

START_S = 1_600_000_000.0
"""When the drives begin."""

FORMATS = ("bag", "mcap", "sqlite3")

PEER = Path(__file__).parent / "peers" / "rosbag1" / "write.py"
"""Writes bags with Debian's rosbag; run by Debian's Python."""

B21 = Robot.load("b21")


class Said(NamedTuple):
    """A message and when it was recorded."""

    topic: str
    time: float
    """s"""
    type: str
    content: Mapping[str, Any]


def sample(frames: int = 521) -> list[Frame]:
    """The first frames of the shipped drive."""
    log = load_log(str(resources.files("echogrid") / "data" / "sample.csv"), B21)
    return [frame for frame, _ in zip(log, range(frames), strict=False)]


def header(time: float, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": int(time), "nanosec": round(time % 1 * 1e9)}, "frame_id": frame}


def turned(yaw: float, pitch: float = 0.0) -> dict[str, float]:
    """Quaternion of a turn to the left after a nose that is lowered (rad)."""
    cy, sy, cp, sp = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    return {"x": -float(sy * sp), "y": float(cy * sp), "z": float(sy * cp), "w": float(cy * cp)}


def transform(
    parent: str, child: str, pose: Sequence[float] | ndarray, time: float, z: float = 0.0, pitch: float = 0.0
) -> dict[str, Any]:
    x, y, yaw = map(float, pose)
    where = {"translation": {"x": x, "y": y, "z": z}, "rotation": turned(yaw, pitch)}
    return {"header": header(time, parent), "child_frame_id": child, "transform": where}


def tf(time: float, *transforms: dict[str, Any], topic: str = "/tf") -> Said:
    return Said(topic, time, TF, {"transforms": list(transforms)})


def odometry(
    time: float, pose: Sequence[float] | ndarray, frames: tuple[str, str] = ("odom", "base_link"), topic="/odom"
) -> Said:
    x, y, yaw = map(float, pose)
    at = {"pose": {"position": {"x": x, "y": y}, "orientation": turned(yaw)}}
    return Said(topic, time, ODOMETRY, {"header": header(time, frames[0]), "child_frame_id": frames[1], "pose": at})


def ranging(
    time: float, topic: str, frame: str, value: float, robot: Robot = B21, stamp: float | None = None, **fields: float
) -> Said:
    said = {
        "header": header(time if stamp is None else stamp, frame),
        "field_of_view": robot.beam_width_rad,
        "min_range": robot.min_range_m,
        "max_range": robot.max_range_m,
        "range": float(value),
    }
    return Said(topic, time, RANGE, said | fields)


def mounted(robot: Robot = B21, base: str = "base_link", time: float = START_S, pitch: float = 0.0) -> Said:
    """The places of the sonars as tf_static has them, in frames sonar_0, sonar_1, ..."""
    places = enumerate(robot.mounts)
    mounts = [transform(base, f"sonar_{i}", mount, time, z=0.3, pitch=pitch) for i, mount in places]
    return tf(time, *mounts, topic="/tf_static")


def time_of(frame: Frame) -> float:
    return START_S + frame.stamp


def posed(frames: Iterable[Frame], parent: str = "odom", child: str = "base_link") -> Iterator[Said]:
    for frame in frames:
        yield tf(time_of(frame), transform(parent, child, frame.pose, time_of(frame)))


def ranged(frames: Iterable[Frame], topic: str = "/sonar/{}", robot: Robot = B21) -> Iterator[Said]:
    for frame in frames:
        for i, value in enumerate(frame.ranges):
            if not np.isnan(value):
                yield ranging(time_of(frame), topic.format(i), f"sonar_{i}", value, robot)


def drive(frames: Sequence[Frame], topic: str = "/sonar/{}", robot: Robot = B21) -> list[Said]:
    """A drive as a robot of today says it: tf_static, tf, and a Range for each reading."""
    return in_order([mounted(robot), *posed(frames), *ranged(frames, topic, robot)])


def in_order(messages: Iterable[Said]) -> list[Said]:
    return sorted(messages, key=lambda said: said.time)


def seen_points(frame: Frame, robot: Robot) -> ndarray:
    """Where each sonar takes its echo to be, in the robot's frame; at the end of its range if there is none."""
    ranges = np.where(np.isinf(frame.ranges), robot.max_range_m, frame.ranges)[:, None]
    axes = robot.mounts[:, 2]
    return robot.mounts[:, :2] + ranges * np.column_stack([np.cos(axes), np.sin(axes)])


def cloud(frame: Frame, robot: Robot, topic: str = "/RosAria/sonar", frame_id: str = "sonar_frame") -> Said:
    points = [{"x": float(x), "y": float(y)} for x, y in seen_points(frame, robot)]
    return Said(topic, time_of(frame), CLOUD, {"header": header(time_of(frame), frame_id), "points": points})


def cloud2(
    frame: Frame,
    robot: Robot,
    topic: str = "/RosAria/sonar_pointcloud2",
    frame_id: str = "sonar_frame",
    big: bool = False,
) -> Said:
    points = np.column_stack([seen_points(frame, robot), np.zeros(robot.sonars)])
    content = {
        "header": header(time_of(frame), frame_id),
        "height": 1,
        "width": len(points),
        "fields": [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate("xyz")],
        "is_bigendian": big,
        "point_step": 12,
        "row_step": 12 * len(points),
        "data": points.astype(">f4" if big else "<f4").tobytes(),
        "is_dense": True,
    }
    return Said(topic, time_of(frame), CLOUD2, content)


def sonar_array(frame: Frame, topic: str = "/sonar") -> Said:
    ranges = [float(value) for value in frame.ranges]
    content = {"header": header(time_of(frame), "sonar"), "ranges_count": len(ranges), "ranges": ranges}
    return Said(topic, time_of(frame), SONAR_ARRAY, content)


@cache
def types(ros1: bool) -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
    store.register(get_types_from_msg("std_msgs/Header header\nint32 ranges_count\nfloat64[] ranges", SONAR_ARRAY))
    return store


def built(store: Typestore, kind: str, content: Mapping[str, Any]) -> Any:
    """A message of rosbags."""
    fields = {name: _field(store, node, content.get(name)) for name, node in store.fielddefs[kind][1]}
    assert fields.keys() >= content.keys(), f"{kind} has no {content.keys() - fields.keys()}"
    return store.types[kind](**fields)


def _field(store: Typestore, node: Any, value: Any) -> Any:
    form, inner = node
    if form == Nodetype.NAME:
        return built(store, inner, value or {})
    if form == Nodetype.BASE:
        return value if value is not None else "" if inner[0] == "string" else 0
    (part, what), length = inner
    if what[0] == "string":
        return list(value or ())
    if part == Nodetype.NAME:
        return [built(store, what, each) for each in value or ()]
    if what[0] == "uint8":
        return np.frombuffer(value or bytes(length), np.uint8)
    return np.array(value or [0] * length, what[0])


def raw(said: Said, store: Typestore, ros1: bool, little: bool = True) -> bytes:
    """A message as it is sent."""
    message = built(store, said.type, said.content)
    if ros1:
        return bytes(store.serialize_ros1(message, said.type))
    return bytes(store.serialize_cdr(message, said.type, little_endian=little))


def nanoseconds(time: float) -> int:
    return round(time * 1e9)


def write(
    path: Path, messages: Iterable[Said], form: str, store: Typestore | None = None, little: bool = True
) -> Path:
    """Write a bag with rosbags: a file for ROS 1, a folder for ROS 2.

    Args:
        path: the file or folder; it must not be there yet.
        messages: in the order in which they are written.
        form: one of FORMATS.
        store: the types; None: those of ``types``.
        little: the byte order of CDR.
    """
    ros1 = form == "bag"
    storage = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
    store = store or types(ros1)
    with BagWriter(path) if ros1 else FolderWriter(path, version=9, storage_plugin=storage) as writer:
        connections = {}
        for said in messages:
            if (said.topic, said.type) not in connections:
                connection = writer.add_connection(said.topic, said.type, typestore=store)
                connections[said.topic, said.type] = connection
            writer.write(connections[said.topic, said.type], nanoseconds(said.time), raw(said, store, ros1, little))
    return path


def file_of(path: Path) -> Path:
    """The file with the messages in what ``write`` wrote."""
    return next(each for each in path.iterdir() if each.suffix != ".yaml") if path.is_dir() else path


def write_mcap(path: Path, messages: Iterable[Said]) -> Path:
    """Write an MCAP file with mcap-ros2-support."""
    with path.open("wb") as file:
        writer, schemas = McapWriter(file), {}
        for said in messages:
            if said.type not in schemas:
                text = types(ros1=False).generate_msgdef(said.type, ros_version=2)[0]
                schemas[said.type] = writer.register_msgdef(said.type, text)
            writer.write_message(said.topic, schemas[said.type], said.content, nanoseconds(said.time))
        writer.finish()
    return path


def has_rosbag() -> bool:
    """Whether Debian's rosbag is here, with the types of messages that are needed."""
    try:
        return subprocess.run([_PYTHON, PEER, "--check"], capture_output=True, timeout=60).returncode == 0
    except OSError:
        return False


def write_with_rosbag(messages: Iterable[Said], bags: Mapping[Path, Mapping[str, Any]]) -> None:
    """Write the same messages to several bags with Debian's rosbag.

    Args:
        messages: in the order in which they are written.
        bags: for each file what rosbag.Bag is to be told; ``unindexed``: the file is left as a crash would.
    """
    job = {
        "messages": [(said.topic, nanoseconds(said.time), said.type, said.content) for said in messages],
        "bags": {str(path): dict(options) for path, options in bags.items()},
    }
    done = subprocess.run([_PYTHON, PEER], input=json.dumps(job), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


_PYTHON = "/usr/bin/python3"
