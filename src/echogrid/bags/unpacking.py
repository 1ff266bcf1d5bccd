"""Bags that are compressed, as a whole or within: unpacked within bounds, whatever they say of themselves."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from heapq import heappop, heappush
from itertools import chain
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.rosbag1 import reader as rosbag1
from rosbags.rosbag2 import Reader, storage_mcap

from echogrid.bags.recognising import METADATA
from echogrid.errors import InputError
from echogrid.files import printable, read_bytes
from echogrid.packed import (
    TooLongError,
    compression,
    compression_of,
    piece_limit,
    unpack,
    unpacked,
    unpacked_piece,
)
from echogrid.yaml_keys import refuse_bomb

MAX_CHUNK = 512 * 2**20
"""A chunk or message of a bag is at most so long (bytes) when it is unpacked."""

MAX_TOGETHER = 4 * MAX_CHUNK
"""Chunks of an MCAP that overlap in time are held together; so many bytes of them at most."""

type Recorded = tuple[Any, int, bytes]
"""Connection, time of recording (ns) and data of a message."""

_MAX_METADATA = 10_000_000
_OF_FILES = re.compile(r"""(["']?\bcompression_mode["']?\s*:\s*)(["']?)file\2""", re.IGNORECASE)


def unpacked_bag(path: Path, ending: str, stack: ExitStack) -> Path:
    """Where a bag lies that rosbags can open: itself, or unpacked until the stack is closed.

    Args:
        path: a file, or the folder of a ROS 2 bag with its metadata.
        ending: that of the unpacked file.
        stack: what closes the bag.

    Raises:
        InputError: it is damaged, becomes too long, or there is no room for it.
    """
    if path.is_file():
        return stack.enter_context(unpacked(path, f"bag{ending}")) if compression_of(path) else path
    metadata = read_bytes(path / METADATA, "the metadata of a bag", _MAX_METADATA).decode("utf-8", "replace")
    refuse_bomb(metadata, printable(path / METADATA))
    odd = [each for each in path.iterdir() if not os.path.isfile(each) and not os.path.isdir(each)]
    if odd:
        raise InputError(printable(odd[0]), "something that is not a plain file", "the files of a bag")
    if not _OF_FILES.search(metadata):
        return path
    # What rosbags would unpack itself has no bounds.
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="echogrid-", ignore_cleanup_errors=True)), "bag")
    folder.mkdir()
    for each in path.iterdir():
        if os.path.isfile(each) and each.name != METADATA:
            unpack(each, folder / each.name)
    (folder / METADATA).write_text(_OF_FILES.sub(r"\1''", metadata), encoding="utf-8")
    return folder


def let_go(bag: Path, path: Path) -> None:
    """Remove an unpacked bag that is open; where the system has it so, its room is free when it is closed.

    Even a process that is killed leaves nothing so.
    """
    if bag != path:
        shutil.rmtree(bag.parent, ignore_errors=True)


def as_they_were(messages: Iterator[Recorded]) -> Iterator[Recorded]:
    """Messages of a bag of ROS 2, unpacked if the first is compressed: none in CDR begins so.

    Raises:
        TooLongError: one becomes too long.
    """
    first = next(messages, None)
    if first is None:
        return messages
    every = chain([first], messages)
    return map(_unpacked, every) if _is_zstd(first[2]) else every


def _is_zstd(data: bytes) -> bool:
    return compression(data[:6]) == "zstd"


def _unpacked(message: Recorded) -> Recorded:
    connection, time, data = message
    limit = piece_limit(len(data), MAX_CHUNK)
    return connection, time, unpacked_piece(data, "zstd", limit) if _is_zstd(data) else data


def chunk_of_ros1(data: bytes, decompressor: Callable[[bytes], bytes]) -> bytes:
    """What the chunk of a bag of ROS 1 becomes.

    Raises:
        TooLongError: it becomes too long.
    """
    kind = _OF_ROS1.get(decompressor)
    return unpacked_piece(data, kind, piece_limit(len(data), MAX_CHUNK)) if kind else data


_OF_ROS1 = {rosbag1.decompressors["bz2"]: "bzip2", rosbag1.decompressors["lz4"]: "lz4"}


def bound(reader: Reader) -> None:
    """See to it that an open bag of ROS 2 is read within bounds.

    Raises:
        TooLongError: a chunk becomes too long, or those of one time together.
    """
    # Messages are unpacked here, where there is a limit.
    reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
    for storage in getattr(reader.storage, "storages", [reader.storage]):
        together, ends = 0, []
        for chunk in sorted(getattr(storage, "chunks", ()), key=attrgetter("message_start_time")):
            size = chunk.uncompressed_size
            if chunk.compression and size > piece_limit(chunk.compressed_size, MAX_CHUNK):
                raise TooLongError(f"a chunk of {chunk.compressed_size} bytes that becomes {size}")
            while ends and ends[0][0] < chunk.message_start_time:
                together -= heappop(ends)[1]
            heappush(ends, (chunk.message_end_time, size))
            together += size
            if together > MAX_TOGETHER:
                raise TooLongError(f"chunks of one time that become more than {MAX_TOGETHER} bytes")


def _chunk_of_mcap(kind: str) -> Callable[[bytes, int], bytes]:
    def decompress(data: bytes, size: int) -> bytes:
        if size > piece_limit(len(data), MAX_CHUNK):
            raise TooLongError(f"a chunk of {len(data)} bytes that becomes {size}")
        return unpacked_piece(data, kind, size)

    return decompress


# The library unpacks a chunk of MCAP whole before it looks at how long the chunk says that it is.
storage_mcap.DECOMPRESSORS.update({kind: _chunk_of_mcap(kind) for kind in ("lz4", "zstd")})
