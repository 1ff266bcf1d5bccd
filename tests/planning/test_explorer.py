"""The explorer in plans that it sees without error: what people miss in others is what it must do."""

import math

import numpy as np
import pytest

from echogrid.grid import Grid, logit
from echogrid.planning.choice import LEVELS, Views
from echogrid.planning.explorer import Explorer
from echogrid.planning.following import Pace
from echogrid.planning.frontiers import Reach
from plan_drive import B21, FAR, STEP_S, WIDE, Drive, shut, two_rooms


def test_all_is_seen_nothing_is_touched_and_it_is_home_again():
    drive = Drive(two_rooms()).run()
    assert drive.explorer.end == "nothing that can be reached is unknown"
    assert drive.explorer.left == []
    assert drive.seen() > 0.99
    assert drive.least > -0.035
    assert math.dist(drive.pose[:2], (1.0, 1.0)) < 0.1
    assert drive.way < 25  # there and back is 12 m


def test_a_robot_that_is_driven_fast_slows_down_before_it_takes_a_way_for_shut():
    bent = np.ones((FAR, WIDE), bool)
    bent[8:34, 8:100] = bent[8:80, 74:100] = False
    drive = Drive(bent)
    drive.explorer.pace = Pace(speed_m_s=1.0)
    drive.run()
    assert drive.seen() > 0.99
    assert drive.least > -0.035
    assert drive.explorer.left == []


def test_it_does_not_go_to_and_fro_between_two_places_as_far_from_it():
    solid = shut()
    drive = Drive(solid, pose=(4.0, 2.5, math.pi / 2)).run()
    assert drive.seen() > 0.99
    goals = np.array(drive.goals)
    side = np.sign(goals[:, 0] - 4.0)
    assert np.count_nonzero(np.diff(side[side != 0])) <= 3
    assert drive.way < 20


def test_a_room_that_it_cannot_get_into_does_not_hold_it_up():
    drive = Drive(two_rooms(door=0.4)).run()
    assert drive.explorer.end == "nothing that can be reached is unknown"
    assert not drive.grid.observed[:, 120:].any()
    assert math.dist(drive.pose[:2], (1.0, 1.0)) < 0.1
    assert drive.way < 20


@pytest.mark.slow
def test_a_place_that_never_shows_anything_is_left_alone_after_a_while():
    dark = np.zeros((FAR, WIDE), bool)
    dark[55:90, 50:75] = True
    drive = Drive(shut(), dark=dark).run()
    assert drive.seen() > 0.85
    assert len(drive.explorer.left) >= 1  # and it is told
    assert math.dist(drive.pose[:2], (1.0, 1.0)) < 0.1
    assert not np.any(drive.grid.observed[dark])


@pytest.mark.unchecked
def test_rims_and_corners_that_no_sonar_hears_are_not_run_after():
    dark = np.zeros((FAR, WIDE), bool)
    dark[2:4] = dark[-4:-2] = True
    dark[:, 2:4] = dark[:, -4:-2] = True
    dark[2:8, 2:8] = True
    plain, dim = Drive(shut()).run(), Drive(shut(), dark=dark).run()
    assert dim.explorer.left == []
    assert dim.way < 1.5 * plain.way


def test_what_it_bumps_into_is_remembered_and_kept_away_from():
    drive = Drive(shut(), pose=(2.0, 2.5, 0.0))
    drive.look()
    drive.explorer._turn = 0.0
    drive.explorer.think(drive.grid, drive.pose, 0.0)
    drive.explorer.bumped(drive.grid, drive.pose)
    touched = drive.pose[:2] + np.array([B21.footprint_radius_m, 0])
    assert drive.explorer.drive(drive.grid, drive.pose)[0] < 0
    drive.run()
    floor = drive.explorer.floor(drive.grid)
    cell = floor.cell(touched)
    assert cell is not None
    assert floor.occupied[cell]
    assert np.isfinite(floor.known_costs).any()
    keeps = floor.grid.centre_of(np.argwhere(np.isfinite(floor.known_costs)))
    assert np.min(np.linalg.norm(keeps - touched, axis=1)) > B21.footprint_radius_m + 0.04
    assert drive.seen() > 0.98


