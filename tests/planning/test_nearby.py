"""What a robot heard a moment ago is where odometry says, whatever a map says."""

from dataclasses import replace

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.geometry import compose, inverse, transform
from echogrid.grid import OCCUPIED_THRESH, Grid, logit
from echogrid.planning.nearby import HALF_LIFE_S, Nearby
from echogrid.simulation.vehicle import Vehicle
from echogrid.simulation.world import polyline

B21 = Robot.load("b21")
POST = np.array([2.0, 1.3])
WALLS = polyline([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [0.0, 3.0]], closed=True)
ROOM = World("room", WALLS, np.full(len(WALLS), 2e-3), np.array([[*POST, 0.05]]))
T_MAP_ODOM = np.array([1.0, -0.5, 0.6])
"""Where the frame of the odometry lies in that of the map."""


@pytest.fixture(scope="module")
def heard():
    """A robot comes by a post and goes on; by odometry, which here is right."""
    vehicle = Vehicle(ROOM, B21, np.array([1.0, 0.8, 0.0]), seed=1)
    vehicle.command(0.2, 0.0)
    frames = [frame for _ in range(30) for frame in vehicle.go_on(4)]
    return [replace(frame, odom=None) for frame in frames]


def free_map():
    """A map by which all is free, 8 x 8 m."""
    return Grid(np.full((200, 200), -5.0, np.float32), np.ones((200, 200), bool), 0.04, (-2.0, -3.0))


def nearby_of(frames):
    nearby = Nearby(B21)
    nearby.add(frames)
    return nearby


def laid_over(nearby, odometry):
    return nearby.laid_over(free_map(), compose(T_MAP_ODOM, odometry), odometry)


def solid(grid, p_map):
    """How far a point (m) is from the nearest cell that is occupied."""
    cells = grid.centre_of(np.argwhere(grid.log_odds > logit(OCCUPIED_THRESH)))
    return np.min(np.linalg.norm(cells - p_map, axis=1), initial=np.inf)


def test_a_post_that_the_map_lacks_is_put_where_it_is_beside_the_robot(heard):
    grid = laid_over(nearby_of(heard), heard[-1].pose)
    assert solid(grid, transform(T_MAP_ODOM, POST)) < 0.08
    added = grid.centre_of(np.argwhere(grid.log_odds > 0))
    world = transform(inverse(T_MAP_ODOM), added)
    assert np.max(np.abs(ROOM.clearance(world))) < 0.2  # nothing but walls and the post
    assert np.all(free_map().log_odds < 0)


def test_nothing_of_the_map_is_taken_away(heard):
    full = free_map()
    full.log_odds[:] = 4.0
    grid = nearby_of(heard).laid_over(full, compose(T_MAP_ODOM, heard[-1].pose), heard[-1].pose)
    assert np.all(grid.log_odds >= 4.0)


def test_what_was_heard_long_ago_is_forgotten(heard):
    nearby, last = nearby_of(heard), heard[-1]
    quiet = np.full(B21.sonars, np.nan)
    nearby.add([replace(last, stamp=last.stamp + s, ranges=quiet) for s in np.arange(1, 12 * HALF_LIFE_S)])
    assert not np.any(laid_over(nearby, last.pose).log_odds > 0)


@pytest.mark.parametrize("later", [{"stamp": -5.0}, {"pose": np.array([9.0, 9.0, 0.0])}])
def test_a_robot_that_began_anew_or_was_carried_off_forgets_all(heard, later):
    nearby, last = nearby_of(heard), heard[-1]
    nearby.add([replace(last, **({"stamp": last.stamp + 0.04} | later), ranges=np.full(B21.sonars, np.nan))])
    assert not np.any(laid_over(nearby, last.pose).log_odds > 0)
