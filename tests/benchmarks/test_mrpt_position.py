import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy import inf, nan

from benchmarks import mrpt_position, position_peers
from benchmarks.mrpt_position import Filter
from echogrid import Frame, Grid, Robot
from echogrid.errors import UsageError
from echogrid.geometry import compose
from echogrid.metrics import Truth, trajectory_error
from echogrid.position.motion import chained, steps

built = pytest.mark.skipif(
    not mrpt_position.available(), reason="MRPT's harness is not built (benchmarks/mrpt/install.sh)"
)

WIDE_M, DEEP_M = 5.0, 4.0
"""Of a room with its lower left corner at the origin."""

EXACT = Filter(particles=20, way=0.0, heading=0.0)


@pytest.fixture(scope="module")
def robot():
    """Twelve sonars round the middle."""
    axes = np.arange(12) * np.pi / 6
    mounts = np.column_stack([0.1 * np.cos(axes), 0.1 * np.sin(axes), axes])
    return replace(Robot.load("b21"), mounts=mounts, beam_width_rad=float(np.deg2rad(15)))


def round_the_room(laps):
    """True poses on a circle of 1 m."""
    angle = np.arange(0, 2 * np.pi * laps, 0.04)
    return np.column_stack([2.5 + np.cos(angle), 2.0 + np.sin(angle), angle + np.pi / 2])


def heard(poses, robot):
    """The nearest wall in each cone, m: walls are so rough that each ray comes back."""
    rays = robot.mounts[:, 2, None] + np.linspace(-0.5, 0.5, 9) * robot.beam_width_rad
    p_world = compose(poses[:, None], robot.mounts)[..., :2]
    way = poses[:, 2, None, None] + rays
    cos, sin = np.cos(way), np.sin(way)
    x, y = (np.where(cos > 0, WIDE_M, 0.0), np.where(sin > 0, DEEP_M, 0.0))
    away = np.minimum((x - p_world[..., :1]) / cos, (y - p_world[..., 1:]) / sin)
    return away.min(axis=-1)


def frames_of(poses, ranges):
    return [Frame(0.1 * i, pose, each) for i, (pose, each) in enumerate(zip(poses, ranges, strict=True))]


def room(cell=0.05):
    """The map of the room: walls a cell thick, floor within."""
    rows, cols = round(DEEP_M / cell) + 2, round(WIDE_M / cell) + 2
    log_odds = np.full((rows, cols), 4.0, np.float32)
    log_odds[1:-1, 1:-1] = -4.0
    return Grid(log_odds, np.ones((rows, cols), bool), cell, (-cell, -cell))


def bent(truth, bias):
    """Odometry that turns by a bias (rad) on each metre."""
    step = steps(truth)
    step[:, 2] += bias * np.hypot(step[:, 0], step[:, 1])
    return chained(truth[0], step)


@built
@pytest.mark.parametrize("reading", [inf, nan])
def test_what_hears_nothing_goes_where_the_odometry_goes(robot, reading):
    poses = round_the_room(1) + np.array([100.0, -50.0, 0.0])
    frames = frames_of(poses, np.full((len(poses), robot.sonars), reading))
    # MRPT adds a millimetre and a milliradian to each step of a particle.
    found = mrpt_position.rbpf_slam(frames, robot, replace(EXACT, particles=200))
    np.testing.assert_allclose(found.then[:, :2], poses[:, :2], atol=0.01)
    known = mrpt_position.monte_carlo(frames, robot, room(), poses[0], np.zeros(3), replace(EXACT, particles=200))
    np.testing.assert_allclose(known.then[:, :2], poses[:, :2], atol=0.01)
    way = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum()
    assert way / EXACT.update_m * 0.7 < found.updates <= way / EXACT.update_m + 1


@built
def test_the_map_says_where_the_robot_is(robot):
    truth = round_the_room(1.5)
    frames = frames_of(bent(truth, 0.05), heard(truth, robot))
    start = truth[0] + np.array([0.2, -0.15, 0.1])
    spread = np.array([0.2, 0.2, 0.15])
    options = Filter(particles=150, way=0.1, heading=0.1)
    found = mrpt_position.monte_carlo(frames, robot, room(), start, spread, options)
    off = np.linalg.norm((found.then - truth)[40:, :2], axis=1)
    assert off.max() < 0.15
    np.testing.assert_array_equal(found.then, found.end)
    there = np.array([1000.0, -2000.0, 0.0])
    elsewhere = replace(room(), origin=(1000.0 - 0.05, -2000.0 - 0.05))
    again = mrpt_position.monte_carlo(frames, robot, elsewhere, start + there, spread, options)
    np.testing.assert_allclose(again.then - there, found.then, atol=0.05)


@built
def test_slam_finds_the_way_that_odometry_bends(robot):
    truth = round_the_room(3)
    odometry = bent(truth, 0.06)
    frames = frames_of(odometry, heard(truth, robot))
    found = mrpt_position.rbpf_slam(frames, robot, Filter(particles=20, heading=0.1))
    before = trajectory_error(odometry, truth).aligned_rms_m
    for poses in (found.then, found.end):
        assert trajectory_error(poses, truth).aligned_rms_m < 0.5 * before
    np.testing.assert_allclose(found.then[0], truth[0], atol=1e-9)


