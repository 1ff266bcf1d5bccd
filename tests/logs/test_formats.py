import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from math import inf, nan, pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.frame import Frame, Log
from echogrid.logs.contents import describe
from echogrid.logs.formats import carmen, load_log, write_csv
from echogrid.robot import Robot, parse_robot, robot_yaml

ROOT = Path(__file__).parents[2]
CORRIDOR8 = ROOT.parent / "shared" / "data" / "corridor8"

ROBOT = parse_robot(
    """
name: duo
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.2, max_range_m: 4.0, beam_width_deg: 25}
mounts: [[0.1, 0, 0], [0, 0.1, 90]]
""",
    "duo.yaml",
)

CSV = b"t,x,y,theta,r0,r1\n0,1,2,0.5,1.5,inf\n0.5,1.25,2,0.5,,2.5\n"
MOUNTS = "0.1 0 0 0 0.1 1.570796"

# The file of all examples lies in one folder; a folder an example would take most of the time.
many = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def put(folder: Path, content: bytes | str, name: str = "drive.log") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def rows(*lines: str) -> str:
    return "\n".join(["t,x,y,theta,r0,r1", *lines, ""])


def odom(x: float, y: float, theta: float, t: float) -> str:
    return f"ODOM {x} {y} {theta} 0.1 0 0 {t} nohost {t + 1000}"


def sonar(t: float, ranges: str = "1.50 2.50", n: int = 2, mounts: str = MOUNTS, cone: float = 0.26) -> str:
    return f"SONAR {cone} {n} {ranges} {mounts} {t} nohost {t + 77}"


def messages(*lines: str) -> str:
    return "\n".join(["# CARMEN Logfile", "PARAM robot_length 0.5 0.0 nohost 0", *lines, ""])


CARMEN = messages(
    odom(0, 0, 0, 10), sonar(10.5), "FLASER 2 1 2 0 0 0 0 0 0 10.5 nohost 0", odom(1, 0, 0, 11)
).encode()


def same(a: Frame, b: Frame) -> bool:
    pairs = [(a.pose, b.pose), (a.ranges, b.ranges)]
    if a.odom is not None and b.odom is not None:
        pairs.append((a.odom, b.odom))
    elif a.odom is not b.odom:
        return False
    return a.stamp == b.stamp and all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def drain(log: Log) -> tuple[list[Frame], InputError | None]:
    """The frames up to the first wrong row, and its error."""
    kept: list[Frame] = []
    try:
        for frame in log:
            kept.append(frame)  # noqa: PERF402  (extend would lose the frames before an error)
    except InputError as error:
        return kept, error
    return kept, None


def assert_plain(error: EchogridError) -> None:
    text = str(error)
    assert text.isprintable(), "no control characters for the terminal"
    assert len(text) < 600
    assert ": found " in text
    assert ", expected " in text


def test_csv_gives_stamp_pose_and_ranges(tmp_path):
    first, second = load_log(put(tmp_path, CSV))
    assert same(first, Frame(0.0, np.array([1.0, 2.0, 0.5]), np.array([1.5, inf])))
    assert same(second, Frame(0.5, np.array([1.25, 2.0, 0.5]), np.array([nan, 2.5])))


def test_csv_carries_odometry_beside_the_pose(tmp_path):
    log = load_log(put(tmp_path, "t,x,y,theta,odom_x,odom_y,odom_theta,r0\n0,1,2,3,4,5,6,0.5\n"))
    assert log.sonars == 1
    assert same(next(iter(log)), Frame(0.0, np.array([1.0, 2, 3]), np.array([0.5]), np.array([4.0, 5, 6])))


