"""Compressed files: told by how they begin, and unpacked on the way, within bounds.

A few bytes can be made to unpack to any number of them, so nothing here is unpacked without a limit.
"""

import bz2
import gzip
import io
import shutil
import sys
import zlib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import override

from echogrid.errors import EchogridError, InputError
from echogrid.files import printable

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MOST_TIMES = 200
"""A log becomes at most so many times as long when it is unpacked, where it is long at all."""

SHORT_TEXT_BYTES, SHORT_BAG_BYTES = 2**26, 2**30
"""What a log of text, or a bag, may always become."""

_KEPT_FREE_BYTES = 2**28
"""What unpacking leaves free on the disk."""

_BEGINNINGS = {b"\x1f\x8b": "gzip", b"\x28\xb5\x2f\xfd": "zstd", b"BZh": "bzip2"}
_FOREIGN = {
    b"PK\x03\x04": ("zip", "unzip"),
    b"\x04\x22\x4d\x18": ("lz4", "lz4 -d"),
    b"\xfd7zXZ\0": ("xz", "xz -d"),
    b"7z\xbc\xaf": ("7-Zip", "7z x"),
}
_OPENERS = {"gzip": gzip.open, "zstd": zstd.open, "bzip2": bz2.open}


def compression(head: bytes) -> str | None:
    """How a file that begins with these bytes (6 or more) is compressed, if it is in a way that can be read."""
    return next((kind for magic, kind in _BEGINNINGS.items() if head.startswith(magic)), None)


def compression_of(path: Path) -> str | None:
    """How a file is compressed; None too where there is none."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return compression(file.read(6))


@contextmanager
def opened(path: Path, short: int = SHORT_TEXT_BYTES) -> Generator[io.BufferedIOBase]:
    """A plain file to be read; one that is compressed is unpacked as it is read.

    Args:
        path: the file.
        short: what it may always become, bytes; a longer one may become MOST_TIMES as long as it is.

    Raises:
        InputError: it is compressed in a way that is not read, cut off, damaged, or becomes longer; the last
            three as it is read.
        OSError: it cannot be opened.
    """
    with path.open("rb") as file:
        head = file.read(6)
        file.seek(0)
        for magic, (kind, tool) in _FOREIGN.items():
            if head.startswith(magic):
                found, wanted = f"a file compressed by {kind}", f"the log in it ({tool} unpacks it)"
                raise InputError(printable(path), found, wanted)
        kind = compression(head)
        if kind is None:
            yield file
            return
        limit = max(short, MOST_TIMES * path.stat().st_size)
        with io.BufferedReader(_Unpacking(file, kind, printable(path), limit), 2**17) as unpacked:
            yield unpacked


@contextmanager
def unpacked(path: Path, name: str) -> Generator[Path]:
    """What a compressed file holds, as a file of this name that is gone when the block ends.

    Raises:
        InputError: as for ``opened``, or there is no room for it.
    """
    with TemporaryDirectory(prefix="echogrid-", ignore_cleanup_errors=True) as folder:
        unpack(path, Path(folder, name))
        yield Path(folder, name)


def unpack(path: Path, target: Path) -> None:
    """Write what a compressed file holds to another; errors as for ``unpacked``."""
    room = shutil.disk_usage(target.parent).free - _KEPT_FREE_BYTES
    try:
        with opened(path, SHORT_BAG_BYTES) as source, target.open("wb") as file:
            while piece := source.read(2**20):
                room -= len(piece)
                if room < 0:
                    found = f"too little room in {target.parent.parent} to unpack it"
                    raise InputError(printable(path), found, "more (TMPDIR names another folder), or it unpacked")
                file.write(piece)
    except OSError as error:
        raise InputError(printable(path), error.strerror or str(error), "room to unpack it") from None


class _Unpacking(io.RawIOBase):
    """The bytes that a compressed file becomes, up to a limit."""

    def __init__(self, file: io.BufferedIOBase, kind: str, name: str, limit: int):
        self._inner = _OPENERS[kind](file, "rb")
        self._kind, self._name, self._limit, self._left = kind, name, limit, limit

    @override
    def readable(self) -> bool:
        return True

    @override
    def readinto(self, buffer) -> int:
        try:
            piece = self._inner.read(len(buffer))
        except (OSError, EOFError, ValueError, zlib.error, zstd.ZstdError):
            found = f"a file compressed by {self._kind} that is cut off or damaged"
            raise InputError(self._name, found, "a whole one") from None
        self._left -= len(piece)
        if self._left < 0:
            found = f"a file compressed by {self._kind} that becomes more than {self._limit // 10**6} MB"
            raise InputError(self._name, found, "a log that does not grow so much, or it unpacked")
        buffer[: len(piece)] = piece
        return len(piece)

    @override
    def close(self) -> None:
        self._inner.close()
        super().close()


class TooLongError(EchogridError):
    """A piece of a file becomes longer than it says, or than it may."""


def piece_limit(size: int, most: int) -> int:
    """What a compressed piece of a file of so many bytes may become: at most ``most``, and always 64 MB."""
    return min(most, max(2**26, MOST_TIMES * size))


def unpacked_piece(data: bytes, kind: str, limit: int) -> bytes:
    """What a compressed piece of a file becomes: by ``zstd``, ``bzip2`` or ``lz4``.

    Raises:
        TooLongError: more than ``limit`` bytes.
        EOFError: it is cut off. The decompressors raise errors of their own for damaged ones.
    """
    if kind == "zstd":
        declared = zstd.get_frame_info(data[:18]).decompressed_size
        if declared is not None and declared > limit:
            raise TooLongError(f"a part of {len(data)} bytes that becomes {declared}")
    out, length = [], 0
    while data:
        unpacker = _unpacker(kind)
        while not unpacker.eof:
            piece = unpacker.decompress(data, max_length=limit + 1 - length)
            out.append(piece)
            length += len(piece)
            if length > limit:
                raise TooLongError(f"a part of {len(data)} bytes that becomes more than {limit}")
            if not unpacker.eof and unpacker.needs_input:
                raise EOFError("a part that is cut off")
            data = b""
        data = unpacker.unused_data or b""
    return out[0] if len(out) == 1 else b"".join(out)


def _unpacker(kind: str):
    if kind == "zstd":
        return zstd.ZstdDecompressor()
    if kind == "bzip2":
        return bz2.BZ2Decompressor()
    from lz4.frame import LZ4FrameDecompressor

    return LZ4FrameDecompressor()
