import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy import inf, nan

from benchmarks import mrpt
from echogrid import Frame, Robot
from echogrid.errors import UsageError

built = pytest.mark.skipif(not mrpt.available(), reason="MRPT's harness is not built (benchmarks/mrpt/install.sh)")

BEAM = 25.0
"""Degrees."""


def robot(*mounts, beam_width_deg=BEAM):
    """A robot with sonars at x, y (m) and axis (degrees)."""
    placed = np.array(mounts, float) * [1, 1, np.pi / 180]
    return replace(Robot.load("b21"), mounts=placed, beam_width_rad=float(np.deg2rad(beam_width_deg)))


def map_of(ranges, mounts=((0, 0, 0),), *, pose=(0.013, 0.017, 0.0), resolution=0.02, centred=True, **options):
    """The map of one scan."""
    frame = Frame(0.0, np.array(pose, float), np.array(ranges, float))
    grid, seconds, cpu_seconds = mrpt.mrpt_map([frame], robot(*mounts), resolution, centred, **options)
    assert 0 < seconds < 10
    assert 0 <= cpu_seconds <= 2 * seconds
    return grid


def touched(grid):
    """World points (m) of the cells that hold anything, and their log-odds."""
    index = np.argwhere(grid.observed)
    return grid.centre_of(index), grid.log_odds[*index.T]


def bearings(grid, axis_deg, pose=(0.013, 0.017, 0.0)):
    """Degrees from the sonar's axis of the cells beyond 1 m that hold anything."""
    p_world, _ = touched(grid)
    x, y = (p_world - pose[:2]).T
    away = np.arctan2(y, x) - np.deg2rad(axis_deg) - pose[2]
    return np.rad2deg(np.angle(np.exp(1j * away)))[np.hypot(x, y) > 1]


@built
@pytest.mark.parametrize("axis_deg", [0, 90, 133])
@pytest.mark.parametrize("beam_deg", [10, 25, 40])
def test_the_cone_as_shipped_lies_half_a_beam_to_the_right_of_the_axis(axis_deg, beam_deg):
    away = bearings(map_of([2.0], [(0, 0, axis_deg)], centred=False, beam_width_rad=np.deg2rad(beam_deg)), axis_deg)
    assert away.mean() == pytest.approx(-beam_deg / 2, abs=1)
    assert away.min() == pytest.approx(-beam_deg, abs=1.5)
    assert away.max() == pytest.approx(0, abs=1.5)


@built
@pytest.mark.parametrize("axis_deg", [0, 90, 133])
@pytest.mark.parametrize("beam_deg", [10, 25, 40])
def test_the_centred_cone_lies_on_the_axis(axis_deg, beam_deg):
    away = bearings(map_of([2.0], [(0, 0, axis_deg)], beam_width_rad=np.deg2rad(beam_deg)), axis_deg)
    assert away.mean() == pytest.approx(0, abs=1)
    assert [away.min(), away.max()] == pytest.approx([-beam_deg / 2, beam_deg / 2], abs=1.5)


@built
def test_a_wall_appears_at_its_range_from_the_sonar_and_the_floor_before_it_is_free():
    pose = (1.5, -2.0, 1.0)
    p_world, log_odds = touched(map_of([2.0], [(0.25, 0.1, 40)], pose=pose, beam_width_rad=np.deg2rad(10)))
    sonar = np.array([1.5 + 0.25 * np.cos(1) - 0.1 * np.sin(1), -2.0 + 0.25 * np.sin(1) + 0.1 * np.cos(1)])
    distance = np.hypot(*(p_world - sonar).T)
    assert distance[log_odds > 0].min() > 1.95
    assert distance[log_odds > 0].max() < 2.05
    assert distance[log_odds < 0].max() < 2.0
    axis = np.deg2rad(40) + 1.0
    grid = map_of([2.0], [(0.25, 0.1, 40)], pose=pose)
    on_axis = sonar + np.outer([1.0, 1.95], [np.cos(axis), np.sin(axis)])
    free, wall = grid.probability_at(on_axis)
    assert free < 0.4
    assert wall > 0.8


@built
def test_every_sonar_speaks_from_its_own_place():
    mounts, ranges = [(0.2, 0, 0), (0, 0.2, 90), (-0.2, 0, 180)], [1.5, 1.0, 2.0]
    together = map_of(ranges, mounts)
    alone = [map_of([reading], [mount]) for reading, mount in zip(ranges, mounts, strict=True)]
    p_world, log_odds = touched(together)
    sums = np.zeros(len(p_world))
    for grid in alone:
        row, col = grid.index_of(p_world).T
        inside = (row >= 0) & (row < grid.shape[0]) & (col >= 0) & (col < grid.shape[1])
        sums[inside] += grid.log_odds[row[inside], col[inside]]
    np.testing.assert_allclose(log_odds, sums, atol=1e-5)


@built
def test_the_readings_add_up_to_mrpts_own_steps():
    levels = np.unique(touched(map_of([2.0]))[1])
    # MRPT rounds log-odds to 1/16, and adds that of occupied three times.
    assert levels.min() == pytest.approx(-10 / 16, abs=1e-5)
    assert any(level == pytest.approx(30 / 16, abs=1e-5) for level in levels)
    freer = np.unique(touched(map_of([2.0], free_certainty=0.9))[1])
    assert freer.min() == pytest.approx(-35 / 16, abs=1e-5)


