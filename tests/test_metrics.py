"""The scores: worked by hand, against plain loops, and by the laws that they obey."""

import dataclasses
import math

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echogrid.errors import InputError
from echogrid.geometry import compose
from echogrid.grid import Grid, logit
from echogrid.metrics import (
    HIDDEN,
    PATH_GOALS,
    PATH_STARTS,
    PathScore,
    Scores,
    Truth,
    _Ways,
    check_overlap,
    path_score,
    score,
    trajectory_error,
)

SHAPE = (5, 5)


def grid_of(p, resolution=1.0, origin=(0.0, 0.0)):
    log_odds = logit(np.asarray(p, dtype=float)).astype(np.float32)
    return Grid(log_odds, np.ones(log_odds.shape, dtype=bool), resolution, origin)


def truth_of(cells, resolution=1.0, origin=(0.0, 0.0)):
    return Truth(np.asarray(cells, dtype=np.int8), resolution, origin)


def few_cells(surface_p, free_p):
    """A 5x5 truth, hidden but for a few cells of its rows 0 (surface) and 4 (free), and its map."""
    cells, p = np.full(SHAPE, 2), np.full(SHAPE, 0.5)
    cells[0, : len(surface_p)], p[0, : len(surface_p)] = 1, surface_p
    cells[4, : len(free_p)], p[4, : len(free_p)] = 0, free_p
    return score(grid_of(p), truth_of(cells))


def plain_scores(p, cells):
    """The definitions once more, cell by cell; p has a border of one cell more than the truth."""
    rows, cols = cells.shape
    at = {(i, j): p[i + 1, j + 1] for i in range(-1, rows + 1) for j in range(-1, cols + 1)}
    surface = [(i, j) for i in range(rows) for j in range(cols) if cells[i, j] == 1]
    free = [(i, j) for i in range(rows) for j in range(cols) if cells[i, j] == 0]
    near = {(i, j): [at[i + a, j + b] for a in (-1, 0, 1) for b in (-1, 0, 1)] for i, j in surface}
    found = [max(near[c]) > 0.65 for c in surface]
    wiped = [at[c] < 0.35 and max(near[c]) <= 0.65 for c in surface]
    far = [c for c in free if all(math.dist(c, s) > 2 for s in surface)]
    wins = [(at[s] > at[f]) + 0.5 * (at[s] == at[f]) for s in surface for f in free]
    clipped = {c: min(max(v, 0.001), 0.999) for c, v in at.items()}
    nll = mean([-math.log(clipped[c]) for c in surface]), mean([-math.log(1 - clipped[c]) for c in free])
    pairs = [(at[c], 1) for c in surface] + [(at[c], 0) for c in free]
    bins = [[(q, y) for q, y in pairs if b <= q * 15 < b + 1] for b in range(15)]
    gaps = [len(b) / len(pairs) * abs(mean([y for _, y in b]) - mean([q for q, _ in b])) for b in bins if b]
    return Scores(
        found=mean(found),
        wiped=mean(wiped),
        free=mean([at[c] < 0.35 for c in free]),
        false=mean([at[c] > 0.65 for c in far]),
        auc=mean(wins),
        nll=(nll[0] + nll[1]) / 2,
        brier=mean([(q - y) ** 2 for q, y in pairs]),
        ece=sum(gaps) if pairs else math.nan,
        surface_cells=len(surface),
        free_cells=len(free),
    )


def mean(values):
    return sum(values) / len(values) if values else math.nan


def same(a, b, tolerance=1e-12):
    return dataclasses.astuple(a) == pytest.approx(dataclasses.astuple(b), abs=tolerance, nan_ok=True)


def test_scores_stand_in_the_order_in_which_they_are_printed():
    names = [field.name for field in dataclasses.fields(Scores)]
    assert names[:8] == ["found", "wiped", "free", "false", "auc", "nll", "brier", "ece"]


