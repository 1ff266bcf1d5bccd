from math import nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid import _core
from echogrid.frame import Frame
from echogrid.geometry import inverse, transform
from echogrid.grid import sigmoid
from echogrid.mapping.build import build_map
from echogrid.models.batches import BATCH
from echogrid.models.networks.local_map import (
    LOCAL_CELL_M,
    LOCAL_CELLS,
    P_UNDER_ROBOT,
    P_VIEW_MAX,
    P_VIEW_MIN,
    Interpreter,
    LocalMap,
    coded,
    in_cells,
    local_cells,
    local_mapper,
)
from echogrid.robot import Robot

pytestmark = pytest.mark.filterwarnings("ignore::echogrid.DoubtWarning")  # places in no order of driving

B21 = Robot.load("b21")
PRIOR = 0.2
POINT_LIKE = Robot("point", 0.0, B21.transducer, 0.0, 5.0, B21.beam_width_rad, B21.mounts[::6])
"""Four sonars and no body: no cell is under it."""


class Told(Interpreter):
    """An interpreter that reads each cell's probability from one sonar: the reading is the probability itself.

    Cell i asks sonar i modulo the number of sonars; a sonar that did not fire says nothing.
    """

    name, prior = "told", PRIOR

    def told(self):
        return {}

    def bind(self, robot, p_robot):
        sonar = np.arange(len(p_robot)) % robot.sonars

        def interpret(ranges):
            told = ranges[:, sonar]
            return np.where(np.isnan(told), np.float32(self.prior), told), ~np.isnan(told)

        return interpret


class Pattern(Interpreter):
    """An interpreter that says the same of every scan."""

    name, prior = "pattern", PRIOR

    def told(self):
        return {}

    def __init__(self, p, spoken=None):
        self.p = np.asarray(p, dtype=np.float32).ravel()
        self.spoken = np.ones(576, dtype=bool) if spoken is None else np.ravel(spoken)

    def bind(self, robot, p_robot):
        def interpret(ranges):
            shape = (len(ranges), 576)
            return np.broadcast_to(self.p, shape), np.broadcast_to(self.spoken, shape)

        return interpret


def frame(x, y, theta, ranges=None):
    return Frame(0.0, np.array([x, y, theta], dtype=float), np.full(4, 1.0) if ranges is None else ranges)


def random_frames(count, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-2, 2, (count, 2)), rng.uniform(-10, 10, count)])
    told = rng.uniform(0.05, 0.95, (count, 4))
    told[rng.random(told.shape) < 0.2] = nan
    return [frame(*pose, ranges) for pose, ranges in zip(poses, told, strict=True)]


def last_of(frames, model, resolution=LOCAL_CELL_M, robot=POINT_LIKE):
    *_, grid = build_map(frames, robot, model, resolution)
    return grid


def equation_4(probability, x, y):
    """Mean of the four centres round a point, in cells from the first centre, with the weights 1/distance."""
    col, row = min(int(x), LOCAL_CELLS - 2), min(int(y), LOCAL_CELLS - 2)
    centres = [(col + i, row + j) for i in (0, 1) for j in (0, 1)]
    distance = np.array([np.hypot(x - i, y - j) for i, j in centres])
    values = np.array([probability[j, i] for i, j in centres])
    if distance.min() < 1e-6:
        return values[np.argmin(distance)]
    return np.sum(values / distance) / np.sum(1 / distance)


def resample(local, points):
    """Probability of points [n, 2], in cells from the first centre, by the core; nan where nothing is said."""
    rule = _core.LocalFusion(0.0, 1e-6, 1 - 1e-6, False, 0.0, None, 0.7)
    told = coded(local)
    p = np.full((len(told), len(points)), nan)
    for i, k in np.ndindex(p.shape):
        # A window of one cell, which lies there.
        at = ((points[None, k] - (LOCAL_CELLS - 1) / 2) * LOCAL_CELL_M).astype(np.float32)
        cell = np.zeros((1, 1), np.float32), np.zeros((1, 1), bool), np.zeros((1, 1), np.int32)
        rule.add(
            told[i : i + 1], np.zeros((1, 0), np.float32), at, np.zeros(1), np.zeros((1, 2), np.int32), 0.1, *cell
        )
        assert cell[1] == cell[2]
        if cell[1]:
            p[i, k] = sigmoid(cell[0])[0, 0]
    return p


