import copy
import pickle
import tracemalloc
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echogrid.errors import UsageError
from echogrid.grid import P_MAX, P_MIN, Grid, GrowingGrid, UnreadGrid, covered, logit, sigmoid, span

resolutions = st.sampled_from([0.05, 0.1, 0.12, 0.25, 1.0])
origins = st.tuples(st.floats(-50, 50), st.floats(-50, 50))


def grid_of(log_odds, observed=True, resolution=1.0, origin=(0.0, 0.0)):
    log_odds = np.asarray(log_odds, dtype=np.float32)
    return Grid(log_odds, np.full(log_odds.shape, observed), resolution, origin)


@given(arrays(float, 5, elements=st.floats(1e-6, 1 - 1e-6)))
def test_the_probability_of_its_log_odds_is_the_probability(p):
    np.testing.assert_allclose(sigmoid(logit(p)), p, rtol=1e-9)


@given(arrays(float, 5, elements=st.floats(-15, 15)))
def test_the_log_odds_of_their_probability_are_the_log_odds(log_odds):
    np.testing.assert_allclose(logit(sigmoid(log_odds)), log_odds, atol=1e-6)
    np.testing.assert_allclose(sigmoid(-log_odds), 1 - sigmoid(log_odds), atol=1e-12)


def test_log_odds_of_known_probabilities():
    assert logit(0.5) == 0
    assert logit(0.9) == pytest.approx(np.log(9))
    assert sigmoid(0.0) == 0.5
    np.testing.assert_array_equal(sigmoid(np.array([-1e4, 1e4])), [0, 1])


def test_probabilities_are_read_out_within_their_limits():
    p = grid_of([[-50, -1, 0, 1, 50]]).probability()
    np.testing.assert_allclose(p, [[P_MIN, sigmoid(-1.0), 0.5, sigmoid(1.0), P_MAX]], rtol=1e-6)


@given(arrays(int, (4, 2), elements=st.integers(-500, 500)), resolutions, origins)
def test_the_cell_of_the_centre_of_a_cell_is_the_cell(index, resolution, origin):
    grid = grid_of(np.zeros((3, 4)), resolution=resolution, origin=origin)
    np.testing.assert_array_equal(grid.index_of(grid.centre_of(index)), index)


@given(arrays(float, (4, 2), elements=st.floats(-50, 50)), resolutions, origins)
def test_the_centre_of_the_cell_of_a_point_is_within_half_a_cell_of_it(points, resolution, origin):
    grid = grid_of(np.zeros((3, 4)), resolution=resolution, origin=origin)
    off = np.abs(grid.centre_of(grid.index_of(points)) - points)
    assert off.max() <= resolution / 2 * (1 + 1e-6)


def test_rows_go_up_in_y_and_columns_in_x():
    grid = grid_of(np.zeros((3, 4)), resolution=0.5, origin=(-1.0, 2.0))
    points = np.array([[-1.0, 2.0], [-0.9, 2.6], [0.9, 3.4], [-1.1, 2.0]])
    np.testing.assert_array_equal(grid.index_of(points), [[0, 0], [1, 0], [2, 3], [0, -1]])
    np.testing.assert_allclose(grid.centre_of(np.array([[0, 0], [2, 3]])), [[-0.75, 2.25], [0.75, 3.25]])


@given(st.integers(-2000, 2000), st.integers(-2000, 2000), resolutions, st.integers(-300, 300))
def test_a_point_on_a_border_belongs_to_the_upper_cell(row, col, resolution, first):
    grid = grid_of(np.zeros((1, 1)), resolution=resolution, origin=(first * resolution, first * resolution))
    corner = np.array([(first + col) * resolution, (first + row) * resolution])
    np.testing.assert_array_equal(grid.index_of(corner), [row, col])