def test_found_wiped_free_and_false_worked_by_hand():
    cells = [
        [1, 1, 1, 1, 1],
        [0, 0, 0, 0, 2],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ]
    p = [
        [0.9, 0.1, 0.1, 0.1, 0.5],
        [0.5, 0.2, 0.2, 0.2, 0.9],  # the hidden 0.9 counts for the two surface cells beside it
        [0.2, 0.2, 0.8, 0.2, 0.2],  # 0.8 two cells from the surface is inexact, not false
        [0.2, 0.8, 0.2, 0.2, 0.2],  # 0.8 three cells away is false
        [0.2, 0.2, 0.2, 0.2, 0.2],
    ]
    scores = score(grid_of(p), truth_of(cells))
    assert scores.found == pytest.approx(4 / 5)  # all but column 2
    assert scores.wiped == pytest.approx(1 / 5)  # column 2
    assert scores.free == pytest.approx(16 / 19)
    assert scores.false == pytest.approx(1 / 10)
    assert (scores.surface_cells, scores.free_cells) == (5, 19)


def test_a_surface_cell_that_is_left_unknown_is_neither_found_nor_wiped():
    scores = few_cells([0.5], [0.1])
    assert (scores.found, scores.wiped) == (0.0, 0.0)


def test_false_measures_distance_by_euclid_and_not_by_rings():
    cells, p = np.full(SHAPE, 2), np.full(SHAPE, 0.1)
    cells[0, 0], cells[2, 1], cells[0, 2] = 1, 0, 0  # sqrt(5) and 2 cells away, both in ring 2
    p[2, 1] = p[0, 2] = 0.9
    assert score(grid_of(p), truth_of(cells)).false == 1.0
    cells[2, 1] = 2
    assert math.isnan(score(grid_of(p), truth_of(cells)).false)


def test_without_any_surface_every_claim_is_false():
    p = np.full(SHAPE, 0.1)
    p[0, :] = 0.9
    scores = score(grid_of(p), truth_of(np.zeros(SHAPE)))
    assert scores.false == pytest.approx(5 / 25)
    assert all(math.isnan(value) for value in (scores.found, scores.wiped, scores.auc, scores.nll))


def test_auc_worked_by_hand():
    # 0.9 beats both; 0.5 ties with 0.5 and beats 0.1.
    assert few_cells([0.9, 0.5], [0.5, 0.1]).auc == pytest.approx(3.5 / 4)


def test_nll_worked_by_hand_gives_the_classes_equal_weight():
    surface, free = [0.8], [0.2, 0.5, 0.5]
    expected = (-math.log(0.8) - (math.log(0.8) + 2 * math.log(0.5)) / 3) / 2
    assert few_cells(surface, free).nll == pytest.approx(expected, abs=1e-6)


def test_brier_worked_by_hand_gives_the_cells_equal_weight():
    assert few_cells([0.8], [0.2, 0.5, 0.5]).brier == pytest.approx((0.04 + 0.04 + 0.5) / 4, abs=1e-6)


def test_ece_worked_by_hand():
    # Bin 13 holds 0.9 (y 1), bin 7 both 0.5 (y 1 and 0: no gap), bin 1 holds 0.1 (y 0).
    assert few_cells([0.9, 0.5], [0.5, 0.1]).ece == pytest.approx(0.1 / 4 + 0.1 / 4, abs=1e-6)
    # 0.67 and 0.73 share bin 10 of 15: their gaps of +0.33 and -0.73 are added before the sign is dropped.
    assert few_cells([0.67], [0.73]).ece == pytest.approx((0.73 - 0.33) / 2, abs=1e-6)


def test_a_perfect_map_has_perfect_scores():
    cells = np.zeros((20, 20))
    cells[0, :] = cells[:, 7] = 1
    cells[12:, 12:] = 2
    scores = score(grid_of(np.where(cells == 1, 0.98, 0.02)), truth_of(cells))
    assert dataclasses.astuple(scores)[:5] == (1.0, 0.0, 1.0, 0.0, 1.0)
    assert scores.nll == pytest.approx(-math.log(0.98), abs=1e-6)
    assert scores.brier == pytest.approx(0.02**2, abs=1e-6)
    assert scores.ece == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize("empty", [False, True])
