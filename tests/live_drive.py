"""A robot that drives and sends its messages to ``Live``, with no network in between."""

from types import SimpleNamespace
from typing import cast

import numpy as np
from numpy import inf

from echogrid.grid import Grid
from echogrid.live.hearing import Heard
from echogrid.mapping.registry import sensor_model
from echogrid.models.networks.set_network import SetNetwork

NETWORK = cast(SetNetwork, sensor_model("set-network"))
START_S = 1000.0
MOUNTS = [(0.2, 0.0, 0.0), (0.0, 0.2, np.pi / 2), (-0.2, 0.0, np.pi), (0.0, -0.2, -np.pi / 2)]


class Recorder:
    """Stands for the mapper: keeps the frames."""

    def __init__(self, robot, network, resolution=None, half_life=None):
        self.robot, self.half_life, self.resolution = robot, half_life, resolution or 0.04
        self.frames, self.before = [], []
        self.cells = np.zeros((3, 4), dtype=np.float32)

    def equip(self, robot):
        self.robot, self.before, self.frames = robot, self.before + self.frames, []

    def prepare(self, batch):
        return lambda: None

    def add(self, frames):
        self.frames += frames

    def grid(self):
        return Grid(self.cells, self.cells == 0, self.resolution, (0.0, 0.0))

    def around(self, x, y, side_m):
        cells = np.full((2, 2), -3, dtype=np.float32)
        return Grid(cells, cells < 0, self.resolution, (x - side_m / 2, y - side_m / 2))


def header(stamp, frame):
    nanos = round(stamp * 1e9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=nanos // 10**9, nanosec=nanos % 10**9), frame_id=frame)


def range_of(stamp, frame, value, fov=0.4, low=0.15, high=5.0):
    return SimpleNamespace(
        header=header(stamp, frame), field_of_view=fov, min_range=low, max_range=high, range=value, radiation_type=0
    )


def xyz(x, y, z=0.0):
    return SimpleNamespace(x=x, y=y, z=z)


def turned(theta):
    return SimpleNamespace(x=0.0, y=0.0, z=np.sin(theta / 2), w=np.cos(theta / 2))


def transform(stamp, parent, child, x, y, theta):
    where = SimpleNamespace(translation=xyz(x, y), rotation=turned(theta))
    return SimpleNamespace(header=header(stamp, parent), child_frame_id=child, transform=where)


def tf(*transforms):
    return SimpleNamespace(transforms=list(transforms))


def odometry(stamp, x, y, theta, parent="odom", child="base_link"):
    pose = SimpleNamespace(pose=SimpleNamespace(position=xyz(x, y), orientation=turned(theta)))
    return SimpleNamespace(header=header(stamp, parent), child_frame_id=child, pose=pose)


class Drive:
    """A robot that sends its messages to Live, ten scans a second."""

    def __init__(self, live, mounts=MOUNTS):
        self.live, self.mounts, self.time = live, mounts, 0.0
        self.pictures, self.notices = [], []
        static = [transform(0, "base_link", f"sonar_{i}", *mount) for i, mount in enumerate(mounts)]
        self.take(Heard.STATIC, "/tf_static", tf(*static))

    def take(self, heard, topic, message, source=None):
        self.live.take(heard, topic, message, self.time, source)

    def pose(self, x=0.0, y=0.0, theta=0.0, after=0.0, source=None):
        stamp = START_S + self.time + after
        self.take(Heard.TF, "/tf", tf(transform(stamp, "odom", "base_link", x, y, theta)), source)

    def ranges(self, values, stamp=None, source=None):
        for i, value in enumerate(values):
            if value is not None:
                message = range_of(stamp or START_S + self.time, f"sonar_{i}", value)
                self.take(Heard.RANGE, f"/s{i}", message, source)

    def step(self):
        self.pictures += self.live.step(self.time)
        self.notices += self.live.notices()
        self.time = round(self.time + 0.1, 6)

    def run(self, scans, values=(1.0, 2.0, inf, 0.5)):
        for _ in range(scans):
            self.pose(x=0.1 * self.time)
            self.ranges(values)
            self.step()

    @property
    def mapper(self):
        return self.live._map._mapper

    @property
    def frames(self):
        return self.mapper.frames