@built
def test_the_seed_gives_the_same_poses_and_another_seed_others(robot):
    truth = round_the_room(0.3)
    frames = frames_of(truth, heard(truth, robot))
    one, again, other = (mrpt_position.rbpf_slam(frames, robot, Filter(particles=5), seed).then for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.abs(one - other).max() > 1e-4


HEADER = {
    "beam_width": 0.4,
    "max_range": 5,
    "sonars": 1,
    "frames": 1,
    "particles": 10,
    "update_m": 0.2,
    "update_rad": 0.2,
    "way": 0.1,
    "heading": 0.1,
    "turned": 0,
    "hit": 0.1,
    "correspondence": 0.3,
    "average": 1,
    "power": 1,
    "seed": 1,
    "cell": 0.1,
}
SLAM = HEADER | {"centred": 1, "occupied_certainty": 0.65}
KNOWN = HEADER | {"start_m": 0.1, "start_rad": 0.1, "x0": 0, "y0": 0, "rows": 1, "cols": 2}


def drive(header, numbers, **changes):
    """What the harness reads: a header, one mount, one frame, and what follows."""
    lines = "".join(f"{key} {value}\n" for key, value in (header | changes).items() if value is not None)
    return lines.encode() + b"data\n" + np.array(numbers, float).tobytes()


def harness(text, *arguments):
    return subprocess.run(
        [mrpt_position.HARNESS, *arguments], input=text, capture_output=True, timeout=60, check=False
    )


@built
@pytest.mark.parametrize(
    ("task", "text"),
    [("slam", drive(SLAM, [0] * 6 + [1])), ("localise", drive(KNOWN, [0] * 6 + [1, 0, 0, 0, 0.1, 1]))],
)
def test_the_harness_takes_a_good_drive(task, text):
    done = harness(text, task)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"frames 1\nupdates 0\n")
    assert len(done.stdout.partition(b"\ndata\n")[2]) == 2 * 3 * 8


@built
@pytest.mark.parametrize(
    ("task", "text", "message"),
    [
        ("drive", b"", "command line: found drive, expected slam"),
        ("slam", b"", "header: found its end"),
        ("slam", drive(SLAM, [], particles=None), "particles: found nothing"),
        ("slam", drive(SLAM, [], cell=nan), "cell: found nan"),
        ("slam", drive(SLAM, [], rows=1), "rows: found an unknown key"),
        ("slam", drive(SLAM, [0, 0]), "mounts: found the end"),
        ("slam", drive(SLAM, [0, 0, 0, 0, inf, 0, 1]), "frames[0]: found a pose of inf"),
        ("slam", drive(SLAM, [0, 0, 0, 0, 0, 0, -1]), "frames[0]: found a range of -1"),
        ("slam", drive(SLAM, [0] * 8), "data: found more bytes"),
        ("localise", drive(KNOWN, [0] * 7, rows=1e8, cols=1e8), "rows * cols: found"),
        ("localise", drive(KNOWN, [0] * 7 + [nan, 0, 0, 0, 1]), "start: found nan"),
        ("localise", drive(KNOWN, [0] * 10 + [0.5]), "map: found the end"),
        ("localise", drive(KNOWN, [0] * 10 + [0.5, 2]), "map: found 2"),
    ],
)
def test_bad_input_is_one_line_and_status_2(task, text, message):
    done = harness(text, task)
    assert done.returncode == 2
    assert done.stdout == b""
    lines = done.stderr.decode().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"mrpt_position: {message}")


def test_without_the_harness_the_script_says_so_in_one_line(monkeypatch, capsys, robot):
    monkeypatch.setattr(mrpt_position, "HARNESS", Path("/nowhere/mrpt_position"))
    monkeypatch.setattr("sys.argv", ["position_peers"])
    position_peers.main()
    assert capsys.readouterr().out == "mrpt_position: not built (benchmarks/mrpt/install.sh)\n"
    with pytest.raises(UsageError, match="expected it"):
        mrpt_position.rbpf_slam(frames_of(np.zeros((1, 3)), np.ones((1, robot.sonars))), robot, EXACT)


def test_the_known_map_is_walls_and_floor_and_knows_nothing_of_what_is_hidden():
    grid = position_peers.map_of(Truth(np.array([[1, 0, 2]], np.int8), 0.1, (2.0, 3.0)))
    wall, floor, hidden = grid.probability()[0]
    assert wall > 0.95
    assert floor < 0.05
    assert hidden == 0.5
    assert grid.observed.tolist() == [[True, True, False]]
    assert (grid.resolution, grid.origin) == (0.1, (2.0, 3.0))


def test_a_row_tells_the_median_after_alignment_and_the_fastest_turn(robot):
    truth = round_the_room(1)
    frames = frames_of(truth, np.full((len(truth), robot.sonars), inf))
    away = np.where(np.arange(len(truth)) % 2, 1.0, -1.0)
    middle = truth[:, :2].mean(axis=0)

    def by_seed(drive, seed):
        """A way that lies elsewhere, and swings about the true one by a tenth of the seed (m)."""
        grown = drive.truth.copy()
        out = (grown[:, :2] - middle) / np.linalg.norm(grown[:, :2] - middle, axis=1, keepdims=True)
        grown[:, :2] += 0.1 * seed * away[:, None] * out
        return {position_peers.WHOLE: compose(np.array([5.0, 1.0, 2.0]), grown)}, 1.0 / seed

    drive = position_peers.Drive("here", robot, frames, truth, room())
    odometry, row = position_peers.rows_of(drive, {"one": by_seed}, 3)
    assert odometry == "| here | - | odometry | 0.000 | |"
    assert row == f"| here | whole drive | one | 0.200 (0.100 to 0.300) | {3 * len(frames)} |"