@pytest.mark.parametrize("content", [CSV, CARMEN])
def test_a_log_can_be_gone_through_again_and_again(tmp_path, content):
    log = load_log(put(tmp_path, content))
    one, two = iter(log), iter(log)
    assert same(next(one), next(two))
    assert len(list(log)) == len(list(log)) > 0


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(b"\xef\xbb\xbf" + CSV, id="byte-order-mark"),
        pytest.param(CSV.replace(b"\n", b"\r\n"), id="CRLF"),
        pytest.param(CSV + b"\n  \n\r\n\n", id="blank lines at the end"),
        pytest.param(CSV.replace(b",", b" , "), id="spaces"),
        pytest.param(CSV.removesuffix(b"\n"), id="no last line end"),
        pytest.param(CSV.replace(b",,", b",nan,"), id="nan"),
        pytest.param(CSV.replace(b",,", b",-inf,"), id="too near"),
        pytest.param(CSV.replace(b"inf", b"+Infinity"), id="Infinity"),
        pytest.param(CSV.replace(b"1.5,", b"15e-1,"), id="exponent"),
    ],
)
def test_csv_is_read_the_same_however_it_is_written(tmp_path, variant):
    plain = list(load_log(put(tmp_path, CSV)))
    frames = list(load_log(put(tmp_path, variant, "variant.csv")))
    assert len(frames) == len(plain)
    assert all(same(a, b) for a, b in zip(frames, plain, strict=True))


def test_the_limits_of_the_robot_are_applied(tmp_path):
    text = rows("0,0,0,0,3.999,4", "1,0,0,0,0.2,0.199", "1,0,0,0,100,0", "3,0,0,0,inf,")
    log = load_log(put(tmp_path, text), ROBOT)
    np.testing.assert_equal(
        [frame.ranges.tolist() for frame in log], [[3.999, inf], [0.2, nan], [inf, nan], [inf, nan]]
    )
    assert log.robot is ROBOT


@pytest.mark.parametrize(
    "content", [rows("0,0,0,0,1,2").replace(",r1", ""), messages(odom(0, 0, 0, 0), sonar(0, "1", 1, "0 0 0"))]
)
def test_another_number_of_sonars_than_the_robot_has_is_refused(tmp_path, content):
    with pytest.raises(InputError, match="found 1 sonars, expected 2, as robot duo has") as caught:
        load_log(put(tmp_path, content), ROBOT)
    assert_plain(caught.value)


GOOD = "1,0,0,0,1,1"
WRONG_ROWS = {
    "column missing": (rows(GOOD, "2,0,0,0,1"), 3, "5 columns"),
    "column too many": (rows(GOOD, "2,0,0,0,1,1,1"), 3, "7 columns"),
    "text": (rows(GOOD, "2,0,0,0,1,near"), 3, "r1 = 'near'"),
    "text in the pose": (rows("x,0,0,0,1,1"), 2, "t = 'x'"),
    "underscore": (rows("1_0,0,0,0,1,1"), 2, "t = '1_0'"),
    "hexadecimal": (rows("1,0,0,0,0x1,1"), 2, "r0 = '0x1'"),
    "two numbers": (rows("1,0,0,0,1 2,1"), 2, "r0 = '1 2'"),
    "other digits": (rows("1,0,0,0,\u0661,1"), 2, "r0 = '\u0661'"),
    "empty pose": (rows("1,0,,0,1,1"), 2, "y = nothing"),
    "time backwards": (rows(GOOD, GOOD, "0.999,0,0,0,1,1"), 4, "time 0.999 after 1.0"),
    "nan pose": (rows(GOOD, "2,0,0,nan,1,1"), 3, "theta = nan"),
    "inf pose": (rows(GOOD, "2,-inf,0,0,1,1"), 3, "x = -inf"),
    "nan stamp": (rows("nan,0,0,0,1,1", GOOD), 2, "t = nan"),
    "inf stamp": (rows(GOOD, "inf,0,0,0,1,1"), 3, "t = inf"),
    "stamp in ns": (rows("1700000000000000000,0,0,0,1,1"), 2, "t = 1.7e+18"),
    "x far off": (rows(GOOD, "2,10000001,0,0,1,1"), 3, "x = 10000001.0"),
    "y far off": (rows(GOOD, "2,0,-1e8,0,1,1"), 3, "y = -100000000.0"),
    "range in mm": (rows(GOOD, "2,0,0,0,1,100.1"), 3, "r1 = 100.1"),
    "negative range": (rows(GOOD, "2,0,0,0,-0.01,1"), 3, "r0 = -0.01"),
    "NUL": (rows(GOOD, "2,0,0,0,1,\0"), 3, "a NUL byte"),
    "not UTF-8": (rows(GOOD).encode() + b"2,0,0,0,1,\xff\n", 3, "not UTF-8"),
    "control character as a blank": (rows("1,0,0,0,1\x1f,1"), 2, r"r0 = '1\x1f'"),
    "control characters": (rows("2,0,0,0,1,\x1b[31m"), 2, r"r1 = '\x1b[31m'"),
    "blank line between": (rows(GOOD, "", " ", GOOD), 3, "a blank line"),
    "cut off": (rows(GOOD) + "2,0,0,0,1,", 3, "cut off"),
    "cut off early": (rows(GOOD) + "2,0,0", 3, "3 columns"),
    "old line ends": (rows(GOOD) + "2,0,0,0,1,1\r3,0,0,0,1,1\r", 3, "11 columns"),
    "first of two": (rows(GOOD, "2,0,0,0,-1,1", "3,0,0,0,1,near"), 3, "r0 = -1.0"),
    "second of two": (rows(GOOD, "2,0,0,0,1,near", "3,0,0,0,-1,1"), 3, "r1 = 'near'"),
    "after rows with gaps": (rows("1,0,0,0,,1", "2,0,0,0,,", "1,0,0,0,,1"), 4, "time 1.0 after 2.0"),
}


