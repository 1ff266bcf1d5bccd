from dataclasses import replace

import numpy as np
import pytest
from numpy import inf

dds_types = pytest.importorskip("echogrid.live.dds_types", reason="found no cyclonedds")
from cyclonedds.idl import IdlStruct  # noqa: E402
from cyclonedds.idl._support import Endianness  # noqa: E402


def grid_message(cells):
    stamp = dds_types.Time(5, 6)
    origin = dds_types.Pose(dds_types.Point(1.0, 2.0, 0.0), dds_types.Quaternion(0.0, 0.0, 0.0, 1.0))
    info = dds_types.MapMetaData(stamp, 0.05, cells.shape[1], cells.shape[0], origin)
    return dds_types.OccupancyGrid(dds_types.Header(stamp, "map"), info, cells.ravel())


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (3, 5), (40, 30)])
def test_a_map_is_written_fast_as_it_would_be_slowly(shape):
    message = grid_message(np.random.default_rng(1).integers(-1, 101, shape).astype(np.int8))
    slow = IdlStruct.serialize(replace(message, data=message.data.tolist()))
    assert message.serialize() == slow
    assert dds_types.OccupancyGrid.deserialize(slow).data == message.data.tolist()


def range_message(kind, *more):
    header = dds_types.Header(dds_types.Time(1, 2), "sonar_1")
    return kind(header, 0, 0.5, 0.25, 5.0, 1.5, *more)


def test_a_range_reads_the_message_of_later_releases():
    new = range_message(dds_types.RangeWithVariance, 0.01).serialize()
    assert dds_types.Range.deserialize(new) == range_message(dds_types.Range)


def transforms(*names):
    place = dds_types.Transform(dds_types.Vector3(1.0, -2.5, 3.0), dds_types.Quaternion(0.1, 0.2, 0.3, 0.4))
    each = [
        dds_types.TransformStamped(dds_types.Header(dds_types.Time(-7, 8), parent), child, place)
        for parent, child in names
    ]
    return dds_types.TFMessage(each)


@pytest.mark.parametrize("length", range(9))
def test_what_comes_most_is_read_fast_as_it_would_be_slowly(length):
    """The gaps before numbers are of every length; half a message is refused."""
    names = [("odom"[: length % 4 + 1], "ä" * length), ("", "base_link"[:length])]
    ranges = dds_types.Range(dds_types.Header(dds_types.Time(-1, 2**32 - 1), "s" * length), 1, 0.5, 0.25, 5.0, inf)
    for message in (transforms(), transforms(*names), ranges):
        kind, data = type(message), message.serialize()
        assert kind.deserialize(data) == message
        assert isinstance(kind.deserialize(data[:-1]), dds_types.Refused)
        big = message.serialize(endianness=Endianness.Big)
        assert kind.deserialize(big) == message


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"\0\1\0\0" + b"\xff" * 100, "a message that cannot be decoded"),
        (
            range_message(dds_types.Range).serialize().replace(b"sonar_1", b"\xff\xfe\xfdnar1"),
            "a message that cannot be decoded",
        ),
        (bytes(dds_types.MAX_MESSAGE_BYTES + 1), "a message that is too long"),
    ],
)
def test_what_cannot_be_decoded_is_refused_and_not_raised(data, reason):
    assert dds_types.Range.deserialize(data).reason == reason
