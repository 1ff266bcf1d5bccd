"""What all text logs share: numbered lines in bounded memory, and the rules that a number must keep."""

import codecs
import itertools
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import inf, ndarray

from echogrid.errors import InputError

MAX_LINE = 1_000_000
"""A longer line (bytes) is no line of a log; it is refused before it fills the memory."""

_NUMBER_BYTES = b"0123456789+-.eE infatyINFATY,\t\r\n"
"""Every byte that a row of numbers needs. float() alone would also take ``1_0`` and control characters."""


@dataclass(frozen=True)
class _Rule:
    expected: str
    low: float
    high: float
    may_miss: bool = False
    """True where ``inf`` (no echo) and ``nan`` (not fired) are values."""


_RULES = {
    # Milliseconds since 1970 stand at 1.7e12, so that a stamp in a wrong unit is found.
    "t": _Rule("a time in s within +-1e11", -1e11, 1e11),
    "x": _Rule("metres within +-1e7", -1e7, 1e7),
    "y": _Rule("metres within +-1e7", -1e7, 1e7),
    "theta": _Rule("radians within +-1e7", -1e7, 1e7),
}
_RANGE_RULE = _Rule("metres from 0 up to 100, or inf", 0.0, 100.0, may_miss=True)


class Table:
    """The rules of rows of numbers, found from the names of their columns.

    ``t`` is the stamp (s), ``x``, ``y``, ``theta`` a pose (m, m, rad), also after ``odom_``; any other
    column is a range (m).
    """

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        self.rules = [_RULES.get(name.removeprefix("odom_"), _RANGE_RULE) for name in names]
        self._low = np.array([rule.low for rule in self.rules])
        self._high = np.array([rule.high for rule in self.rules])
        self._may_miss = np.array([rule.may_miss for rule in self.rules])
        self._stamp = self.names.index("t")

    def check(
        self, values: Float[ndarray, "rows columns"], last_stamp: float = -inf
    ) -> tuple[int, tuple[str, str] | None]:
        """Find the first row that breaks a rule.

        Args:
            values: rows of numbers, one column a name.
            last_stamp: the stamp (s) of the row before the first.

        Returns:
            The number of good rows before it, and what was found and expected there; None if all are good.
        """
        right = (values >= self._low) & (values <= self._high) | self._may_miss & ~np.isfinite(values)
        stamps = values[:, self._stamp]
        wrong = ~right.all(axis=1)
        wrong[1:] |= stamps[1:] < stamps[:-1]
        if len(values) and stamps[0] < last_stamp:
            wrong[0] = True
        if not wrong.any():
            return len(values), None
        row = int(wrong.argmax())
        if not right[row].all():
            column = int(right[row].argmin())
            found = f"{self.names[column]} = {float(values[row, column])!r}"
            return row, (found, self.rules[column].expected)
        before = float(stamps[row - 1]) if row else last_stamp
        return row, (f"time {float(stamps[row])!r} after {before!r}", "rows in time order")


def printable(path: Path) -> str:
    """The path as it may be shown on a terminal; a name with control characters is quoted."""
    return str(path) if str(path).isprintable() else repr(str(path))


def quoted(text: bytes | str) -> str:
    """A piece of a file for a message: short, on one line, control characters escaped."""
    if isinstance(text, bytes):
        text = text[:200].decode("utf-8", errors="backslashreplace")
    return repr(text if len(text) <= 40 else text[:37] + "...")


def numbered(path: Path) -> Iterator[tuple[int, bytes]]:
    """Go through the lines of a file, numbered from 1, each with its line end; a byte order mark is dropped.

    No more than one line is in memory.

    Raises:
        InputError: no file, one that cannot be read, or a line longer than MAX_LINE.
    """
    name = printable(path)
    try:
        _refuse_odd_file(path, name)
        with path.open("rb") as file:
            for number in itertools.count(1):
                line = file.readline(MAX_LINE + 1)
                if not line:
                    return
                if len(line) > MAX_LINE:
                    _refuse_long_line(f"{name}:{number}")
                yield number, line.removeprefix(codecs.BOM_UTF8) if number == 1 else line
    except OSError as error:
        raise InputError(name, error.strerror or str(error), "a log file") from None
    except ValueError:
        raise InputError(name, "a name that holds a null byte", "a log file") from None


def _refuse_odd_file(path: Path, name: str) -> None:
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode):
        # A pipe cannot be read twice, and a device may never end.
        found = "a directory" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise InputError(name, found, "a log file")


def _refuse_long_line(where: str) -> None:
    raise InputError(where, f"a line of more than {MAX_LINE} bytes", "the lines of a text log")


def text_of(line: bytes, where: str) -> str:
    """The line as text, without its line end.

    Raises:
        InputError: not UTF-8, or with a NUL in it: the file is no text.
    """
    if b"\0" in line:
        raise InputError(where, "a NUL byte", "a text file")
    try:
        return line.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError:
        raise InputError(where, "bytes that are not UTF-8 text", "a text file") from None


def only_numbers(line: bytes) -> bool:
    """Whether the bytes are all of the kind that numbers, commas and blanks are written with."""
    return not line.translate(None, _NUMBER_BYTES)


def number_of(field: bytes, what: str, where: str) -> float:
    """The number that a field holds; ``what`` names the field.

    Raises:
        InputError: the field is empty or holds something else.
    """
    if only_numbers(field):
        try:
            return float(field)
        except ValueError:
            pass
    found = quoted(field.strip()) if field.strip() else "nothing"
    raise InputError(where, f"{what} = {found}", "a number")
