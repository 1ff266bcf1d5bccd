"""Paths on maps, against closed forms, invariances and what a robot's disc covers."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from echogrid import Grid, NoPathError, Robot, plan
from echogrid.errors import UsageError
from echogrid.grid import logit
from echogrid.output.map_server_file import occupancy
from echogrid.planning.clearance import MARGIN_M, Floor
from echogrid.planning.paths import NARROW_M

CELL = 0.05
B21 = Robot.load("b21")
R = B21.footprint_radius_m


def grid_of(p, origin=(0.0, 0.0)):
    """A map of probabilities; nan: nobody spoke."""
    p = np.asarray(p, float)
    return Grid(
        np.where(np.isnan(p), 0, logit(np.nan_to_num(p, nan=0.5))).astype(np.float32), ~np.isnan(p), CELL, origin
    )


def room(width=6.0, height=4.0):
    """A free room with a wall of one cell round it."""
    p = np.full((round(height / CELL), round(width / CELL)), 0.05)
    p[[0, -1]] = p[:, [0, -1]] = 0.95
    return p


def parted(door=None, at=3.0, wall=0.95):
    """The room with a wall across it, and a door of some width in its middle (m)."""
    p = room()
    col = round(at / CELL)
    p[:, col] = wall
    if door is not None:
        half = round(door / CELL / 2)
        p[40 - half : 40 + half, col] = 0.05
    return p


def between(grid, ends):
    start, goal = ends
    return plan(grid, start, goal, B21)


def covered(grid, path, of):
    """Whether the footprint comes within its radius of the middle of some cells, along a path."""
    middles = grid.centre_of(np.argwhere(of))
    return KDTree(middles).query(path.points)[0].min() if len(middles) else math.inf


@pytest.mark.parametrize("goal", [(5.0, 1.0), (5.0, 3.1), (1.0, 3.0), (4.3, 2.9)])
def test_in_the_open_a_path_is_the_straight_line(goal):
    path = plan(grid_of(room()), (1.0, 1.0), goal, B21)
    straight = math.dist((1.0, 1.0), goal)
    assert straight - 1e-9 <= path.length_m < 1.01 * straight
    np.testing.assert_allclose(path.points[[0, -1]], [(1.0, 1.0), goal])
    assert np.max(np.diff(path.s_m)) <= 0.0501


def test_round_the_end_of_a_wall_it_is_a_little_longer_than_the_shortest():
    p = room()
    p[: round(2.0 / CELL), 60] = 0.95  # up to y = 2 m at x = 3.0 to 3.05 m
    path = plan(grid_of(p), (2.0, 1.0), (4.05, 1.0), B21)
    # Two tangents to a disc of the footprint round the wall's end, and the arc between them.
    keep = R + MARGIN_M
    reach = math.hypot(1.025, 1.0)
    tangent = math.sqrt(reach**2 - keep**2)
    arc = 2 * (math.pi - math.atan2(1.025, 1.0) - math.acos(keep / reach)) * keep
    shortest = 2 * tangent + arc
    assert 0.99 * shortest < path.length_m < 1.2 * shortest


def test_there_is_room_it_keeps_its_distance():
    p = room()
    p[40:, 60] = 0.95
    path = plan(grid_of(p), (2.0, 1.0), (4.0, 1.0), B21)
    assert np.min(path.clearance_m) > 0.3
    tight = plan(grid_of(parted(door=2 * R + 0.15)), (1, 2), (5, 2), B21)
    assert 0 <= np.min(tight.clearance_m) < 0.1


@given(st.integers(0, 2**32 - 1))
def test_no_path_covers_what_is_occupied_or_unknown(seed):
    rng = np.random.default_rng(seed)
    p = room()
    for value in (0.95, 0.95, np.nan, np.nan, 0.5):
        row, col = rng.integers(0, [70, 110])
        p[row : row + rng.integers(1, 20), col : col + rng.integers(1, 20)] = value
    grid = grid_of(p, origin=(-1.0, 2.0))
    ends = rng.uniform([-0.6, 2.4], [4.6, 5.6], (2, 2))
    try:
        path = between(grid, ends)
    except NoPathError:
        return
    classes = occupancy(grid)
    # Half a cell is left to where in its cell a point of the path is, and half a diagonal to a cell's corners.
    margin = MARGIN_M if path.narrow is None else NARROW_M
    assert covered(grid, path, classes == 100) > R + margin - 0.2 * CELL
    assert covered(grid, path, classes == -1) > R - 0.2 * CELL
    assert np.all(np.linalg.norm(path.points[[0, -1]] - ends, axis=1) <= 0.16)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.05, 0.1, 0.2, 0.3]))
def test_in_cells_of_any_size_the_footprint_covers_no_wall_and_the_clearance_is_true(seed, cell):
    rng = np.random.default_rng(seed)
    p = np.full((20, 24), 0.05)
    p[[0, -1]] = p[:, [0, -1]] = 0.95
    p[rng.integers(0, 20, 12), rng.integers(0, 24, 12)] = 0.95
    grid = Grid(logit(p).astype(np.float32), np.ones(p.shape, bool), cell, (0.0, 0.0))
    robot = Robot("disc", float(rng.uniform(0.5, 2.0)) * cell, B21.transducer, 0.2, 4.0, 0.4, np.zeros((1, 3)))
    ends = rng.uniform(1, 19, (2, 2)) * cell
    try:
        path = plan(grid, ends[0], ends[1], robot)
    except NoPathError:
        return
    off = np.abs(path.points[:, None] - grid.centre_of(np.argwhere(p > 0.5))) - cell / 2
    beside = np.hypot(*np.moveaxis(np.maximum(off, 0), -1, 0)).min(axis=1) - robot.footprint_radius_m
    assert beside.min() >= -0.01 * cell
    np.testing.assert_allclose(path.clearance_m, beside, atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_a_way_is_there_where_an_independent_search_finds_one(seed):
    from scipy import ndimage

    rng = np.random.default_rng(seed)
    p = room()
    for _ in range(6):
        row, col = rng.integers(0, [70, 110])
        p[row : row + rng.integers(1, 40), col : col + rng.integers(1, 3)] = 0.95
    grid = grid_of(p)
    ends = rng.uniform([0.5, 0.5], [5.5, 3.5], (2, 2))
    # The distance between middles less half a cell, by another way than the planner's.
    cells = np.argwhere(np.ones(grid.shape, bool))
    gap = KDTree(np.argwhere(p > 0.65)).query(cells)[0].reshape(grid.shape) - 0.5
    piece, _ = ndimage.label(gap * CELL >= R + MARGIN_M)
    narrow, _ = ndimage.label(gap * CELL >= R + NARROW_M)
    a, b = (tuple(cell) for cell in grid.index_of(ends))
    if not (piece[a] and piece[b]):
        return
    if narrow[a] == narrow[b]:
        path = between(grid, ends)
        assert path.length_m >= math.dist(*ends) - 1e-6
        assert (path.narrow is None) == (piece[a] == piece[b])
    else:
        with pytest.raises(NoPathError, match="no way to"):
            between(grid, ends)


@pytest.mark.parametrize("change", ["back", "mirrored", "moved", "upright"])
def test_a_path_does_not_depend_on_where_the_map_lies(change):
    p, ends = parted(door=0.9), [np.array([1.0, 0.8]), np.array([5.1, 3.1])]
    length = between(grid_of(p), ends).length_m
    if change == "back":
        other = between(grid_of(p), ends[::-1])
    elif change == "mirrored":
        other = between(grid_of(p[:, ::-1]), [np.array([6.0, 0]) + end * [-1, 1] for end in ends])
    elif change == "moved":
        other = between(grid_of(p, (-20.0, 7.0)), [end + np.array([-20.0, 7.0]) for end in ends])
    else:
        other = between(grid_of(p.T), [end[::-1] for end in ends])
    assert other.length_m == pytest.approx(length, rel=0.02)


def test_what_is_unknown_is_driven_on_only_where_that_is_allowed_and_then_little():
    p = parted(door=1.2)
    p[:, 55:58] = np.nan
    with pytest.raises(NoPathError, match="no way to"):
        plan(grid_of(p), (1, 1), (5, 3), B21)
    path = plan(grid_of(p), (1, 1), (5, 3), B21, unknown=True)
    assert np.min(path.clearance_m) < 0
    way = room()
    way[20:60, 60] = np.nan
    assert np.min(plan(grid_of(way), (2, 2), (4, 2), B21, unknown=True).clearance_m) >= 0  # goes round it


@pytest.mark.parametrize(
    ("p", "drives"), [(0.02, True), (0.2499, True), (0.2501, False), (0.5, False), (0.6499, False), (0.98, False)]
)
def test_the_thresholds_are_those_of_nav2(p, drives):
    values = parted(wall=p)
    classes = occupancy(grid_of(values))
    assert (classes[40, 60] == 0) == drives
    if drives:
        assert plan(grid_of(values), (1, 2), (5, 2), B21).length_m == pytest.approx(4, rel=0.01)
    else:
        with pytest.raises(NoPathError):
            plan(grid_of(values), (1, 2), (5, 2), B21)


def test_what_nobody_spoke_of_is_not_free_whatever_its_log_odds():
    grid = grid_of(parted(wall=0.05))
    grid.observed[:, 60] = False
    with pytest.raises(NoPathError):
        plan(grid, (1, 2), (5, 2), B21)


def refusal(*args, **more):
    with pytest.raises(NoPathError) as caught:
        plan(*args, **more)
    return str(caught.value)


def test_why_there_is_none():
    shut = grid_of(parted())
    assert "start (3.02, 2.00) m: found what is occupied" in refusal(shut, (3.02, 2), (5, 2), B21)
    assert "goal (0.20, 2.00) m: found something occupied 0.17 m off" in refusal(shut, (1, 2), (0.2, 2), B21)
    assert "(9.00, 2.00) m: found a place outside of what was mapped" in refusal(shut, (9, 2), (1, 2), B21)
    dim = parted()
    dim[30:50, 90:110] = np.nan
    assert "goal (5.00, 2.00) m: found ground that is not known" in refusal(grid_of(dim), (4, 1), (5, 2), B21)
    said = refusal(shut, (1, 2), (5, 2), B21)
    assert "found no way to (5.00, 2.00) m: walls, or what is unknown, are all round it, expected a way " in said
    # It gets as near as its footprint and the margin leave it beside the wall.
    assert float(said.split("within ")[1].split(" m")[0]) == pytest.approx(5 - (3 - R - MARGIN_M), abs=2 * CELL)


def test_a_door_too_narrow_is_named():
    said = refusal(grid_of(parted(door=0.4)), (1, 2), (5, 2), B21)
    width, x, y = (
        float(said.split(key)[1].split(end)[0]) for key, end in (("is ", " m"), ("at (", ","), (", ", ")"))
    )
    assert width == pytest.approx(0.4, abs=2 * CELL)
    assert math.dist((x, y), (3.025, 2.0)) < 0.25
    assert f"expected a way {2 * (R + NARROW_M):.2f} m wide" in said


def test_the_narrowest_place_is_the_door_not_the_end_of_a_wall_on_the_way():
    values = parted(door=0.4)
    values[round(1.0 / CELL) :, round(1.5 / CELL)] = 0.95  # it could be driven round closely
    said = refusal(grid_of(values), (0.8, 3), (5, 2), B21)
    x, y = (float(said.split(key)[1].split(end)[0]) for key, end in (("at (", ","), (", ", ")")))
    assert math.dist((x, y), (3.025, 2.0)) < 0.25


@pytest.mark.parametrize("wide_m", [CELL, 1.0])
def test_ground_that_is_not_known_is_no_door(wide_m):
    values = room()
    values[1:-1, round(3.0 / CELL) : round((3.0 + wide_m) / CELL)] = np.nan
    said = refusal(grid_of(values), (1, 2), (5, 2), B21)
    assert "walls, or what is unknown, are all round it" in said
    assert said.endswith("; over ground that is not known there is a way (--unknown)")
    assert plan(grid_of(values), (1, 2), (5, 2), B21, unknown=True).length_m == pytest.approx(4, rel=0.02)
    assert "--unknown" not in refusal(grid_of(parted()), (1, 2), (5, 2), B21)


def test_a_robot_without_a_footprint_is_refused():
    with pytest.raises(UsageError, match="robot b21: footprint_radius_m: found 0, expected the radius"):
        plan(grid_of(room()), (1, 2), (5, 2), replace(B21, footprint_radius_m=0.0))


def test_a_door_with_smeared_posts_is_driven_through_and_named():
    values = parted(door=0.5)  # 0.53 m of footprint, and posts that are neither free nor occupied
    smeared = np.zeros_like(values, dtype=bool)
    smeared[:, 60] = values[:, 60] > 0.5
    smeared[:, 60] &= np.roll(~smeared[:, 60], 1) | np.roll(~smeared[:, 60], -1)
    values[smeared] = 0.4
    path = plan(grid_of(values), (1, 2), (5, 2), B21)
    assert path.narrow is not None
    assert math.dist(path.narrow, (3.025, 2.0)) < 0.1
    assert -0.06 < path.clearance_m.min() < 0
    values[smeared] = 0.6  # less likely free than not
    with pytest.raises(NoPathError, match=r"the widest way there is 0\.4"):
        plan(grid_of(values), (1, 2), (5, 2), B21)


def test_where_there_is_a_wide_way_none_is_narrow():
    assert plan(grid_of(parted(door=0.7)), (1, 2), (5, 2), B21).narrow is None


def test_a_start_that_the_map_smears_a_little_is_moved():
    path = plan(grid_of(room()), (R + 0.05, 2.0), (3, 2), B21)  # 3 cm too near to the wall
    assert 0.02 < path.points[0, 0] - (R + 0.05) < 0.12


def test_what_is_no_place_or_no_map_is_refused():
    for wrong in ((math.nan, 1), (1, math.inf), (1,), (1, 2, 3), (1e9, 0)):
        with pytest.raises(UsageError, match=r"plan: (start|goal): found .*, expected x, y within 1e\+07 m"):
            plan(grid_of(room()), (1, 1), wrong, B21)
    for empty in (np.full((20, 20), np.nan), np.full((20, 20), 0.95), np.zeros((0, 0))):
        with pytest.raises(UsageError, match="found a map without free cells"):
            plan(grid_of(empty), (0.5, 0.5), (0.6, 0.6), B21)


def test_to_where_it_stands_there_is_nothing_to_drive():
    assert plan(grid_of(room()), (2, 2), (2, 2), B21).length_m < CELL


def test_clearance_is_the_room_beside_the_footprint():
    floor = Floor.of(grid_of(room()), R)
    cell = floor.cell((3.025, 1.025))
    assert cell is not None
    assert floor.known_m[cell] == pytest.approx(1.025 - CELL, abs=1e-6)
    path = plan(grid_of(room()), (1, 1.025), (5, 1.025), B21)
    assert path.clearance_m == pytest.approx(np.full(len(path.points), 1.025 - CELL - R), abs=0.3)


def test_where_its_sonars_hear_nothing_a_metre_is_dear_and_the_middle_stays_the_cheapest():
    grid = grid_of(parted(1.0))
    plain, deaf = Floor.of(grid, R), Floor.of(grid, R, deaf_m=0.2)
    beside = np.minimum(plain.gap_m - plain.body_m, plain.known_m - R)
    assert np.all(deaf.known_costs[beside > 0.2] == plain.known_costs[beside > 0.2])
    near = (beside >= 0) & (beside < 0.19)
    assert np.all(deaf.known_costs[near] > plain.known_costs[near])
    across = deaf.known_costs[:, round(3.0 / CELL) + 1]  # in the door
    way = np.flatnonzero(np.isfinite(across))
    assert abs(float(np.mean(way[across[way] == across[way].min()])) - np.mean(way)) <= 1