@pytest.mark.parametrize(("aside_m", "touched"), [(0.3, True), (-0.3, True), (0.6, False)])
def test_what_is_touched_is_where_the_map_is_least_sure(aside_m, touched):
    """A door whose post no sonar hears: the post is remembered, and not the middle of the way."""
    free = np.full((60, 60), logit(0.02), dtype=np.float32)
    grid = Grid(free, np.ones_like(free, dtype=bool), 0.05, (0.0, 0.0))
    post = grid.index_of(np.array([1.5, 1.5 + aside_m]))
    grid.log_odds[tuple(post)] = logit(0.4)
    explorer = Explorer(B21)
    explorer.bumped(grid, np.array([1.5, 1.5, 0.0]))
    floor = explorer.floor(grid)
    place = floor.grid.centre_of(np.argwhere(floor.occupied)).mean(axis=0)
    expected = [0.0, np.sign(aside_m)] if touched else [1.0, 0.0]
    np.testing.assert_allclose(place - 1.5, B21.footprint_radius_m * np.array(expected), atol=0.06)


def test_a_way_that_shuts_is_not_driven_into():
    """Between two thoughts a wall appears: the robot stops before it."""
    drive = Drive(two_rooms(), pose=(2.0, 2.5, 0.0))
    while drive.pose[0] < 3.2:
        drive.look()
        if drive.explorer.due(drive.time):
            drive.explorer.think(drive.grid, drive.pose, drive.time)
        speed, turn = drive.explorer.drive(drive.grid, drive.pose)
        theta = drive.pose[2] + turn * STEP_S
        drive.pose = np.array([
            drive.pose[0] + speed * STEP_S * math.cos(theta), drive.pose[1] + speed * STEP_S * math.sin(theta), theta
        ])  # fmt: skip
        drive.time += STEP_S
        assert drive.time < 200
    drive.solid[:, 79:81] = True
    drive._middles = drive.grid.centre_of(np.argwhere(drive.solid))
    drive.grid.log_odds[drive.solid & drive.grid.observed] = 6.0
    drive.run()
    assert drive.least > -0.035


def test_a_way_home_that_is_shut_is_told():
    drive = Drive(two_rooms(), pose=(2.0, 2.5, 0.0))
    drive.explorer._home = np.array([1.0, 1.0])
    solid = drive.solid.copy()
    solid[:, 79:81] = True
    drive.solid, drive.pose = solid, np.array([6.0, 2.5, 0.0])
    drive.run()
    assert drive.explorer.end == "something is in the way back"
    assert drive.pose[0] > 4.2
    assert drive.least > -0.035


@pytest.mark.parametrize(("posts", "open_"), [(0.8, True), (0.97, False)])
def test_a_door_it_came_through_stays_open_though_posts_are_heard_in_it_afterwards(posts, open_):
    p = np.full((80, 120), 0.02)
    p[:, 60:62] = 0.99
    p[30:50, 60:62] = 0.02
    explorer = Explorer(B21)

    def way(grid):
        floor = explorer.floor(grid)
        at, to = floor.cell((1.5, 2.0)), floor.cell((4.5, 2.0))
        assert at is not None
        assert to is not None
        return Reach.of(floor, at).cells[to]

    def grid():
        return Grid(logit(p).astype(np.float32), np.ones_like(p, dtype=bool), 0.05, (0.0, 0.0))

    assert way(grid())
    for x in np.arange(1.5, 4.5, 0.03):
        explorer.note_way(np.array([x, 2.0, 0.0]))
    p[30:37, 60:62] = p[43:50, 60:62] = posts
    assert way(grid()) == open_
    explorer.remapped()
    assert not way(grid())


def test_a_robot_in_a_door_that_looks_too_narrow_goes_on_from_beside_it():
    """Where it stands is a cell that it could not leave."""
    p = np.full((80, 120), 0.02)
    p[:, 58:60] = 0.99
    p[30:50, 58:60] = 0.02
    p[33:35, 60:62] = p[46:48, 60:62] = 0.5  # it looks narrower behind than it is
    grid = Grid(logit(p).astype(np.float32), np.ones_like(p, dtype=bool), 0.05, (0.0, 0.0))
    explorer = Explorer(B21)
    floor = explorer.floor(grid)
    at = floor.cell((3.0, 2.02))
    assert at is not None
    floor.known_costs[at[0] - 2 : at[0] + 3, at[1] - 2 : at[1] + 3] = np.inf
    floor.known_costs[at] = 1.0
    view = Views(floor, B21, np.array([3.0, 2.02, 0.0]), LEVELS)[0]
    assert view is not None
    assert np.count_nonzero(view.reach.cells) > 500
    floor.known_costs[...] = np.inf
    floor.known_costs[at] = 1.0
    alone = Views(floor, B21, np.array([3.0, 2.02, 0.0]), LEVELS)[0]
    assert alone is not None
    assert np.count_nonzero(alone.reach.cells) == 1
    floor.known_costs[at] = np.inf
    assert Views(floor, B21, np.array([3.0, 2.02, 0.0]), LEVELS)[0] is None


