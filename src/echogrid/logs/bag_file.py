"""Bags of ROS 1 and ROS 2 as files: opening them, decoding messages of the types that are needed, finding damage."""

import os
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from echogrid.errors import EchogridError, InputError
from echogrid.logs.lines import printable
from echogrid.ros.messages import CLOUD, CLOUD2, ODOMETRY, RANGE, SONAR_ARRAY, TF, TF_OLD, RangeSaid

MAGIC = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
"""How the files begin, and how their names must end."""

_METADATA = "metadata.yaml"
"""What the folder of a ROS 2 bag holds beside the files with the messages."""

_SIZE = Struct("<L").unpack_from
_TIME = Struct("<LL").unpack_from

_MESSAGE = 2
"""Operation code of a record with a message."""

MAX_CHUNK = 512 * 2**20
"""A longer chunk (bytes) is a broken one."""


_RANGE_FIELDS = ["header", "radiation_type", "field_of_view", "min_range", "max_range", "range"]
_HEAD_1, _HEAD_2 = Struct("<IIII").unpack_from, Struct("<iII").unpack_from
_NUMBERS, _NUMBERS_BIG, _HEAD_BIG = (
    Struct("<ffff").unpack_from,
    Struct(">ffff").unpack_from,
    Struct(">iII").unpack_from,
)


def _range_of_ros1(data: bytes, _: str) -> RangeSaid:
    """A sensor_msgs/Range of ROS 1. Nearly all messages are of this type; the general decoder takes five times as
    long.
    """
    _, sec, nanosec, length = _HEAD_1(data)
    end = 16 + length
    return RangeSaid(sec + nanosec * 1e-9, str(data[16:end], "utf-8"), *_NUMBERS(data, end + 1))


def _range_of_cdr(data: bytes, _: str) -> RangeSaid:
    """Likewise of ROS 2, in CDR of either byte order."""
    little = data[1] & 1
    sec, nanosec, length = _HEAD_2(data, 4) if little else _HEAD_BIG(data, 4)
    end = 16 + length
    # Behind a byte the floats are aligned to four, counted from behind the head of four.
    numbers = _NUMBERS(data, (end + 4) & ~3) if little else _NUMBERS_BIG(data, (end + 4) & ~3)
    return RangeSaid(sec + nanosec * 1e-9, str(data[16 : end - 1], "utf-8"), *numbers)


_HEADER = ("header.stamp.sec", "header.stamp.nanosec", "header.frame_id")
_PLACE = ("x", "y", "z")
_TRANSFORM = (
    *_HEADER,
    "child_frame_id",
    *(f"transform.translation.{axis}" for axis in _PLACE),
    *(f"transform.rotation.{axis}" for axis in (*_PLACE, "w")),
)
_FIELDS = {
    RANGE: (*_HEADER, "field_of_view", "min_range", "max_range", "range"),
    SONAR_ARRAY: (*_HEADER, "ranges[]"),
    CLOUD: (*_HEADER, "points[].x", "points[].y"),
    CLOUD2: (
        *(*_HEADER, "height", "width", "fields[].name", "fields[].offset", "fields[].datatype"),
        *("is_bigendian", "point_step", "data[]"),
    ),
    TF: tuple(f"transforms[].{field}" for field in _TRANSFORM),
    TF_OLD: tuple(f"transforms[].{field}" for field in _TRANSFORM),
    ODOMETRY: (
        *(*_HEADER, "child_frame_id"),
        *(f"pose.pose.position.{axis}" for axis in _PLACE),
        *(f"pose.pose.orientation.{axis}" for axis in (*_PLACE, "w")),
    ),
}
"""Fields that are read of each type; a bag brings its own definitions, which may be damaged or of another time."""

_TEXTS = ("frame_id", "child_frame_id", "name")
"""Last parts of those fields that are texts; all others are numbers."""

_MENDS = {
    ".bag": "; rosbag reindex may mend it",
    ".mcap": "; mcap recover may mend it",
    ".db3": "; .recover of sqlite3 may mend it",
}
"""What helps a bag that is cut off, by the end of its name."""

_FOREIGN = ("jsonschema", "protobuf", "ros1msg", "flatbuffer")
"""Encodings of an MCAP that the library does not know."""

