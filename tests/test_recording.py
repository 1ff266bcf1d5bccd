"""A recording says the same to rosbags and to the mcap library as the frames and the map it was made of."""

import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import rosbags.rosbag2
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from echogrid.errors import UsageError
from echogrid.geometry import wrap
from echogrid.grid import Grid
from echogrid.log import Frame
from echogrid.mapfile import occupancy
from echogrid.recording import MAP_PERIOD_S, MAX_MAP_CELLS, MAX_MAPS, Pace, Recorder, _ros_time, _stored
from echogrid.robot import Robot

ROBOT = Robot.load("b21")
START = 1_700_000_000.25


def a_grid(rows=7, cols=11, seed=0):
    rng = np.random.default_rng(seed)
    observed = rng.random((rows, cols)) < 0.7
    return Grid(rng.normal(0, 3, (rows, cols)).astype(np.float32), observed, 0.12, (-1.5, 2.25))


def a_drive(count=30, seed=0, moving_from=None):
    rng = np.random.default_rng(seed)
    for i in range(count):
        ranges = rng.uniform(ROBOT.min_range_m, ROBOT.max_range_m, ROBOT.sonars)
        ranges[rng.random(ROBOT.sonars) < 0.2] = np.inf
        ranges[rng.random(ROBOT.sonars) < 0.2] = np.nan
        mounts = None
        if moving_from is not None and i >= moving_from:
            mounts = ROBOT.mounts + rng.normal(0, 0.01, ROBOT.mounts.shape)
        pose = np.array([*rng.uniform(-50, 50, 2), rng.uniform(-9, 9)])
        yield Frame(START + 0.2 * i, pose, ranges, mounts=mounts)


def record(path, frames, grids=(), last=None):
    with Recorder(path, ROBOT) as recorder:
        for frame in frames:
            recorder.add(frame)
            for grid in grids:
                recorder.keep(grid)
        recorder.finish(last or a_grid())
    return path


def by_rosbags(path):
    """Topic, time of the log (ns) and message, in their order."""
    with AnyReader([path]) as reader:
        for connection, stamp, data in reader.messages():
            yield connection.topic, stamp, reader.deserialize(data, connection.msgtype)


def by_mcap(path):
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            yield channel.topic, message.log_time, decoded


READERS = [by_rosbags, by_mcap]


def seconds(stamp):
    return stamp.sec + stamp.nanosec * 1e-9


def planar(transform):
    turn = transform.rotation
    assert (turn.x, turn.y, transform.translation.z) == (0, 0, 0)
    assert np.hypot(turn.z, turn.w) == pytest.approx(1)
    return [transform.translation.x, transform.translation.y, 2 * np.arctan2(turn.z, turn.w)]


def assert_same_pose(got, expected):
    np.testing.assert_allclose(np.subtract(got, expected)[..., :2], 0, atol=1e-9)
    np.testing.assert_allclose(wrap(np.subtract(got, expected)[..., 2]), 0, atol=1e-9)


@pytest.mark.parametrize("messages", READERS)
def test_each_frame_is_read_back(tmp_path, messages):
    frames = list(a_drive())
    record(tmp_path / "map.mcap", frames)
    got = {round(frame.stamp, 6): (None, np.full(ROBOT.sonars, np.nan)) for frame in frames}
    for topic, log_time, message in messages(tmp_path / "map.mcap"):
        if topic == "/tf":
            (at,) = message.transforms
            assert (at.header.frame_id, at.child_frame_id) == ("map", "base_link")
            stamp = seconds(at.header.stamp)
            got[round(stamp, 6)] = (planar(at.transform), got[round(stamp, 6)][1])
        elif topic.startswith("/sonar_"):
            stamp = seconds(message.header.stamp)
            assert message.header.frame_id == topic[1:]
            assert message.radiation_type == 0
            limits = (message.field_of_view, message.min_range, message.max_range)
            assert limits == pytest.approx((ROBOT.beam_width_rad, ROBOT.min_range_m, ROBOT.max_range_m), rel=1e-7)
            assert message.variance == 0
            assert not np.isnan(message.range)
            got[round(stamp, 6)][1][int(topic.removeprefix("/sonar_"))] = message.range
        else:
            continue
        assert log_time == pytest.approx(stamp * 1e9, abs=1000)
    for frame in frames:
        pose, ranges = got[round(frame.stamp, 6)]
        assert_same_pose(pose, frame.pose)
        np.testing.assert_array_equal(ranges, frame.ranges.astype(np.float32))