@pytest.mark.parametrize(("content", "line", "found"), WRONG_ROWS.values(), ids=WRONG_ROWS)
def test_a_wrong_row_is_an_error_with_its_line(tmp_path, content, line, found):
    path = put(tmp_path, content)
    frames, error = drain(load_log(path))
    assert error is not None
    assert error.where == f"{path}:{line}"
    assert found in error.found
    assert_plain(error)
    assert len(frames) == line - 2, "the frames before the wrong row are given first"


@pytest.mark.parametrize("line", [3, 256, 257, 258, 512, 513, 514, 601])
@pytest.mark.parametrize("wrong", ["{:.1f},0,0,0,1,1", "{},0,0,0,1", "{},0,0,0,1,-3"])
def test_the_line_is_right_anywhere_in_a_long_file(tmp_path, line, wrong):
    lines = [f"{i},0,0,0,1,{i % 90}" for i in range(1, 601)]
    lines[line - 2] = wrong.format(line - 2 - 0.5)
    path = put(tmp_path, rows(*lines))
    frames, error = drain(load_log(path))
    assert error is not None
    assert error.where == f"{path}:{line}"
    assert len(frames) == line - 2


WRONG_FILES = {
    "empty": ("", None, "an empty file"),
    "blank": ("\n\n", 1, "''"),
    "header only": (rows(), None, "no rows"),
    "header and blank lines": (rows("", "", ""), None, "no rows"),
    "another format": ("time;range\n0;1\n", 1, "'time;range'"),
    "no sonars": ("t,x,y,theta\n0,0,0,0\n", 1, "nothing as column 5"),
    "sonars from 1": ("t,x,y,theta,r1\n0,0,0,0,1\n", 1, "'r1' as column 5"),
    "gap in the sonars": ("t,x,y,theta,r0,r2\n0,0,0,0,1,1\n", 1, "'r2' as column 6"),
    "degrees": ("t,x,y,theta_deg,r0\n0,0,0,0,1\n", 1, "'theta_deg' as column 4"),
    "half of the odometry": ("t,x,y,theta,odom_x,odom_y,r0\n0,0,0,0,1,1,1\n", 1, "'r0' as column 7"),
    "odometry last": ("t,x,y,theta,r0,odom_x,odom_y,odom_theta\n", 1, "'odom_x' as column 6"),
    "too many sonars": ("t,x,y,theta," + ",".join(f"r{i}" for i in range(513)), 1, "513 sonars"),
    "NUL": (b"t,x,y,theta,r0\0\n", 1, "a NUL byte"),
    "compressed": (b"\x1f\x8b\x08\x00\x00", 1, "a NUL byte"),
    "not UTF-8": (b"\x89PNG\r\n", 1, "not UTF-8"),
    "control characters": ("\x1b[31m\x07\n", 1, r"'\x1b[31m\x07'"),
    "no line end in 3 MB": ("t,x,y,theta,r0" * 200_000, 1, "a line of more than"),
    "no SONAR": (messages(odom(0, 0, 0, 0)), None, "no SONAR line"),
    "no ODOM": (messages(sonar(0), sonar(1)), None, "no ODOM line"),
    "comments only": ("# CARMEN Logfile\n", None, "no SONAR line"),
    "no mounts": (messages(odom(0, 0, 0, 0), sonar(0, mounts="")), 4, "8 fields"),
    "sonars not a number": (messages("SONAR 0.26 two 1 2"), 3, "n = 'two'"),
    "no sonars in SONAR": (messages("SONAR 0.26 0 1 nohost 1"), 3, "n = '0'"),
    "SONAR alone": (messages("SONAR"), 3, "n = ''"),
    "mount out of reach": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 20 0")),
        4,
        "a mount at [0.0, 20.0, 0.0]",
    ),
    "mount in degrees": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 0 90")),
        4,
        "a mount at [0.0, 0.0, 90.0]",
    ),
    "mount not a number": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 0 left")),
        4,
        "a mount = 'left'",
    ),
}


