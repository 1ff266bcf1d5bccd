"""The CSV log: one row a frame.

Header ``t,x,y,theta,r0,...,rN-1``, with ``odom_x,odom_y,odom_theta`` besides where there is dead reckoning
besides the pose; the columns may be in any order, and separated otherwise (``csv_header``). Units s, m, m, rad, m. A
range of ``inf`` is no echo; an empty one, ``nan`` or ``-inf`` (too near) is not fired or not valid. Rows are in time
order; equal stamps are allowed.
"""

from collections.abc import Iterable, Iterator
from functools import partial
from itertools import batched, islice
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import inf, nan, ndarray

from echogrid.doubts import Judge
from echogrid.errors import InputError
from echogrid.files import printable, replacing, unwritable
from echogrid.frame import Frame, Log, Progress
from echogrid.logs.csv_header import ODOM, POSE, Header, read_header, recognises
from echogrid.logs.lines import MAX_LINE, blocks, numbered, text_of
from echogrid.logs.rows import Table, number_of, only_numbers
from echogrid.robot import Robot

__all__ = ["load", "recognises", "write_csv"]

# One call of numpy's parser costs as much as some ten rows; past a few hundred rows nothing is gained.
_BATCH_ROWS, _PIECE_BYTES = 256, 2**16

_COMMENT = ord("#")

MAX_EMPTY = 100_000
"""Blank lines or comments in a row; a small compressed file can be made to hold any number of them."""


def load(path: Path, robot: Robot | None) -> Log:
    """Open a CSV log; the rows are read, and checked, as the log is gone through.

    Args:
        path: the file.
        robot: whose limits the ranges are brought to (``Robot.clean``); None leaves them as they are.

    Raises:
        InputError: not such a file, a wrong header, or no rows.
    """
    lines = numbered(path)
    header = read_header(lines, printable(path))
    if not any(line.strip() and not line.startswith(b"#") for _, line in islice(lines, MAX_EMPTY)):
        raise _no_rows(printable(path))
    sonars = len(header.columns) - header.columns.index("r0")
    notes: dict[str, int] = {}
    progress = Progress("scan", partial(_count, path, header))
    frames = partial(_frames, path, header, robot, notes)
    return Log(printable(path), sonars, robot, frames, notes, progress, judges=True)


def _count(path: Path, header: Header) -> int:
    """The rows of a log."""
    lines = (line for number, line in numbered(path) if number > header.line)
    return sum(not line.isspace() and line[0] != _COMMENT for line in lines)


def _frames(path: Path, header: Header, robot: Robot | None, notes: dict[str, int]) -> Iterator[Frame]:
    """Go through the rows; the frames before a wrong row come before its error."""
    name = printable(path)
    if read_header(numbered(path), name) != header:
        raise InputError(f"{name}:1", "another header than before", "a log that does not change")
    table = Table(header.columns)
    first_range = header.columns.index("r0")
    last_stamp = -inf
    judge = Judge(robot)
    notes.clear()
    with_commas, order = header.with_commas(name), header.order
    for first, rows in _batches(path, header):
        rows, mixed = with_commas(rows, first) if with_commas else (rows, None)
        values, error = _parse(rows, header.names, first, name)
        error = error or mixed
        if order:
            values = values[:, order]
        good, fault = table.check(values, last_stamp)
        values = values[:good]
        ranges = values[:, first_range:]
        ranges[ranges < 0] = nan  # only -inf is left of the negative ones
        judge.see(values[:, 0], values[:, 1:4], ranges)
        if robot is not None:
            ranges = robot.clean(ranges)
        # Copied: whoever keeps the poses of a long drive would keep all its ranges with them.
        poses = values[:, 1:4].copy()
        odoms = values[:, 4:7].copy() if first_range > len(POSE) else [None] * good
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


def _batches(path: Path, header: Header) -> Iterator[tuple[int, list[bytes]]]:
    """Group the rows; yields the number of the first line of each group, and its lines."""
    first, rows = header.line + 1, []
    for number, run in _runs(path, header):
        if number != first + len(rows):  # behind other lines
            if rows:
                yield first, rows
            first, rows = number, []
        rows += run
        while len(rows) >= _BATCH_ROWS:
            yield first, rows[:_BATCH_ROWS]
            first, rows = first + _BATCH_ROWS, rows[_BATCH_ROWS:]
        if sum(map(len, rows)) > MAX_LINE:
            yield first, rows
            first, rows = first + len(rows), []
    if rows:
        yield first, rows


def _runs(path: Path, header: Header) -> Iterator[tuple[int, list[bytes]]]:
    """Go through the rows, some that stand one below the other at a time.

    Yields:
        The number of the line where they begin, and their lines; none of them behind each line that is no row.

    Raises:
        InputError: a blank line between rows, or too many lines that are none.
    """
    name, blank, empty = printable(path), 0, 0
    for number, lines in blocks(path, _PIECE_BYTES):
        start = max(header.line + 1 - number, 0)
        for end in (*_no_rows_in(lines, start), len(lines)):
            if start < end:
                if blank:
                    raise _blank_line(name, blank)
                yield number + start, lines[start:end]
                empty = 0
            if end == len(lines):
                break
            start, empty = end + 1, empty + 1
            yield number + start, []
            if lines[end][0] != _COMMENT:
                blank = blank or number + end
                if empty > MAX_EMPTY:
                    raise _blank_line(name, blank)
            elif empty > MAX_EMPTY:
                raise InputError(f"{name}:{number + end}", f"{MAX_EMPTY} comments in a row", "rows between them")


def _no_rows_in(lines: list[bytes], start: int) -> list[int]:
    """Which lines, from one on, are blank or comments."""
    if start >= len(lines) or min(lines)[0] > _COMMENT:  # no number begins so, but for blanks before it
        return []
    odd = (i for i in range(start, len(lines)) if lines[i][0] <= _COMMENT)
    return [i for i in odd if lines[i][0] == _COMMENT or lines[i].isspace()]


def _blank_line(name: str, number: int) -> InputError:
    return InputError(f"{name}:{number}", "a blank line between rows", "a row")


def _parse(
    rows: list[bytes], columns: tuple[str, ...], first: int, name: str
) -> tuple[Float[ndarray, "rows columns"], InputError | None]:
    """The numbers of the rows up to the first that is not made of numbers, and that row's error."""
    if rows and only_numbers(b"".join(rows)):
        try:
            values = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
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
    return [
        nan if column[0] == "r" and not field.strip() else number_of(field, column, where)
        for column, field in zip(columns, fields, strict=True)
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
            front = POSE if batch[0].odom is None else POSE + ODOM
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