@given(arrays(float, (5, 2), elements=st.floats(-3, 6)))
def test_the_probability_at_a_point_is_that_of_its_cell_and_one_half_outside(points):
    rng = np.random.default_rng(0)
    grid = grid_of(rng.normal(0, 2, (3, 4)), resolution=0.5, origin=(0.5, 1.0))
    for (x, y), p in zip(points, grid.probability_at(points), strict=True):
        col, row = int((x - 0.5) // 0.5), int((y - 1.0) // 0.5)
        if min(abs((x - 0.5) / 0.5 - round((x - 0.5) / 0.5)), abs((y - 1) / 0.5 - round((y - 1) / 0.5))) < 1e-6:
            continue
        held = 0 <= col < 4 and 0 <= row < 3
        assert p == (grid.probability()[row, col] if held else 0.5)


def test_a_map_without_cells_knows_nothing_anywhere():
    grid = GrowingGrid(0.1).grid()
    assert grid.shape == (0, 0)
    assert grid.origin == (0, 0)
    np.testing.assert_array_equal(grid.probability_at(np.array([[0.0, 0.0], [3.0, 4.0]])), 0.5)


@given(arrays(bool, st.tuples(st.integers(1, 6), st.integers(1, 7))), resolutions, origins, st.booleans())
def test_the_observed_part_is_the_smallest_that_holds_all_that_was_observed(observed, resolution, origin, counted):
    log_odds = np.arange(observed.size, dtype=np.float32).reshape(observed.shape)
    grid = Grid(log_odds, observed, resolution, origin, log_odds.astype(np.int32) if counted else None)
    part, cells = grid.observed_part(), np.argwhere(observed)
    assert (part is None) == (not len(cells))
    if part is None:
        return
    assert part.shape == tuple(np.ptp(cells, axis=0) + 1)
    np.testing.assert_array_equal(np.argwhere(part.observed), cells - cells.min(axis=0))
    np.testing.assert_array_equal(part.log_odds[part.observed], log_odds[observed])
    there = part.centre_of(np.argwhere(part.observed))
    np.testing.assert_allclose(there, grid.centre_of(cells), atol=1e-9)
    assert (part.views is None) == (grid.views is None)
    for mine, whole in ((part.log_odds, log_odds), (part.observed, observed), (part.views, grid.views)):
        assert whole is None or np.shares_memory(mine, whole)


def test_a_span_goes_from_the_first_that_is_marked_to_the_last():
    assert span(np.array([False, True, False, True, False])) == slice(1, 4)
    assert span(np.zeros(3, dtype=bool)) == slice(0, 0)


def view(rng, low=-20, high=20):
    shape = rng.integers(1, 9, 2)
    evidence = rng.integers(-8, 9, shape).astype(np.float32) / 4
    spoken = rng.random(shape) < 0.7
    return rng.integers(low, high, 2), np.where(spoken, evidence, np.float32(0)), spoken


def fused(views, resolution=0.5):
    grown = GrowingGrid(resolution)
    for corner, evidence, spoken in views:
        grown.reserve(corner, corner + evidence.shape)
        grown.fuse(corner, evidence, spoken)
    return grown.grid()


def plain_sum(views):
    """The evidence of each cell by its row and column, and the cells of which a view spoke."""
    total, spoken_of = {}, set()
    for corner, evidence, spoken in views:
        for i, j in np.ndindex(*evidence.shape):
            cell = (int(corner[0] + i), int(corner[1] + j))
            total[cell] = total.get(cell, 0.0) + float(evidence[i, j])
            if spoken[i, j]:
                spoken_of.add(cell)
    return total, spoken_of


@given(st.integers(0, 10_000), st.integers(1, 8))
def test_a_cell_holds_the_sum_of_the_evidence_of_all_views_at_its_place(seed, count):
    rng = np.random.default_rng(seed)
    views = [view(rng) for _ in range(count)]
    grid, (total, spoken_of) = fused(views), plain_sum(views)
    first = np.rint(np.array(grid.origin[::-1]) / grid.resolution).astype(int)
    np.testing.assert_array_equal(first, np.min([corner for corner, _, _ in views], axis=0))
    last = np.max([corner + evidence.shape for corner, evidence, _ in views], axis=0)
    np.testing.assert_array_equal(first + grid.shape, last)
    for i, j in np.ndindex(*grid.shape):
        cell = (int(first[0] + i), int(first[1] + j))
        assert grid.log_odds[i, j] == total.get(cell, 0)
        assert grid.observed[i, j] == (cell in spoken_of)


@given(st.integers(0, 10_000), st.permutations(range(6)))
def test_the_map_is_independent_of_the_order_of_the_views(seed, order):
    rng = np.random.default_rng(seed)
    views = [view(rng) for _ in range(6)]
    one, other = fused(views), fused([views[i] for i in order])
    assert one.origin == other.origin
    np.testing.assert_array_equal(one.log_odds, other.log_odds)
    np.testing.assert_array_equal(one.observed, other.observed)


def test_a_view_that_says_nothing_changes_nothing():
    rng = np.random.default_rng(0)
    views = [view(rng) for _ in range(4)]
    corner, evidence, _ = views[0]
    silent = (corner, np.zeros_like(evidence), np.zeros(evidence.shape, dtype=bool))
    one, other = fused(views), fused([*views, silent])
    np.testing.assert_array_equal(one.log_odds, other.log_odds)
    np.testing.assert_array_equal(one.observed, other.observed)


@given(st.lists(st.tuples(st.integers(-400, 400), st.integers(-400, 400)), min_size=1, max_size=6))
def test_growth_in_any_direction_keeps_what_was_there(corners):
    grown = GrowingGrid(1.0)
    one = np.ones((1, 1), dtype=np.float32)
    for n, corner in enumerate(corners, start=1):
        cell = np.array(corner)
        grown.reserve(cell, cell + 1)
        grown.fuse(cell, one, np.ones((1, 1), dtype=bool))
        grid = grown.grid()
        assert grid.log_odds.sum() == n
        for past in set(corners[:n]):
            index = tuple(np.array(past) - np.rint(grid.origin[::-1]).astype(int))
            assert grid.log_odds[index] == corners[:n].count(past)
            assert grid.observed[index]
        assert grid.observed.sum() == len(set(corners[:n]))


def test_memory_does_not_grow_with_the_number_of_views():
    rng = np.random.default_rng(0)
    grown = GrowingGrid(0.1)
    corners = [np.array(corner) for corner in rng.integers(-100, 100, (800, 2)).tolist()]
    patch, spoken = np.full((30, 30), 0.1, dtype=np.float32), np.ones((30, 30), dtype=bool)
    grown.reserve(np.array([-100, -100]), np.array([130, 130]))
    tracemalloc.start()
    used = []
    for n, corner in enumerate(corners):
        grown.reserve(corner, corner + 30)
        grown.fuse(corner, patch, spoken)
        if n % 200 == 199:
            used.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert max(used) - min(used) < 10_000


def test_a_map_that_would_be_too_large_is_refused_in_one_line():
    grown = GrowingGrid(0.1)
    grown.reserve(np.array([0, 0]), np.array([10, 10]))
    grown.fuse(np.array([0, 0]), np.ones((10, 10), dtype=np.float32), np.ones((10, 10), dtype=bool))
    with pytest.raises(
        UsageError, match=r"^map: found a drive that spans .* m at 0.1 m a cell, expected at most 4e\+08 cells"
    ):
        grown.reserve(np.array([0, 0]), np.array([10**6, 10**6]))


def test_refined_worked_by_hand():
    a = 2.0
    log_odds = [
        [a, a, a, a, 0],
        [0, -1, 0, 0, 0],
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, a],
        [a, a, 0, 0, 0],
    ]
    observed = np.ones((5, 5), dtype=bool)
    observed[1, 2] = False
    # Two cells below the bar have three neighbours in it: one is filled, of the other nobody spoke. The ends of the
    # bar and of the pair have one neighbour, the single cell none: they are cleared.
    np.testing.assert_array_equal(
        grid_of(log_odds, observed).refined().log_odds,
        [
            [0, a, a, 0, 0],
            [0, a, 0, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0],
        ],
    )


