"""Frontiers: where the floor ends that is known, and the robot could go on."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid import Grid, Robot
from echogrid.geometry import wrap
from echogrid.grid import logit
from echogrid.planning.clearance import Floor, gap, spread, swept
from echogrid.planning.frontiers import REACH_M, STAND_M, Reach, _middle, frontiers, look

CELL = 0.05
B21 = Robot.load("b21")
NOWHERE = np.array([[0.0, 0.0, 1.0]])
"""A hull in which nothing lies."""


def floor_of(p):
    p = np.asarray(p, float)
    grid = Grid(
        np.where(np.isnan(p), 0, logit(np.nan_to_num(p, nan=0.5))).astype(np.float32), ~np.isnan(p), CELL, (0, 0)
    )
    return Floor.of(grid, B21.footprint_radius_m, rim_m=1.0, margin_m=0.0)


def room(door=None, filled=np.nan):
    """A room of 4 x 3 m with walls of two cells; a door of some width (m) to the right is filled with a value."""
    p = np.full((60, 80), 0.05)
    p[:2] = p[-2:] = 0.99
    p[:, :2] = p[:, -2:] = 0.99
    if door is not None:
        half = round(door / CELL / 2)
        p[30 - half : 30 + half, -2:] = filled
    return p


def found(p, sure=0.9):
    floor = floor_of(p)
    at = floor.cell((2.0, 1.5))
    assert at is not None
    return frontiers(Reach.of(floor, at), B21, sure)


def test_a_room_that_is_shut_has_none():
    assert found(room()) == []


def test_a_door_is_one_and_a_crack_is_none():
    for one in found(room(door=0.9)):
        assert math.dist(one.place, (4.0, 1.5)) < 0.5
        assert one.gain_m2 > 0.3
    assert len(found(room(door=0.9))) >= 1
    assert found(room(door=0.4)) == []


def test_a_first_look_is_from_where_sonars_hear_what_is_beyond():
    p = room()
    p[:, 40:] = np.nan
    floor = floor_of(p)
    at = floor.cell((1.0, 1.5))
    assert at is not None
    # The sonars of a B21 hear nothing within 0.26 m, that is up to 0.25 m off its footprint.
    for one in frontiers(Reach.of(floor, at), B21, 0.9):
        assert floor.known_m[one.cell] < B21.footprint_radius_m + 2 * CELL
        stand = floor.grid.centre_of(np.array(one.stand))
        assert math.dist(stand, one.place) <= STAND_M + 1e-9
        assert floor.known_m[one.stand] > B21.footprint_radius_m + 0.2 or abs(one.place[1] - 1.5) > 0.8
    near = replace(B21, min_range_m=0.01)
    assert all(one.stand == one.cell for one in frontiers(Reach.of(floor, at), near, 0.9))


def test_a_first_look_is_from_this_side_of_a_wall():
    """The other side is in reach too, and there is more room there."""
    p = np.full((60, 120), 0.05)
    p[:2] = p[-2:] = 0.99
    p[:, :2] = p[:, -2:] = 0.99
    p[16:, 40] = 0.99
    p[30:, 52:] = np.nan
    p[16:30, 52] = 0.99
    floor = floor_of(p)
    at = floor.cell((1.0, 1.5))
    assert at is not None
    found = frontiers(Reach.of(floor, at), B21, 0.9)
    assert found
    for one in found:
        assert floor.grid.centre_of(np.array(one.stand))[0] > 40 * CELL


def test_a_rim_that_is_not_known_is_none():
    p = room()
    p[2:4, 2:-2] = np.nan
    p[2:8, 2:8] = np.nan  # and a corner that no sonar reaches
    assert found(p) == []


def test_what_is_occupied_but_not_surely_may_be_a_door():
    assert len(found(room(door=0.9, filled=0.8), sure=0.9)) >= 1
    assert found(room(door=0.9, filled=0.8), sure=0.65) == []


def test_a_door_that_looks_narrower_than_the_robot_may_be_asked_for():
    p = room(door=0.4, filled=0.95)
    floor = floor_of(p)
    at = floor.cell((2.0, 1.5))
    assert at is not None
    reach = Reach.of(floor, at)
    assert frontiers(reach, B21, 0.99 - 1e-6) == []
    ones = frontiers(reach, B21, 0.99 - 1e-6, share=0.6)
    assert ones
    assert all(math.dist(one.place, (3.7, 1.5)) < 0.4 for one in ones)
    walls = floor_of(room())
    assert frontiers(Reach.of(walls, at), B21, 0.99 - 1e-6, share=0.6) == []


def test_ground_behind_a_wall_is_none_however_much_there_is():
    p = np.full((60, 160), np.nan)
    p[:, :80] = room()
    assert found(p) == []


def test_a_door_between_known_rooms_promises_more_than_a_weak_wall():
    p = np.full((60, 240), np.nan)
    p[:, :80], p[:, 160:] = room(door=0.9, filled=0.95), room()
    p[58:60, 30:50] = 0.95  # behind it is nothing that was ever driven round
    ones = found(p, sure=0.975)
    door = max(one.promise_m2 for one in ones if abs(one.place[1] - 1.5) < 0.5)
    others = [one.promise_m2 for one in ones if abs(one.place[1] - 1.5) >= 0.5]
    assert others
    assert door > 1.5 * max(others)
    open_ = max(one.promise_m2 for one in found(room(door=0.9)))
    assert open_ > max(one.promise_m2 for one in found(room(door=0.9, filled=0.8)))


def test_a_pillar_is_no_door_however_unsure():
    p = np.full((60, 80), 0.05)
    p[20:30, 20:28] = 0.8  # in the open
    p[25:35, 70:75] = 0.8  # before ground that is not known
    p[20:40, 75:] = np.nan
    floor = floor_of(p)
    at = floor.cell((0.5, 0.5))
    assert at is not None
    lone = np.argwhere(Reach.of(floor, at).lone)
    assert len(lone) == 80
    np.testing.assert_allclose(floor.grid.centre_of(lone).mean(axis=0), [1.2, 1.25], atol=1e-6)


def test_it_comes_close_to_the_middle_of_an_edge_but_off_posts():
    floor = floor_of(room())
    row, first = floor.cell((2.0, 1.5)) or (0, 0)
    in_the_open = np.array([(row, first + k) for k in range(9)])
    assert _middle(floor, B21, in_the_open) == (row, first + 4)
    wall = first + 38  # 40 cells of the room lie to the right of its middle, two of them wall
    beside = np.array([(row, wall - 14 + k) for k in range(9)])
    _, col = _middle(floor, B21, beside)
    assert wall - 14 <= col < wall - 10
    assert floor.gap_m[row, col] > floor.gap_m[row, wall - 10]


@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 30),
    st.integers(1, 30),
    st.floats(0.0, 0.6),
    st.sampled_from([0.02, 0.05, 0.1]),
)
def test_what_a_disc_sweeps_is_what_is_nearer_than_its_radius(seed, rows, cols, radius_m, resolution):
    random = np.random.default_rng(seed)
    cells = random.random((rows, cols)) < random.choice([0.0, 0.02, 0.3])
    for radius in (radius_m, round(radius_m / resolution) * resolution):
        np.testing.assert_array_equal(swept(cells, radius, resolution), gap(cells, resolution) < radius)


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12), st.integers(0, 5), st.integers(0, 1))
def test_cells_spread_along_one_axis(seed, rows, cols, by, axis):
    cells = np.random.default_rng(seed).random((rows, cols)) < 0.2
    expected = np.zeros_like(cells)
    for row, col in np.argwhere(cells):
        low, high = max(0, (row, col)[axis] - by), (row, col)[axis] + by + 1
        expected[(slice(low, high), col) if axis == 0 else (row, slice(low, high))] = True
    np.testing.assert_array_equal(spread(cells, by, axis), expected)


def test_the_hull_holds_what_is_free_and_nothing_far_from_it():
    p = np.full((60, 80), np.nan)
    p[10:20, 10:60] = 0.05
    p[20:50, 10:12] = 0.05
    floor = floor_of(p)
    at = floor.cell((1.5, 0.75))
    assert at is not None
    hull = Reach.of(floor, at).hull
    rows, cols = np.nonzero(p == 0.05)
    points = (np.column_stack([cols, rows]) + 0.5) * CELL
    assert np.all(points @ hull[:, :2].T + hull[:, 2] <= 1e-9)
    inside, outside = np.array([1.0, 1.5]), np.array([2.8, 2.4])
    assert np.all(hull[:, :2] @ inside + hull[:, 2] <= 0)
    assert np.any(hull[:, :2] @ outside + hull[:, 2] > 0)


def test_what_is_seen_from_a_place():
    nothing = np.full((200, 200), np.nan)
    nothing[90:110, 90:110] = 0.05
    floor = floor_of(nothing)
    here = np.array([5.0, 5.0])
    _, gain, _ = look(floor, B21, here, floor.occupied, NOWHERE)
    assert gain == pytest.approx(math.pi * REACH_M**2 - 1.0, rel=0.05)  # a disc, less what is known
    nothing[:, 112:114] = 0.99  # half a metre to the right a wall
    walled = floor_of(nothing)
    _, less, _ = look(walled, B21, here, walled.occupied, NOWHERE)
    apart, hidden = 0.6, math.acos(0.6 / REACH_M)
    segment = REACH_M**2 * hidden - apart * math.sqrt(REACH_M**2 - apart**2)
    assert gain - less == pytest.approx(segment, rel=0.1)


def test_a_robot_with_eyes_to_one_side_is_turned_to_what_is_new():
    ahead = Robot("fan", 0.2, B21.transducer, 0.2, 4.0, np.deg2rad(30), np.array([[0.1, 0, 0], [0.1, 0, 0.4]]))
    p = np.full((100, 100), 0.05)
    p[:, 70:] = np.nan
    floor = floor_of(p)
    heading, gain, _ = look(floor, ahead, np.array([2.5, 2.5]), floor.occupied, NOWHERE)
    assert abs(wrap(heading + 0.2)) < 0.4  # the middle of its view to the right, where nothing is known
    assert gain > 0.5
