"""A drive as bags hold it, whole and with faults, and what is said of such a bag."""

import re
from collections.abc import Iterable
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import pytest

from bag_writers import (
    B21,
    START_S,
    Said,
    drive,
    has_rosbag,
    header,
    odometry,
    posed,
    ranged,
    sample,
    tf,
    time_of,
    transform,
    write_with_rosbag,
)
from commands import call
from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.robot import Robot

FRAMES = sample(30)
END_S = START_S + FRAMES[-1].stamp
DRIVE = drive(FRAMES)
RANGES = list(ranged(FRAMES))
P3DX = Robot.load("p3dx")
RING = [
    Frame(frame.stamp, frame.pose, P3DX.clean(np.where(np.arange(16) % 5 == 4, inf, frame.ranges[:16])))
    for frame in FRAMES
]
"""The drive as if a Pioneer had heard the first of the readings."""

LONG = sample(60)
"""Twelve seconds: more than is surveyed."""

TWO = [odometry(time_of(frame), frame.pose, topic=topic) for frame in FRAMES for topic in ("/odom", "/visual_odom")]
SHIFT = np.array([1.0, -2.0, 0.5])

with_rosbag = pytest.mark.skipif(not has_rosbag(), reason="Debian's rosbag is not here")


def shifted(frames: Iterable[Frame], by: np.ndarray) -> list[Frame]:
    return [replace(frame, pose=compose(by, frame.pose)) for frame in frames]


def again(
    said: Said, stamp: float | None = None, frame: str | None = None, topic: str | None = None, **fields
) -> Said:
    """A message with some fields changed."""
    old = said.content["header"]
    at = old["stamp"]["sec"] + old["stamp"]["nanosec"] * 1e-9 if stamp is None else stamp
    content = dict(said.content) | {"header": header(at, old["frame_id"] if frame is None else frame)} | fields
    return said._replace(topic=topic or said.topic, content=content)


def other_robot() -> list[Said]:
    mounts = [transform("r2/base_link", f"r2/sonar_{i}", mount, START_S) for i, mount in enumerate(B21.mounts)]
    ranges = (
        again(said, frame="r2/" + said.content["header"]["frame_id"], topic="/r2" + said.topic)
        for said in ranged(FRAMES)
    )
    return [tf(START_S, *mounts, topic="/tf_static"), *posed(FRAMES, "r2/odom", "r2/base_link"), *ranges]


def own_tf(robot: str, x: float) -> list[Said]:
    """The transforms of a robot that has its own topic of them, but no names of its own for its frames."""
    return [said._replace(topic=f"{robot}/tf") for said in posed(shifted(FRAMES, np.array([x, 0.0, 0.0])))]


def rosbag_of(path: Path, messages: Iterable[Said] = DRIVE, **options: object) -> Path:
    write_with_rosbag(messages, {path: options})
    return path


def assert_same_frames(found: Iterable[Frame], expected: Iterable[Frame]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert one.mounts is None
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-9)
        np.testing.assert_allclose(one.ranges, other.ranges, rtol=1e-6)
        assert one.stamp - START_S == pytest.approx(other.stamp, abs=1e-6)


def refused(capsys, path: Path, *args: object) -> str:
    """The line that the command says of a bag that it refuses."""
    capsys.readouterr()
    assert call("info", path, *args) == 2
    written = capsys.readouterr()
    line = written.err.removesuffix("\n")
    assert line.isprintable(), line
    assert len(line) < 600
    assert re.fullmatch(r"echogrid: .*: found .+, expected .+", line)
    assert line.startswith(f"echogrid: {path}")
    return line


def stated(capsys, path: Path, *args: object) -> tuple[str, str]:
    """What the command says of a bag that it takes: notes, and the rest."""
    capsys.readouterr()
    status = call("info", path, *args)
    written = capsys.readouterr()
    assert status == 0, written.err
    return written.err, written.out