@pytest.mark.parametrize(("content", "line", "found"), WRONG_FILES.values(), ids=WRONG_FILES)
def test_a_file_that_is_no_log_is_refused_at_once(tmp_path, content, line, found):
    path = put(tmp_path, content)
    with pytest.raises(InputError) as caught:
        load_log(path)
    assert caught.value.where == (f"{path}:{line}" if line else str(path))
    assert found in caught.value.found
    assert_plain(caught.value)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("absent.csv", "No such file"),
        (".", "a directory"),
        ("/dev/zero", "a pipe or a device"),
        ("a\0b", "null byte"),
        ("x" * 300, "too long"),
        ("absent\x1b[31m.csv", "No such file"),
    ],
)
def test_what_is_not_a_file_is_refused_at_once(tmp_path, name, found):
    with pytest.raises(InputError) as caught:
        load_log(str(tmp_path / name))
    assert found in caught.value.found
    assert_plain(caught.value)


@pytest.mark.parametrize(
    ("content", "other", "found"),
    [
        (CSV, b"", "''"),
        (CSV, rows(), "no rows"),
        (CSV, "t,x,y,theta,r0\n0,0,0,0,1\n", "another header"),
        (CSV, None, "No such file"),
        (CARMEN, b"", "no SONAR"),
        (CARMEN, messages(odom(0, 0, 0, 0)), "no SONAR"),
        (CARMEN, messages(sonar(0)), "no ODOM"),
        (CARMEN, None, "No such file"),
    ],
)
def test_a_file_that_changes_after_it_was_opened_is_an_input_error(tmp_path, content, other, found):
    path = put(tmp_path, content)
    log = load_log(path)
    path.unlink() if other is None else put(tmp_path, other)
    frames, error = drain(log)
    assert error is not None
    assert found in error.found
    assert frames == []
    assert_plain(error)


