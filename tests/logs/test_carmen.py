import gzip
from math import inf, nan, pi

import numpy as np
import pytest

from echogrid.logs import carmen
from echogrid.logs.contents import describe
from echogrid.logs.formats import load_log
from echogrid.packed import zstd
from echogrid.robot import parse_robot, robot_yaml
from log_samples import CARMEN, ROBOT, assert_plain, drain, messages, odom, peak_of, put, same, sonar

STOOD = odom(0, 0, 0, 0), odom(0, 0, 0, 9)
"""Odometry of a robot that does not move."""


def test_carmen_pose_is_interpolated_at_the_time_of_the_message(tmp_path):
    # A quarter of the way from (0, 0, 170 deg) to (4, -2, -170 deg): the short way passes 180, not 0.
    text = messages(odom(0, 0, np.deg2rad(170), 10), sonar(10.5), odom(4, -2, np.deg2rad(-170), 12))
    (frame,) = load_log(put(tmp_path, text))
    assert frame.stamp == 10.5
    np.testing.assert_allclose(frame.pose, [1.0, -0.5, np.deg2rad(175)], atol=1e-12)
    assert frame.ranges.tolist() == [1.5, 2.5]
    assert frame.odom is None


def test_carmen_heading_is_wrapped_when_it_passes_half_a_turn(tmp_path):
    text = messages(odom(0, 0, np.deg2rad(170), 10), sonar(11.5), odom(4, -2, np.deg2rad(-170), 12))
    (frame,) = load_log(put(tmp_path, text))
    np.testing.assert_allclose(frame.pose, [3.0, -1.5, np.deg2rad(-175)], atol=1e-12)


def test_carmen_takes_the_nearest_odometry_just_before_the_first_and_after_the_last(tmp_path):
    text = messages(sonar(2.5), sonar(2.9), odom(5, 6, 1, 3), odom(7, 8, 2, 4), sonar(4), sonar(4.5))
    log = load_log(put(tmp_path, text))
    assert [frame.pose.tolist() for frame in log] == [[5, 6, 1], [5, 6, 1], [7, 8, 2], [7, 8, 2]]
    assert log.notes == {}
    late = messages(odom(5, 6, 1, 3), odom(7, 8, 2, 4), sonar(2.8), sonar(4.2))
    assert [frame.pose.tolist() for frame in load_log(put(tmp_path, late))] == [[5, 6, 1], [7, 8, 2]]


def test_carmen_lines_outside_of_the_odometry_are_left_out_and_told(tmp_path):
    text = messages(
        sonar(1), *(line for t in range(3, 6) for line in (odom(t, 0, 0, t), sonar(t))), *map(sonar, (6, 9))
    )
    log = load_log(put(tmp_path, text))
    assert [frame.stamp for frame in log] == [3, 4, 5]
    assert log.notes == {carmen.OUTSIDE: 3}
    assert [frame.stamp for frame in log] == [3, 4, 5]
    assert log.notes == {carmen.OUTSIDE: 3}


@pytest.mark.parametrize(
    ("there", "gap", "kept"),
    [
        ((0.31, 0, 0), 2.1, False),
        ((0, 0, 0.36), 2.1, False),
        ((0, 0, 0.36 - 2 * pi), 2.1, False),
        ((0.31, 0, 0), 1.9, True),
        ((0.2, 0.2, 0.3), 60.0, True),
        ((0, 0, 2 * pi), 60.0, True),
    ],
)
def test_carmen_lines_in_a_gap_in_which_the_robot_moved_are_left_out_and_told(tmp_path, there, gap, kept):
    text = messages(
        odom(0, 0, 0, 0), sonar(0), sonar(1), sonar(1.5), odom(*there, gap), sonar(gap), odom(*there, gap + 1)
    )
    log = load_log(put(tmp_path, text))
    assert [frame.stamp for frame in log] == ([0, 1, 1.5, gap] if kept else [0, gap])
    assert log.notes == ({} if kept else {carmen.GAP: 2})


