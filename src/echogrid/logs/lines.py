"""Lines of a text log, in bounded memory."""

import codecs
import itertools
import stat
from collections.abc import Iterator
from pathlib import Path

from echogrid.errors import InputError
from echogrid.files import printable
from echogrid.packed import opened

MAX_LINE = 1_000_000
"""A longer line (bytes) is no line of a log; it is refused before it fills the memory."""


def quoted(text: bytes | str) -> str:
    """A piece of a file for a message: short, on one line, control characters escaped."""
    if isinstance(text, bytes):
        text = text[:200].decode("utf-8", errors="backslashreplace")
    return repr(text if len(text) <= 40 else text[:37] + "...")


def numbered(path: Path) -> Iterator[tuple[int, bytes]]:
    """Go through the lines of a file, numbered from 1, each with its line end; a byte order mark is dropped.

    A compressed file is unpacked as it is read.

    No more than one line is in memory.

    Raises:
        InputError: no file, one that cannot be read, or a line longer than MAX_LINE.
    """
    name = printable(path)
    try:
        _refuse_odd_file(path, name)
        with opened(path) as file:
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
    if line[257:262] == b"ustar":
        raise InputError(where, "a tar archive", "the log in it (tar -xf unpacks it)")
    if b"\0" in line:
        raise InputError(where, "a NUL byte", "a text file")
    try:
        return line.decode("utf-8").rstrip("\r\n")
    except UnicodeDecodeError:
        raise InputError(where, "bytes that are not UTF-8 text", "a text file") from None


def first_line(path: Path) -> str:
    """The first line of a log, without its line end.

    Raises:
        InputError: no file, an empty one, or one that is no text.
    """
    name = printable(path)
    _, line = next(numbered(path), (1, b""))
    if not line:
        raise InputError(name, "an empty file", "a log")
    return text_of(line, f"{name}:1")
