"""An export makes of scans what the core makes of them: at each bearing and ring of one, in each cell of a drive."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from commands import SAMPLE
from echogrid.logs.formats import load_log
from echogrid.microcontroller.source import source_of
from echogrid.models.networks import set_core
from echogrid.models.networks.memory import Memory, Recent
from echogrid.models.networks.set_core import BEARINGS, REACH_M, ends_within
from echogrid.robot import Robot, preset_names
from export_samples import PER_LOG_ODDS, UNKNOWN, Oracle, Window, in_a_room, network, random_array, walk

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="found no gcc")

MOST = 127 / PER_LOG_ODDS
ROUNDING = 0.5 / PER_LOG_ODDS + 1e-4
WIDE = 9.6
"""A window that holds all that is said on a ``walk``, m."""

POSES = {
    "drives": walk(np.random.default_rng(2), 6),
    "stands": np.tile([0.3, 0.1, 0.4], (6, 1)),
}


def ring(sonars, radius, begin=0.0):
    """Sonars that look outwards; begun ahead, those of 4, 8 or 16 look along bearings of the local map."""
    axis = begin + np.arange(sonars) * 2 * np.pi / sonars
    mounts = np.column_stack([radius * np.cos(axis), radius * np.sin(axis), axis])
    return replace(Robot.load("b21"), name=f"ring of {sonars}", mounts=mounts, footprint_radius_m=0.12)


ROBOTS = [
    *map(Robot.load, preset_names()),
    *(ring(sonars, 0.1) for sonars in (1, 3, 4, 8)),
    ring(8, 0.0),
    *(random_array(np.random.default_rng(seed)) for seed in range(4)),
    random_array(np.random.default_rng(4), 9, reach=1.2, any_way=True),
]


def local_map_of_the_core(robot, frames):
    """Of the last scan: log-odds at bearings and rings, and how far each bearing tells, m."""
    recent, memory = Recent(robot.mounts), Memory(robot.mounts)
    for frame in frames:
        cleaned = replace(frame, ranges=robot.clean(frame.ranges))
        [whole], new = recent.completed([cleaned])
        recalled = memory.take(whole.pose[None], whole.ranges[None], None, new)
    mounts = None if whole.mounts is None else whole.mounts[None]
    ends = ends_within(robot.mounts if mounts is None else mounts, robot.max_ranges_m)
    ends |= ends_within(robot.mounts, robot.max_ranges_m)
    array = set_core.sonar_array(
        robot.mounts, robot.max_ranges_m, robot.footprint_radius_m, robot.beam_width_rad, ends
    )
    tables = set_core.network(network().weights, None).tables(array, whole.ranges[None], recalled.traits, mounts)
    return tables.values()[0], tables.told_until()[0] if ends else np.full(BEARINGS, REACH_M)


@pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.name)
def test_the_local_map_of_a_scan_is_that_of_the_core(tmp_path, robot):
    rng = np.random.default_rng(1)
    window = Window(tmp_path, source_of(network(), robot, 6.0, 0.2))
    for drive, in_turn in [("drives", False), ("drives", True), ("stands", True)]:
        frames = list(in_a_room(rng, robot, POSES[drive], in_turn=in_turn))
        window.start()
        assert [window.scan(frame) for frame in frames] == [0] * len(frames)
        (found, reach), (expected, until) = window.local_map(), local_map_of_the_core(robot, frames)
        assert np.mean(expected != 0) > 0.1
        np.testing.assert_array_equal(found != 0, expected != 0)
        np.testing.assert_allclose(reach, until, atol=1e-5)
        assert np.max(np.abs(found - expected)) < 5e-4


def assert_alike(window, oracle, within=0.1):
    """Windows that speak of the same cells, and say the same of them."""
    cells = window.read()
    log_odds, observed = oracle.window(window.corner(), window.side)
    known = cells != UNKNOWN
    assert np.mean(known) > 0.1
    assert np.mean(known != observed) < 0.0005  # centres on the rim
    off = np.abs(cells / PER_LOG_ODDS - np.clip(log_odds, -MOST, MOST))[known & observed]
    assert np.max(off) <= within + ROUNDING
    assert np.mean(off > 2 * ROUNDING) < 0.01
    assert np.mean(np.abs(log_odds[known & observed]) < MOST) > 0.5


@pytest.mark.parametrize(
    ("seed", "scans", "cell", "how", "array"),
    [
        (0, 1, 0.06, {}, {}),
        (1, 150, 0.12, {}, {}),
        (2, 80, 0.1, {"in_turn": True}, {}),
        (3, 80, 0.08, {"silent": 0.1}, {}),
        (4, 80, 0.12, {"in_turn": True, "silent": 0.1}, {}),
        (8, 60, 0.1, {"in_turn": True}, {"sonars": 9, "reach": 1.2, "any_way": True}),
    ],
)
def test_a_drive_of_a_random_array_gives_the_map_of_the_mapper(tmp_path, seed, scans, cell, how, array):
    rng = np.random.default_rng(seed)
    robot = random_array(rng, **array)
    window, oracle = Window(tmp_path, source_of(network(), robot, WIDE, cell)), Oracle(robot, cell, network())
    for frame in in_a_room(rng, robot, walk(rng, scans), **how):
        assert window.scan(frame) == 0
        oracle.scan(frame)
    assert_alike(window, oracle)


def test_the_sample_gives_the_map_of_the_mapper(tmp_path):
    robot = Robot.load("b21")
    window, oracle = Window(tmp_path, source_of(network(), robot, 18.0, 0.1)), Oracle(robot, 0.1, network())
    for frame in load_log(SAMPLE, robot):
        assert window.scan(frame) == 0
        oracle.scan(frame)
    assert_alike(window, oracle)


def test_a_robot_that_stands_for_long_and_then_drives_far_has_the_map_of_the_mapper(tmp_path):
    """Of a preset whose sonars lie on bearings; the window rolls over more than its side."""
    rng = np.random.default_rng(5)
    robot = Robot.load("nomad200")
    window, oracle = Window(tmp_path, source_of(network(), robot, 6.0, 0.12)), Oracle(robot, 0.12, network())
    along = np.concatenate([np.zeros(120), np.arange(70) * 0.097])
    poses = np.column_stack([along - 1.53, -0.1 * along, np.full(len(along), 0.4)])
    for frame in in_a_room(rng, robot, poses, half=(40.0, 2.2)):
        window.scan(frame)
        oracle.scan(frame)
    assert_alike(window, oracle)
    corner = np.array(window.corner())
    assert np.all(np.abs(corner + 3.0 - poses[-1, :2]) <= 0.12)