def test_refining_fills_a_hole_with_the_mean_of_its_occupied_neighbours_and_weakens_no_cell():
    log_odds = np.full((5, 5), 1.0)
    log_odds[2, 2], log_odds[2, 3], log_odds[1, 1] = -3.0, -1.0, 3.0
    refined = grid_of(log_odds).refined()
    assert refined.log_odds[2, 2] == pytest.approx((6 + 3) / 7)
    assert refined.log_odds[1, 1] == 3
    assert refined.probability()[0, 0] == pytest.approx(sigmoid(np.mean([1.0, 1.0, 3.0])))


@given(arrays(np.float32, (5, 6), elements=st.floats(-4, 4, width=32)), arrays(bool, (5, 6)))
def test_refining_leaves_the_frame_of_the_map_and_what_nobody_spoke_of(log_odds, observed):
    grid = Grid(log_odds, observed, 0.3, (1.0, -2.0))
    refined = grid.refined()
    assert (refined.resolution, refined.origin) == (grid.resolution, grid.origin)
    np.testing.assert_array_equal(refined.observed, observed)
    np.testing.assert_array_equal(refined.log_odds[~observed], log_odds[~observed])


@given(st.integers(0, 10_000), st.floats(0, 1.5), st.floats(0.05, 0.5))
def test_the_cells_that_a_disc_covers_are_those_whose_centre_it_holds(seed, radius, resolution):
    rng = np.random.default_rng(seed)
    poses, corner, shape = rng.uniform(-3, 3, (3, 3)), rng.integers(-12, 8, 2), (9, 14)
    near = covered(poses, radius, corner, shape, resolution)
    for row, col in np.ndindex(*shape):
        y, x = ((cell + first + 0.5) * resolution for cell, first in zip((row, col), corner, strict=True))
        distance = np.hypot(poses[:, 0] - x, poses[:, 1] - y)
        if np.all(np.abs(distance - radius) > 1e-9):
            assert near[row, col] == np.any(distance < radius)


