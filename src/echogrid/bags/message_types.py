"""Types of the messages in a bag: as it defines them, checked for what is read of them, and their decoders."""

from collections.abc import Callable
from struct import Struct
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from echogrid.errors import InputError
from echogrid.ros.messages import CLOUD, CLOUD2, ODOMETRY, RANGE, SONAR_ARRAY, TF, TF_OLD, RangeSaid

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

_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""Definition of both TFMessages, for bags that lack their own."""


class Types:
    """The types of a bag's messages."""

    def __init__(self, name: str, ros1: bool):
        """Of the bag that messages call ``name``; of ROS 1 or of ROS 2."""
        self._name, self._ros1 = name, ros1
        self._stores: dict[str, Typestore] = {}

    def decoder(self, connection: Connection) -> Callable[[bytes, str], Any]:
        """What makes messages of a connection of their bytes and the name of their type; RangeSaid of a Range.

        Raises:
            InputError: the bag defines a type without a field that is read.
        """
        kind = connection.msgtype
        store = self._stores.get(kind) or self._defined(connection)
        missing = [field for field in _FIELDS.get(kind, ()) if not _has(store, kind, field)]
        if missing:
            raise InputError(self._name, f"a definition of {kind} without {missing[0]}", "that of ROS")
        self._stores[kind] = store
        decode = store.deserialize_ros1 if self._ros1 else store.deserialize_cdr
        if kind != RANGE:
            return decode
        fields = [name for name, _ in store.fielddefs[RANGE][1]]
        if fields[: len(_RANGE_FIELDS)] == _RANGE_FIELDS:
            return _range_of_ros1 if self._ros1 else _range_of_cdr
        return lambda data, kind: RangeSaid.of(decode(data, kind))

    def _defined(self, connection: Connection) -> Typestore:
        """The types of a connection: as the bag defines them, else as they are known."""
        kind, (form, definition) = connection.msgtype, connection.msgdef
        if form == MessageDefinitionFormat.NONE:
            store = get_typestore(Stores.ROS1_NOETIC if self._ros1 else Stores.ROS2_HUMBLE)
            if kind in (TF, TF_OLD) and kind not in store.types:
                store.register(get_types_from_msg(_TRANSFORMS, kind))
            return store
        store = get_typestore(Stores.EMPTY)
        if form == MessageDefinitionFormat.MSG:
            store.register(get_types_from_msg(definition, kind))
            return store
        for part in definition.split("=" * 80 + "\n"):
            text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            if text.strip():
                store.register(get_types_from_idl(text))
        return store


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


_RANGE_FIELDS = ["header", "radiation_type", "field_of_view", "min_range", "max_range", "range"]
"""How a definition of a Range begins whose messages can be read at fixed places."""

_HEAD_1, _HEAD_2 = Struct("<IIII").unpack_from, Struct("<iII").unpack_from
_HEAD_BIG, _NUMBERS, _NUMBERS_BIG = (Struct(form).unpack_from for form in (">iII", "<ffff", ">ffff"))


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