def plain_map(frames, views, grid):
    """Evidence at each cell of a grid, frame by frame and cell by cell, and whether a cell is at the rim of a view.

    ``views``: probability and spoken, each [row, col], of each frame's local map.
    """
    rows, cols = grid.shape
    index = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1).reshape(-1, 2)
    total, spoken_of, rim = np.zeros(len(index)), np.zeros(len(index), dtype=bool), np.zeros(len(index), dtype=bool)
    for each, (probability, spoken) in zip(frames, views, strict=True):
        p_robot = transform(inverse(each.pose)[None], grid.centre_of(index))
        at = p_robot / LOCAL_CELL_M + (LOCAL_CELLS - 1) / 2
        edge = np.min(np.minimum(at, LOCAL_CELLS - 1 - at), axis=1)
        rim |= np.abs(edge) < 1e-3
        for k in np.flatnonzero(edge >= 0):
            x, y = at[k]
            rim[k] |= min(abs(x - round(x)), abs(y - round(y))) < 1e-3
            col, row = min(int(x), LOCAL_CELLS - 2), min(int(y), LOCAL_CELLS - 2)
            if not spoken[row : row + 2, col : col + 2].any():
                continue
            p = np.clip(equation_4(probability, x, y), P_VIEW_MIN, P_VIEW_MAX)
            total[k] += np.log(p / (1 - p)) - np.log(PRIOR / (1 - PRIOR))
            spoken_of[k] = True
    return total.reshape(rows, cols), spoken_of.reshape(rows, cols), rim.reshape(rows, cols)


def told_views(frames):
    told = np.array([each.ranges[np.arange(576) % 4].reshape(24, 24) for each in frames])
    return [(np.where(np.isnan(t), PRIOR, t), ~np.isnan(t)) for t in told]