def test_a_map_that_knows_nothing_scores_as_a_coin(empty):
    grid = Grid(np.zeros((0, 0), np.float32), np.zeros((0, 0), bool), 1.0, (0.0, 0.0))
    cells = np.eye(5)
    scores = score(grid if empty else grid_of(np.full(SHAPE, 0.5)), truth_of(cells))
    assert dataclasses.astuple(scores)[:5] == (0.0, 0.0, 0.0, 0.0, 0.5)
    assert scores.nll == pytest.approx(math.log(2))
    assert scores.brier == pytest.approx(0.25)
    assert scores.ece == pytest.approx(abs(5 / 25 - 0.5))


def test_a_truth_without_cells_to_count_scores_nan():
    scores = score(grid_of(np.full(SHAPE, 0.9)), truth_of(np.full(SHAPE, 2)))
    assert all(math.isnan(value) for value in dataclasses.astuple(scores)[:8])
    assert (scores.surface_cells, scores.free_cells) == (0, 0)


def test_outside_the_map_everything_is_unknown():
    cells = np.zeros((5, 9))
    cells[0, 8] = 1
    scores = score(grid_of(np.full(SHAPE, 0.1)), truth_of(cells))
    assert (scores.found, scores.wiped) == (0.0, 0.0)
    assert scores.free == pytest.approx(25 / 44)


def test_a_neighbourhood_reaches_past_the_border_of_the_truth():
    p = np.full((7, 7), 0.1)
    p[0, 0] = 0.9
    inner = truth_of([[1]], origin=(1.0, 1.0))
    assert score(grid_of(p), inner).found == 1.0
    assert score(grid_of(p), truth_of([[1]], origin=(2.0, 2.0))).wiped == 1.0


def test_a_neighbourhood_is_of_truth_cells_and_not_of_map_cells():
    p = np.full((8, 8), 0.1)
    p[4, 7] = 0.9  # three map cells, but one and a half truth cells, from the surface
    cells = np.full((4, 4), 2)
    cells[2, 2] = 1
    assert score(grid_of(p, 0.5, (0.0, 0.25)), truth_of(cells)).found == 1.0


MAPS = arrays(np.float64, (8, 9), elements=st.sampled_from([0.05, 0.3, 0.34, 0.36, 0.5, 0.64, 0.66, 0.9]))
CELLS = arrays(np.int8, (6, 7), elements=st.sampled_from([0, 0, 0, 1, 2]))


@given(MAPS, CELLS)
@settings(max_examples=100, deadline=None)
def test_the_scores_are_those_of_plain_loops(p, cells):
    grid = grid_of(p, origin=(-1.0, -1.0))
    assert same(score(grid, truth_of(cells)), plain_scores(grid.probability().astype(float), cells))


@given(
    arrays(np.float64, (4, 5), elements=st.floats(0.06, 0.94)),
    arrays(np.int8, (4, 5), elements=st.integers(0, 2)),
)
@settings(max_examples=100, deadline=None)
def test_auc_is_the_share_of_pairs_in_the_right_order(p, cells):
    grid = grid_of(np.round(p, 1))  # rounded, so that there are ties
    shown = grid.probability()
    wins = [(a > b) + 0.5 * (a == b) for a in shown[cells == 1] for b in shown[cells == 0]]
    assert score(grid, truth_of(cells)).auc == pytest.approx(mean(wins), nan_ok=True)


@given(MAPS, CELLS, st.integers(-4000, 4000), st.integers(-4000, 4000))
@settings(max_examples=50, deadline=None)
def test_a_shift_of_map_and_truth_together_changes_nothing(p, cells, i, j):
    # Multiples of a power of two, so that the shift itself is exact.
    here = score(grid_of(p, 0.5), truth_of(cells, 0.25, (0.125, 0.125)))
    shift = i * 0.125, j * 0.125
    there = score(grid_of(p, 0.5, shift), truth_of(cells, 0.25, (shift[0] + 0.125, shift[1] + 0.125)))
    assert same(here, there, tolerance=0.0)


@given(MAPS, CELLS)
@settings(max_examples=50, deadline=None)
def test_turning_map_and_truth_together_changes_nothing(p, cells):
    here = score(grid_of(p), truth_of(cells))
    assert same(here, score(grid_of(p.T), truth_of(cells.T)))