@pytest.mark.parametrize("off", [3600.0, -1e9])
def test_carmen_of_two_clocks_is_refused(tmp_path, off):
    path = put(
        tmp_path, messages(*(line for t in range(9) for line in (odom(t, 0, 0, 1e9 + t), sonar(1e9 + t + off))))
    )
    frames, error = drain(load_log(path))
    assert frames == []
    assert error is not None
    assert_plain(error)
    assert "ODOM from 1000000000.0 to 1000000008.0 s" in error.found
    assert error.expected == "stamps of one clock"


def test_carmen_finds_the_pose_of_a_line_that_stands_too_late(tmp_path):
    text = messages(*(odom(t, 0, 0, t) for t in range(5)), sonar(1.5), sonar(3.25), odom(5, 0, 0, 5))
    assert [frame.pose[0] for frame in load_log(put(tmp_path, text))] == [1.5, 3.25]


def test_carmen_poses_do_not_depend_on_how_much_odometry_is_kept(tmp_path, monkeypatch):
    lines = [line for i in range(400) for line in (odom(i, i % 7, 0.01 * i, i), sonar(i + 0.5))]
    path = put(tmp_path, messages(*lines))
    kept = list(load_log(path))
    monkeypatch.setattr(carmen, "_KEPT_ODOMS", 2)
    assert all(same(a, b) for a, b in zip(kept, load_log(path), strict=True))
    assert kept[3].pose[0] == 3.5
    assert kept[398].pose[0] == 398.5


def test_carmen_describes_its_robot(tmp_path):
    robot = load_log(put(tmp_path, CARMEN)).robot
    assert robot is not None
    assert (robot.name, robot.sonars, robot.transducer.name) == ("carmen", 2, "polaroid-600")
    np.testing.assert_allclose(robot.mounts, [[0.1, 0, 0], [0, 0.1, pi / 2]], atol=1e-6)
    assert (robot.min_range_m, robot.max_range_m, robot.beam_width_rad) == (0.15, 5.0, 0.26)
    assert robot.footprint_radius_m == 0.1
    again = parse_robot(robot_yaml(robot), "carmen.yaml")
    np.testing.assert_allclose(again.mounts, robot.mounts, atol=1e-6)


@pytest.mark.parametrize("cone", [0, 15.0, nan])
def test_carmen_cone_that_makes_no_sense_becomes_25_degrees(tmp_path, cone):
    robot = load_log(put(tmp_path, messages(odom(0, 0, 0, 0), sonar(0, cone=cone)))).robot
    assert robot is not None
    assert robot.beam_width_rad == pytest.approx(np.deg2rad(25))


def test_carmen_ranges_are_brought_to_the_limits(tmp_path):
    path = put(tmp_path, messages(*STOOD, sonar(1, "0 4.5"), sonar(2, "0.18 -inf"), sonar(3, "5.0 nan")))
    np.testing.assert_equal([f.ranges.tolist() for f in load_log(path)], [[nan, 4.5], [0.18, nan], [inf, nan]])
    log = load_log(path, ROBOT)
    assert log.robot is ROBOT
    np.testing.assert_equal([f.ranges.tolist() for f in log], [[nan, inf], [nan, nan], [inf, nan]])


def test_carmen_mounts_of_the_log_do_not_matter_where_the_robot_is_given(tmp_path):
    odd = messages(*STOOD, sonar(0, mounts="0 99 0 0 0 0"), sonar(1, mounts="1 1 1 1 1 1"))
    assert len(list(load_log(put(tmp_path, odd), ROBOT))) == 2


def test_carmen_mounts_may_be_written_in_another_way(tmp_path):
    text = messages(*STOOD, sonar(0), sonar(1, mounts="0.100 0 -0.0 0 0.1 1.5708"))
    assert len(list(load_log(put(tmp_path, text)))) == 2


