"""The formats of recorded logs: one file a format, one table, and every reader yields the same Frame."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from echogrid.bags import recognising as bag
from echogrid.errors import InputError
from echogrid.files import printable
from echogrid.frame import Log
from echogrid.logs import carmen, csv_log
from echogrid.logs.lines import first_line, quoted
from echogrid.robot import Robot
from echogrid.ros.messages import Choice


@dataclass(frozen=True)
class Reader:
    """One format of logs."""

    format: str
    """What the format is called, and what its first line looks like."""
    recognises: Callable[[Path], bool]
    """Tells whether a file is of the format; an InputError if it must be read for that, and cannot be."""
    load: Callable[[Path, Robot | None, Choice], Log]
    """Opens a file of the format."""
    chooses: bool = False
    """Whether there are topics and frames in it to choose from."""


def _text(name: str, recognises: Callable[[str], bool], load: Callable[[Path, Robot | None], Log]) -> Reader:
    """A format of text, which is told from the first line."""
    return Reader(name, lambda path: recognises(first_line(path)), lambda path, robot, _: load(path, robot))


def _bag(path: Path, robot: Robot | None, choice: Choice) -> Log:
    from echogrid.bags.reader import load  # a tenth of a second, which no other log should cost

    return load(path, robot, choice)


READERS = (
    _text("a CARMEN log (# ..., ODOM ..., SONAR ...)", carmen.recognises, carmen.load),
    Reader("a CSV log (t,x,y,theta,r0,...)", csv_log.recognises, lambda path, robot, _: csv_log.load(path, robot)),
    Reader("a bag of ROS", bag.recognises, _bag, chooses=True),
)
"""Asked from the last to the first: what ends or begins like a bag is not looked at as a text, and what begins with
comments may be a CSV log before it is a CARMEN log."""


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
    path, choice = Path(path), choice or Choice()
    name = printable(path)
    asked = [reader for reader in reversed(READERS) if reader.chooses or not choice.names]
    reader = next((reader for reader in asked if reader.recognises(path)), None)
    if reader is None and choice.names:
        raise InputError(name, "a log that is no bag", "a bag, for topics and frames to be chosen from")
    if reader is None:
        formats = " or ".join(reader.format for reader in READERS)
        raise InputError(f"{name}:1", quoted(first_line(path)), formats)
    log = reader.load(path, robot, choice)
    if robot is not None and robot.sonars != log.sonars:
        raise InputError(name, f"{log.sonars} sonars", f"{robot.sonars}, as robot {robot.name} has")
    return log