@given(
    st.sampled_from([0.06, 0.1, 0.12]),
    st.sampled_from([0.05, 0.1, 0.13]),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
)
@settings(max_examples=50, deadline=None)
def test_p_is_what_the_map_says_at_the_centres(resolution, truth_resolution, origin):
    rng = np.random.default_rng(0)
    grid = grid_of(rng.uniform(0.03, 0.97, (30, 40)), resolution, (-1.0, -1.0))
    truth = truth_of(rng.integers(0, 2, (12, 15)), truth_resolution, origin)
    centres = np.array([[(col + 0.5, row + 0.5) for col in range(15)] for row in range(12)])
    p = grid.probability_at(centres * truth_resolution + origin).astype(float)
    assert score(grid, truth).brier == pytest.approx(np.mean((p - truth.cells) ** 2))


RADIUS = 0.25


def two_rooms(door=True):
    """Two rooms of 2.8 x 3 m in cells of 0.1 m, a partition in column 30, and a door of 1 m in it."""
    cells = np.zeros((32, 60))
    cells[[0, -1]] = cells[:, [0, -1]] = cells[:, 30] = 1
    if door:
        cells[11:21, 30] = 0
    return truth_of(cells, 0.1)


def perfect_map(truth, resolution=0.1):
    """What is in the truth, in cells of some size."""
    rows, cols = np.round(np.array(truth.cells.shape) * truth.resolution / resolution).astype(int)
    p = np.full((rows, cols), 0.02)
    row, col = np.argwhere(truth.cells == 1).T
    at = [np.floor((v + 0.5) * truth.resolution / resolution).astype(int) for v in (row, col)]
    p[at[0].clip(0, rows - 1), at[1].clip(0, cols - 1)] = 0.98
    return p


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.12, 0.2])
def test_paths_on_a_perfect_map_meet_nothing(resolution):
    truth = two_rooms()
    paths = path_score(grid_of(perfect_map(truth, resolution), resolution), truth, RADIUS)
    assert paths == PathScore(0.0, 0.0, 0.0, pairs=PATH_STARTS * PATH_GOALS)


@pytest.mark.parametrize(("shift", "collides"), [((0.1, 0.0), False), ((0.1, -0.1), False), ((0.0, 0.2), True)])
def test_a_wall_one_cell_off_is_inexact_and_two_cells_off_is_a_collision(shift, collides):
    truth = two_rooms()
    paths = path_score(grid_of(perfect_map(truth), 0.1, shift), truth, RADIUS)
    assert (paths.collides > 0) == collides
    assert (paths.blocked > 0) == collides


def test_one_cell_is_one_of_the_map_where_those_are_larger():
    truth = two_rooms()
    assert path_score(grid_of(perfect_map(truth, 0.2), 0.2, (0.0, 0.2)), truth, RADIUS).collides == 0.0


def test_paths_through_a_wiped_partition_collide():
    truth = two_rooms()
    p = perfect_map(truth)
    p[1:-1, 30] = 0.02
    paths = path_score(grid_of(p, 0.1), truth, RADIUS)
    assert 0 < paths.collides < 1  # ways inside a room, and some through the middle, are free
    assert (paths.blocked, paths.lost) == (0.0, 0.0)


def test_without_a_door_all_ways_stay_in_their_room():
    truth = two_rooms(door=False)
    p = perfect_map(truth)
    assert path_score(grid_of(p, 0.1), truth, RADIUS) == PathScore(0.0, 0.0, 0.0, pairs=64)
    p[1:-1, 30] = 0.02
    assert path_score(grid_of(p, 0.1), truth, RADIUS).collides == 0.0


def test_no_way_of_the_truth_leads_through_hidden_cells():
    truth = two_rooms(door=False)
    p = perfect_map(truth)
    truth.cells[1:-1, 30] = 2
    assert path_score(grid_of(p, 0.1), truth, RADIUS) == PathScore(0.0, 0.0, 0.0, pairs=64)


