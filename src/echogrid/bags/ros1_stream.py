"""Bags of ROS 1, read in the order of time and in bounded memory."""

from collections import Counter
from collections.abc import Collection, Iterator
from operator import itemgetter
from struct import Struct
from typing import NamedTuple

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader, ReaderError

from echogrid.bags.unpacking import MAX_CHUNK, chunk_of_ros1

_SIZE = Struct("<L").unpack_from
_TIME = Struct("<LL").unpack_from

_MESSAGE = 2
"""Operation code of a record with a message."""


class _Layout(NamedTuple):
    """Where the fields stand in the head of a message: whoever writes a bag writes them alike in all."""

    conn: int
    time: int
    """Where the values begin, counted from the beginning of the head."""
    parts: tuple[tuple[int, int, bytes], ...]
    """What stands before, between and behind the two: begin, end, and bytes, the operation code among them."""

    @staticmethod
    def of(data: bytes, head: int, body: int, values: dict[bytes, int]) -> "_Layout":
        """That of the head of a message, between two places, whose values begin where ``_places`` says."""
        conn, time = values[b"conn"] - head, values[b"time"] - head
        one, other = sorted([(conn, conn + 4), (time, time + 8)])
        parts = ((0, one[0]), (one[1], other[0]), (other[1], body - head))
        return _Layout(conn, time, tuple((begin, end, data[head + begin : head + end]) for begin, end in parts))

    def fits(self, data: bytes, head: int, body: int) -> bool:
        """Whether the head between two places is of this layout, and of a message."""
        (_, one, first), (two, three, second), (four, five, third) = self.parts
        return (
            body - head == five
            and data[head : head + one] == first
            and data[head + two : head + three] == second
            and data[head + four : body] == third
        )


def _places(data: bytes, head: int, body: int) -> dict[bytes, int]:
    """Where the value of each field begins in a head between two places."""
    values: dict[bytes, int] = {}
    while head < body:
        sign = data.index(b"=", head + 4)
        values[data[head + 4 : sign]] = sign + 1
        head += 4 + _SIZE(data, head)[0]
    return values


class StreamedBag(Reader):
    """A bag of ROS 1 whose messages are read in the order of their time, in memory of a few chunks.

    The index of rosbags, which holds every message, would fill the memory.
    """

    def open(self) -> None:
        """Open the bag; what its connections hold is counted from the heads of its chunks.

        Raises:
            ReaderError: it is damaged.
        """
        super().open()
        counts = Counter[int]()
        for chunk in self.chunk_infos:
            counts.update(chunk.connection_counts)
        self.connections = [each._replace(msgcount=counts[each.id]) for each in self.connections]

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
        data = chunk_of_ros1(file.read(chunk.datasize), chunk.decompressor)
        place, end = 0, len(data)
        layout: _Layout | None = None
        while place < end:
            head = place + 4
            body = head + _SIZE(data, place)[0]
            place = body + 4 + _SIZE(data, body)[0]
            if place > end:
                raise ReaderError("a record that ends outside of its chunk")
            if layout is None or not layout.fits(data, head, body):
                values = _places(data, head, body)
                if data[values[b"op"]] != _MESSAGE:
                    continue
                layout = _Layout.of(data, head, body, values)
            (number,) = _SIZE(data, head + layout.conn)
            if number in wanted:
                sec, nsec = _TIME(data, head + layout.time)
                yield sec * 10**9 + nsec, number, data[body + 4 : place]