@pytest.mark.parametrize("begin", [(), ((0, 0), (5, 4))])
def test_room_that_is_refused_leaves_the_map_as_it_was(begin):
    grown = GrowingGrid(0.5)
    if begin:
        grown.reserve(*map(np.array, begin))
        grown.fuse(np.array([1, 1]), np.ones((2, 2), np.float32), np.ones((2, 2), bool))
    before = grown.grid()
    far = np.array([10**7, -(10**7)]), np.array([10**7 + 5, -(10**7) + 4])
    for taking in (grown.reserve, grown.check_room) if begin else ():
        with pytest.raises(UsageError, match=r"^map: found a drive that spans 5e\+06 x 5e\+06 m at 0.5 m a cell"):
            taking(*far)
    huge = np.array([0, 0]), np.array([10**5, 10**5])
    for taking in (grown.reserve, grown.check_room):
        with pytest.raises(UsageError, match=r"^map: found a drive that spans 50\d\d\d x 50\d\d\d m"):
            taking(*huge)
    after = grown.grid()
    assert (after.shape, after.origin) == (before.shape, before.origin)
    np.testing.assert_array_equal(after.log_odds, before.log_odds)
    grown.reserve(np.array([-1, 0]), np.array([3, 3]))
    assert grown.grid().shape == ((6, 4) if begin else (4, 3))
    assert grown.grid().log_odds.sum() == (4 if begin else 0)