def test_mrpts_probability_of_free_is_turned_into_log_odds_of_occupied():
    p_free = np.array([[0.5, 0.9, 0.1]], dtype=np.float32)
    log_odds = mrpt.occupied_log_odds(p_free)
    assert log_odds.dtype == np.float32
    np.testing.assert_allclose(log_odds, [[0.0, -np.log(9), np.log(9)]], atol=1e-6)


@built
def test_what_did_not_fire_or_heard_no_echo_changes_nothing():
    assert not map_of([nan]).observed.any()
    assert not map_of([inf]).observed.any()


@built
def test_no_echo_as_an_invalid_reading_frees_half_the_largest_distance():
    p_world, log_odds = touched(map_of([inf], no_echo_m=inf, max_distance_m=6.0))
    assert np.hypot(*p_world.T).max() == pytest.approx(3.0, abs=0.05)
    assert log_odds.max() < 0
    assert not map_of([inf], no_echo_m=inf, invalid_as_free=False).observed.any()


@built
def test_no_echo_as_a_maximum_range_is_an_obstacle_there():
    p_world, log_odds = touched(map_of([inf], no_echo_m=5.0))
    assert np.hypot(*p_world[log_odds > 0].T).min() > 4.8


@built
def test_cells_lie_on_multiples_of_the_resolution_and_far_from_the_origin_nothing_changes():
    here = map_of([2.0], pose=(0.3, 0.2, 0.5), resolution=0.125)
    there = map_of([2.0], pose=(1_000_000.3, -2_000_000.2 + 0.4, 0.5), resolution=0.125)
    np.testing.assert_array_equal(here.log_odds, there.log_odds)
    assert np.subtract(there.origin, here.origin) == pytest.approx([1_000_000, -2_000_000])
    for grid in (here, map_of([2.0], resolution=0.12)):
        cells = np.array(grid.origin) / grid.resolution
        np.testing.assert_allclose(cells, np.rint(cells), atol=1e-9)
        assert grid.log_odds.dtype == np.float32


HEADER = {
    "rows": 100,
    "cols": 100,
    "x0": 0,
    "y0": 0,
    "resolution": 0.1,
    "beam_width": 0.4,
    "centred": 0,
    "no_echo": 0,
    "max_distance": 15,
    "occupied_certainty": 0.65,
    "free_certainty": 0,
    "invalid_as_free": 1,
    "sonars": 1,
    "frames": 1,
}


def drive(numbers=(0, 0, 0, 5, 5, 0, 1), **changes):
    """What the harness reads: a header, one mount, one frame."""
    header = {key: value for key, value in (HEADER | changes).items() if value is not None}
    lines = "".join(f"{key} {value}\n" for key, value in header.items())
    return lines.encode() + b"data\n" + np.array(numbers, float).tobytes()


def harness(text):
    return subprocess.run([mrpt.HARNESS], input=text, capture_output=True, timeout=60, check=False)


@built
def test_the_harness_takes_a_good_drive():
    done = harness(drive())
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"rows 100\ncols 100\n")
    assert len(done.stdout.partition(b"\ndata\n")[2]) == 100 * 100 * 4


@built
@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "header: found its end"),
        (b"hello\ndata\n", "header: found a line"),
        (drive(rows=None), "rows: found nothing"),
        (drive(rows=1.5), "rows: found 1.5"),
        (drive(rows=1e8, cols=1e8), "rows * cols: found"),
        (drive(resolution="nan"), "resolution: found nan"),
        (drive(occupied_certainty=0.4), "occupied_certainty: found 0.4"),
        (drive(colour=1), "colour: found an unknown key"),
        (drive(numbers=(0, 0)), "mounts: found the end"),
        (drive(numbers=(0, 0, 0, 5, 5, 0)), "frames: found the end"),
        (drive(numbers=(0, 0, 0, 5, 5, 0, 1, 1)), "frames: found more bytes"),
        (drive(numbers=(0, nan, 0, 5, 5, 0, 1)), "mounts: found nan"),
        (drive(numbers=(0, 0, 0, 5, inf, 0, 1)), "frames[0]: found a pose of inf"),
        (drive(numbers=(0, 0, 0, 5, 5, 0, -1)), "frames[0]: found a range of -1"),
        (drive(numbers=(0, 0, 0, 5, 5, 0, 4)), "frames[0]: found a reading that comes within 17 cells"),
        (drive(numbers=(0, 0, 0, 5, 5, 0, 3), resolution=0.002), "frames[0]: found a cone with a side"),
    ],
)
def test_bad_input_is_one_line_and_status_2(text, message):
    done = harness(text)
    assert done.returncode == 2
    assert done.stdout == b""
    lines = done.stderr.decode().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"mrpt_grid: {message}")


@built
def test_an_option_that_mrpt_does_not_know_is_an_error():
    with pytest.raises(UsageError, match="mrpt_grid: occupied_certainty: found"):
        map_of([2.0], occupied_certainty=1.5)


def test_a_drive_that_does_not_fit_the_robot_is_an_error():
    with pytest.raises(UsageError, match="found no frames"):
        mrpt.mrpt_map([], robot((0, 0, 0)), 0.1, centred=True)
    with pytest.raises(UsageError, match="found a frame of 2 readings, expected 1"):
        map_of([1.0, 2.0])


def test_without_the_harness_the_script_says_so_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(mrpt, "HARNESS", Path("/nowhere/mrpt_grid"))
    assert not mrpt.available()
    mrpt.main()
    assert capsys.readouterr().out == "mrpt: not built (benchmarks/mrpt/install.sh)\n"
    with pytest.raises(UsageError, match="expected it"):
        map_of([2.0])