def test_the_way_of_a_point_does_not_lead_through_walls_either():
    truth = two_rooms(door=False)
    assert path_score(grid_of(perfect_map(truth), 0.1), truth, 0.0) == PathScore(0.0, 0.0, 0.0, pairs=64)


def corridor():
    cells = np.zeros((12, 80))
    cells[[0, -1]] = 1
    return truth_of(cells, 0.1)


def test_a_ghost_wall_across_a_corridor_loses_the_ways_that_it_blocks():
    truth = corridor()
    p = perfect_map(truth)
    p[:, 40] = 0.9
    paths = path_score(grid_of(p, 0.1), truth, RADIUS)
    assert 0 < paths.blocked < 1
    assert paths.lost == paths.blocked
    assert paths.collides == 0.0
    p[:, 2:-2:6] = 0.9  # every way of a metre crosses one
    ways = path_score(grid_of(p, 0.1), truth, RADIUS)
    assert (ways.blocked, ways.lost) == (1.0, 1.0)
    assert math.isnan(ways.collides)


def test_a_ghost_in_a_room_is_gone_round_but_for_the_ways_that_end_at_it():
    truth = two_rooms()
    p = perfect_map(truth)
    p[14:18, 20] = 0.9
    paths = path_score(grid_of(p, 0.1), truth, RADIUS)
    assert 0 < paths.lost < paths.blocked < 1
    assert paths.collides == 0.0


@pytest.mark.parametrize("empty", [False, True])
def test_a_map_that_knows_nothing_shows_no_way(empty):
    truth = two_rooms()
    grid = Grid(np.zeros((0, 0), np.float32), np.zeros((0, 0), bool), 0.1, (0.0, 0.0))
    paths = path_score(grid if empty else grid_of(np.full((32, 60), 0.5), 0.1), truth, RADIUS)
    assert math.isnan(paths.collides)
    assert (paths.blocked, paths.lost) == (0.0, 1.0)


def test_a_map_of_free_space_alone_drives_through_everything_but_the_border():
    truth = two_rooms()
    paths = path_score(grid_of(np.full((32, 60), 0.02), 0.1), truth, RADIUS)
    assert paths.collides > 0.3
    assert (paths.blocked, paths.lost) == (0.0, 0.0)


def test_what_a_path_meets_in_hidden_cells_is_no_collision():
    truth = two_rooms()
    truth.cells[:, 30] = np.where(truth.cells[:, 30] == 1, 2, 0)
    paths = path_score(grid_of(np.full((32, 60), 0.02), 0.1), truth, RADIUS)
    assert paths.collides == 0.0


def test_a_wall_of_fine_cells_is_not_stepped_over():
    truth = corridor()
    p = perfect_map(truth, 0.025)
    p[:, 161] = 0.9  # between the centres of two columns of the truth
    paths = path_score(grid_of(p, 0.025), truth, RADIUS)
    assert 0 < paths.lost == paths.blocked


def test_no_way_leads_between_two_cells_that_touch_at_a_corner():
    cells = np.zeros((30, 30))
    cells[np.arange(30), np.arange(30)] = 1
    truth = truth_of(cells, 0.1)
    # On the map one side is closed: were there a way through, some would lead from there to the other side.
    one_side = grid_of(np.where(np.tri(30) > 0, 0.98, 0.02), 0.1)
    paths = path_score(one_side, truth, 0.0)
    assert 0 < paths.lost < 1
    assert paths == PathScore(0.0, paths.lost, paths.lost, pairs=64)


@pytest.mark.parametrize(
    ("solid", "met"),
    [
        ([], False),
        ([(0, 0)], True),
        ([(2, 2)], True),
        ([(3, 3)], True),
        ([(1, 2)], False),
        ([(1, 2), (2, 1)], True),
        ([(1, 2), (3, 2)], False),
    ],
)
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_path_meets_what_it_goes_through_and_two_cells_that_touch_at_a_corner(solid, met, mirrored):
    cells = np.zeros((4, 4), dtype=bool)
    for cell in solid:
        cells[cell] = True
    corners = (3, 12) if mirrored else (0, 15)
    ways = _Ways(np.ones((4, 4), dtype=bool), np.array(corners[:1]))
    assert ways.length[0, corners[1]] == pytest.approx(3 * math.sqrt(2))
    cells = cells[:, ::-1] if mirrored else cells
    assert ways.meet(np.array([0]), np.array(corners[1:]), cells).tolist() == [met]