_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""Definition of both TFMessages, for bags that lack their own."""


def recognises(path: Path) -> bool:
    """Whether there is a bag: a file that begins or ends like one, or a folder with the metadata or files of one."""
    if os.path.isdir(path):
        return os.path.isfile(path / _METADATA) or bool(_files(path))
    return _ending(path) is not None or (path.suffix in MAGIC.values() and os.path.isfile(path))


def _files(folder: Path) -> list[Path]:
    """The bags in a folder."""
    try:
        return sorted(each for each in folder.iterdir() if each.suffix in MAGIC.values())
    except OSError:
        return []


def _ending(path: Path) -> str | None:
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except (OSError, ValueError):  # a name that cannot be is told by whoever takes it for a text
        return None
    return next((ending for magic, ending in MAGIC.items() if head.startswith(magic)), None)


class Topic(NamedTuple):
    """A topic in a bag."""

    name: str
    type: str
    """As ROS 2 writes it: ``sensor_msgs/msg/Range``."""
    messages: int


class Message(NamedTuple):
    """A message in a bag."""

    topic: str
    type: str
    received: float
    """When it was recorded, s."""
    content: Any
    """The message, its fields by their names; a RangeSaid for a Range."""


class BagFile:
    """An open bag; to be used in a ``with`` block.

    Raises:
        InputError: it is not a bag, or a damaged one; so do its methods.
    """

    def __init__(self, path: Path):
        """Open a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag."""
        self.name = printable(path)
        ending = None if path.is_dir() else _ending(path)
        if ending and path.suffix != ending:
            found = f"a bag that begins like {ending} and ends in {path.suffix or 'nothing'}"
            raise InputError(self.name, found, f"{ending} at the end of its name")
        files = _files(path) if path.is_dir() else [path]
        if path.is_dir() and not (path / _METADATA).is_file():
            names = ", ".join(printable(each) for each in files[:6])
            raise InputError(self.name, f"a folder without {_METADATA}", f"one, or a file alone: {names}")
        if path.is_file() and ending is None:
            found = "a file that does not begin like a bag" if path.stat().st_size else "an empty file"
            raise InputError(self.name, found, f"a {path.suffix} file as it was recorded")
        self._first = ending == ".bag"
        self._mend = next((_MENDS[each.suffix] for each in files if each.suffix in _MENDS), "")
        with self._damage():
            self._reader = _StreamedBag(path) if self._first else Reader2(path)
            self._reader.open()
            self._connections = list(self._reader.connections)
        self._stores: dict[str, Typestore] = {}

    def __enter__(self) -> "BagFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @contextmanager
    def _damage(self) -> Generator[None]:
        # The libraries below let out errors of many kinds for files that are cut off or overwritten.
        try:
            yield
        except (EchogridError, PermissionError):
            raise
        except Exception as error:
            if isinstance(error, KeyError) and error.args[0] in _FOREIGN:
                found = f"channels of {error.args[0]} in an MCAP"
                raise InputError(self.name, found, "messages of ROS 2 alone (mcap filter)") from None
            said = " ".join(str(error).replace(f" {self.name}", "").split())[:120] or type(error).__name__
            if isinstance(error, MemoryError):  # a length that cannot be true
                said = "a record too long for the memory"
            raise InputError(
                self.name, f"a bag that is cut off or damaged ({said})", f"a whole one{self._mend}"
            ) from None

    def topics(self) -> list[Topic]:
        """All topics, by their names."""
        counts: dict[tuple[str, str], int] = {}
        for each in self._connections:
            key = each.topic, each.msgtype
            counts[key] = counts.get(key, 0) + self._count(each)
        return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]

    def _count(self, connection: Connection) -> int:
        if isinstance(self._reader, _StreamedBag):
            return sum(chunk.connection_counts.get(connection.id, 0) for chunk in self._reader.chunk_infos)
        return connection.msgcount

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of some topics, in the order in which they were recorded."""
        wanted = [each for each in self._connections if each.topic in topics and self._count(each)]
        if not wanted:
            return
        decoders = {}
        with self._damage():
            for each in wanted:
                decoders[each.id, each.topic] = self._decoder(each)
            for connection, time, data in self._reader.messages(wanted):
                kind = connection.msgtype
                content = decoders[connection.id, connection.topic](data, kind)
                yield Message(connection.topic, kind, time * 1e-9, content)

    def _decoder(self, connection: Connection) -> Callable[[bytes, str], Any]:
        store, kind = self._store(connection), connection.msgtype
        if kind != RANGE:
            return store.deserialize_ros1 if self._first else store.deserialize_cdr
        fields = [name for name, _ in store.fielddefs[RANGE][1]]
        if fields[: len(_RANGE_FIELDS)] == _RANGE_FIELDS:
            return _range_of_ros1 if self._first else _range_of_cdr
        decode = store.deserialize_ros1 if self._first else store.deserialize_cdr
        return lambda data, kind: RangeSaid.of(decode(data, kind))

    def _store(self, connection: Connection) -> Typestore:
        """The types of a connection: as the bag defines them, else as they are known."""
        kind = connection.msgtype
        if kind not in self._stores:
            definition, form = connection.msgdef.data, connection.msgdef.format
            if form == MessageDefinitionFormat.NONE:
                store = get_typestore(Stores.ROS1_NOETIC if self._first else Stores.ROS2_HUMBLE)
                if kind in (TF, TF_OLD) and kind not in store.types:
                    store.register(get_types_from_msg(_TRANSFORMS, kind))
            else:
                store = get_typestore(Stores.EMPTY)
                if form == MessageDefinitionFormat.MSG:
                    store.register(get_types_from_msg(definition, kind))
                else:
                    for part in definition.split("=" * 80 + "\n"):
                        text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
                        if text.strip():
                            store.register(get_types_from_idl(text))
            missing = [field for field in _FIELDS.get(kind, ()) if not _has(store, kind, field)]
            if missing:
                raise InputError(self.name, f"a definition of {kind} without {missing[0]}", "that of ROS")
            self._stores[kind] = store
        return self._stores[kind]


