"""The CSV log: one row a frame.

Header ``t,x,y,theta,r0,...,rN-1``, with ``odom_x,odom_y,odom_theta`` after ``theta`` where there is
dead reckoning besides the pose. Units s, m, m, rad, m. A range of ``inf`` is no echo; an empty one, ``nan``
or ``-inf`` (too near) is not fired or not valid. Rows are in time order; equal stamps are allowed.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import batched
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import inf, nan, ndarray

from echogrid.doubts import Judge
from echogrid.errors import InputError
from echogrid.files import printable, replacing, unwritable
from echogrid.frame import Frame, Log
from echogrid.logs.lines import MAX_LINE, numbered, quoted, text_of
from echogrid.logs.rows import Table, number_of, only_numbers
from echogrid.robot import MAX_SONARS, Robot

_POSE = ("t", "x", "y", "theta")
_ODOM = ("odom_x", "odom_y", "odom_theta")

# One call of numpy's parser costs as much as some ten rows; past a few hundred rows nothing is gained.
_BATCH_ROWS = 256


def recognises(first_line: str) -> bool:
    """Whether a file that starts with this line is meant as a CSV log."""
    return first_line.replace(" ", "").startswith("t,x,y,theta")


def load(path: Path, robot: Robot | None) -> Log:
    """Open a CSV log; the rows are read, and checked, as the log is gone through.

    Args:
        path: the file.
        robot: whose limits the ranges are brought to (``Robot.clean``); None leaves them as they are.

    Raises:
        InputError: not such a file, a wrong header, or no rows.
    """
    lines = numbered(path)
    columns = _columns(lines, printable(path))
    if not any(line.strip() for _, line in lines):
        raise _no_rows(printable(path))
    sonars = len(columns) - columns.index("r0")
    notes: dict[str, int] = {}
    return Log(printable(path), sonars, robot, partial(_frames, path, columns, robot, notes), notes, judges=True)


def _columns(lines: Iterator[tuple[int, bytes]], name: str) -> tuple[str, ...]:
    """Names of the columns, from the first line."""
    where = f"{name}:1"
    _, line = next(lines, (1, b""))
    found = tuple(column.strip() for column in text_of(line, where).split(","))
    front = _POSE + _ODOM if found[4:5] == _ODOM[:1] else _POSE
    sonars = max(len(found) - len(front), 1)
    expected = front + tuple(f"r{i}" for i in range(sonars))
    for i, column in enumerate(expected):
        if found[i : i + 1] != (column,):
            shown = quoted(found[i]) if i < len(found) else "nothing"
            raise InputError(where, f"{shown} as column {i + 1}", repr(column))
    if sonars > MAX_SONARS:
        raise InputError(where, f"{sonars} sonars", f"at most {MAX_SONARS}")
    return expected


def _frames(path: Path, columns: tuple[str, ...], robot: Robot | None, notes: dict[str, int]) -> Iterator[Frame]:
    """Go through the rows; the frames before a wrong row come before its error."""
    name = printable(path)
    lines = numbered(path)
    if _columns(lines, name) != columns:
        raise InputError(f"{name}:1", "another header than before", "a log that does not change")
    table = Table(columns)
    first_range = columns.index("r0")
    last_stamp = -inf
    judge = Judge(robot)
    notes.clear()
    for first, rows in _batches(lines, name):
        values, error = _parse(rows, columns, first, name)
        good, fault = table.check(values, last_stamp)
        values = values[:good]
        ranges = values[:, first_range:]
        ranges[ranges < 0] = nan  # only -inf is left of the negative ones
        judge.see(values[:, 0], values[:, 1:4], ranges)
        if robot is not None:
            ranges = robot.clean(ranges)
        # Copied: whoever keeps the poses of a long drive would keep all its ranges with them.
        poses = values[:, 1:4].copy()
        odoms = values[:, 4:7].copy() if first_range > len(_POSE) else [None] * good
        stamps = values[:, 0].tolist()
        yield from map(Frame, stamps, poses, ranges, odoms)
        if fault is not None:
            raise InputError(f"{name}:{first + good}", *fault)
        if error is not None:
            raise error
        last_stamp = stamps[-1]
    if last_stamp == -inf:
        raise _no_rows(name)  # opening has seen one: the file has changed since
    notes |= judge.notes()


def _no_rows(name: str) -> InputError:
    return InputError(name, "a header and no rows", "one row a frame")


def _batches(lines: Iterator[tuple[int, bytes]], name: str) -> Iterator[tuple[int, list[bytes]]]:
    """Group the rows; yields the number of the first line of each group, and its lines."""
    rows: list[bytes] = []
    size, first, blank = 0, 2, 0
    for number, line in lines:
        if line.isspace():
            blank = blank or number
            continue
        if blank:
            break
        rows.append(line)
        size += len(line)
        if len(rows) == _BATCH_ROWS or size > MAX_LINE:
            yield first, rows
            rows, size, first = [], 0, number + 1
    else:
        blank = 0
    if rows:
        yield first, rows
    if blank:
        raise InputError(f"{name}:{blank}", "a blank line between rows", "a row")


def _parse(
    rows: list[bytes], columns: tuple[str, ...], first: int, name: str
) -> tuple[Float[ndarray, "rows columns"], InputError | None]:
    """The numbers of the rows up to the first that is not made of numbers, and that row's error."""
    text = b"".join(rows)
    if only_numbers(text):
        try:
            values = np.loadtxt(text.decode("ascii").splitlines(), delimiter=",", comments=None, ndmin=2)
        except ValueError:
            pass  # a wrong row, or an empty field: both need the slow way
        else:
            if values.shape == (len(rows), len(columns)):
                return values, None
    kept: list[list[float]] = []
    error = None
    try:
        for i, row in enumerate(rows):
            kept.append(_numbers(row, columns, f"{name}:{first + i}"))
    except InputError as caught:
        error = caught
    return np.array(kept, dtype=float).reshape(len(kept), len(columns)), error


