"""Following a path with wheels that have limits, and stopping before what is not known."""

import math
from itertools import pairwise

import numpy as np
import pytest

from echogrid import Grid
from echogrid.geometry import wrap
from echogrid.grid import logit
from echogrid.planning.clearance import Floor
from echogrid.planning.following import THERE_M, Pace, follow, may_go

PACE = Pace()


def driven(points, pose, room=1.0, dt=0.16):
    """Poses of a robot that follows a path; its wheels do at once what they are told."""
    poses = [np.array(pose, float)]
    for _ in range(2000):
        velocity = follow(points, poses[-1], room, PACE)
        if velocity is None:
            return np.array(poses)
        speed, turn = velocity
        assert 0 <= speed <= PACE.speed_m_s + 1e-9
        assert abs(turn) <= PACE.turn_rad_s + 1e-9
        x, y, theta = poses[-1]
        middle = theta + turn * dt / 2
        poses.append(
            np.array(
                [x + speed * dt * math.cos(middle), y + speed * dt * math.sin(middle), float(wrap(theta + turn * dt))]
            )
        )
    pytest.fail("never arrived")


def line(*corners):
    points = [np.array(corners[0], float)[None]]
    for a, b in pairwise(corners):
        parts = math.ceil(math.dist(a, b) / 0.05)
        points.append(np.array(a) + np.arange(1, parts + 1)[:, None] / parts * (np.array(b) - a))
    return np.concatenate(points)


def off_path(points, poses):
    return np.max(np.min(np.linalg.norm(points[:, None] - poses[None, :, :2], axis=2), axis=0))


@pytest.mark.parametrize("heading", [0.0, 1.0, math.pi, -2.0])
def test_a_straight_path_is_driven_to_its_end(heading):
    points = line((0, 0), (3, 1))
    poses = driven(points, (0, 0, heading))
    assert math.dist(poses[-1, :2], (3, 1)) < THERE_M
    assert off_path(points, poses) < 0.06


@pytest.mark.parametrize(("room", "off"), [(1.0, 0.15), (0.05, 0.06)])
def test_corners_are_cut_little_and_less_in_the_narrow(room, off):
    points = line((0, 0), (2, 0), (2, 2), (0.5, 2))
    assert off_path(points, driven(points, (0, 0, 0), room)) < off


def floor_of(free):
    """A floor with a cell of 5 cm whose middle of the first one is at the origin."""
    log_odds = np.where(free, logit(0.05), 0).astype(np.float32)
    return Floor.of(Grid(log_odds, np.ones(free.shape, bool), 0.05, (-0.025, -0.025)), 0.25)


def test_it_may_go_where_all_is_free_and_stops_before_what_is_not():
    free = np.ones((60, 100), bool)
    free[:, 80:] = False  # from x = 3.975 m on
    floor = floor_of(free)
    going = (0.3, 0.0)
    stops = 0.3 * 0.3 + 0.3**2 / 0.8 + 0.05
    assert may_go(floor, np.array([2.0, 1.5, 0.0]), going, PACE)
    assert may_go(floor, np.array([3.975 - 0.25 - stops - 0.06, 1.5, 0.0]), going, PACE)
    assert not may_go(floor, np.array([3.975 - 0.25 - stops + 0.08, 1.5, 0.0]), going, PACE)
    assert may_go(floor, np.array([3.7, 1.5, math.pi]), going, PACE)
    assert may_go(floor, np.array([3.7, 1.5, 0.0]), (0.0, 0.9), PACE)


def test_a_robot_that_covers_what_is_unknown_may_leave_it_but_not_go_deeper():
    free = np.ones((60, 100), bool)
    free[:, 80:] = False
    floor = floor_of(free)
    assert may_go(floor, np.array([3.85, 1.5, math.pi]), (0.1, 0.0), PACE)
    assert not may_go(floor, np.array([3.85, 1.5, 0.0]), (0.1, 0.0), PACE)


def test_at_the_end_there_is_nothing_to_follow():
    assert follow(line((0, 0), (1, 0)), np.array([1.0, 0.02, 0.0]), 1.0, PACE) is None