@pytest.mark.parametrize("closed", [(1, 2), (2, 1)])
def test_no_way_cuts_a_closed_corner(closed):
    open_ = np.ones((4, 4), dtype=bool)
    open_[closed] = False
    for cells, start, goal in ((open_, 5, 10), (open_[:, ::-1], 6, 9)):
        assert _Ways(cells, np.array([start])).length[0, goal] == pytest.approx(2.0)


def test_the_seed_decides_the_ways_and_the_map_does_not():
    truth = two_rooms()
    p = perfect_map(truth)
    p[5:, 20] = 0.9
    first = path_score(grid_of(p, 0.1), truth, RADIUS, seed=1)
    assert path_score(grid_of(p, 0.1), truth, RADIUS, seed=1) == first
    assert len({path_score(grid_of(p, 0.1), truth, RADIUS, seed=seed).blocked for seed in range(6)}) > 1
    # Claims outside the ways change nothing.
    p[0] = 0.5
    assert path_score(grid_of(p, 0.1), truth, RADIUS, seed=1).blocked == first.blocked


@pytest.mark.parametrize("cells", [[[1]], np.zeros((3, 3)), np.full(SHAPE, 2), np.ones(SHAPE), np.zeros((9, 9))])
def test_a_truth_too_small_for_a_way_scores_nan(cells):
    truth = truth_of(cells, 0.1)
    paths = path_score(grid_of(perfect_map(truth), 0.1), truth, RADIUS)
    assert all(math.isnan(share) for share in (paths.collides, paths.blocked, paths.lost))
    assert paths.pairs == 0


@pytest.mark.parametrize(
    ("x", "y", "share"),
    [(1.0, 2.0, 1.0), (2.5, 2.0, 0.5), (2.9, 2.9, 0.01), (3.0, 2.0, 0), (1.0, 3.0, 0), (-50.0, 2.0, 0)],
)
def test_a_truth_of_another_place_is_refused_and_one_that_shares_a_cell_is_not(x, y, share):
    grid = Grid(np.zeros((10, 20), np.float32), np.ones((10, 20), bool), 0.1, (1.0, 2.0))
    truth = Truth(np.zeros((10, 10), np.int8), 0.1, (x, y))
    if share:
        assert check_overlap(grid, truth, "map", "truth") == pytest.approx(share)
    else:
        found = (
            r"^truth: found a truth of another place, x .* m, expected one of the place of the map, x 1.00 .. 3.00,"
        )
        with pytest.raises(InputError, match=found):
            check_overlap(grid, truth, "map", "truth")


def test_cells_that_were_not_observed_or_are_hidden_are_nothing_in_common():
    observed = np.zeros((10, 10), bool)
    observed[:, ::9] = True  # a frame whose inside nobody spoke of
    grid = Grid(np.zeros((10, 10), np.float32), observed, 0.1, (0.0, 0.0))
    cells = np.full((10, 10), HIDDEN, np.int8)
    cells[5, 5] = 1
    with pytest.raises(InputError, match=r"^truth: found a truth of another place"):
        check_overlap(grid, Truth(cells, 0.1, (0.0, 0.0)), "map", "truth")
    cells[5, 0] = 0
    assert check_overlap(grid, Truth(cells, 0.1, (0.0, 0.0)), "map", "truth") == 0.5


def test_a_map_or_a_truth_that_says_nothing_is_refused():
    grid = Grid(np.zeros((10, 10), np.float32), np.zeros((10, 10), bool), 0.1, (0.0, 0.0))
    truth = Truth(np.full((10, 10), HIDDEN, np.int8), 0.1, (0.0, 0.0))
    with pytest.raises(InputError, match=r"^map: found a map in which nothing was observed"):
        check_overlap(grid, truth, "map", "truth")
    grid.observed[:] = True
    with pytest.raises(InputError, match=r"^truth: found hidden cells only"):
        check_overlap(grid, truth, "map", "truth")


