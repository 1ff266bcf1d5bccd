"""Bags of ROS 1 and ROS 2 as files: opening them, their topics and messages, finding damage."""

from collections.abc import Collection, Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.rosbag2 import Reader

from echogrid.bags.message_types import Types
from echogrid.bags.recognising import METADATA, ending_of, files_of
from echogrid.bags.ros1_stream import StreamedBag
from echogrid.bags.unpacking import as_they_were, bound, let_go, unpacked_bag
from echogrid.errors import EchogridError, InputError
from echogrid.files import printable
from echogrid.packed import TooLongError, compression_of

_MENDS = {
    ".bag": "; rosbag reindex may mend it",
    ".mcap": "; mcap recover may mend it",
    ".db3": "; .recover of sqlite3 may mend it",
}
"""What helps a bag that is cut off, by the end of its name."""

_FOREIGN = ("jsonschema", "protobuf", "ros1msg", "flatbuffer")
"""Encodings of an MCAP that the library does not know."""


class Topic(NamedTuple):
    """A topic in a bag."""

    name: str
    type: str
    """As ROS 2 writes it: ``sensor_msgs/msg/Range``."""
    messages: int

    def __str__(self) -> str:
        return f"{self.name} ({self.type if self.messages else 'without messages'})"


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
        ending = None if path.is_dir() else ending_of(path)
        if ending and path.suffix != ending and not compression_of(path):
            found = f"a bag that begins like {ending} and ends in {path.suffix or 'nothing'}"
            raise InputError(self.name, found, f"{ending} at the end of its name")
        files = files_of(path) if path.is_dir() else [path]
        if path.is_dir() and not (path / METADATA).is_file():
            names = ", ".join(printable(each) for each in files[:6])
            raise InputError(self.name, f"a folder without {METADATA}", f"one, or a file alone: {names}")
        if path.is_file() and ending is None:
            found = "a file that does not begin like a bag" if path.stat().st_size else "an empty file"
            raise InputError(self.name, found, f"a {path.suffix} file as it was recorded")
        ros1 = ending == ".bag"
        self._mend = next((_MENDS[each.suffix] for each in files if each.suffix in _MENDS), "")
        self._ros1 = ros1
        with ExitStack() as stack, self._damage():
            bag = unpacked_bag(path, ending or "", stack)
            self._reader = StreamedBag(bag) if ros1 else Reader(bag)
            self._reader.open()
            stack.callback(self._reader.close)
            let_go(bag, path)
            if isinstance(self._reader, Reader):
                bound(self._reader)
            self._connections = list(self._reader.connections)
            self._open = stack.pop_all()
        self._types = Types(self.name, ros1)

    def __enter__(self) -> "BagFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @contextmanager
    def _damage(self) -> Generator[None]:
        # The libraries below let out errors of many kinds for files that are cut off or overwritten.
        try:
            yield
        except TooLongError as error:
            found, expected = f"a bag with {error}", "one that does not grow so much when it is unpacked"
            raise InputError(self.name, found, expected) from None
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
            counts[key] = counts.get(key, 0) + each.msgcount
        return [Topic(name, kind, count) for (name, kind), count in sorted(counts.items())]

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of some topics, in the order in which they were recorded."""
        wanted = [each for each in self._connections if each.topic in topics and each.msgcount]
        if not wanted:
            return
        with self._damage():
            decoders = {(each.id, each.topic): self._types.decoder(each) for each in wanted}
            messages = self._reader.messages(wanted)
            for connection, time, data in messages if self._ros1 else as_they_were(messages):
                kind = connection.msgtype
                content = decoders[connection.id, connection.topic](data, kind)
                yield Message(connection.topic, kind, time * 1e-9, content)