@pytest.mark.parametrize("messages", READERS)
def test_the_map_is_read_back(tmp_path, messages):
    grid = a_grid()
    record(tmp_path / "map.mcap", a_drive(3), last=grid)
    (message,) = [message for topic, _, message in messages(tmp_path / "map.mcap") if topic == "/map"]
    assert message.header.frame_id == "map"
    assert seconds(message.header.stamp) == pytest.approx(START + 0.4, abs=1e-6)
    info = message.info
    assert (info.height, info.width) == grid.shape
    assert info.resolution == np.float32(grid.resolution)
    assert (info.origin.position.x, info.origin.position.y) == grid.origin
    assert (info.origin.orientation.z, info.origin.orientation.w) == (0, 1)
    cells = np.array(message.data).reshape(grid.shape)
    np.testing.assert_array_equal(cells, occupancy(grid))
    assert set(np.unique(cells)) == {-1, 0, 100}


@pytest.mark.parametrize("messages", READERS)
def test_sonars_that_stay_where_they_are_stand_on_tf_static_once(tmp_path, messages):
    record(tmp_path / "map.mcap", a_drive(4))
    (message,) = [message for topic, _, message in messages(tmp_path / "map.mcap") if topic == "/tf_static"]
    assert [(at.header.frame_id, at.child_frame_id) for at in message.transforms] == [
        ("base_link", f"sonar_{i}") for i in range(ROBOT.sonars)
    ]
    assert_same_pose([planar(at.transform) for at in message.transforms], ROBOT.mounts)


@pytest.mark.parametrize("moving_from", [0, 2])
def test_sonars_that_fired_elsewhere_are_on_tf_from_then_on(tmp_path, moving_from):
    frames = list(a_drive(4, moving_from=moving_from))
    frames.append(Frame(START + 1, np.zeros(3), np.full(ROBOT.sonars, 1.0)))
    record(tmp_path / "map.mcap", frames)
    messages = list(by_rosbags(tmp_path / "map.mcap"))
    assert sum(topic == "/tf_static" for topic, _, _ in messages) == (moving_from > 0)
    for i, message in enumerate(message for topic, _, message in messages if topic == "/tf"):
        robot, *sonars = message.transforms
        assert robot.child_frame_id == "base_link"
        assert len(sonars) == (ROBOT.sonars if i >= moving_from else 0)
        if sonars:
            expected = ROBOT.mounts if frames[i].mounts is None else frames[i].mounts
            assert [at.child_frame_id for at in sonars] == [f"sonar_{k}" for k in range(ROBOT.sonars)]
            assert_same_pose([planar(at.transform) for at in sonars], expected)


def test_only_the_map_and_the_static_frames_are_latched_and_all_is_reliable(tmp_path):
    record(tmp_path / "map.mcap", a_drive(1))
    with AnyReader([tmp_path / "map.mcap"]) as reader:
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert qos.reliability.name == "RELIABLE"
            latched = connection.topic in ("/map", "/tf_static")
            assert qos.durability.name == ("TRANSIENT_LOCAL" if latched else "VOLATILE")
            assert qos.depth == (1 if latched else 100)


def test_it_is_a_recording_of_ros2_with_all_definitions_in_compressed_chunks(tmp_path):
    path = record(tmp_path / "map.mcap", a_drive(200))
    with open(path, "rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert {schema.name: schema.encoding for schema in summary.schemas.values()} == dict.fromkeys(
        ["nav_msgs/msg/OccupancyGrid", "sensor_msgs/msg/Range", "tf2_msgs/msg/TFMessage"], "ros2msg"
    )
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    fired = sum(int((~np.isnan(frame.ranges)).sum()) for frame in a_drive(200))
    assert summary.statistics.message_count == fired + 200 + 2
    assert path.stat().st_size < 60 * fired


@given(st.floats(0.1, 100), st.data())
@settings(max_examples=200)
def test_a_reading_within_the_limits_is_within_them_in_the_message(longest, data):
    robot = replace(ROBOT, min_range_m=0.05, max_range_m=longest)
    below = st.floats(0.05, longest, exclude_max=True)
    ranges = data.draw(st.lists(below | st.just(np.nextafter(longest, 0)), min_size=1, max_size=5))
    stored = _stored(np.array([*ranges, np.inf, np.nan]), robot)
    assert stored.dtype == np.float32
    assert (stored[:-2] >= np.float32(0.05)).all()
    assert (stored[:-2] < np.float32(longest)).all()
    np.testing.assert_allclose(stored, [*ranges, np.inf, np.nan], rtol=2e-7)


