"""Lines of a text log, in bounded memory."""

import codecs
import io
import stat
from collections.abc import Iterator
from pathlib import Path

from echogrid.errors import InputError
from echogrid.files import printable
from echogrid.packed import opened

MAX_LINE = 1_000_000
"""A longer line (bytes) is no line of a log; it is refused before it fills the memory."""

_FEW_BYTES = 2**13


def quoted(text: bytes | str) -> str:
    """A piece of a file for a message: short, on one line, control characters escaped."""
    if isinstance(text, bytes):
        text = text[:200].decode("utf-8", errors="backslashreplace")
    return repr(text if len(text) <= 40 else text[:37] + "...")


def numbered(path: Path) -> Iterator[tuple[int, bytes]]:
    """Go through the lines of a file, numbered from 1; otherwise as ``blocks``."""
    for first, lines in blocks(path):
        yield from enumerate(lines, first)


def blocks(path: Path, size: int = _FEW_BYTES) -> Iterator[tuple[int, list[bytes]]]:
    """Go through the lines of a file, some at a time, each with its line end; a byte order mark is dropped.

    A compressed file is unpacked as it is read. No more than ``size`` bytes, or one line, are read at a time.

    Yields:
        The number of the first of some lines, from 1, and the lines; all those before an error come before it.

    Raises:
        InputError: no file, one that cannot be read, or a line longer than MAX_LINE.
    """
    name = printable(path)
    try:
        _refuse_odd_file(path, name)
        with opened(path) as file:
            number, rest = 1, b""
            while piece := file.read1(size):
                # Not splitlines, which ends lines at a lone \r too.
                lines = io.BytesIO(rest + piece).readlines()
                rest = b"" if lines[-1].endswith(b"\n") else lines.pop()
                if len(lines[0] if lines else rest) > MAX_LINE:
                    _refuse_long_line(f"{name}:{number}")
                if lines:
                    if number == 1:
                        lines[0] = lines[0].removeprefix(codecs.BOM_UTF8)
                    yield number, lines
                    number += len(lines)
            if rest:
                yield number, [rest.removeprefix(codecs.BOM_UTF8) if number == 1 else rest]
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
