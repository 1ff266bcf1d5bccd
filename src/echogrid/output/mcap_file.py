"""A drive and its map as a recording of ROS 2: one MCAP file that Foxglove, RViz, ros2 bag and rosbags read."""

import os
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from math import floor, hypot
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from echogrid.errors import UsageError
from echogrid.files import place_of, unwritable
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import Grid
from echogrid.output.follower import Pace
from echogrid.output.map_server_file import occupancy
from echogrid.robot import Robot
from echogrid.temporary import beside

MAP_FRAME, ROBOT_FRAME = "map", "base_link"
"""Names of frames, by ROS's REP 105."""

FIRING_S = 0.005
"""From one sonar to the next before the first frame, where sonars fired one after another."""

MAX_STAMP_S = 2**31 - 1
"""ROS counts the seconds of a stamp in 32 bits with a sign; MCAP holds none below 0."""

_NEVER = QosTime(9_223_372_036, 854_775_807)
"""As rosbag2 writes an endless duration."""


class _Stamp(NamedTuple):
    """A time as ROS holds it."""

    sec: int
    nanosec: int

    def ns(self) -> int:
        """Nanoseconds since 0."""
        return self.sec * 1_000_000_000 + self.nanosec

    def header(self, frame_id: str) -> ros.std_msgs__msg__Header:
        """The head of a message of that time."""
        return ros.std_msgs__msg__Header(ros.builtin_interfaces__msg__Time(self.sec, self.nanosec), frame_id)


