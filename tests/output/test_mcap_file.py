"""A recording says the same to rosbags and to the mcap library as the frames and the map it was made of."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rosbags.rosbag2
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2

from echogrid.cli import main
from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.grid import Grid
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from echogrid.output.map_file import read_map
from echogrid.output.map_server_file import occupancy
from echogrid.output.mcap_file import Recorder, _ros_time, _stored
from echogrid.robot import Robot

ROBOT = Robot.load("b21")
START = 1_700_000_000.25


def a_grid(rows=7, cols=11, seed=0):
    rng = np.random.default_rng(seed)
    observed = rng.random((rows, cols)) < 0.7
    return Grid(rng.normal(0, 3, (rows, cols)).astype(np.float32), observed, 0.12, (-1.5, 2.25))


def a_straight_drive(count):
    for i in range(count):
        ranges = np.linspace(0.5, 6, ROBOT.sonars)
        yield Frame(START + i, np.array([0.1 * i, 0.05 * i, 0.01 * i]), np.where(ranges < 4, ranges, np.inf))


def a_drive(count=30, seed=0):
    rng = np.random.default_rng(seed)
    for i in range(count):
        ranges = rng.uniform(ROBOT.min_range_m, ROBOT.max_range_m, ROBOT.sonars)
        ranges[rng.random(ROBOT.sonars) < 0.2] = np.inf
        ranges[rng.random(ROBOT.sonars) < 0.2] = np.nan
        pose = np.array([*rng.uniform(-50, 50, 2), rng.uniform(-9, 9)])
        yield Frame(START + 0.2 * i, pose, ranges)


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


def test_sonars_that_fired_elsewhere_do_so_from_where_the_robot_then_was(tmp_path):
    frames = [*sequential(20), Frame(START + 30, np.array([1.0, 2, 3]), np.ones(ROBOT.sonars))]
    record(tmp_path / "map.mcap", frames)
    poses, heard, log_times = {}, {}, []
    for topic, log_time, message in by_rosbags(tmp_path / "map.mcap"):
        log_times.append(log_time)
        if topic == "/tf":
            (at,) = message.transforms
            poses[seconds(at.header.stamp)] = planar(at.transform)
        elif topic.startswith("/sonar_"):
            heard.setdefault(int(topic.removeprefix("/sonar_")), []).append(seconds(message.header.stamp))
    assert log_times == sorted(log_times)
    before = 0.0
    for k, frame in enumerate(frames):
        for i in range(ROBOT.sonars):
            stamp = heard[i][k]
            assert before < stamp <= frame.stamp + 1e-6
            looked = compose(frame.pose, mounts_of(frame)[i])
            assert_same_pose(compose(np.array(poses[stamp]), ROBOT.mounts[i]), looked)
        before = frame.stamp


def mounts_of(frame):
    return ROBOT.mounts if frame.mounts is None else frame.mounts


def sequential(count):
    """Frames of sonars that fired one after another, two at a time, on a robot that drives and turns."""
    for k in range(count):
        end = np.array([0.3 * k, 0.1 * k, 0.4 * k])
        ago = (ROBOT.sonars - 1 - np.arange(ROBOT.sonars)) // 2 / ROBOT.sonars * 2
        then = end - ago[:, None] * [0.3, 0.1, 0.4]
        mounts = compose(inverse(end), compose(then, ROBOT.mounts))
        yield Frame(START + k, end, np.linspace(0.5, 4, ROBOT.sonars), mounts=mounts)


@pytest.mark.parametrize("drive", [a_straight_drive, sequential])
def test_our_own_reader_finds_the_same_frames(tmp_path, drive):
    frames = list(drive(20))
    log = load_log(record(tmp_path / "map.mcap", frames))
    assert log.robot is not None
    np.testing.assert_allclose(log.robot.mounts, ROBOT.mounts, atol=1e-6)
    assert log.robot.beam_width_rad == pytest.approx(ROBOT.beam_width_rad)
    assert (log.robot.min_range_m, log.robot.max_range_m) == pytest.approx((ROBOT.min_range_m, ROBOT.max_range_m))
    got = list(log)
    assert len(got) == len(frames)
    for read, frame in zip(got, frames, strict=True):
        assert read.stamp == pytest.approx(frame.stamp, abs=1e-6)
        assert_same_pose(read.pose, frame.pose)
        np.testing.assert_allclose(read.ranges, frame.ranges, rtol=1e-6)
        assert (read.mounts is None) == (frame.mounts is None)
        off = mounts_of(read) - mounts_of(frame)
        np.testing.assert_allclose(off[:, :2], 0, atol=1e-5)
        np.testing.assert_allclose(wrap(off[:, 2]), 0, atol=1e-5)


def test_a_reading_just_below_the_limit_is_no_no_echo(tmp_path):
    just = np.nextafter(ROBOT.max_range_m, 0)
    record(tmp_path / "map.mcap", [Frame(START, np.zeros(3), np.full(ROBOT.sonars, just))])
    ranges = [message for topic, _, message in by_mcap(tmp_path / "map.mcap") if topic.startswith("/sonar")]
    assert len(ranges) == ROBOT.sonars
    assert all(message.range < message.max_range for message in ranges)


def test_only_the_map_and_the_static_frames_are_latched_and_all_is_reliable(tmp_path):
    record(tmp_path / "map.mcap", a_drive(1))
    with AnyReader([tmp_path / "map.mcap"]) as reader:
        for connection in reader.connections:
            assert isinstance(connection.ext, ConnectionExtRosbag2)
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
    assert summary is not None
    assert summary.statistics is not None
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


# The command.


def test_the_command_writes_it_beside_the_map(tmp_path, capsys):
    log = tmp_path / "drive.csv"
    write_csv(log, a_straight_drive(12), ROBOT.sonars)
    options = ["--interpreter", "cone", "--out", str(tmp_path / "out")]
    main(["map", str(log), "--mcap", "--pgm", "raw", *options])
    assert "12 scans" in capsys.readouterr().out
    names = {"map.mcap", "map.npz", "map.pgm", "map.png", "map.yaml", "run.yaml"}
    assert set(os.listdir(tmp_path / "out")) == names
    assert yaml.safe_load((tmp_path / "out" / "map.yaml").read_text())["mode"] == "raw"
    grid = read_map(tmp_path / "out")
    last = [message for topic, _, message in by_rosbags(tmp_path / "out" / "map.mcap") if topic == "/map"][-1]
    np.testing.assert_array_equal(np.reshape(last.data, grid.shape), occupancy(grid))
    np.testing.assert_allclose([last.info.origin.position.x, last.info.origin.position.y], grid.origin)


def test_a_log_that_ros_cannot_hold_leaves_no_folder(tmp_path, capsys):
    log = tmp_path / "drive.csv"
    write_csv(log, [Frame(f.stamp - 2 * START, f.pose, f.ranges) for f in a_straight_drive(3)], ROBOT.sonars)
    with pytest.raises(SystemExit, match="2"):
        main(["map", str(log), "--mcap", "--interpreter", "cone", "--out", str(tmp_path / "out")])
    assert capsys.readouterr().err.startswith(
        f"echogrid: {tmp_path / 'out' / 'map.mcap'}: found a scan at -1700000000.25 s"
    )
    assert os.listdir(tmp_path) == ["drive.csv"]
