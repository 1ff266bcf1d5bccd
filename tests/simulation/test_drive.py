import re
from math import pi

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.geometry import wrap
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.simulation.drive import STEP_M, TURN_RAD, along, read_waypoints, tour, truth_of, turning
from echogrid.simulation.rooms import SHAPES, random_world
from echogrid.simulation.world import SMOOTH_M, World, inside_room, polyline


def world_of(*lines, closed=False, cylinders=(), start=None):
    walls = np.concatenate([polyline(line, closed) for line in lines])
    round_ = np.array(cylinders, dtype=float).reshape(-1, 3)
    return World("test", walls, np.full(len(walls), SMOOTH_M), round_, start)


ROOM = world_of([[0.03, 0.03], [4.03, 0.03], [4.03, 3.03], [0.03, 3.03]], closed=True)


def standing_at(x, y):
    return np.array([[x, y, 0.0]])


def label_at(truth, x, y):
    col, row = np.floor((np.array([x, y]) - truth.origin) / truth.resolution).astype(int)
    return truth.cells[row, col]


def centres(truth):
    rows, cols = truth.cells.shape
    x = truth.origin[0] + (np.arange(cols) + 0.5) * truth.resolution
    y = truth.origin[1] + (np.arange(rows) + 0.5) * truth.resolution
    return np.stack(np.meshgrid(x, y), axis=-1)


@settings(max_examples=25)
@given(st.integers(0, 1000), st.sampled_from(list(SHAPES)), st.floats(0.1, 0.4))
def test_a_tour_keeps_its_clearance_and_its_steps(seed, shape, clearance):
    world = random_world(np.random.default_rng(seed), shape)
    try:
        poses = tour(world, clearance)
    except UsageError:
        return
    assert world.clearance(poses[:, :2]).min() > clearance - 0.05
    assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max(initial=0) <= STEP_M + 1e-9
    assert np.all(np.isfinite(poses))


def test_a_tour_stays_in_the_room_and_passes_near_all_of_it():
    poses = tour(ROOM, 0.3)
    assert np.all(inside_room(ROOM, poses[:, :2]))
    assert ROOM.clearance(poses[:, :2]).min() > 0.25
    x, y = np.meshgrid(np.arange(0.4, 3.7, 0.2), np.arange(0.4, 2.7, 0.2))
    free = np.column_stack([x.ravel(), y.ravel()])
    nearest = np.linalg.norm(free[:, None] - poses[:, :2], axis=-1).min(axis=1)
    assert nearest.max() < 1.1


def test_a_tour_goes_through_no_wall():
    world = world_of([[0, 0], [5, 0], [5, 4], [0, 4], [0, 0]], [[2, 0], [2, 3]], start=(1, 1))
    poses = tour(world, 0.3)
    steps = np.diff(poses[:, :2], axis=0)
    sight = world.sight(poses[:-1, :2], np.arctan2(steps[:, 1], steps[:, 0]))
    assert np.all(sight > np.linalg.norm(steps, axis=1))
    assert poses[:, 0].min() < 1
    assert poses[:, 0].max() > 3.5


def test_a_tour_drives_the_way_it_looks():
    poses = tour(ROOM, 0.3)
    ways = np.diff(poses[:, :2], axis=0)
    ahead = np.einsum("ij,ij->i", ways, np.column_stack([np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])]))
    assert np.mean(ahead > 0.5 * STEP_M) > 0.9


def test_where_a_tour_turns_back_the_robot_turns_on_the_spot():
    there = tour(ROOM, 0.3)
    poses = turning(there)
    steps = np.diff(poses, axis=0)
    assert np.abs(wrap(np.diff(there[:, 2]))).max() > np.deg2rad(60)
    assert np.abs(wrap(steps[:, 2])).max() <= TURN_RAD + 1e-9
    assert np.count_nonzero(np.hypot(steps[:, 0], steps[:, 1]) > 0) == len(there) - 1
    assert {tuple(pose) for pose in there.tolist()} <= {tuple(pose) for pose in poses.tolist()}


@pytest.mark.parametrize(("start", "low", "high"), [((1, 1), 0, 2), ((3, 1), 2, 4)])
def test_a_tour_is_of_the_room_of_the_start(start, low, high):
    world = world_of([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], [[2, 0], [2, 3]], start=start)
    poses = tour(world, 0.3)
    assert poses[:, 0].min() > low
    assert poses[:, 0].max() < high
    assert np.linalg.norm(poses[0, :2] - start) < 0.2