def _has(store: Typestore, kind: str, field: str) -> bool:
    """Whether a type has a field, of the kind that is needed."""
    for name in field.split("."):
        if kind not in store.fielddefs:
            return False
        node: Any = dict(store.fielddefs[kind][1]).get(name.removesuffix("[]"))
        if node is None:
            return False
        many = node[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)
        if many is not name.endswith("[]"):
            return False
        form, inner = node[1][0] if many else node
        kind = inner if form == Nodetype.NAME else inner[0]
    if field.split(".")[-1] in _TEXTS:
        return kind == "string"
    return kind.rstrip("0123456789") in ("int", "uint", "float", "bool")


class _StreamedBag(Reader):
    """A bag of ROS 1 whose messages are read in the order of their time, in memory of a few chunks.

    The index of rosbags, which holds every message, would fill the memory.
    """

    def read_index_data(self, pos: int, indexes: dict) -> None:
        """Pass over the index of a chunk."""

    def messages(  # ty: ignore[incompatible-method-override]
        self, connections: Collection[Connection] = ()
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Messages of some connections: connection, time of receipt (ns), data.

        Raises:
            ReaderError: the bag is damaged.
        """
        wanted = {each.id: each for each in connections or self.connections}
        chunks = sorted(
            (chunk for chunk in self.chunk_infos if not wanted.keys().isdisjoint(chunk.connection_counts)),
            key=lambda chunk: chunk.start_time,
        )
        held: list[tuple[int, int, bytes]] = []
        for chunk in chunks:
            # What is older than all that is still to be read can go.
            ready = [each for each in held if each[0] < chunk.start_time]
            held = [each for each in held if each[0] >= chunk.start_time]
            for time, number, data in ready:
                yield wanted[number], time, data
            held.extend(self._of_chunk(chunk.pos, wanted))
            held.sort(key=itemgetter(0))
        for time, number, data in held:
            yield wanted[number], time, data

    def _of_chunk(self, position: int, wanted: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        chunk, file = self.chunks[position], self.bio
        if file is None or chunk.datasize > MAX_CHUNK:
            raise ReaderError("a chunk that is too long")
        file.seek(chunk.datapos)
        data = chunk.decompressor(file.read(chunk.datasize))
        place, end = 0, len(data)
        while place < end:
            head = place + 4
            body = head + _SIZE(data, place)[0]
            place = body + 4 + _SIZE(data, body)[0]
            if place > end:
                raise ReaderError("a record that ends outside of its chunk")
            values: dict[bytes, int] = {}
            while head < body:
                sign = data.index(b"=", head + 4)
                values[data[head + 4 : sign]] = sign + 1
                head += 4 + _SIZE(data, head)[0]
            if data[values[b"op"]] != _MESSAGE:
                continue
            (number,) = _SIZE(data, values[b"conn"])
            if number in wanted:
                sec, nsec = _TIME(data, values[b"time"])
                yield sec * 10**9 + nsec, number, data[body + 4 : place]
