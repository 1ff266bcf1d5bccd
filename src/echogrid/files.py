"""Files: written whole or not at all, read only where they are plain ones, and how messages name them."""

import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from importlib import resources
from pathlib import Path

from echogrid.errors import InputError, UsageError
from echogrid.temporary import beside


@contextmanager
def replacing(path: str | Path) -> Generator[Path]:
    """A new, empty file beside ``path`` that takes its place when the block ends well.

    When the block raises, the new file is removed and what stood at ``path`` is untouched. The temporary
    name keeps the suffix of ``path``. A link is followed; the permissions are those of any new file.

    Raises:
        UsageError: something other than a file stands at ``path``, or the system refuses to write (an
            ``OSError`` of the block counts as that too).
    """
    target = place_of(path)
    try:
        with beside(target) as temporary:
            yield temporary
            temporary.replace(target)
    except OSError as error:
        raise unwritable(path, error.strerror or str(error)) from error


def place_of(path: str | Path) -> Path:
    """Where a path leads, once it is known that a file may be put there.

    Raises:
        UsageError: something other than a file stands there.
    """
    target = Path(os.path.realpath(path))
    if os.path.exists(target) and not os.path.isfile(target):
        # A rename would put a plain file in the place of a device such as /dev/null.
        raise unwritable(path, "a folder" if os.path.isdir(target) else "something that is not a plain file")
    return target


def check_writable(path: str | Path) -> None:
    """Make sure that ``replacing`` will do, before there is much work for it; all stays as it is.

    Raises:
        UsageError: as ``replacing``.
    """
    target = place_of(path)
    try:
        with beside(target):
            pass
    except OSError as error:
        raise unwritable(path, error.strerror or str(error)) from error


def unwritable(path: str | Path, found: str, expected: str = "a file that can be written") -> UsageError:
    """The error for a place that cannot be written; its text is one line."""
    return UsageError(f"{path}: found {found}, expected {expected}")


@contextmanager
def made(folder: Path) -> Generator[None]:
    """Make a folder and its parents; when the block raises, those that were made and are empty go again."""
    new = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = "a file" if folder.is_file() else error.strerror or str(error)
        raise unwritable(folder, found, "a folder that can be written") from None
    try:
        yield
    except BaseException:
        for each in new:
            with suppress(OSError):
                each.rmdir()
        raise


def plain_file(path: Path, expected: str, limit: int) -> Path:
    """The path, once it is known to be a plain file of at most ``limit`` bytes (a pipe would never end)."""
    if os.path.isdir(path):
        raise InputError(path, "a folder", expected)
    if not os.path.lexists(path):
        raise InputError(path, "no such file", expected)
    if not os.path.isfile(path):
        raise InputError(path, "something that is not a plain file", expected)
    if os.path.getsize(path) > limit:
        raise InputError(path, f"more than {limit} bytes", expected)
    return path


def read_bytes(path: Path, expected: str, limit: int) -> bytes:
    """What a file holds, of at most ``limit`` bytes.

    Raises:
        InputError: it cannot be read, is no plain file, or longer.
    """
    try:
        return plain_file(path, expected, limit).read_bytes()
    except OSError as error:
        raise InputError(path, error.strerror or str(error), expected) from None


MAX_TEXT_BYTES = 1_000_000
"""Of a robot, a world or waypoints."""


def read_text(path: Path, expected: str) -> str:
    """The text of a short file (UTF-8); errors as of ``read_bytes``."""
    try:
        return read_bytes(path, expected, MAX_TEXT_BYTES).decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(path, "bytes that are not UTF-8 text", expected) from None


def shipped_names(folder: str) -> list[str]:
    """Names of the YAML files in a folder of the package."""
    inside = resources.files("echogrid") / folder
    return sorted(entry.name.removesuffix(".yaml") for entry in inside.iterdir() if entry.name.endswith(".yaml"))


def shipped_or_file(name_or_file: str | Path, folder: str, what: str) -> str:
    """The text of a YAML file that ships in a folder of the package, or of one of the user's.

    Args:
        name_or_file: the name of one that ships, or a path.
        folder: of the package.
        what: it describes, for messages: robot, world.

    Raises:
        InputError: the file cannot be read.
        UsageError: neither one that ships nor a file.
    """
    shipped = shipped_names(folder)
    if str(name_or_file) in shipped:
        return (resources.files("echogrid") / folder / f"{name_or_file}.yaml").read_text(encoding="utf-8")
    if not os.path.lexists(name_or_file):
        raise UsageError(f"{what}: found {name_or_file}, expected a file or one of {', '.join(shipped)}")
    return read_text(Path(name_or_file), f"a {what} file (YAML)")


def printable(path: Path) -> str:
    """The path as it may be shown on a terminal; a name with control characters is quoted."""
    return str(path) if str(path).isprintable() else repr(str(path))
