"""A robot explores simulated rooms whose walls mirror the sound."""

from dataclasses import replace

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.errors import UsageError
from echogrid.grid import Grid
from echogrid.planning.explore import Exploration, Reachable
from echogrid.simulation.world import SMOOTH_M, polyline

B21 = Robot.load("b21")


def world(*more, box=((0, 0), (4.4, 0), (4.4, 2.4), (0, 2.4)), closed=True):
    walls = np.concatenate([polyline([*map(list, box)], closed=closed), *map(polyline, more)])
    return World("rooms", walls, np.full(len(walls), SMOOTH_M), np.zeros((0, 3)))


ROOMS = world([[2.2, 0], [2.2, 0.7]], [[2.2, 1.7], [2.2, 2.4]])
START = np.array([1.0, 1.2, 0.5])


@pytest.fixture(scope="module")
def explored():
    return Exploration(ROOMS, B21, START, seed=1).run()


@pytest.mark.unchecked
def test_between_mirrors_all_of_the_floor_is_seen_nothing_touched_and_it_comes_home(explored):
    assert explored.end == "nothing that can be reached is unknown"
    assert explored.seen[-1, 2] >= 0.99
    assert explored.bumps == 0
    assert explored.least_m > 0.02
    assert explored.home_m < 0.1
    poses = np.array([frame.pose for frame in explored.frames])
    assert np.max(poses[:, 0]) > 2.5  # it went through the door
    assert np.min(ROOMS.clearance(poses[:, :2])) - B21.footprint_radius_m == pytest.approx(explored.least_m, abs=0.02)


def test_what_is_told_of_it_is_what_happened(explored):
    told = explored.told()
    way = np.sum(np.linalg.norm(np.diff([frame.pose[:2] for frame in explored.frames], axis=0), axis=1))
    assert told["way_m"] == pytest.approx(way, rel=0.02)
    assert told["time_s"] == pytest.approx(explored.frames[-1].stamp, abs=0.1)
    reached = [explored.until(share) for share in (0.5, 0.9, 0.99)]
    assert all(one is not None for one in reached)
    assert sorted(reached) == reached
    assert explored.until(1.1) is None
    assert np.all(np.diff(explored.seen[:, 0]) >= 0)


def test_reachable_is_what_the_footprint_sweeps_from_the_start():
    points = Reachable.of(world(), B21, np.array([1.0, 1.0])).points
    # A box less 10 cm all round, its corners rounded by the footprint.
    w, h, r = 4.2, 2.2, B21.footprint_radius_m
    assert len(points) * 0.05**2 == pytest.approx(w * h - (4 - np.pi) * r**2, rel=0.04)
    assert Reachable.of(world(), B21, np.array([1.0, 1.0])).beyond < 0.03  # but for the corners
    shut_off = Reachable.of(world([[2.2, 0], [2.2, 1.0]], [[2.2, 1.4], [2.2, 2.4]]), B21, np.array([1.0, 1.0]))
    assert 0.45 < shut_off.beyond < 0.6
    only_left = Reachable.of(world([[2.2, 0], [2.2, 2.0]]), B21, np.array([1.0, 1.0])).points
    assert np.max(only_left[:, 0]) < 2.2


def test_seen_is_the_share_that_the_map_calls_free():
    reachable = Reachable.of(world(), B21, np.array([1.0, 1.0]))
    log_odds = np.full((50, 90), -3, np.float32)
    log_odds[:, 44:] = 0.0
    half = Grid(log_odds, np.ones_like(log_odds, bool), 0.05, (0.0, 0.0))
    assert reachable.seen(half) == pytest.approx(0.5, abs=0.01)
    nothing = Grid(log_odds, np.zeros_like(log_odds, bool), 0.05, (0.0, 0.0))
    assert reachable.seen(nothing) == 0.0


@pytest.mark.parametrize(
    ("where", "start", "line"),
    [
        (world(closed=False), (1.0, 1.2), "found a hole through which the robot gets out"),
        (world(), (0.1, 1.2), r"start: found \(0.10, 1.20\) m, less than 0.36 m from a wall"),
        (world(), (9.0, 1.2), r"start: found \(9.00, 1.20\) m"),
        (world(box=((0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5))), (0.25, 0.25), "start: found"),
    ],
)
def test_where_it_cannot_begin_is_said_before_it_drives(where, start, line):
    with pytest.raises(UsageError, match=line):
        Exploration(where, B21, np.array([*start, 0.0])).run()


def test_poses_are_found_by_four_sonars_at_least():
    with pytest.raises(UsageError, match="robot b21: found 3 sonars, expected at least 4 to find poses by"):
        Exploration(ROOMS, replace(B21, mounts=B21.mounts[:3]), START, slam=True).run()


@pytest.mark.slow
def test_a_robot_that_finds_its_poses_sees_all_touches_nothing_and_comes_home():
    found = Exploration(ROOMS, B21, START, seed=1, slam=True).run()
    assert found.end == "nothing that can be reached is unknown"
    assert found.seen[-1, 2] >= 0.97
    assert found.bumps == 0
    assert found.home_m < 0.25
    true = {frame.stamp: frame for frame in found.frames}
    off = np.array([frame.pose - true[frame.stamp].pose for frame in found.placed])
    drift = np.array([frame.odom - true[frame.stamp].pose for frame in found.placed])
    assert np.max(np.hypot(*off.T[:2])) < np.max(np.hypot(*drift.T[:2]))
    np.testing.assert_array_equal(found.placed[-1].odom, true[found.placed[-1].stamp].odom)
