"""NPZ archives from strangers: opened within bounds, any damage told in one line."""

import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from echogrid.errors import EchogridError, InputError
from echogrid.files import plain_file

MOST_TIMES, SHORT_BYTES = 500, 2**28
"""An archive becomes at most so many times as long when it is unpacked, and may always become so long."""


@contextmanager
def open_npz(path: Path, expected: str, limit: int) -> Generator[np.lib.npyio.NpzFile]:
    """The arrays of an NPZ file, read as they are asked for; any damage met on the way is an InputError.

    Args:
        path: the file.
        expected: what it ought to be, for messages.
        limit: of its length, as it lies there and unpacked, bytes.

    Raises:
        InputError: no plain file, no archive, damaged, or too long.
    """
    try:
        with open(plain_file(path, expected, limit), "rb") as file:
            _check_archive(file, path, expected, limit)
            with np.load(file, allow_pickle=False) as arrays:
                yield arrays
    except EchogridError:
        raise
    except OSError as error:
        raise InputError(path, error.strerror or str(error), expected) from None
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for a damaged file
        reason = str(error) or type(error).__name__
        raise InputError(path, f"an archive that cannot be read ({reason})", expected) from None


def _check_archive(file: BinaryIO, path: Path, expected: str, limit: int) -> None:
    """Refuse what is no archive at all, and one that would fill the memory; leaves the file at its start.

    What an archive says of itself is enough: zipfile gives no more bytes of a member than are declared.
    """
    if not zipfile.is_zipfile(file):
        raise InputError(path, "a file that is not an NPZ archive", expected)
    with zipfile.ZipFile(file) as archive:
        declared = sum(member.file_size for member in archive.infolist())
    if declared > min(limit, max(SHORT_BYTES, MOST_TIMES * path.stat().st_size)):
        raise InputError(path, f"an archive that becomes {declared:.1e} bytes when unpacked", expected)
    file.seek(0)
