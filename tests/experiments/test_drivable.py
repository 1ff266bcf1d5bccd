"""The measures of the study drivable: laws on maps that are drawn, not made."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid import Grid, Robot, World
from echogrid.simulation.world import ROUGH_M, SMOOTH_M, polyline
from experiments.common.rooms import robots
from experiments.studies.drivable import doors, measures, passes, swarm, walls
from experiments.studies.drivable.study import passes_of
from experiments.studies.generalise.suite import DOOR_AT_M, placed

CELL_M = 0.04
KNOWN = 4.0
"""Log-odds of what a drawn map is sure of."""
ROOM = World(
    "room",
    polyline([[0, 0], [4, 0], [4, 3], [0, 3]], closed=True),
    np.full(4, SMOOTH_M),
    np.zeros((0, 3)),
    (2.0, 1.5),
)
POSES = np.array([[x, y, 0.0] for y in (1.2, 1.8) for x in np.arange(0.6, 3.41, 0.1)])


def drawn(occupied, low=(-1.0, -1.0), high=(5.0, 4.0), cell=CELL_M):
    """A map that is sure of all: where a function of points says so it is occupied, else free."""
    cols, rows = (round((b - a) / cell) for a, b in zip(low, high, strict=True))
    grid = Grid(np.zeros((rows, cols), np.float32), np.ones((rows, cols), bool), cell, low)
    at = grid.centre_of(np.argwhere(grid.observed))
    odds = np.where(occupied(at), KNOWN, -KNOWN).astype(np.float32).reshape(rows, cols)
    return replace(grid, log_odds=odds)


def faces(at):
    """The walls as a map that knows them exactly has them: every cell that a wall touches, as far as centres tell."""
    return ROOM.clearance(at) < 0.75 * CELL_M


def test_a_perfect_map_smears_nothing_and_has_no_phantoms():
    grid = drawn(faces)
    told = measures.smear(grid, ROOM.clearance)
    assert told["cells"] > 300
    assert told["smear"] == 0.0
    assert told["off_m"] < CELL_M
    assert not measures.phantoms(grid, ROOM, POSES).any()


def test_a_map_without_walls_has_no_smear_to_tell():
    assert measures.smear(drawn(lambda at: at[:, 0] > 99), ROOM.clearance)["smear"] is None


@given(st.floats(0.12, 0.6))
@settings(max_examples=20, deadline=None)
def test_black_behind_a_face_is_smear_in_its_share(depth):
    grid = drawn(lambda at: (at[:, 0] > 4.0) & (at[:, 0] < 4.0 + depth) & (np.abs(at[:, 1] - 1.5) < 1.4))
    told = measures.smear(grid, ROOM.clearance)
    assert told["smear"] == pytest.approx(1 - measures.SMEAR_M / depth, abs=CELL_M / depth)
    assert told["off_m"] == pytest.approx(depth / 2, abs=CELL_M)


def test_a_phantom_is_what_is_black_far_behind_a_wall_and_not_what_is_black_in_the_room():
    behind = drawn(lambda at: faces(at) | (np.hypot(at[:, 0] - 4.6, at[:, 1] - 1.5) < 0.15))
    within = drawn(lambda at: faces(at) | (np.hypot(at[:, 0] - 2.0, at[:, 1] - 1.5) < 0.15))
    ghost = measures.phantoms(behind, ROOM, POSES)
    assert ghost.sum() * CELL_M**2 == pytest.approx(np.pi * 0.15**2, rel=0.15)
    assert np.all(measures.occupied(behind)[ghost][:, 0] > 4.4)
    assert not measures.phantoms(within, ROOM, POSES).any()


@given(st.floats(0.05, 0.5), st.floats(0.0, 0.1))
@settings(max_examples=30, deadline=None)
def test_the_thickness_of_a_drawn_wall_is_what_was_drawn(behind, front):
    grid = drawn(
        lambda at: np.select(
            [np.max(np.abs(at - [2, 1.5]) - [2, 1.5], axis=1) > 0],
            [ROOM.clearance(at) < behind],
            ROOM.clearance(at) < front,
        )
    )
    at, way = walls.seen_faces(ROOM, POSES)
    assert len(at) > 100
    assert np.all(ROOM.clearance(at + 0.1 * way) > 0.09)
    assert np.all(np.max(np.abs(at + 0.1 * way - [2, 1.5]) - [2, 1.5], axis=1) > 0.05), "behind is outside"
    extents = walls.thickness(grid, at, way)
    assert walls.median(extents[:, 0]) == pytest.approx(front, abs=CELL_M)
    assert walls.median(extents[:, 1]) == pytest.approx(behind, abs=CELL_M)


def test_a_wall_that_is_missing_has_no_thickness():
    at, way = walls.seen_faces(ROOM, POSES)
    extents = walls.thickness(drawn(lambda at: at[:, 0] > 99), at, way)
    assert np.isnan(extents).all()
    assert walls.median(extents[:, 0]) is None


def test_a_partition_that_is_seen_from_both_sides_is_no_face():
    wall = np.array([[2.0, 0.0, 2.0, 2.0]])
    both = World("both", np.concatenate([ROOM.walls, wall]), np.full(5, SMOOTH_M), np.zeros((0, 3)), (1.0, 1.5))
    poses = np.array([[1.2, 1.0, 0.0], [2.8, 1.0, 0.0], [1.0, 2.5, 0.0]])
    at, _ = walls.seen_faces(both, poses)
    assert not np.any((np.abs(at[:, 0] - 2.0) < 1e-6) & (np.abs(at[:, 1] - 1.1) < 0.8))
    one_sided, _ = walls.seen_faces(both, poses[:1])
    assert np.any((np.abs(one_sided[:, 0] - 2.0) < 1e-6) & (np.abs(one_sided[:, 1] - 1.1) < 0.8))


@given(st.floats(0.15, 1.2), st.floats(-0.3, 0.3), st.sampled_from([0.04, 0.05, 0.12]))
@settings(max_examples=40, deadline=None)
def test_a_lane_is_as_wide_as_the_gap_in_the_wall(width, at_y, cell):
    """To a cell or two: its edges lie anywhere in cells, and it is measured to the centres of those beside it."""
    gap = lambda at: np.abs(at[:, 1] - 1.5 - at_y) < width / 2  # noqa: E731
    grid = drawn(lambda at: (np.abs(at[:, 0] - 2.0) < 0.15) & ~gap(at), cell=cell)
    lane = measures.lane_m(grid, np.array([1.0, 1.5]), np.array([3.0, 1.5]))
    assert width - cell - 1e-9 <= lane <= width + 2 * cell + 1e-9 or (width < 2 * cell and lane == 0)


def test_there_is_no_lane_through_a_wall_nor_off_the_map():
    grid = drawn(lambda at: np.abs(at[:, 0] - 2.0) < 0.15)
    assert measures.lane_m(grid, np.array([1.0, 1.5]), np.array([3.0, 1.5])) == 0.0
    assert measures.lane_m(grid, np.array([1.0, 1.5]), np.array([30.0, 1.5])) == 0.0
    open_ = drawn(lambda at: at[:, 0] > 99)
    assert measures.lane_m(open_, np.array([1.0, 1.5]), np.array([3.0, 1.5])) > 3.0


def test_of_two_lanes_the_wider_counts():
    def posts(at):
        x, y = at.T
        return (np.abs(x - 2.0) < 0.15) & ~(np.abs(y - 0.5) < 0.2) & ~(np.abs(y - 2.5) < 0.4)

    lane = measures.lane_m(drawn(posts), np.array([1.0, 0.5]), np.array([3.0, 0.5]))
    assert lane == pytest.approx(0.8, abs=2.1 * CELL_M)


def test_what_is_claimed_under_the_body_is_seen_and_what_lies_beside_it_is_not():
    for away, worst in ((0.1, 1.0), (0.3, 0.0)):
        spot = drawn(lambda at, away=away: np.hypot(at[:, 0] - 2.0, at[:, 1] - 1.2 + away) < 0.06)
        claims = measures.body_claims(measures.under_body(spot, POSES, 0.22))
        assert claims["worst"] == pytest.approx(worst, abs=0.03)
        assert (claims["not free"] > 0) == (worst > 0.5)


@pytest.mark.parametrize("number", range(6))
def test_layouts_have_the_doors_and_the_walls_they_say(number):
    rooms_ = doors.layout(number)
    assert rooms_.door in doors.DOORS_M
    assert doors.WALLS_M[0] <= rooms_.thick <= doors.WALLS_M[1]
    middle = rooms_.at(np.array([[0.0, DOOR_AT_M]]))
    assert rooms_.world.clearance(middle)[0] == pytest.approx(rooms_.door / 2)
    jamb = rooms_.at(np.array([[rooms_.thick / 2, DOOR_AT_M + rooms_.door / 2]]))
    assert rooms_.world.clearance(jamb)[0] < 1e-9
    kinds = set(rooms_.world.roughness.tolist())
    assert kinds == ({SMOOTH_M}, {ROUGH_M}, {SMOOTH_M, ROUGH_M})[number % 3]
    poses = doors.way(rooms_)
    x = rooms_.back(poses[:, :2])[:, 0]
    assert x.min() < -1
    assert x.max() > 1
    widest = max(robot.footprint_radius_m for robot in robots().values())
    assert rooms_.world.clearance(poses[:, :2]).min() > widest


def test_a_perfect_map_of_a_layout_is_right_and_a_closed_door_and_a_hole_are_told():
    rooms_ = doors.layout(1)
    robot = Robot.load("p3dx")
    poses = doors.way(rooms_)
    low, high = (tuple(v) for v in rooms_.world.bounds() + np.array([[-0.5], [0.5]]))
    true = lambda at: rooms_.world.clearance(at) < 0.75 * CELL_M  # noqa: E731
    radius = robot.footprint_radius_m
    perfect = doors.open_door(drawn(true, low, high), rooms_, poses, radius)
    assert perfect["right"]
    assert not perfect["hole"]
    assert perfect["lane_m"] == pytest.approx(rooms_.door, abs=3 * CELL_M)

    def own(at):
        return placed(at - rooms_.shift, -rooms_.turn, np.zeros(2))

    shut = drawn(lambda at: true(at) | (np.abs(own(at)[:, 0]) < 0.05), low, high)
    assert not doors.open_door(shut, rooms_, poses, radius)["right"]
    gone = drawn(lambda at: true(at) & (np.abs(own(at)[:, 0]) > 0.3), low, high)
    assert doors.open_door(gone, rooms_, poses, radius)["hole"]


def test_passes_are_the_same_tour_with_other_noise_one_after_the_other():
    first, second = passes_of(ROOM, Robot.load("p3dx"), POSES, 2, 1)
    np.testing.assert_array_equal([f.pose for f in first], [f.pose for f in second])
    assert np.mean([np.array_equal(a.ranges, b.ranges) for a, b in zip(first, second, strict=True)]) < 0.1
    assert second[0].stamp > first[-1].stamp


def test_more_passes_are_worse_when_they_wipe_or_lose_walls():
    once = {"wiped": 0.01, "found": 0.95}
    assert not passes.worse(once, {"wiped": 0.014, "found": 0.945})
    assert passes.worse(once, {"wiped": 0.02, "found": 0.95})
    assert passes.worse(once, {"wiped": 0.0, "found": 0.93})


FLIGHTS = sorted(run for run in swarm.MAZES if (swarm.FOLDER / f"{run}.csv").is_file())


@pytest.mark.skipif(not FLIGHTS, reason="the flights are not here")
def test_flights_are_read_as_cones_and_as_rays():
    run = FLIGHTS[0]
    cones, rays = (
        swarm.flight(swarm.FOLDER / f"{run}.csv", kind, swarm.drone(kind, swarm.MAX_M)) for kind in swarm.KINDS
    )
    assert len(cones) == len(rays) > 100
    for cone, ray in zip(cones, rays, strict=True):
        zones = ray.ranges.reshape(4, 8)
        least = np.min(np.where(np.isnan(zones), np.inf, zones), axis=1)
        heard = np.isfinite(cone.ranges)
        np.testing.assert_allclose(cone.ranges[heard], least[heard])
        assert np.all(~np.isfinite(least[~heard]))
    points = swarm.walls_of(swarm.FOLDER / "walls.csv", swarm.MAZES[run])
    path = np.array([frame.pose[:2] for frame in cones])
    assert 0.05 < np.min(measures.near_to(points)(path)) < 1.0


def test_where_there_are_no_flights_swarm_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(swarm, "FOLDER", tmp_path)
    swarm.swarm(swarm.Study(("muriel",)))
    assert "no flights in" in capsys.readouterr().out
