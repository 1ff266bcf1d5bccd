"""A wall that was heard at the edge of what a robot hears goes on where it hears nothing."""

from dataclasses import replace

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, transform
from echogrid.grid import OCCUPIED_THRESH, Grid, logit
from echogrid.planning.onward import ALONG_M, DEAF_M, KEPT_M, Onward
from echogrid.simulation.vehicle import Vehicle
from echogrid.simulation.world import polyline

B21 = Robot.load("b21")
WALL = polyline([[0.0, 0.0], [6.0, 0.0], [6.0, 4.0], [0.0, 4.0]], closed=True)
SMOOTH = World("room", WALL, np.full(len(WALL), 5e-5), np.empty((0, 3)))
PLACE = np.array([2.0, 0.9, 0.0])


def unsure(p=0.3):
    """A map of 8 x 8 m that says the same of all."""
    return Grid(np.full((200, 200), logit(p), np.float32), np.ones((200, 200), bool), 0.04, (-1.0, -1.0))


def added(onward, pose=PLACE, grid=None, odometry=None):
    """Middles of the cells (m) that are occupied by it and were not."""
    grid = unsure() if grid is None else grid
    after = onward.laid_over(grid, pose, pose if odometry is None else odometry)
    return grid.centre_of(np.argwhere((after.log_odds > logit(OCCUPIED_THRESH)) & (grid.log_odds < 0)))


def beside_a_wall(off_m, robot=B21, step_m=0.04):
    """Scans of a robot that drives along a wall at y = 0 to its right, so far from its footprint, up to x = 2 m.

    Args:
        off_m: see above.
        robot: that drives.
        step_m: from one scan to the next; 0: it stands.
    """
    to_right = np.abs(robot.mounts[:, 2] + np.pi / 2) < np.deg2rad(8)
    y = robot.footprint_radius_m + off_m
    ranges = robot.clean(np.where(to_right, y + robot.mounts[:, 1], np.inf))
    return [Frame(1.0 + k, np.array([2.0 + step_m * (k - 15), y, 0.0]), ranges) for k in range(16)]


def onward_of(frames, robot=B21):
    onward = Onward(robot)
    onward.add(frames)
    return onward


@pytest.fixture(scope="module")
def oblique():
    """A robot comes up to a mirror at 30 degrees until it is 0.1 m off; how it was heard."""
    vehicle = Vehicle(SMOOTH, B21, np.array([1.0, 1.4, np.deg2rad(-30)]), seed=3)
    vehicle.command(0.15, 0.0)
    frames = []
    while vehicle.pose[1] > B21.footprint_radius_m + 0.1:
        frames += vehicle.go_on(4)
    return [replace(frame, odom=None) for frame in frames]


def test_the_wall_goes_on_ahead_of_the_last_echo(oblique):
    onward, last = Onward(B21), oblique[-1].pose
    onward.add(oblique)
    wall = added(onward, last)
    touches_at = last[0] + 0.1 / np.tan(np.deg2rad(30))
    ahead = wall[wall[:, 0] > last[0]]
    assert np.max(ahead[:, 0]) > touches_at - 0.05
    assert np.all(np.abs(wall[:, 1]) < 0.3)


@pytest.mark.parametrize("off_m", [0.28, 0.33])
def test_it_lies_along_the_wall_as_far_as_is_said_and_no_farther(off_m):
    wall = added(onward_of(beside_a_wall(off_m)))
    assert np.all(np.abs(wall[:, 1]) < 0.13)
    assert ALONG_M - 0.05 < np.max(wall[:, 0]) - 2.0 < ALONG_M + 0.1


def test_what_is_heard_from_afar_is_left_to_the_map():
    scans, grid = beside_a_wall(0.5), unsure()
    assert onward_of(scans).laid_over(grid, scans[-1].pose, scans[-1].pose) is grid


def test_at_a_post_nothing_goes_on():
    """Who drives by one hears it with one sonar after the other, where it is but for the beam width: as in a door."""
    post, grid, scans = np.array([1.7, 0.0]), unsure(), []
    for k, x in enumerate(np.arange(1.2, 2.2, 0.02)):
        pose = np.array([x, B21.footprint_radius_m + 0.3, 0.0])
        to_post = transform(inverse(pose), post) - B21.mounts[:, :2]
        off = np.abs(np.arctan2(to_post[:, 1], to_post[:, 0]) - B21.mounts[:, 2])
        ranges = np.where(off < B21.beam_width_rad / 2, np.linalg.norm(to_post, axis=1), np.inf)
        scans.append(Frame(1.0 + 0.1 * k, pose, B21.clean(ranges)))
    assert sum(np.min(scan.ranges, initial=np.inf, where=~np.isnan(scan.ranges)) < 0.36 for scan in scans) > 10
    assert onward_of(scans).laid_over(grid, scans[-1].pose, scans[-1].pose) is grid


def test_a_robot_that_stands_is_told_of_no_line():
    scans, grid = beside_a_wall(0.3, step_m=0.0), unsure()
    assert onward_of(scans).laid_over(grid, scans[-1].pose, scans[-1].pose) is grid


def test_surely_free_ground_stays_free_and_unknown_ground_does_not():
    scans = beside_a_wall(0.3)
    onward, pose = onward_of(scans), scans[-1].pose
    assert not len(added(onward, grid=unsure(0.02)))
    unknown = replace(unsure(), observed=np.zeros((200, 200), bool))
    assert np.any(onward.laid_over(unknown, pose, pose).observed)
    assert not np.any(unknown.observed)


def test_where_the_robot_stands_there_is_no_wall():
    scans = beside_a_wall(0.3)
    quiet = np.full(B21.sonars, np.nan)
    wall = added(onward_of([*scans, replace(scans[-1], pose=np.array([2.2, 0.0, 0.0]), ranges=quiet)]))
    assert not len(wall) or np.min(np.abs(wall[:, 0] - 2.2)) > B21.footprint_radius_m - 0.05


def test_it_is_forgotten_where_it_is_far():
    scans, grid = beside_a_wall(0.3), unsure()
    on = np.array([2.1 + ALONG_M + KEPT_M + B21.footprint_radius_m, scans[-1].pose[1], 0.0])
    onward = onward_of([*scans, replace(scans[-1], pose=on, ranges=np.full(B21.sonars, np.nan))])
    assert onward.laid_over(grid, on, on) is grid


def test_it_lies_where_the_map_has_what_odometry_tells():
    scans, T_map_odom = beside_a_wall(0.3), np.array([1.0, 1.5, 0.6])
    wall = added(onward_of(scans), compose(T_map_odom, scans[-1].pose), odometry=scans[-1].pose)
    assert len(wall)
    assert np.all(np.abs(transform(inverse(T_map_odom), wall)[:, 1]) < 0.15)


def test_a_robot_that_hears_up_to_itself_needs_none_of_it():
    close = replace(B21, min_range_m=0.05)
    assert close.deaf_m < DEAF_M
    scans, grid = beside_a_wall(0.05, close), unsure()
    assert onward_of(scans, close).laid_over(grid, scans[-1].pose, scans[-1].pose) is grid