def test_carmen_pose_is_interpolated_at_the_time_of_the_message(tmp_path):
    # A quarter of the way from (0, 0, 170 deg) to (4, -2, -170 deg): the short way passes 180, not 0.
    text = messages(odom(0, 0, np.deg2rad(170), 10), sonar(11), odom(4, -2, np.deg2rad(-170), 14))
    (frame,) = load_log(put(tmp_path, text))
    assert frame.stamp == 11.0
    np.testing.assert_allclose(frame.pose, [1.0, -0.5, np.deg2rad(175)], atol=1e-12)
    assert frame.ranges.tolist() == [1.5, 2.5]
    assert frame.odom is None


def test_carmen_heading_is_wrapped_when_it_passes_half_a_turn(tmp_path):
    text = messages(odom(0, 0, np.deg2rad(170), 10), sonar(13), odom(4, -2, np.deg2rad(-170), 14))
    (frame,) = load_log(put(tmp_path, text))
    np.testing.assert_allclose(frame.pose, [3.0, -1.5, np.deg2rad(-175)], atol=1e-12)


def test_carmen_takes_the_nearest_odometry_before_the_first_and_after_the_last(tmp_path):
    text = messages(sonar(1), sonar(2), odom(5, 6, 1, 3), odom(7, 8, 2, 4), sonar(4), sonar(9))
    poses = [frame.pose.tolist() for frame in load_log(put(tmp_path, text))]
    assert poses == [[5, 6, 1], [5, 6, 1], [7, 8, 2], [7, 8, 2]]
    late = messages(odom(5, 6, 1, 3), odom(7, 8, 2, 4), sonar(1), sonar(9))
    assert [frame.pose.tolist() for frame in load_log(put(tmp_path, late))] == [[5, 6, 1], [7, 8, 2]]


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
    path = put(tmp_path, messages(odom(0, 0, 0, 0), sonar(1, "0 4.5"), sonar(2, "0.18 -inf"), sonar(3, "5.0 nan")))
    np.testing.assert_equal([f.ranges.tolist() for f in load_log(path)], [[nan, 4.5], [0.18, nan], [inf, nan]])
    log = load_log(path, ROBOT)
    assert log.robot is ROBOT
    np.testing.assert_equal([f.ranges.tolist() for f in log], [[nan, inf], [nan, nan], [inf, nan]])


def test_carmen_mounts_of_the_log_do_not_matter_where_the_robot_is_given(tmp_path):
    odd = messages(odom(0, 0, 0, 0), sonar(0, mounts="0 99 0 0 0 0"), sonar(1, mounts="1 1 1 1 1 1"))
    assert len(list(load_log(put(tmp_path, odd), ROBOT))) == 2


def test_carmen_mounts_may_be_written_in_another_way(tmp_path):
    text = messages(odom(0, 0, 0, 0), sonar(0), sonar(1, mounts="0.100 0 -0.0 0 0.1 1.5708"))
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
    lines = [sonar(t) for t in range(4)]
    assert len(list(load_log(put(tmp_path, messages(*lines[:3], odom(0, 0, 0, 9)))))) == 3
    path = put(tmp_path, messages(*lines, odom(0, 0, 0, 9)))
    frames, error = drain(load_log(path))
    assert error is not None
    assert (len(frames), error.where) == (0, f"{path}:6")
    assert_plain(error)


def read_anything(path: Path) -> None:
    """A log gives frames that keep the rules, or an EchogridError that speaks plainly; nothing else."""
    try:
        log = load_log(path)
        last = -inf
        for frame in log:
            assert frame.ranges.shape == (log.sonars,)
            assert np.isfinite([frame.stamp, *frame.pose]).all()
            assert not (frame.ranges < 0).any()
            assert frame.stamp >= last
            last = frame.stamp
        describe(log)
    except EchogridError as error:
        assert_plain(error)


@many
@given(
    st.binary(max_size=200),
    st.sampled_from([b"", b"t,x,y,theta,r0\n", b"t,x,y,theta", b"# ", b"SONAR ", b"ODOM "]),
)
def test_random_bytes_never_break_a_reader(tmp_path, noise, start):
    read_anything(put(tmp_path, start + noise))