def drives():
    """A drive of 3 to 40 poses on no line, and one that is near it until it is moved as a whole."""
    return st.builds(_drive, st.integers(0, 2**32 - 1), st.integers(3, 40), st.floats(0.0, 0.3))


def _drive(seed, count, off):
    rng = np.random.default_rng(seed)
    truth = np.column_stack([rng.uniform(-10, 10, (count, 2)), rng.uniform(-np.pi, np.pi, count)])
    near = truth + off * rng.standard_normal(truth.shape)
    return truth, compose(rng.uniform(-3, 3, 3), near)


def _paths(*drives_):
    for poses in drives_:
        half = poses[:, 2] / 2
        turns = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
        yield PosePath3D(np.column_stack([poses[:, :2], 0 * half]), turns)


def _evo(truth, path, relation):
    ape = evo_metrics.APE(relation)
    ape.process_data((truth, path))
    return ape.get_statistic(evo_metrics.StatisticsType.rmse), ape.get_statistic(evo_metrics.StatisticsType.max)


@given(drives())
def test_errors_of_a_trajectory_are_those_of_evo(drive):
    truth, poses = drive
    error = trajectory_error(poses, truth)
    place, turn = evo_metrics.PoseRelation.translation_part, evo_metrics.PoseRelation.rotation_angle_deg
    reference, whole, first = _paths(truth, poses, poses)
    rotation, *_ = whole.align(reference)
    assume(rotation[2, 2] > 0)  # evo may turn the plane upside down
    first.align_origin(reference)
    np.testing.assert_allclose((error.aligned_rms_m, error.aligned_worst_m), _evo(reference, whole, place), atol=1e-7)
    np.testing.assert_allclose((error.first_rms_m, error.first_worst_m), _evo(reference, first, place), atol=1e-7)
    np.testing.assert_allclose(error.heading_rms_deg, _evo(reference, whole, turn)[0], atol=1e-4)


@given(drives(), st.integers(0, 2**32 - 1))
def test_no_other_rigid_motion_lays_a_trajectory_nearer(drive, seed):
    truth, poses = drive
    best = trajectory_error(poses, truth).aligned_rms_m
    for motion in np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 3)):
        other = compose(motion, poses)
        assert best <= np.sqrt(np.mean(np.sum((other - truth)[:, :2] ** 2, axis=1))) + 1e-9


@given(drives(), st.integers(0, 2**32 - 1))
def test_errors_of_a_trajectory_do_not_depend_on_its_frame(drive, seed):
    truth, poses = drive
    motion = np.random.default_rng(seed).uniform(-20, 20, 3)
    one, other = trajectory_error(poses, truth), trajectory_error(compose(motion, poses), truth)
    np.testing.assert_allclose(dataclasses.astuple(other), dataclasses.astuple(one), atol=1e-5)


def test_errors_of_a_trajectory_by_hand():
    truth = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, np.pi]])
    poses = truth + np.array([[0.0, 0.0, 0.0], [0.0, 0.3, np.deg2rad(6.0)], [0.0, 0.0, -2 * np.pi]])
    error = trajectory_error(poses, truth)
    # Laid onto the truth the three are 0.1, 0.2 and 0.1 m off; the headings are 0, 6 and 0 degrees.
    assert error.aligned_rms_m == pytest.approx(np.sqrt(0.06 / 3))
    assert error.aligned_worst_m == pytest.approx(0.2)
    assert error.first_rms_m == pytest.approx(np.sqrt(0.09 / 3))
    assert error.first_worst_m == pytest.approx(0.3)
    assert error.heading_rms_deg == pytest.approx(6 / np.sqrt(3))
    assert dataclasses.astuple(trajectory_error(truth[:1], truth[:1])) == (0, 0, 0, 0, 0)


@pytest.mark.parametrize("poses", [np.zeros((3, 3)), np.zeros((0, 3)), np.full((2, 3), np.nan)])
def test_trajectories_that_cannot_be_compared_are_refused(poses):
    with pytest.raises(InputError, match=r"trajectory: found .*poses of shape"):
        trajectory_error(poses, np.zeros((2, 3)))