def test_the_local_map_is_24_by_24_cells_of_12_cm_with_the_robot_in_its_middle():
    cells = local_cells()
    assert cells.shape == (576, 2)
    np.testing.assert_allclose(cells.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(cells[[0, 1, 24, -1]], [[-1.38, -1.38], [-1.26, -1.38], [-1.38, -1.26], [1.38, 1.38]])
    np.testing.assert_allclose(
        in_cells(cells), np.stack(np.meshgrid(range(24), range(24)), axis=-1).reshape(-1, 2), atol=1e-5
    )


@settings(max_examples=60)
@given(st.integers(0, 10_000))
def test_resampling_is_equation_4(seed):
    rng = np.random.default_rng(seed)
    probability = rng.random((24, 24)).astype(np.float32)
    points = rng.uniform(0, 23, (20, 2)).astype(np.float32)
    points[:3] = np.clip(np.rint(points[:3]), 1, 22)
    p = resample(LocalMap(probability[None], np.ones((1, 24, 24), dtype=bool)), points)[0]
    expected = [equation_4(probability, float(x), float(y)) for x, y in points]
    np.testing.assert_allclose(p, expected, atol=2e-5)


def test_no_point_outside_the_outermost_centres_has_four_neighbours():
    x = [-0.01, 1e-4, 23.0 - 1e-4, 23.01, 5.0, 5.0, -100.0]
    y = [5.0, 1e-4, 23.0 - 1e-4, 5.0, -0.01, 23.01, 800.0]
    said = resample(LocalMap(np.full((1, 24, 24), PRIOR), np.ones((1, 24, 24), bool)), np.column_stack([x, y]))
    np.testing.assert_array_equal(~np.isnan(said[0]), [False, True, True, False, False, False, False])


def test_resampling_at_its_own_centres_returns_the_local_map():
    rng = np.random.default_rng(0)
    probability, spoken = rng.random((3, 24, 24)).astype(np.float32), np.ones((3, 24, 24), dtype=bool)
    inner = np.stack(np.meshgrid(np.arange(24.0), np.arange(24.0)), axis=-1)[1:-1, 1:-1]
    p = resample(LocalMap(probability, spoken), inner.reshape(-1, 2))
    np.testing.assert_allclose(p, probability[:, 1:-1, 1:-1].reshape(3, -1), atol=1e-5)


def test_resampling_speaks_where_one_of_the_four_is_spoken_of():
    spoken = np.zeros((1, 24, 24), dtype=bool)
    spoken[0, 5, 7] = True
    x, y = [6.5, 7.5, 7.0, 8.5, 7.5, 5.5], [4.5, 5.5, 5.0, 5.5, 6.5, 5.5]
    p = resample(LocalMap(np.full((1, 24, 24), PRIOR), spoken), np.column_stack([x, y]))[0]
    np.testing.assert_array_equal(np.isnan(p), [False, False, False, True, True, True])
    np.testing.assert_allclose(p[:3], PRIOR, atol=1e-6)


def test_the_floor_under_the_robot_is_free_and_the_rest_is_as_the_interpreter_says():
    local = local_mapper(B21, Told())(np.full((2, 24), nan, np.float32))
    x, y = local_cells().T
    under = (np.maximum(np.abs(x), np.abs(y)) < 0.24) & (np.hypot(x, y) < B21.footprint_radius_m)
    odds = P_UNDER_ROBOT / (1 - P_UNDER_ROBOT) * PRIOR / (1 - PRIOR)
    expected = np.where(under, odds / (1 + odds), PRIOR).reshape(24, 24)
    assert under.sum() == 16
    for probability, spoken in zip(*local, strict=True):
        np.testing.assert_allclose(probability, expected, atol=1e-6)
        np.testing.assert_array_equal(spoken, under.reshape(24, 24))


def test_an_interpreter_that_says_the_prior_leaves_the_map_at_one_half():
    grid = last_of(random_frames(10), Pattern(np.full((24, 24), PRIOR)))
    np.testing.assert_allclose(grid.probability(), 0.5, atol=1e-6)
    assert grid.observed.any()


def test_scans_in_which_no_sonar_fired_leave_the_map_unobserved():
    grid = last_of([frame(0, 0, 0, np.full(4, nan))] * 3, Told())
    assert not grid.observed.any()
    np.testing.assert_array_equal(grid.log_odds, 0)


def test_a_map_of_unfired_sonars_is_free_under_the_robot_alone():
    frames = [Frame(0.0, np.array([0.06, 0.06, 0.0]), np.full(24, nan))]
    grid = last_of(frames, Told(), robot=B21)
    p = grid.probability_at(np.array([[0.06, 0.06], [0.12, 0.0], [0.7, 0.06], [0.06, -0.7]]))
    np.testing.assert_allclose(p[:2], P_UNDER_ROBOT, atol=0.02)
    np.testing.assert_array_equal(p[2:], 0.5)


@pytest.mark.parametrize("quarter", range(4))
def test_a_pattern_lands_turned_with_the_robot(quarter):
    pattern = np.full((24, 24), 0.1)
    pattern[4, 6:20], pattern[4:9, 19] = 0.9, 0.9
    x, y = 10 * LOCAL_CELL_M, -7 * LOCAL_CELL_M
    grid = last_of([frame(x, y, quarter * pi / 2)], Pattern(pattern))
    rows, cols = np.meshgrid(np.arange(24), np.arange(24), indexing="ij")
    at = (np.stack([cols, rows], axis=-1) - 11.5) * LOCAL_CELL_M + [x, y]
    # Row 0 is the lowest y: seen from above, a turn to the left is np.rot90 the other way round.
    turned = np.rot90(pattern, -quarter)
    inner = np.s_[1:-1, 1:-1]
    evidence = np.log(turned / (1 - turned)) - np.log(PRIOR / (1 - PRIOR))
    index = grid.index_of(at[inner])
    np.testing.assert_allclose(grid.log_odds[index[..., 0], index[..., 1]], evidence[inner], atol=0.05)


@pytest.mark.parametrize("resolution", [0.12, 0.05])
def test_the_map_is_the_sum_of_its_views_each_by_equation_4(resolution):
    frames = random_frames(12, seed=3)
    grid = last_of(frames, Told(), resolution)
    total, spoken_of, rim = plain_map(frames, told_views(frames), grid)
    assert rim.mean() < 0.1
    np.testing.assert_allclose(grid.log_odds[~rim], total[~rim], atol=2e-3)
    np.testing.assert_array_equal(grid.observed[~rim], spoken_of[~rim])
    assert np.std(total) > 0.5


def on_world(grid):
    """Log-odds and observed cells of a grid on a fixed window of the world."""
    first = np.rint(np.array(grid.origin[::-1]) / grid.resolution).astype(int) + 100
    world, spoken = np.zeros((200, 200)), np.zeros((200, 200), dtype=bool)
    window = np.s_[first[0] : first[0] + grid.shape[0], first[1] : first[1] + grid.shape[1]]
    world[window], spoken[window] = grid.log_odds, grid.observed
    return world, spoken


MANY = random_frames(2 * BATCH + 2)


@pytest.fixture(scope="module")
def whole():
    return on_world(last_of(MANY, Told()))


def test_the_map_is_independent_of_the_order_of_the_frames(whole):
    order = np.random.default_rng(1).permutation(len(MANY))
    log_odds, observed = on_world(last_of([MANY[i] for i in order], Told()))
    np.testing.assert_allclose(log_odds, whole[0], atol=1e-3)
    np.testing.assert_array_equal(observed, whole[1])


@pytest.mark.parametrize("count", [1, BATCH - 1, BATCH, BATCH + 1, 2 * BATCH])
def test_a_drive_mapped_in_two_parts_sums_to_the_map_of_the_whole(whole, count):
    parts = [on_world(last_of(part, Told())) for part in (MANY[:count], MANY[count:])]
    np.testing.assert_allclose(parts[0][0] + parts[1][0], whole[0], atol=1e-3)
    np.testing.assert_array_equal(parts[0][1] | parts[1][1], whole[1])


def test_the_same_frames_give_the_same_bytes(whole):
    again = on_world(last_of(MANY, Told()))
    np.testing.assert_array_equal(again[0], whole[0])


def test_a_drive_moved_by_whole_cells_gives_the_map_moved_by_whole_cells():
    rows, cols = 31, -57
    moved = [
        frame(f.pose[0] + cols * LOCAL_CELL_M, f.pose[1] + rows * LOCAL_CELL_M, f.pose[2], f.ranges) for f in MANY[:9]
    ]
    here, there = last_of(MANY[:9], Told()), last_of(moved, Told())
    np.testing.assert_allclose(there.origin, np.array(here.origin) + np.array([cols, rows]) * LOCAL_CELL_M, atol=1e-9)
    assert here.shape == there.shape
    differ = ~np.isclose(here.log_odds, there.log_odds, atol=1e-3) | (here.observed != there.observed)
    assert differ.mean() < 0.001


def test_a_drive_far_from_the_origin_is_mapped_as_sharply():
    far = [
        frame(f.pose[0] + 8333 * LOCAL_CELL_M, f.pose[1] - 8333 * LOCAL_CELL_M, f.pose[2], f.ranges) for f in MANY[:9]
    ]
    here, there = last_of(MANY[:9], Told()), last_of(far, Told())
    differ = ~np.isclose(here.log_odds, there.log_odds, atol=1e-3) | (here.observed != there.observed)
    assert differ.mean() < 0.001


def test_a_heading_and_the_same_heading_a_turn_later_are_one():
    turned = [frame(*f.pose[:2], f.pose[2] + 4 * pi, f.ranges) for f in MANY[:5]]
    here, there = last_of(MANY[:5], Told()), last_of(turned, Told())
    assert np.mean(~np.isclose(here.log_odds, there.log_odds, atol=1e-3)) < 0.001


def test_no_view_moves_a_cell_farther_than_its_limit():
    certain = Pattern(np.ones((24, 24)))
    once, twice = last_of([frame(0, 0, 0)], certain), last_of([frame(0, 0, 0)] * 2, certain)
    most = np.log(P_VIEW_MAX / (1 - P_VIEW_MAX)) - np.log(PRIOR / (1 - PRIOR))
    assert once.log_odds.max() == pytest.approx(most, abs=1e-4)
    np.testing.assert_allclose(twice.log_odds, 2 * once.log_odds, atol=1e-4)