TOKENS = [
    b"",
    b" ",
    b",",
    b"\n",
    b"\r",
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-",
    b"0",
    b"9" * 30,
    b"_",
    b"\0",
]


@many
@given(st.data(), st.sampled_from([CSV, CARMEN]))
def test_a_damaged_log_never_breaks_a_reader(tmp_path, data, content):
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        end = start + data.draw(st.integers(0, 12))
        piece = data.draw(st.one_of(st.sampled_from(TOKENS), st.binary(max_size=3)))
        content = content[:start] + piece + content[end:]
    read_anything(put(tmp_path, content))


@many
@given(st.lists(st.text("0123456789.+-e infaty_\x0b\x1f", max_size=6), min_size=1, max_size=3))
def test_an_empty_field_beside_it_changes_no_reading(tmp_path, fields):
    # Rows with an empty field are taken apart in another way than rows without.
    row = f"0,0,0,0,{','.join(fields)},"
    header = "t,x,y,theta," + ",".join(f"r{i}" for i in range(len(fields) + 1)) + "\n"
    frames, error = drain(load_log(put(tmp_path, header + row + "nan\n")))
    others, other = drain(load_log(put(tmp_path, header + row + "\n")))
    assert (error is None) == (other is None)
    assert len(frames) == len(others)
    assert all(same(a, b) for a, b in zip(frames, others, strict=True))


numbers = st.floats(-1e6, 1e6, allow_nan=False)
poses = st.tuples(numbers, numbers, numbers).map(np.array)
readings = st.one_of(st.floats(0, 100), st.just(inf), st.just(nan))


@st.composite
def drives(draw):
    sonars, has_odom = draw(st.integers(1, 6)), draw(st.booleans())
    stamps = sorted(draw(st.lists(st.floats(-1e10, 1e10), min_size=1, max_size=8)))
    lists = st.lists(readings, min_size=sonars, max_size=sonars).map(np.array)
    return [Frame(t, draw(poses), draw(lists), draw(poses) if has_odom else None) for t in stamps]


@many
@given(drives())
def test_write_then_read_is_the_identity(tmp_path, frames):
    path = tmp_path / "drive.csv"
    write_csv(path, iter(frames), len(frames[0].ranges))
    read = list(load_log(path))
    assert len(read) == len(frames)
    assert all(same(a, b) for a, b in zip(read, frames, strict=True))


def steps(count: int, sonars: int = 2) -> Iterator[Frame]:
    for i in range(count):
        yield Frame(i * 0.1, np.array([i * 0.01, 0.0, 0.1]), np.full(sonars, 1.0 + i % 7))


def test_a_long_log_is_written_whole(tmp_path):
    path = tmp_path / "drive.csv"
    write_csv(str(path), steps(1000), 2)
    assert all(same(a, b) for a, b in zip(load_log(path), steps(1000), strict=True))
    assert path.read_text().splitlines()[:2] == ["t,x,y,theta,r0,r1", "0.0,0.0,0.0,0.1,1.0,1.0"]


def failing() -> Iterator[Frame]:
    yield from steps(700)
    raise KeyboardInterrupt


def with_frame(**changes: object) -> list[Frame]:
    values = {"stamp": 40.0, "pose": np.zeros(3), "ranges": np.ones(2), "odom": None} | changes
    return [*steps(300), Frame(**values)]  # ty: ignore[invalid-argument-type]