# Maps on the way.


def test_maps_on_the_way_are_five_seconds_apart_and_bear_the_time_of_the_last_frame(tmp_path):
    record(tmp_path / "map.mcap", a_drive(120), grids=[a_grid(seed=1)])
    stamps = [stamp for topic, stamp, _ in by_rosbags(tmp_path / "map.mcap") if topic == "/map"]
    assert stamps == sorted(stamps)
    after = np.array(stamps) * 1e-9 - START
    assert after == pytest.approx([5, 10, 15, 20, 23.8], abs=0.21)


@pytest.mark.parametrize(("hours", "least"), [(0.1, 20), (1, 35), (10, 50), (1000, 55)])
def test_a_drive_of_any_length_has_a_bounded_number_of_maps_spread_over_it(hours, least):
    pace = Pace()
    pace.due(START, 0)
    stamps = START + np.arange(0, hours * 3600, max(0.5, hours / 10))
    taken = [stamp - START for stamp in stamps if pace.due(stamp, 1000)]
    assert least <= len(taken) < MAX_MAPS
    assert taken[0] == pytest.approx(MAP_PERIOD_S, abs=max(0.5, hours / 10))
    assert all(b - a >= MAP_PERIOD_S for a, b in pairwise(taken))


def test_large_maps_are_fewer():
    pace = Pace()
    assert sum(pace.due(stamp, MAX_MAP_CELLS // 3) for stamp in range(0, 10_000, 50)) == 3


def test_a_map_without_cells_is_none():
    pace = Pace()
    assert not any(pace.due(stamp, 0) for stamp in range(100))
    assert pace.due(100, 1)


# What ROS cannot hold, and failure.


@pytest.mark.parametrize("stamp", [-1e-9, -5.0, 2.0**31, 1e11, np.nan, np.inf])
def test_a_stamp_that_ros_cannot_hold_is_one_clear_line(tmp_path, stamp):
    with pytest.raises(UsageError, match=r"map.mcap: found a scan at .* s, expected 0 to 2147483647 s"):
        record(tmp_path / "map.mcap", [Frame(stamp, np.zeros(3), np.ones(ROBOT.sonars))])
    assert list(tmp_path.iterdir()) == []


@given(st.floats(0, 2.0**31 - 2))
@settings(max_examples=200)
def test_a_stamp_survives_to_the_nanosecond(stamp):
    at = _ros_time(stamp, Path("none"))
    assert 0 <= at.nanosec < 1_000_000_000
    assert abs((at.sec - stamp) + at.nanosec * 1e-9) <= 0.6e-9


@pytest.mark.parametrize("failure", [RuntimeError("bug"), KeyboardInterrupt()])
def test_a_block_that_raises_leaves_nothing_and_what_was_there(tmp_path, failure):
    (tmp_path / "map.mcap").write_bytes(b"old")

    def frames():
        yield from a_drive(5)
        raise failure

    with pytest.raises(type(failure)):
        record(tmp_path / "map.mcap", frames())
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"map.mcap": b"old"}


def test_a_good_end_replaces_what_was_there_and_leaves_nothing_else(tmp_path):
    (tmp_path / "map.mcap").write_bytes(b"old")
    (tmp_path / "plain").touch()
    path = record(tmp_path / "map.mcap", a_drive(2))
    assert sorted(os.listdir(tmp_path)) == ["map.mcap", "plain"]
    assert path.read_bytes()[:8] == b"\x89MCAP0\r\n"
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("place", ["none/map.mcap", "file/map.mcap", "folder"])
def test_a_place_that_cannot_be_written_is_one_clear_line(tmp_path, place):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(UsageError) as error:
        record(tmp_path / place, a_drive(1))
    assert str(tmp_path / place) in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]
    assert os.listdir(tmp_path / "folder") == []


@pytest.mark.parametrize("step", ["open", "write", "close"])
def test_a_disk_that_fills_up_is_one_clear_line_and_leaves_nothing(tmp_path, monkeypatch, step):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(rosbags.rosbag2.Writer, step, full)
    with pytest.raises(UsageError, match=r"map.mcap: found No space left"):
        record(tmp_path / "map.mcap", a_drive(1))
    assert list(tmp_path.iterdir()) == []