@pytest.mark.parametrize(("p_door", "level"), [(0.5, 0), (0.95, 2), (0.985, 4), (0.994, None)])
def test_a_door_that_was_taken_for_a_wall_is_looked_at_before_it_is_done(p_door, level):
    """It leads out of all that is known, and nothing behind it was ever heard: it promises next to nothing."""
    p = np.full((100, 140), np.nan)
    p[20:80, 20:100] = 0.02
    p[20:24] = p[76:80] = np.where(np.isnan(p[20:24]), np.nan, 0.994)
    p[20:80, 20:24] = p[20:80, 96:100] = 0.994
    p[40:64, 96:100] = p_door
    observed = ~np.isnan(p)
    grid = Grid(logit(np.where(observed, p, 0.5)).astype(np.float32), observed, 0.04, (0.0, 0.0))
    explorer = Explorer(B21, turns=False)
    explorer.think(grid, np.array([2.0, 2.0, 0.0]), 0.0)
    assert (explorer.goal is None) == (level is None)
    if explorer.goal is not None:
        assert math.dist(explorer.goal.place, (3.8, 2.0)) < 0.8
        assert explorer._level >= level


@pytest.mark.parametrize(("p_door", "patience_s"), [(0.02, 600), (0.95, 120)])
def test_it_has_more_patience_with_likely_places_than_with_walls(p_door, patience_s):
    p = np.full((100, 140), np.nan)
    p[20:80, 20:100] = 0.02
    p[20:24, 20:100] = p[76:80, 20:100] = 0.994
    p[20:80, 20:24] = p[20:80, 96:100] = 0.994
    p[40:64, 96:100] = p_door
    observed = ~np.isnan(p)
    grid = Grid(logit(np.where(observed, p, 0.5)).astype(np.float32), observed, 0.04, (0.0, 0.0))
    explorer, stamp = Explorer(B21, turns=False), 1.7e9
    begin = stamp
    while not explorer.end:
        explorer.think(grid, np.array([2.0, 2.0, 0.0]), stamp)
        stamp += 20.0
    assert stamp - begin == pytest.approx(patience_s, abs=60)


def test_a_place_left_alone_once_is_tried_again_before_walls_are_but_not_at_once():
    p = np.full((100, 200), np.nan)
    p[20:80, 20:180] = 0.02
    p[20:24, 20:180] = p[76:80, 20:180] = 0.994
    p[20:80, 20:24] = p[20:80, 176:180] = 0.994
    p[40:64, 176:180] = 0.02  # a door, 6 m from a weak wall
    p[40:64, 20:24] = 0.95
    observed = ~np.isnan(p)
    grid = Grid(logit(np.where(observed, p, 0.5)).astype(np.float32), observed, 0.04, (0.0, 0.0))
    explorer = Explorer(B21, turns=False)
    explorer.think(grid, np.array([4.0, 2.0, 0.0]), 0.0)
    assert explorer.goal is not None
    door = explorer.goal.place
    assert math.dist(door, (7.0, 2.0)) < 0.8
    explorer.give_up()
    explorer.think(grid, np.array([6.0, 2.0, 0.0]), 1.0)
    assert explorer.goal is not None
    assert math.dist(explorer.goal.place, (0.95, 2.0)) < 0.8
    explorer.goal = None
    explorer.think(grid, np.array([2.0, 2.0, 0.0]), 2.0)
    assert explorer.goal is not None
    assert math.dist(explorer.goal.place, door) < 0.3


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_robot_shut_in_on_all_sides_ends_where_it_is(turn):
    solid = shut()
    solid[10:32, 10:32] = True
    solid[13:29, 13:29] = False  # 0.8 m wide
    drive = Drive(solid, pose=(1.05, 1.05, turn)).run()
    assert drive.way < 3
    assert math.dist(drive.pose[:2], (1.05, 1.05)) < 0.15


@pytest.mark.unchecked
@pytest.mark.parametrize("likely", [True, False])
def test_a_door_behind_which_little_is_heard_is_gone_through_where_that_is_likely_free(likely, monkeypatch):
    solid = two_rooms()
    dim = np.zeros_like(solid)
    dim[:, 78:100] = True
    if not likely:
        monkeypatch.setattr("plan_drive.LIKELY", -0.2)
    drive = Drive(solid, dim=dim).run()
    behind = np.mean(drive.grid.observed[:, 100:][~solid[:, 100:]])
    assert (behind > 0.95) if likely else (behind < 0.5)
    assert drive.least > -0.035
    assert math.dist(drive.pose[:2], (1.0, 1.0)) < 0.1