def _ros_time(stamp: float, where: Path) -> _Stamp:
    """A stamp (s) as ROS holds it.

    Raises:
        UsageError: it cannot; the message begins with ``where``.
    """
    if not 0 <= stamp < MAX_STAMP_S:
        raise UsageError(f"{where}: found a scan at {stamp:.17g} s, expected 0 to {MAX_STAMP_S} s, as ROS counts")
    ns = round((stamp - floor(stamp)) * 1e9)
    return _Stamp(floor(stamp) + ns // 1_000_000_000, ns % 1_000_000_000)


def _stored(ranges: Float[ndarray, "sonars"], robot: Robot) -> Float[ndarray, "sonars"]:
    """Ranges (m) as the message holds them: float32, those below the robot's limit still below it."""
    limit = robot.max_range_m if robot.own_max_ranges_m is None else robot.own_max_ranges_m
    longest = np.nextafter(np.float32(limit), np.float32(0))
    return np.where(ranges == np.inf, np.float32(np.inf), np.minimum(ranges.astype(np.float32), longest))


def firings(
    frame: Frame, mounts: Float[ndarray, "sonars 3"], before: float
) -> list[tuple[float, Float[ndarray, "3"], list[int]]]:
    """Where the robot was when its sonars fired: time (s), pose (m, m, rad), numbers of the sonars; in order of time.

    The last is the pose and stamp of the frame. A frame that says where its sonars were does not say when; the
    places before the last are spread evenly over the time since ``before``, the farthest first.

    Args:
        frame: readings that are nan are of sonars that did not fire.
        mounts: the robot's own, m, m, rad.
        before: stamp of the frame before, s.
    """
    fired = np.flatnonzero(~np.isnan(frame.ranges))
    if frame.mounts is None:
        return [(frame.stamp, frame.pose, fired.tolist())]
    moves = compose(frame.mounts, inverse(mounts))
    groups: dict[tuple[float, ...], list[int]] = {(0.0, 0.0, 0.0): []}
    for i in fired.tolist():
        groups.setdefault(tuple((np.round(moves[i], 5) + 0.0).tolist()), []).append(i)
    order = sorted(groups, key=lambda move: -hypot(*move))
    stamps = np.linspace(min(before, frame.stamp), frame.stamp, len(order) + 1)[1:].tolist()
    poses = [compose(frame.pose, moves[groups[move][0]]) if any(move) else frame.pose for move in order]
    return [(stamp, pose, groups[move]) for stamp, pose, move in zip(stamps, poses, order, strict=True)]


class Recorder:
    """Writes a recording while the drive is mapped; a context manager.

    The file takes its place when the block ends well; when it raises, nothing is left. Each frame is written as it
    comes, so that memory does not grow with the drive. Topics:

    - /tf: the robot's pose, map to base_link, for each frame;
    - /tf_static: base_link to sonar_0, sonar_1, ..., in the plane;
    - /sonar_0, /sonar_1, ...: sensor_msgs/Range under REP 117: +inf is no echo; what was not fired is not written;
    - /map: nav_msgs/OccupancyGrid as of ``occupancy``, at the times that Pace picks.

    The types are those of ROS 2 Jazzy, whose Range has a field more (at the end) than that of Humble. All messages
    of a frame bear its stamp, unless it says that its sonars fired from other places: see ``firings``. Dead reckoning
    beside the pose is left out.
    """

    def __init__(self, path: str | Path, robot: Robot):
        """Nothing is written before the block begins.

        Args:
            path: the file (.mcap); one that is there is replaced.
            robot: the robot that drives; its mounts are in the order of the readings.
        """
        self.path, self.robot = Path(path), robot
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._stamp, self._now = _Stamp(0, 0), 0.0
        self._pace = Pace()
        self._begun = False

    def __enter__(self) -> "Recorder":
        with ExitStack() as stack, self._writing():
            folder = stack.enter_context(beside(place_of(self.path), folder=True))
            # Version 8 is the last whose quality of service both Humble and later releases read.
            self._writer = Writer(folder / "bag", version=8, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
            self._map = self._topic("/map", ros.nav_msgs__msg__OccupancyGrid.__msgtype__, latched=True)
            self._static = self._topic("/tf_static", ros.tf2_msgs__msg__TFMessage.__msgtype__, latched=True)
            self._tf = self._topic("/tf", ros.tf2_msgs__msg__TFMessage.__msgtype__)
            self._ranges = [
                self._topic(f"/sonar_{i}", ros.sensor_msgs__msg__Range.__msgtype__) for i in range(self.robot.sonars)
            ]
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack, self._writing():
            self._writer.__exit__(kind, error, trace)
            if kind is None:
                (written,) = self._writer.path.glob("*.mcap")
                os.replace(written, place_of(self.path))

    def add(self, frame: Frame) -> None:
        """Write a frame: where the robot and its sonars are, and what they read.

        Raises:
            UsageError: the stamp is none that ROS can hold, or the file cannot be written.
        """
        self._stamp = _ros_time(frame.stamp, self.path)
        with self._writing():
            if not self._begun:
                self._begun = True
                self._pace.due(frame.stamp, 0)
                mounts = [self._placed(ROBOT_FRAME, f"sonar_{i}", mount) for i, mount in enumerate(self.robot.mounts)]
                self._send(self._static, ros.tf2_msgs__msg__TFMessage(mounts))
                self._now = frame.stamp - FIRING_S * self.robot.sonars
            stored = _stored(frame.ranges, self.robot).tolist()
            for stamp, pose, sonars in firings(frame, self.robot.mounts, max(self._now, 0.0)):
                self._stamp = _ros_time(stamp, self.path)
                self._send(self._tf, ros.tf2_msgs__msg__TFMessage([self._placed(MAP_FRAME, ROBOT_FRAME, pose)]))
                for i in sonars:
                    self._send(self._ranges[i], self._range(i, stored[i]))
        self._now = frame.stamp

    def keep(self, grid: Grid) -> None:
        """Write the map so far if it is time for one; to be called as often as there is a new one."""
        if self._pace.due(self._now, grid.log_odds.size):
            self.finish(grid)

    def finish(self, grid: Grid) -> None:
        """Write the map as it is at the last frame, in any case."""
        rows, cols = grid.shape
        x, y = grid.origin
        header = self._stamp.header(MAP_FRAME)
        corner = ros.geometry_msgs__msg__Pose(
            ros.geometry_msgs__msg__Point(x, y, 0.0), ros.geometry_msgs__msg__Quaternion(0.0, 0.0, 0.0, 1.0)
        )
        info = ros.nav_msgs__msg__MapMetaData(header.stamp, grid.resolution, cols, rows, corner)
        with self._writing():
            self._send(self._map, ros.nav_msgs__msg__OccupancyGrid(header, info, occupancy(grid).ravel()))

    def _topic(self, name: str, msgtype: str, latched: bool = False) -> Connection:
        durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
        depth = 1 if latched else 100
        qos = Qos(
            *(QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability, _NEVER, _NEVER),
            *(QosLiveliness.AUTOMATIC, _NEVER, False),
        )
        return self._writer.add_connection(name, msgtype, typestore=self._types, offered_qos_profiles=[qos])

    def _send(self, topic: Connection, message: object) -> None:
        self._writer.write(topic, self._stamp.ns(), self._types.serialize_cdr(message, topic.msgtype))

    def _range(self, sonar: int, metres: float) -> ros.sensor_msgs__msg__Range:
        robot = self.robot
        return ros.sensor_msgs__msg__Range(
            self._stamp.header(f"sonar_{sonar}"),
            ros.sensor_msgs__msg__Range.ULTRASOUND,
            field_of_view=robot.beam_width_rad,
            min_range=robot.min_range_m,
            max_range=float(robot.max_ranges_m[sonar]),
            range=metres,
            variance=0.0,
        )

    def _placed(self, parent: str, child: str, pose: Float[ndarray, "3"]) -> ros.geometry_msgs__msg__TransformStamped:
        x, y, theta = (float(v) for v in pose)
        turn = ros.geometry_msgs__msg__Quaternion(0.0, 0.0, float(np.sin(theta / 2)), float(np.cos(theta / 2)))
        return ros.geometry_msgs__msg__TransformStamped(
            self._stamp.header(parent),
            child,
            ros.geometry_msgs__msg__Transform(ros.geometry_msgs__msg__Vector3(x, y, 0.0), turn),
        )

    @contextmanager
    def _writing(self) -> Generator[None]:
        """What the system refuses is one line that names the file."""
        try:
            yield
        except OSError as error:
            raise unwritable(self.path, error.strerror or str(error)) from error