def test_a_tour_without_a_start_is_of_the_largest_room():
    world = world_of([[0, 0], [6, 0], [6, 3], [0, 3], [0, 0]], [[2, 0], [2, 3]])
    assert tour(world, 0.3)[:, 0].min() > 2


def test_without_free_space_there_is_no_tour():
    with pytest.raises(UsageError, match=r"free space 3.00 m from all walls, expected a room with walls all round$"):
        tour(ROOM, 3.0)


def test_along_goes_straight_in_even_steps_and_turns_on_the_spot():
    poses = along(np.array([[0.0, 0], [1, 0], [1, 0.5]]))
    np.testing.assert_allclose(poses[0], [0, 0, 0])
    np.testing.assert_allclose(poses[-1], [1, 0.5, pi / 2])
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    turns = wrap(np.diff(poses[:, 2]))
    np.testing.assert_allclose(steps[steps > 1e-9], STEP_M)
    assert np.all(np.abs(turns) <= TURN_RAD + 1e-9)
    assert turns.sum() == pytest.approx(pi / 2)
    assert steps.sum() == pytest.approx(1.5)
    moving = steps > 1e-9
    assert np.sum(~moving & (turns > 0)) >= 9
    ways = np.diff(poses[:, :2], axis=0)[moving]
    np.testing.assert_allclose(np.arctan2(ways[:, 1], ways[:, 0]), poses[:-1, 2][moving], atol=1e-9)


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=2, max_size=5))
def test_along_passes_its_waypoints_in_order_without_a_jump(waypoints):
    poses = along(np.array(waypoints))
    np.testing.assert_allclose(poses[[0, -1], :2], [waypoints[0], waypoints[-1]], atol=1e-9)
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert steps.max(initial=0) <= 1.5 * STEP_M + 1e-9
    assert np.abs(wrap(np.diff(poses[:, 2]))).max(initial=0) <= TURN_RAD + 1e-9
    at = 0
    for point in waypoints:
        here = np.linalg.norm(poses[at:, :2] - point, axis=1) < 1e-6
        assert here.any()
        at += int(np.argmax(here))


def test_along_turns_the_short_way():
    poses = along(np.array([[0.0, 0.0], [-1.0, 0.1], [-2.0, 0.0]]))
    turns = wrap(np.diff(poses[:, 2]))
    assert np.abs(turns).sum() == pytest.approx(2 * np.arctan2(0.1, 1))


def test_waypoints_that_repeat_are_one():
    np.testing.assert_array_equal(along(np.array([[1.0, 2], [1, 2]])), [[1, 2, 0]])
    once, twice = np.array([[0.0, 0], [1, 1]]), np.array([[0.0, 0], [0, 0], [1, 1], [1, 1]])
    np.testing.assert_array_equal(along(twice), along(once))


def test_truth_of_a_room_has_walls_one_cell_thick():
    # The walls lie at 0.03 and 4.03 m: in the cells 0 and 40 of 0.1 m.
    truth = truth_of(ROOM, standing_at(0.85, 0.95))
    xy = np.rint((centres(truth) - 0.05) / 0.1).astype(int)
    surface = {tuple(c) for c in xy[truth.cells == SURFACE]}
    assert {(x, 0) for x in range(1, 18)} <= surface
    assert {(0, y) for y in range(1, 20)} <= surface
    assert all(0 in c for c in surface)
    free = xy[truth.cells == FREE]
    assert free.min() == 1


def test_a_wall_on_the_border_of_two_cells_is_the_surface_of_the_far_one():
    truth = truth_of(world_of([[2, -3], [2, 3]]), standing_at(1.25, 0.05))
    assert label_at(truth, 1.95, 0.05) == FREE
    assert label_at(truth, 2.05, 0.05) == SURFACE
    assert label_at(truth, 2.15, 0.05) == HIDDEN


def test_truth_has_nothing_farther_than_its_reach_and_all_that_is_nearer():
    truth = truth_of(ROOM, standing_at(1.5, 1.5), reach=1.2)
    distance = np.linalg.norm(centres(truth) - [1.5, 1.5], axis=-1)
    assert np.all(truth.cells[distance > 1.2 + 0.08] == HIDDEN)
    assert np.all(truth.cells[distance < 1.2] == FREE)
    assert not np.any(truth.cells == SURFACE)


