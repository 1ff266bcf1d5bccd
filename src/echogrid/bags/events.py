"""What single messages of a bag say: readings of sonars with their stamps; transforms and poses on the way."""

from collections import Counter
from collections.abc import Collection, Iterator
from math import inf, nan
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.bags.bag_file import Message
from echogrid.robot import Robot
from echogrid.ros.messages import (
    ODOMETRY,
    RANGE,
    SONAR_ARRAY,
    TF,
    TF_OLD,
    Sonar,
    is_static,
    points_of,
    put_odometry,
    put_transforms,
    ranges_of,
    seconds,
)
from echogrid.ros.sonars import base_of
from echogrid.ros.transforms import Transforms

BEGIN_S = 1.0
"""Of a bag whose time begins before this, 0 is a time as any other, s."""

NO_STAMP = "a reading without a time on a topic of others that have one"


class Event(NamedTuple):
    """A reading in a bag."""

    sonar: Sonar
    stamp: float
    """s"""
    range_m: float
    """As it stands in the message."""
    field_of_view: float
    """rad; nan if the type has none."""
    limits: tuple[float, float]
    """Minimum and maximum range, m; nan if the type has none."""


def stamp_of(message: Message) -> float:
    """The time that a message says, s; 0 if it says none."""
    content = message.content
    if message.type == RANGE:
        return content.stamp
    if message.type in (TF, TF_OLD):
        return max((seconds(each.header.stamp) for each in content.transforms), default=0.0)
    return seconds(content.header.stamp)


def events(
    message: Message,
    transforms: Transforms,
    robot: Robot | None,
    refused: Counter[str],
    unstamped: Collection[str] | None = None,
    from_zero: bool = False,
) -> Iterator[Event]:
    """The readings in a message; its transforms and poses are put where they belong.

    ``unstamped``: topics whose messages have the time when they were recorded; None: each that says no other.
    ``from_zero``: 0 is a time as any other, as where a simulation begins.
    """
    content, kind = message.content, message.type
    late = message.received if unstamped is not None and message.topic in unstamped else None
    if kind in (TF, TF_OLD):
        refused.update(put_transforms(transforms, content, is_static(message.topic), late))
    elif kind == ODOMETRY:
        reason = put_odometry(transforms, content, late)
        if reason:
            refused[reason] += 1
    elif (
        unstamped is not None
        and late is None
        and not stamp_of(message)
        and not from_zero
        and message.received >= BEGIN_S
    ):
        refused[NO_STAMP] += 1
    elif kind == RANGE:
        stamp, frame, field_of_view, low, high, range_m = content
        yield Event(Sonar(message.topic, frame), stamp or message.received, range_m, field_of_view, (low, high))
    else:
        yield from _of_all(message, transforms, robot, refused)


def _of_all(message: Message, transforms: Transforms, robot: Robot | None, refused: Counter[str]) -> Iterator[Event]:
    """The readings in a message that holds those of all sonars."""
    content = message.content
    stamp = seconds(content.header.stamp) or message.received
    ranges = ranges_of(content) if message.type == SONAR_ARRAY else _of_points(message, transforms, robot)
    if ranges is None or (robot is not None and len(ranges) != robot.sonars):
        count = "no" if ranges is None else len(ranges)
        wanted = f", where robot {robot.name} has {robot.sonars}" if robot else ""
        refused[f"a message of {count} sonars{wanted}"] += 1
        return
    limits = (nan, nan) if robot is None else (robot.min_range_m, robot.max_range_m)
    for number, range_m in enumerate(ranges.tolist()):
        yield Event(Sonar(message.topic, str(number)), stamp, range_m, nan, limits)


def _of_points(message: Message, transforms: Transforms, robot: Robot | None) -> Float[ndarray, "sonars"] | None:
    """Ranges (m) of the points that sonars saw, in the order of the sonars; nan where the places are not known."""
    points = points_of(message.content)
    if points is None or robot is None or len(points) != robot.sonars:
        return None if points is None else np.full(len(points), nan)
    frame = message.content.header.frame_id
    base = base_of(transforms, frame)
    pose = transforms.pose(base, frame, seconds(message.content.header.stamp), reach=inf) if frame != base else None
    if pose is not None:
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        points = points @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    # The points are of single precision: what was 5 m must not fall below it, and be an echo.
    return np.round(np.hypot(*(points - robot.mounts[:, :2]).T), 5)
