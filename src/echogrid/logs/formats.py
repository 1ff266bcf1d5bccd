"""Readers of recorded logs: one file a format, one table, and every reader yields the same Frame."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from echogrid.errors import InputError
from echogrid.frame import Log
from echogrid.logs import bag, carmen, csv_log
from echogrid.logs.csv_log import write_csv
from echogrid.logs.lines import numbered, printable, quoted, text_of
from echogrid.robot import Robot
from echogrid.ros.messages import Choice

__all__ = ["READERS", "Reader", "load_log", "write_csv"]


@dataclass(frozen=True)
class Reader:
    """One format of logs."""

    format: str
    """What the format is called, and what its first line looks like."""
    recognises: Callable[[str], bool]
    """Tells from the first line whether a file is of the format."""
    load: Callable[[Path, Robot | None], Log]
    """Opens a file of the format."""


READERS = (
    Reader("a CSV log (t,x,y,theta,r0,...)", csv_log.recognises, csv_log.load),
    Reader("a CARMEN log (# ..., ODOM ..., SONAR ...)", carmen.recognises, carmen.load),
)


def load_log(path: str | Path, robot: Robot | None = None, choice: Choice | None = None) -> Log:
    """Open a recorded log; the format is told from how the file begins.

    The frames are read anew, in bounded memory, each time the log is gone through; a wrong row raises its
    InputError then, after the frames before it.

    Args:
        path: the file.
        robot: the robot that recorded it. Its limits are applied to the ranges (``Robot.clean``), and its
            mounts are taken in place of those that the log may carry. None: what the log says of itself.
        choice: what of a bag to read.

    Raises:
        InputError: no file, a format that is not known, a wrong header, nothing in it, or another number of
            sonars than the robot has.
    """
    path = Path(path)
    name = printable(path)
    if bag.recognises(path):
        return bag.load(path, robot, choice)
    if choice not in (None, Choice()):
        raise InputError(name, "a log that is no bag", "a bag, for topics and frames to be chosen from")
    _, line = next(numbered(path), (1, b""))
    if not line:
        raise InputError(name, "an empty file", "a log")
    first_line = text_of(line, f"{name}:1")
    for reader in READERS:
        if reader.recognises(first_line):
            log = reader.load(path, robot)
            break
    else:
        formats = " or ".join([*(reader.format for reader in READERS), "a bag of ROS"])
        raise InputError(f"{name}:1", quoted(first_line), formats)
    if robot is not None and robot.sonars != log.sonars:
        raise InputError(name, f"{log.sonars} sonars", f"{robot.sonars}, as robot {robot.name} has")
    return log