def test_carmen_of_windows_reads_the_same(tmp_path):
    plain = list(load_log(put(tmp_path, CARMEN)))
    other = b"\xef\xbb\xbf" + CARMEN.replace(b"\n", b"\r\n").replace(b"ODOM ", b"ODOM  \t")
    assert all(same(a, b) for a, b in zip(plain, load_log(put(tmp_path, other)), strict=True))


START = (odom(0, 0, 0, 1), sonar(1))

WRONG_MESSAGES = {
    "other number of sonars": ((sonar(2, "1", 1, "0 0 0"),), 5, "1 sonars"),
    "other mounts": ((sonar(2, mounts="0.1 0 0 0 0.1 -1.570796"),), 5, "other mounts"),
    "mount not a number": ((sonar(2, mounts="0.1 0 0 0 0.1 east"),), 5, "a mount = 'east'"),
    "reading missing": ((sonar(2, "1"),), 5, "13 fields"),
    "reading is text": ((sonar(2, "1 far"),), 5, "a field = 'far'"),
    "underscore": ((sonar(2, "1 1_0"),), 5, "a field = '1_0'"),
    "negative range": ((sonar(2, "1 -0.5"),), 5, "r1 = -0.5"),
    "range in mm": ((sonar(2, "1500 1"),), 5, "r0 = 1500.0"),
    "nan stamp": ((sonar(nan),), 5, "t = nan"),
    "time backwards": ((sonar(0.5),), 5, "time 0.5 after 1.0"),
    "odometry backwards": ((odom(0, 0, 0, 2), odom(0, 0, 0, 1.5)), 6, "time 1.5 after 2.0"),
    "odometry cut off": (("ODOM 1 2 3",), 5, "4 fields"),
    "odometry is text": ((odom(0, 0, 0, 2), "ODOM 0 up 0 0 0 0 3 nohost 3"), 6, "a field = 'up'"),
    "nan pose": ((odom(0, nan, 0, 2),), 5, "y = nan"),
    "far off": ((odom(-2e7, 0, 0, 2),), 5, "x = -20000000.0"),
    "NUL": ((odom(0, 0, 0, 2).replace("0.1", "\0"),), 5, "a NUL byte"),
    "control characters": ((sonar(2, "1 \x1b[2J"),), 5, r"a field = '\x1b[2J'"),
}


@pytest.mark.parametrize(("lines", "line", "found"), WRONG_MESSAGES.values(), ids=WRONG_MESSAGES)
def test_a_wrong_message_is_an_error_with_its_line(tmp_path, lines, line, found):
    path = put(tmp_path, messages(*START, *lines))
    frames, error = drain(load_log(path))
    assert error is not None
    assert error.where == f"{path}:{line}"
    assert found in error.found
    assert_plain(error)
    assert len(frames) == 1


def test_carmen_holds_back_a_bounded_number_of_messages(tmp_path, monkeypatch):
    monkeypatch.setattr(carmen, "MAX_HELD", 3)
    lines = [sonar(t / 8) for t in range(4)]
    assert len(list(load_log(put(tmp_path, messages(*lines[:3], odom(0, 0, 0, 0.5)))))) == 3
    path = put(tmp_path, messages(*lines, odom(0, 0, 0, 0.5)))
    frames, error = drain(load_log(path))
    assert error is not None
    assert (len(frames), error.where) == (0, f"{path}:6")
    assert_plain(error)


def test_a_carmen_log_is_streamed(tmp_path):
    path = put(tmp_path, messages(*(line for i in range(4000) for line in (odom(i, 0, 0, i), sonar(i)))))
    assert path.stat().st_size > 4e5
    describe(load_log(path))  # what is made once, and kept, counts for no log
    assert peak_of(lambda: describe(load_log(path))) < 4.5e5


@pytest.mark.parametrize("pack", [gzip.compress, zstd.compress])
def test_a_compressed_log_is_read(tmp_path, pack):
    plain = list(load_log(put(tmp_path, CARMEN)))
    packed = load_log(put(tmp_path, pack(CARMEN), "drive.log.gz"))
    for _ in range(2):
        assert all(same(a, b) for a, b in zip(packed, plain, strict=True))
