"""Frames on their way into a map: what cannot be a frame of the robot is refused, what can be is cleaned.

Frames of logs are as they should be, and are handed on as they are; those of other programs may be anything.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError, UsageError
from echogrid.frame import Frame
from echogrid.limits import MOST_M, MOST_RAD, MOST_RANGE_M, MOST_STAMP_S, as_real, as_reals
from echogrid.robot import Robot
from echogrid.yaml_keys import shown

LATE_S = 1.0
"""A stamp that lies farther back than this is a clock that has jumped, not a frame that is late."""

_FLOAT = np.dtype(float)

_POSE_LIMITS = {"x": (MOST_M, "metres"), "y": (MOST_M, "metres"), "theta": (MOST_RAD, "radians")}


def check_robot(robot: Robot) -> None:
    """Raise a UsageError if a robot, which a program may have made itself, is none that can be mapped with."""
    if not isinstance(robot, Robot):
        raise UsageError(f"robot: found {_kind(robot)}, expected a Robot, as of Robot.load")
    mounts = as_reals(robot.mounts)
    if mounts is None or mounts.shape[1:] != (3,) or not len(mounts) or not np.isfinite(mounts).all():
        raise UsageError(f"robot {robot.name}: found mounts {shown(robot.mounts)}, expected rows of x, y, axis")
    low, high = as_real(robot.min_range_m), as_real(robot.max_range_m)
    if low is None or high is None or not 0 <= low < high < np.inf:
        found = f"ranges from {shown(robot.min_range_m)} to {shown(robot.max_range_m)} m"
        raise UsageError(f"robot {robot.name}: found {found}, expected a minimum below a maximum")
    own = robot.own_max_ranges_m
    if own is not None and not (np.shape(own) == (len(mounts),) and np.min(own) > low and np.max(own) <= high):
        expected = f"{len(mounts)} numbers above {low:g}, up to {high:g}"
        raise UsageError(f"robot {robot.name}: found own maximum ranges {shown(own)}, expected {expected}")


def fitting(frames: Iterable[Frame], robot: Robot, latest: float | None = None) -> Iterator[Frame]:
    """Frames whose stamps, poses, mounts and numbers of ranges can be; what the ranges are is for ``cleaned``.

    Numbers in lists, of integers or of single precision become arrays of floats.

    Args:
        frames: in their order.
        robot: the robot that they are to be of.
        latest: the latest stamp before them, s, where time must not go back; None: the order is not looked at.

    Raises:
        UsageError: in one line that begins with the number of the frame, from 0, and its stamp.
    """
    try:
        each = iter(frames)
    except TypeError:
        raise UsageError(f"map: found {_kind(frames)}, expected frames, in a list or a log") from None
    for number, given in enumerate(each):
        frame = given if _as_it_should_be(given, robot.sonars) else _brought(given, number, robot)
        if latest is not None:
            if frame.stamp < latest - LATE_S:
                found = f"a clock that jumps back, from {latest!r} s"
                raise UsageError(
                    f"{named(frame, number)}: found {found}, expected time that goes on, or no half-life"
                )
            latest = max(latest, frame.stamp)
        yield frame


def _as_it_should_be(frame: Frame, sonars: int) -> bool:
    """Whether nothing is to be done about a frame; this is all that most frames ever meet, and it is quick."""
    if type(frame) is not Frame:
        return False
    stamp, pose, ranges = frame.stamp, frame.pose, frame.ranges
    if not (type(pose) is ndarray and pose.dtype is _FLOAT and pose.shape == (3,)):
        return False
    if not (type(ranges) is ndarray and ranges.dtype is _FLOAT and ranges.shape == (sonars,)):
        return False
    x, y, theta = pose.tolist()
    within = -MOST_M <= x <= MOST_M and -MOST_M <= y <= MOST_M and -MOST_RAD <= theta <= MOST_RAD
    if not (within and isinstance(stamp, float) and -MOST_STAMP_S <= stamp <= MOST_STAMP_S):
        return False
    mounts = frame.mounts
    if mounts is None:
        return True
    if not (type(mounts) is ndarray and mounts.dtype is _FLOAT and mounts.shape == (sonars, 3)):
        return False
    return bool(mounts.min() >= -MOST_M and mounts.max() <= MOST_M)


def _brought(frame: Frame, number: int, robot: Robot) -> Frame:
    """A frame in arrays of floats, or a UsageError that says what is wrong with it."""
    if not isinstance(frame, Frame):
        raise UsageError(f"map: frame {number}: found {_kind(frame)}, expected a Frame")
    where = named(frame, number)
    stamp = as_real(frame.stamp)
    if stamp is None or not -MOST_STAMP_S <= stamp <= MOST_STAMP_S:
        found = f"stamp = {shown(frame.stamp) if stamp is None else repr(stamp)}"
        raise UsageError(f"map: frame {number}: found {found}, expected a time in s within +-{MOST_STAMP_S:g}")
    pose = _array(frame.pose, (3,), where, "a pose", "x, y, theta")
    for (name, (most, unit)), value in zip(_POSE_LIMITS.items(), pose.tolist(), strict=True):
        if not -most <= value <= most:
            raise UsageError(f"{where}: found {name} = {value!r}, expected {unit} within +-{most:g}")
    ranges = as_reals(frame.ranges)
    if ranges is not None and ranges.ndim == 1 and len(ranges) != robot.sonars:
        raise UsageError(f"{where}: found {len(ranges)} readings, expected {robot.sonars} (robot {robot.name})")
    ranges = _array(frame.ranges, (robot.sonars,), where, "ranges", "one range a sonar")
    mounts = frame.mounts
    if mounts is not None:
        mounts = _array(mounts, (robot.sonars, 3), where, "mounts", "x, y, axis of each sonar")
        if not np.all(np.abs(mounts) <= MOST_M):
            sonar = int(np.argmin(np.all(np.abs(mounts) <= MOST_M, axis=1)))
            found = f"mounts[{sonar}] = {shown(mounts[sonar].tolist())}"
            raise UsageError(f"{where}: found {found}, expected metres and radians within +-{MOST_M:g}")
    return replace(frame, stamp=stamp, pose=pose, ranges=ranges, mounts=mounts)


def _array(value: object, shape: tuple[int, ...], where: str, what: str, expected: str) -> Float[ndarray, "*n"]:
    array = as_reals(value)
    if array is None or array.shape != shape:
        found = _kind(value) if array is None else f"an array of shape {array.shape}"
        raise UsageError(f"{where}: found {what} that is {found}, expected {expected}: numbers of shape {shape}")
    return array


def cleaned(batch: Sequence[Frame], robot: Robot) -> Sequence[Frame]:
    """Frames as of ``fitting`` with their ranges cleaned by ``Robot.clean``; the same frames where all are clean.

    Raises:
        UsageError: a range is below 0 or longer than any; the line names the frame's stamp and the sonar.
    """
    if not batch:
        return batch
    ranges = np.array([frame.ranges for frame in batch])
    clean = robot.clean(ranges)
    kept = (clean == ranges) | np.isnan(ranges)
    if kept.all():
        return batch
    wrong = (ranges < 0) | (ranges > MOST_RANGE_M) & (ranges < np.inf)
    if wrong.any():
        at, sonar = np.argwhere(wrong)[0]
        found = f"a range of {ranges[at, sonar]:g} of sonar {sonar}"
        expected = f"metres from 0 to {MOST_RANGE_M:g}, inf (no echo) or nan (not fired)"
        raise UsageError(f"{named(batch[at])}: found {found}, expected {expected}")
    whole = kept.all(axis=1)
    return [
        frame if same else replace(frame, ranges=row) for frame, same, row in zip(batch, whole, clean, strict=True)
    ]


def named(frame: Frame, number: int | None = None) -> str:
    """How a message speaks of a frame."""
    stamp = as_real(frame.stamp)
    at = f"stamp {shown(frame.stamp) if stamp is None else repr(stamp)} s"
    return f"map: frame of {at}" if number is None else f"map: frame {number} ({at})"


def _kind(value: object) -> str:
    """What a value is, in a word or two for a message."""
    if value is None:
        return "None"
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    return f"{type(value).__name__} {shown(value)}"


class Heard:
    """Whether there is anything to map in frames, which pass."""

    def __init__(self) -> None:
        self.frames, self._valid = 0, False

    def of(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames, each as it comes."""
        for frame in frames:
            self.frames += 1
            self._valid = self._valid or not np.isnan(frame.ranges).all()
            yield frame

    def check(self, name: str) -> None:
        """Raise an InputError on a log of that name if there was nothing."""
        if not self.frames:
            raise InputError(name, "no frames", "at least one")
        if not self._valid:
            found = "no valid reading of any sonar: all are 0 m, nan or below min_range"
            raise InputError(name, found, "ranges in m, or inf where there is no echo")