@pytest.mark.parametrize("seed", range(20))
def test_room_is_found_for_all_that_can_be_reserved_part_by_part(monkeypatch, seed):
    """At the very edge of what a map may hold: what was checked as a whole is never refused in parts."""
    side, rng = 1000, np.random.default_rng(seed)
    monkeypatch.setattr("echogrid.grid.MAX_CELLS", side**2)
    refused = 0
    for size in (side - 500, side - 300, side - 129, side - 128, side - 127, side - 60, side):
        for begun in (False, True):
            grown = GrowingGrid(1.0)
            low, high = np.zeros(2, np.int64), np.array([size, size])
            if begun:
                grown.reserve(high // 2, high // 2 + 5)
                grown.fuse(high // 2, np.ones((5, 5), np.float32), np.ones((5, 5), bool))
            try:
                grown.check_room(low, high)
            except UsageError:
                refused += 1
                continue
            for corner in (*rng.integers(0, size - 4, (8, 2)), low, high - 5):
                grown.reserve(corner, corner + 5)
                assert grown._layers["log_odds"].size <= side**2
            assert grown.grid().shape == (size, size)
            assert grown.grid().log_odds.sum() == 25 * begun
    assert refused == 6


@pytest.mark.parametrize("chosen", [True, False])
def test_what_a_cell_holds_bounds_how_many_there_are(monkeypatch, chosen):
    monkeypatch.setattr("echogrid.grid.MAX_BYTES", 45 * 1000**2)
    last = np.array([800, 800])
    GrowingGrid(0.1).check_room(0 * last, last)
    GrowingGrid(0.1, {"more": np.zeros(10, np.float32)}).check_room(0 * last, last)
    with pytest.raises(UsageError, match=r"at most 8e\+05 cells \(are the poses in mm or cm, ") as error:
        GrowingGrid(0.1, {"more": np.zeros(12, np.float32)}, chosen=chosen).check_room(0 * last, last)
    assert ("--resolution" in str(error.value)) == chosen


def test_a_map_is_copied_seldom_while_it_grows():
    grown, copies = GrowingGrid(0.1), set()
    for step in range(0, 20_000, 10):
        grown.reserve(np.array([0, step]), np.array([4, step + 10]))
        copies.add(id(grown._layers["log_odds"].base) ^ grown._layers["log_odds"].shape[1])
    assert len(copies) < 40


FINE_CM = 4
coarser = st.sampled_from([5, 6, 7, 8, 10, 12, 15, 25, 50])
finer = st.sampled_from([1, 2, 3, 4])
fine_maps = st.tuples(
    st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 40), st.integers(-90, 90), st.integers(-90, 90)
)


def fine_map(drawn, speckled=0.3):
    """Some of its cells are unobserved and hold 0, as those outside do."""
    seed, rows, cols, row, col = drawn
    rng = np.random.default_rng(seed)
    observed = rng.random((rows, cols)) > speckled
    log_odds = np.where(observed, rng.normal(-1, 2, (rows, cols)), 0).astype(np.float32)
    views = rng.integers(1, 9, (rows, cols)).astype(np.int32) * observed
    return Grid(log_odds, observed, FINE_CM / 100, (col * FINE_CM / 100, row * FINE_CM / 100), views)


def cells_told(grid, size_cm):
    """What a map says of each cell of the world [row, col]: log-odds, observed, views."""
    first = np.rint(np.array(grid.origin[::-1]) * 100 / size_cm).astype(int)
    index = first + np.argwhere(np.ones(grid.shape, dtype=bool))
    layers = (grid.log_odds.ravel().tolist(), grid.observed.ravel().tolist(), grid.views.ravel().tolist())
    return dict(zip(map(tuple, index.tolist()), zip(*layers, strict=True), strict=True))


@given(fine_maps, coarser)
def test_a_coarser_cell_is_as_occupied_as_the_most_occupied_of_its_parts(drawn, size_cm):
    grid = fine_map(drawn)
    told, parts = cells_told(grid, FINE_CM), {}
    # Whole numbers of centimetres: no rounding decides. Of every cell that might be met all parts are asked.
    low, high = (np.array(end) * FINE_CM // size_cm for end in (min(told), np.add(max(told), 1)))
    for row in range((low[0] - 1) * size_cm // FINE_CM - 1, (high[0] + 2) * size_cm // FINE_CM + 1):
        for col in range((low[1] - 1) * size_cm // FINE_CM - 1, (high[1] + 2) * size_cm // FINE_CM + 1):
            at = tuple((FINE_CM * i + FINE_CM // 2) // size_cm for i in (row, col))
            parts.setdefault(at, []).append(told.get((row, col), (0.0, False, 0)))
    coarse = grid.in_cells_of(size_cm / 100)
    assert coarse.resolution == size_cm / 100
    found = cells_told(coarse, size_cm)
    for at, (log_odds, observed, views) in found.items():
        assert (log_odds, observed, views) == tuple(max(part) for part in zip(*parts[at], strict=True))
    # No cell of which somebody spoke is left out.
    spoken = {at for at, each in parts.items() if any(part[1] for part in each)}
    assert spoken <= found.keys()


@given(fine_maps, coarser)
def test_a_wall_of_one_cell_is_never_lost_and_free_is_what_is_wholly_free(drawn, size_cm):
    grid = fine_map(drawn)
    coarse = grid.in_cells_of(size_cm / 100)
    points = grid.centre_of(np.argwhere(grid.log_odds > 0))
    assert np.all(coarse.probability_at(points + 1e-7) >= grid.probability_at(points) - 1e-6)
    free = coarse.centre_of(np.argwhere(coarse.log_odds < 0))
    offset = (np.arange(0, size_cm) + 0.5 - size_cm / 2) / 100
    for dx in offset:
        for dy in offset[:: max(1, size_cm // 5)]:
            at = free + np.array([dx, dy])
            # Of a cell on the edge the other side may hold the middle.
            middle = grid.centre_of(grid.index_of(at))
            inside = np.all(np.abs(middle - free) < size_cm / 200 - 1e-6, axis=1)
            assert np.all(grid.probability_at(at)[inside] < 0.5)


@given(fine_maps, finer)
def test_a_finer_cell_is_what_the_cell_is_in_which_its_middle_lies(drawn, size_cm):
    grid = fine_map(drawn)
    fine = grid.in_cells_of(size_cm / 100)
    told, found = cells_told(grid, FINE_CM), cells_told(fine, size_cm)
    for at, value in found.items():
        of = tuple((2 * k + 1) * size_cm // (2 * FINE_CM) for k in at)
        assert value == told.get(of, (0.0, False, 0))
    assert len(found) >= grid.observed.size * (FINE_CM / size_cm) ** 2 - 1e-6


@given(fine_maps)
def test_in_cells_of_the_same_size_a_map_is_the_same(drawn):
    grid = fine_map(drawn)
    same = grid.in_cells_of(grid.resolution)
    for name in ("log_odds", "observed", "views"):
        np.testing.assert_array_equal(getattr(same, name), getattr(grid, name))
    assert same.origin == pytest.approx(grid.origin)
    assert same.resolution == grid.resolution


@given(fine_maps, st.one_of(coarser, finer), st.integers(0, 9), st.integers(0, 9))
def test_how_much_room_a_map_has_round_it_does_not_matter_in_other_cells(drawn, size_cm, before, after):
    grid = fine_map(drawn)
    room = tuple(n + before + after for n in grid.shape)
    wide = grid.part(np.array([-before, -before]), room)
    tight, wide = (g.in_cells_of(size_cm / 100) for g in (grid, wide))
    points = wide.centre_of(np.argwhere(np.ones(wide.shape, dtype=bool)))
    np.testing.assert_array_equal(wide.probability_at(points), tight.probability_at(points))


def test_a_map_of_no_cells_has_none_of_any_size():
    for size in (0.03, 0.04, 0.1):
        assert GrowingGrid(0.04).grid().in_cells_of(size).shape == (0, 0)
        assert GrowingGrid(0.04).grid().in_cells_of(size).resolution == size


def unread(grid):
    """A map that is not read yet, and how often it was."""
    read = []
    return UnreadGrid(lambda: read.append(1) or grid), read


def test_a_map_that_nobody_looks_at_is_not_read_and_one_that_is_looked_at_is_read_once():
    grid = fine_map((1, 5, 7, -3, 4))
    lazy, read = unread(grid)
    assert isinstance(lazy, Grid)
    assert not read
    for _ in range(2):
        assert lazy.log_odds is grid.log_odds
        assert lazy.views is grid.views
        assert lazy.shape == (5, 7)
        assert repr(lazy) == repr(grid)
        np.testing.assert_array_equal(lazy.probability(), grid.probability())
        np.testing.assert_array_equal(lazy.part(np.zeros(2, int), (2, 2)).log_odds, grid.log_odds[:2, :2])
        np.testing.assert_array_equal(lazy.in_cells_of(0.1).log_odds, grid.in_cells_of(0.1).log_odds)
    assert read == [1]


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, lambda grid: pickle.loads(pickle.dumps(grid))])
@pytest.mark.parametrize("looked", [True, False])
def test_a_copy_of_a_map_that_is_not_read_yet_is_the_map_and_reads_nothing_later(way, looked):
    grid = fine_map((1, 5, 7, -3, 4))
    lazy, read = unread(grid)
    if looked:
        assert lazy.shape
    other = way(lazy)
    assert read == [1]
    assert type(other) is Grid
    for field in fields(Grid):
        np.testing.assert_array_equal(getattr(other, field.name), getattr(grid, field.name))
    assert (other.log_odds is grid.log_odds) == (way is copy.copy)


@given(st.integers(0, 2**32), st.integers(-40, 40), st.integers(-40, 40), st.integers(0, 30), st.integers(0, 30))
def test_copied_layers_of_any_rectangle_are_those_of_the_map_and_blank_outside(seed, row, col, rows, cols):
    rng = np.random.default_rng(seed)
    grown = GrowingGrid(0.1, {"count": np.int32(7)[...]})
    corner = np.array([row, col])
    if seed % 5:
        low = rng.integers(-20, 20, 2)
        high = low + rng.integers(1, 30, 2)
        grown.reserve(low, high)
        grown.layers()["log_odds"][:] = rng.normal(0, 1, tuple(high - low))
        grown.layers()["count"][:] = rng.integers(0, 99, tuple(high - low))
    copies = grown.copied(corner, (rows, cols), ("log_odds", "count"))
    expected = grown.part(corner, (rows, cols))
    np.testing.assert_array_equal(copies["log_odds"], expected.log_odds)
    first, size = grown.reserved(corner, (rows, cols))
    blank = np.ones((rows, cols), dtype=bool)
    blank[tuple(slice(a, a + n) for a, n in zip(first - corner, size, strict=True))] = False
    assert np.all(copies["count"][blank] == 7)
    assert np.all(copies["log_odds"][blank] == 0)
    if all(size):
        held = grown.window(first, size)["count"]
        np.testing.assert_array_equal(copies["count"][~blank], held.ravel())
    copies["log_odds"][:] = 99
    assert not np.any(grown.grid().log_odds == 99)
