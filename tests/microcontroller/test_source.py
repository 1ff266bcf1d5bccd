"""An export does what it says, in the memory that it says, and nothing undefined."""

import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.microcontroller.source import MOST_SONARS, source_of, state_bytes, write
from echogrid.robot import Robot
from export_samples import (
    PER_LOG_ODDS,
    UNKNOWN,
    WARNINGS,
    Window,
    in_a_room,
    network,
    packed,
    random_array,
    told,
    walk,
)

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="found no gcc")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Four sonars, one of a short range, in a small window."""
    mounts = np.column_stack([np.zeros(4), np.zeros(4), np.arange(4) * np.pi / 2])
    robot = replace(
        Robot.load("b21"), mounts=mounts, own_max_ranges_m=np.array([1.0, 3.0, 3.0, 3.0]), footprint_radius_m=0.3
    )
    return Window(tmp_path_factory.mktemp("small"), source_of(network(), robot, 5.4, 0.1))


@pytest.fixture
def window(small):
    small.start()
    return small


def frame(*ranges, at=(0.0, 0.0, 0.0), stamp=0.0):
    return Frame(stamp, np.array(at), np.array(ranges, dtype=float))


def test_nothing_is_known_before_the_first_scan(window):
    assert np.all(window.read() == UNKNOWN)


def test_what_left_the_window_is_unknown_when_it_comes_back(window):
    window.scan(frame(0.8, 1.5, 1.5, 1.5))
    before = window.read()
    corner = window.corner()
    window.scan(frame(*[np.nan] * 4, at=(3.0, 0.0, 0.0), stamp=10.0))
    window.scan(frame(*[np.nan] * 4, at=(0.0, 0.0, 0.0), stamp=20.0))
    assert window.corner() == corner
    after = window.read()
    gone = slice(None), slice(0, 30)  # x below 3 - 2.7 + 0.6: past the floor stood on
    assert np.any(before[gone] != UNKNOWN)
    far = np.hypot(*np.meshgrid(np.arange(54) - 26.5, np.arange(54) - 26.5)) > 4
    assert np.all(after[gone][far[gone]] == UNKNOWN)
    assert np.any(after[:, 31:][far[:, 31:]] != UNKNOWN)


def test_the_floor_stood_on_and_come_over_is_free_whatever_is_said(window):
    window.scan(frame(*[np.nan] * 4))
    window.scan(frame(*[0.27] * 4, at=(0.5, 0.0, 0.0), stamp=5.0))
    x0, y0 = window.corner()
    for x in np.arange(-0.2, 0.71, 0.1):
        assert window.c.echogrid_cell(window.state, int((0.02 - y0) / 0.1), int((x - x0) / 0.1)) <= -4 * PER_LOG_ODDS
    window.scan(frame(*[np.nan] * 4, at=(1.4, 0.0, 0.0), stamp=6.0))  # too far for a step: not come over
    x0, y0 = window.corner()
    assert window.c.echogrid_cell(window.state, int((0.02 - y0) / 0.1), int((0.95 - x0) / 0.1)) > -4 * PER_LOG_ODDS


def test_nothing_is_said_past_a_sonars_own_range(window):
    window.scan(frame(np.inf, np.inf, np.nan, np.nan))
    x = (np.arange(54) + 0.5) * 0.1 + window.corner()[0]
    ahead = window.read()[25:29]
    assert np.all(ahead[:, (x > 0.4) & (x < 0.9)] != UNKNOWN)
    assert np.all(ahead[:, x > 1.12] == UNKNOWN)
    assert np.any(window.read()[:, 25:29][x > 2.0] != UNKNOWN)


def test_raw_ranges_are_cleaned_by_the_sonars_limits(window):
    window.scan(frame(1.0, 99.0, 0.1, -1.0))
    raw = window.read()
    window.start()
    window.scan(frame(np.inf, np.inf, np.nan, np.nan))
    assert np.array_equal(raw, window.read())
    window.start()
    window.scan(frame(0.9, np.inf, np.nan, np.nan))
    assert not np.array_equal(raw, window.read())


@pytest.mark.parametrize("pose", [(np.nan, 0, 0), (0, np.inf, 0), (0, 0, np.nan), (2000.0, 0, 0), (0, 0, 1e4)])
def test_a_pose_that_cannot_be_changes_nothing(window, pose):
    window.scan(frame(0.8, 1.5, 1.5, np.inf))
    before = bytes(window.state)
    assert window.scan(frame(0.8, 1.5, 1.5, np.inf, at=pose, stamp=1.0)) == 1
    assert bytes(window.state) == before


def test_cells_outside_of_the_window_are_unknown(window):
    window.scan(frame(0.8, 1.5, 1.5, 1.5))
    for row, col in [(-1, 3), (3, -1), (54, 3), (3, 54), (2**31 - 1, 0), (0, -(2**31))]:
        assert window.c.echogrid_cell(window.state, row, col) == UNKNOWN


def test_time_may_wrap(window):
    def driven(begin):
        window.start()
        for k in range(20):
            fires = np.array([1.0, np.nan, 1.4, np.nan] if k % 2 else [np.nan, 1.2, np.nan, 1.6])
            window.scan(Frame(begin + 0.1 * k, np.array([0.02 * k, 0, 0]), fires))
        return window.read()

    assert np.array_equal(driven(0.0), driven(2**32 / 1000 - 1))


def test_a_silent_sonar_is_taken_to_hear_what_it_heard_just_before_and_not_what_it_heard_long_ago(window):
    def after(gap_s, way_m=0.02):
        window.start()
        window.scan(frame(0.8, 1.2, 1.4, 1.6))
        window.scan(frame(0.8, np.nan, np.nan, np.nan, at=(way_m, 0, 0), stamp=gap_s))
        return window.read()

    assert np.array_equal(after(0.1), after(1.9))
    assert not np.array_equal(after(0.1), after(2.1))
    assert not np.array_equal(after(0.1, 0.39), after(2.1, 0.39))
    assert np.array_equal(after(0.1, 0.41), after(2.1, 0.41))


@pytest.mark.parametrize(("between", "recalled"), [(0, True), (15, True), (16, False)])
def test_a_silent_sonar_hears_nothing_after_sixteen_scans(window, between, recalled):
    window.scan(frame(*[np.inf] * 4))
    for _ in range(between):
        window.scan(frame(*[np.nan] * 4))
    window.scan(frame(np.inf, np.nan, np.nan, np.nan, at=(-0.3, 0, 0)))
    x = (np.arange(54) + 0.5) * 0.1 + window.corner()[0]
    assert np.any(window.read()[25:29, x < -2.6] != UNKNOWN) == recalled


def test_a_scan_in_which_no_sonar_fires_says_nothing_of_what_was_heard_before(window):
    window.scan(frame(*[np.inf] * 4))
    window.scan(frame(*[np.nan] * 4, at=(-0.3, 0, 0)))
    x = (np.arange(54) + 0.5) * 0.1 + window.corner()[0]
    assert np.all(window.read()[25:29, x < -2.6] == UNKNOWN)


def test_the_state_takes_what_is_said(small, tmp_path):
    assert small.size == state_bytes(4, 54)
    assert tuple(small.read().shape) == (54, 54)
    for n, side in [(1, 1.3), (7, 2.7)]:
        robot = replace(Robot.load("b21"), mounts=np.zeros((n, 3)))
        source = source_of(network(), robot, side, 0.1)
        assert Window(tmp_path / str(n), source).size == source.state_bytes


@pytest.mark.parametrize(
    "flags", [["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"], ["-O3"]]
)
def test_nothing_is_undefined(tmp_path, flags):
    rng = np.random.default_rng(6)
    robot = random_array(rng, 9, reach=2.2)
    window = Window(tmp_path, source_of(network(), robot, 3.0, 0.1))
    frames = list(in_a_room(rng, robot, walk(rng, 60, step=0.2, box=3.0), in_turn=True, silent=0.2))
    frames += [
        Frame(0.0, np.array([x, y, theta]), frames[0].ranges) for x, y, theta in np.diag([999.0, -999.0, -620.0])
    ]
    for each in frames:
        window.scan(each)
    program = tmp_path / "drive"
    files = [tmp_path / "echogrid.c", __file__.replace("test_source.py", "drive.c")]
    told([shutil.which("gcc"), *WARNINGS, *flags, "-D_POSIX_C_SOURCE=200809L", "-I", tmp_path, *files, "-o", program])
    done = subprocess.run([program], input=packed(frames), capture_output=True, timeout=100)
    assert (done.returncode, done.stderr.decode()) == (0, "")
    assert done.stdout[8:] == window.read().tobytes()


def test_the_example_is_short_and_compiles_without_a_warning(tmp_path):
    source = source_of(network(), Robot.load("b21"), 6.0, 0.1)
    write(tmp_path, source)
    files = [tmp_path / "echogrid.c", tmp_path / "example.c"]
    told([shutil.which("gcc"), *WARNINGS, "-O2", *files, "-o", tmp_path / "example"])
    assert len(source.texts["example.c"].splitlines()) <= 40


def test_the_header_is_cpp_too(small, tmp_path):
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("found no g++")
    Window(tmp_path, source_of(network(), Robot.load("b21"), 6.0, 0.1))
    put = tmp_path / "main.cpp"
    put.write_text('#include "echogrid.h"\nint main() { static echogrid map; echogrid_start(&map); }\n')
    told([shutil.which("gcc"), "-c", tmp_path / "echogrid.c", "-o", tmp_path / "echogrid.o"])
    told([compiler, "-Wall", put, tmp_path / "echogrid.o", "-o", tmp_path / "main"])
    told([tmp_path / "main"])


@pytest.mark.parametrize(
    ("side", "cell", "line"),
    [
        (6.0, 0.01, "--cell: found 0.01, expected 0.02 to 0.5 m"),
        (6.0, float("nan"), "--cell: found nan, expected 0.02 to 0.5 m"),
        (0.5, 0.1, "--side: found 0.5, expected 1 to 50 m"),
        (1.0, 0.4, "--side: found 2 cells of 0.4 m, expected 8 to 500"),
        (40.0, 0.04, "--side: found 1000 cells of 0.04 m, expected 8 to 500"),
    ],
)
def test_a_window_that_is_none_is_refused(side, cell, line):
    with pytest.raises(UsageError) as refused:
        source_of(network(), Robot.load("b21"), side, cell)
    assert str(refused.value) == line


def test_arrays_and_networks_that_are_too_large_are_refused():
    many = replace(Robot.load("b21"), mounts=np.zeros((MOST_SONARS + 1, 3)))
    with pytest.raises(UsageError, match=r"robot b21: found 65 sonars, expected at most 64"):
        source_of(network(), many, 6.0, 0.1)
    wide = replace(network(), weights=network().weights | {"b1": np.zeros(65)})
    with pytest.raises(UsageError, match=r"found layers of 65 units, expected at most 64"):
        source_of(wide, Robot.load("b21"), 6.0, 0.1)


@pytest.mark.parametrize("name", ["evil */ int x; /* ☠\n??/", "/*/*/", "???/", "*" * 9 + "/" * 9, "\\"])
def test_a_name_cannot_leave_its_comment(tmp_path, name):
    source = source_of(network(), replace(Robot.load("b21"), name=name), 1.0, 0.1)
    text = source.texts["echogrid.c"]
    assert text.isascii()
    assert text.index("*/") > text.index("It writes this file anew")
    Window(tmp_path, source, "-O0")  # without a warning