@pytest.mark.parametrize(
    ("frames", "error", "text"),
    [
        (failing(), KeyboardInterrupt, None),
        ([], InputError, "found no frames"),
        (with_frame(ranges=np.ones(3)), InputError, "frame 300: found 7 numbers, expected 6"),
        (with_frame(odom=np.zeros(3)), InputError, "frame 300: found 9 numbers, expected 6"),
        (with_frame(stamp=1.0), InputError, "frame 300: found time 1.0 after 29.9"),
        (with_frame(pose=np.array([0, nan, 0])), InputError, "frame 300: found y = nan"),
        (with_frame(ranges=np.array([1, 101.0])), InputError, "frame 300: found r1 = 101.0"),
    ],
)
def test_a_log_that_cannot_be_written_whole_leaves_the_folder_as_it_was(tmp_path, frames, error, text):
    path = put(tmp_path, b"precious", "drive.csv")
    with pytest.raises(error, match=text):
        write_csv(path, frames, 2)
    assert [entry.name for entry in tmp_path.iterdir()] == ["drive.csv"]
    assert path.read_bytes() == b"precious"


@pytest.mark.parametrize("name", ["folder", "absent/drive.csv", "file/drive.csv", "x" * 300, "a\0b", "/"])
def test_a_place_that_cannot_be_written_is_a_usage_error(tmp_path, name):
    (tmp_path / "folder").mkdir()
    put(tmp_path, b"", "file")
    with pytest.raises(UsageError) as caught:
        write_csv(tmp_path / name, steps(3), 2)
    assert_plain(caught.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]


def peak_of(work) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_log_is_streamed_both_ways(tmp_path):
    path = tmp_path / "drive.csv"
    assert peak_of(lambda: write_csv(path, steps(20_000, 8), 8)) < 1e6
    assert path.stat().st_size > 1e6
    assert peak_of(lambda: describe(load_log(path))) < 1e6


def test_a_carmen_log_is_streamed(tmp_path):
    path = put(tmp_path, messages(*(line for i in range(8000) for line in (odom(i, 0, 0, i), sonar(i)))))
    assert path.stat().st_size > 8e5
    assert peak_of(lambda: describe(load_log(path))) < 4e5


def test_a_file_without_line_ends_does_not_fill_the_memory(tmp_path):
    path = put(tmp_path, CSV + b"1," * 4_000_000)

    def read():
        _, error = drain(load_log(path))
        assert error is not None
        assert error.where == f"{path}:4"

    assert peak_of(read) < 4e6


def test_readers_start_without_jax():
    code = "import sys, echogrid.logs.formats; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def corridor8(*arguments: object) -> subprocess.CompletedProcess:
    script = ROOT / "experiments" / "corridor8_to_csv.py"
    return subprocess.run([sys.executable, script, *map(str, arguments)], check=False, capture_output=True, text=True)


@pytest.mark.skipif(not CORRIDOR8.is_dir(), reason="the recorded run is not part of the repository")
def test_the_recorded_corridor_becomes_a_csv_log(tmp_path):
    path = tmp_path / "corridor8.csv"
    result = corridor8(CORRIDOR8, path)
    assert (result.returncode, result.stderr) == (0, "")
    log = load_log(path, Robot.load(ROOT / "experiments" / "corridor8.yaml"))
    info = describe(log)
    assert (info.frames, info.sonars, info.start_s) == (413, 8, 0.0)
    assert info.span_s == pytest.approx(92.8, abs=0.05)
    assert info.length_m == pytest.approx(25, abs=0.2)
    assert info.no_echo == pytest.approx(0.33, abs=0.01)
    assert info.no_echo_by_sonar[4] == pytest.approx(0.81, abs=0.01)
    first = next(iter(log))
    assert first.ranges.tolist() == [inf, inf, 2.32, 2.36, inf, inf, 2.16, 1.19]
    # The run turns right at the end of the first leg.
    assert min(frame.pose[2] for frame in log) < -pi / 4


def test_the_corridor_script_says_in_one_line_what_is_wrong(tmp_path):
    put(tmp_path, "0 1 1 1 1 1 1 1 1\n", "measurement.txt")
    put(tmp_path, "7 0 0 0\n", "poses.txt")
    for folder in (tmp_path, tmp_path / "absent"):
        result = corridor8(folder, tmp_path / "out.csv")
        assert result.returncode == 2
        assert len(result.stderr.splitlines()) == 1
        assert not (tmp_path / "out.csv").exists()