def _numbers(row: bytes, columns: tuple[str, ...], where: str) -> list[float]:
    text_of(row, where)
    fields = row.split(b",")
    if len(fields) != len(columns):
        raise InputError(where, f"{len(fields)} columns", f"{len(columns)}, as the header has")
    if not fields[-1].strip() and not row.endswith(b"\n"):
        raise InputError(where, "a last line that is cut off", "a value and a line end")
    empty_allowed = columns.index("r0")
    return [
        nan if i >= empty_allowed and not field.strip() else number_of(field, column, where)
        for i, (column, field) in enumerate(zip(columns, fields, strict=True))
    ]


def write_csv(path: str | Path, frames: Iterable[Frame], sonars: int) -> None:
    """Write a CSV log; ``load_log`` reads the same frames back, to the last bit.

    The frames are taken one after the other, so that they need not fit into memory. The file appears only
    when it is whole: after any exception, one of the iterator's own included, the folder is as it was.

    Args:
        path: the file, replaced if it is there.
        frames: at least one; either all have ``odom`` or none.
        sonars: number of readings in each frame.

    Raises:
        InputError: a frame that the format cannot hold (the message carries its number, from 0), or none.
        UsageError: the file cannot be written.
    """
    name = printable(Path(path))
    if "\0" in str(path):
        raise unwritable(name, "a name with a NUL in it")
    with replacing(path) as temporary, temporary.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(_lines(frames, sonars, name))


def _lines(frames: Iterable[Frame], sonars: int, name: str) -> Iterator[str]:
    table: Table | None = None
    last_stamp = -inf
    done = 0
    for batch in batched(frames, _BATCH_ROWS):
        if table is None:
            front = _POSE if batch[0].odom is None else _POSE + _ODOM
            table = Table(front + tuple(f"r{i}" for i in range(sonars)))
            yield ",".join(table.names) + "\n"
        values = np.array([_row(frame, table, f"{name}: frame {done + i}") for i, frame in enumerate(batch)])
        good, fault = table.check(values, last_stamp)
        if fault is not None:
            raise InputError(f"{name}: frame {done + good}", *fault)
        last_stamp = values[-1, 0]
        done += len(batch)
        for row in values.tolist():
            yield ",".join(map(repr, row)) + "\n"
    if table is None:
        raise InputError(name, "no frames", "at least one to write")


def _row(frame: Frame, table: Table, where: str) -> list[float]:
    parts = [frame.pose, frame.ranges] if frame.odom is None else [frame.pose, frame.odom, frame.ranges]
    row = [frame.stamp, *np.concatenate(parts).tolist()]
    if len(row) != len(table.names):
        front = ",".join(table.names[: table.names.index("r0")])
        raise InputError(where, f"{len(row)} numbers", f"{len(table.names)} ({front} and the ranges)")
    return row