def test_truth_hides_what_a_box_hides():
    box = [[1.53, 1.33], [1.73, 1.33], [1.73, 1.73], [1.53, 1.73], [1.53, 1.33]]
    truth = truth_of(world_of([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], box), standing_at(1.05, 1.55), reach=1.4)
    assert label_at(truth, 1.45, 1.55) == FREE
    assert label_at(truth, 1.55, 1.55) == SURFACE
    assert label_at(truth, 1.65, 1.55) == HIDDEN
    assert label_at(truth, 2.05, 1.55) == HIDDEN
    assert label_at(truth, 1.75, 1.95) == FREE
    assert label_at(truth, 2.05, 2.05) == FREE


def test_truth_of_a_longer_drive_sees_all_that_its_poses_see():
    box = [[1.53, 1.33], [1.73, 1.33], [1.73, 1.73], [1.53, 1.73], [1.53, 1.33]]
    world = world_of([[0, 0], [4, 0], [4, 3], [0, 3], [0, 0]], box)
    a, b = standing_at(1.05, 1.55), standing_at(2.45, 1.55)
    both = truth_of(world, np.concatenate([a, b]))
    for alone in (truth_of(world, a), truth_of(world, b)):
        seen = alone.cells != HIDDEN
        points, labels = centres(alone)[seen], alone.cells[seen]
        together = np.array([label_at(both, x, y) for x, y in points])
        assert np.all(together[labels == SURFACE] == SURFACE)
        assert np.all(together != HIDDEN)


@settings(max_examples=15)
@given(st.integers(0, 1000), st.sampled_from(list(SHAPES)))
def test_every_surface_cell_of_a_truth_holds_a_wall_and_every_free_centre_is_in_sight(seed, shape):
    rng = np.random.default_rng(seed)
    world = random_world(rng, shape)
    points = rng.uniform(*world.bounds(), (50, 2))
    points = points[world.clearance(points) > 0.2][:1]
    if not len(points):
        return
    truth = truth_of(world, np.column_stack([points, [0.0]]), 0.1, 1.2)
    at = centres(truth)
    assert np.all(world.clearance(at[truth.cells == SURFACE]) <= 0.1 * np.sqrt(0.5) + 0.01)
    to = at[truth.cells == FREE] - points[0]
    sight = world.sight(np.repeat(points, len(to), axis=0), np.arctan2(to[:, 1], to[:, 0]))
    assert np.mean(sight >= np.linalg.norm(to, axis=1)) > 0.99


def put(folder, content):
    path = folder / "way.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_waypoints_are_read_without_their_comments(tmp_path):
    path = put(tmp_path, "# a drive\n1, 2\n\n3.5,-4 # there\n1e1,0\n")
    np.testing.assert_array_equal(read_waypoints(path), [[1, 2], [3.5, -4], [10, 0]])


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("1", "'1'"),
        ("1,2,3", "'1,2,3'"),
        ("one,2", "'one,2'"),
        ("1;2", "'1;2'"),
        ("nan,2", "'nan,2'"),
        ("1,inf", "'1,inf'"),
        ("1,2e9", "'1,2e9'"),
    ],
)
def test_a_wrong_waypoint_is_one_line_that_names_the_line(tmp_path, line, found):
    path = put(tmp_path, f"0,0\n# here\n{line}\n1,1\n")
    with pytest.raises(InputError, match=rf"^{re.escape(str(path))}:3: found {re.escape(found)}, expected x,y "):
        read_waypoints(path)


@pytest.mark.parametrize(("content", "count"), [("", 0), ("# nothing\n", 0), ("1,2\n", 1)])
def test_fewer_than_two_waypoints_are_no_drive(tmp_path, content, count):
    path = put(tmp_path, content)
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: found {count} waypoints, expected at least 2$"):
        read_waypoints(path)


def test_waypoints_that_cannot_be_read_are_one_line(tmp_path):
    with pytest.raises(InputError, match=r"missing.csv: found no such file, expected"):
        read_waypoints(tmp_path / "missing.csv")
    with pytest.raises(InputError, match=r": found a folder, expected"):
        read_waypoints(tmp_path)
    with pytest.raises(InputError, match=r": found bytes that are not UTF-8 text, expected"):
        read_waypoints(put(tmp_path, b"\xff\xfe1,2"))


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=60) | st.text(alphabet="0123456789.,-+e#\n naif_", max_size=60).map(str.encode))
def test_any_bytes_are_waypoints_or_raise_our_errors(tmp_path, content):
    try:
        points = read_waypoints(put(tmp_path, content))
    except EchogridError as error:
        points, message = np.zeros((2, 2)), str(error)
    else:
        message = ""
    assert len(points) >= 2
    assert np.all(np.isfinite(points))
    assert "\n" not in message
