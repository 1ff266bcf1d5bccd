import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.frame import Frame
from echogrid.grid import Grid
from echogrid.mapping.build import build_map
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth, score
from echogrid.models.networks import surroundings
from echogrid.models.networks.set_layers import LOOKS, initial
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import Robot
from echogrid.simulation.drive import truth_of
from echogrid.simulation.world import World
from echogrid.training import drives
from echogrid.training import map_lessons as making
from echogrid.training.map_lessons import (
    BEHIND,
    BEHIND_M,
    DEEP,
    GAP,
    GAP_CELLS,
    NOTHING,
    SIDE,
    gaps,
    labels,
    map_lessons,
    widened,
)

P3DX = Robot.load("p3dx")
CELL_M = SetNetwork.cell_m
DRIVES = 3


@pytest.fixture(scope="module")
def network():
    rng = np.random.default_rng(0)
    weights = initial(rng, 6)
    return SetNetwork(weights | {name: 20 * weights[name] for name in ("wp", "wr", "wz")}, None, {})


@pytest.fixture(scope="module")
def made(network):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drives, "_CHUNK", DRIVES)
        return map_lessons(network, P3DX, DRIVES, seed=3)


def test_lessons_have_the_shapes_that_they_promise(made):
    assert made.told.shape == (DRIVES, SIDE, SIDE, surroundings.FEATURES)
    assert made.told.dtype == np.float16
    assert made.array.shape == (DRIVES, surroundings.TOLD)
    assert made.label.shape == (DRIVES, SIDE, SIDE)
    assert np.isfinite(made.told).all()
    np.testing.assert_allclose(made.array, np.tile(made.array[0], (DRIVES, 1)))
    np.testing.assert_allclose(
        made.array[0], surroundings.told_of(P3DX.beam_width_rad, P3DX.max_range_m, P3DX.mounts)
    )


def test_what_nobody_spoke_of_and_what_was_stood_on_is_not_judged(made):
    looks, stood = np.expm1(made.told[..., 5].astype(float) * np.log1p(LOOKS)), made.told[..., 6] > 0
    judged = made.label != NOTHING
    assert set(np.unique(made.label)) <= {SURFACE, FREE, GAP, BEHIND, DEEP, NOTHING}
    assert np.all(looks[judged] > 0)
    assert not np.any(judged & stood)
    for label in made.label:
        assert np.mean(label == FREE) > 0.02
        assert np.any(label == SURFACE)


def test_the_map_of_a_lesson_is_that_of_the_mapper(network):
    """Though it is made of a robot that is filled up with sonars that are not there."""
    rng = np.random.default_rng(0)
    poses = np.column_stack([0.1 * np.arange(40), np.zeros(40), 0.02 * np.arange(40)])
    ranges = P3DX.clean(rng.uniform(0.3, 6, (40, P3DX.sonars)))
    grown, fusion = making._mapped(network, P3DX, poses, ranges)
    fusion.read_out(grown, *grown.reserved())
    frames = [Frame(0.1 * i, *each) for i, each in enumerate(zip(poses, ranges, strict=True))]
    *_, grid = build_map(frames, P3DX, network)
    here = grown.grid()
    assert here.origin == grid.origin
    np.testing.assert_allclose(here.log_odds, grid.log_odds, atol=1e-3)
    np.testing.assert_array_equal(here.views, grid.views)


def truth_from(seed, resolution, rows=40, cols=50):
    rng = np.random.default_rng(seed)
    cells = np.full((rows, cols), HIDDEN, dtype=np.int8)
    cells[5:30, 8:30] = 0
    cells[5, 8:30] = cells[30, 8:30] = SURFACE
    cells[rng.random(cells.shape) < 0.01] = SURFACE if seed % 7 else 0
    if not seed % 7:
        cells[cells == SURFACE] = 0
    x, y = (float(resolution * n) for n in rng.integers(-60, 20, 2))
    return Truth(cells, resolution, (x, y))


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 999), st.sampled_from([0.04, 0.05, 0.12]), st.integers(-80, 0), st.integers(-80, 0))
def test_a_label_is_what_lies_at_the_middle_of_the_cell(seed, resolution, row, col):
    truth = truth_from(seed, resolution)
    found = labels(truth, np.array([row, col]), CELL_M)
    at = np.argwhere(truth.cells == SURFACE)
    rng = np.random.default_rng(seed)
    for i, k in rng.integers(0, SIDE, (300, 2)):
        middle = (np.array([row + i, col + k]) + 0.5) * CELL_M
        inside = (middle - truth.origin[::-1]) / resolution
        if np.min(np.abs(inside - np.rint(inside))) < 1e-6:
            continue  # rounding decides
        cell = np.floor(inside).astype(int)
        if np.any(cell < 0) or np.any(cell >= truth.cells.shape):
            assert found[i, k] == NOTHING
            continue
        kind = truth.cells[tuple(cell)]
        if kind != HIDDEN:
            assert found[i, k] == {SURFACE: SURFACE, 0: FREE}[kind]
        else:
            near = len(at) and np.min(np.hypot(*(at - cell).T)) * resolution < BEHIND_M
            assert found[i, k] == (BEHIND if near else DEEP)


@settings(max_examples=8, deadline=None)
@given(st.floats(0.5, 1.5), st.floats(-0.5, 0.5))
def test_a_cell_is_surface_within_half_a_cell_of_the_scores_of_a_face(x, y):
    """Wherever the face lies in the cells of the scores' truth."""
    world = World("wall", np.array([[x, y - 9, x, y + 9]]), np.array([1e-3]), np.zeros((0, 3)))
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    truth = widened(truth_of(world, poses, 0.1 / 3, 2.5))
    corner = np.array([-SIDE // 2, -SIDE // 2])
    label = labels(truth, corner, CELL_M)[SIDE // 2 - 10 : SIDE // 2 + 10]
    off = (corner[1] + np.arange(SIDE) + 0.5) * CELL_M - (x + 0.01)
    slack = 0.1 / 6 + 1e-6
    assert np.all((label == SURFACE)[:, np.abs(off) < 0.05 - slack])
    assert not np.any((label == SURFACE)[:, np.abs(off) > 0.05 + slack])
    assert np.all(label[:, (off < -0.05 - slack) & (off > -x)] == FREE)
    assert np.all(label[:, (off > 0.05 + slack) & (off < 0.3)] == BEHIND)


def wall_with_a_door(width, turn, thick=3):
    """Two rooms that a wall parts, through the middle of a square and turned, and a door in it (cells)."""
    middle = (np.arange(SIDE) - (SIDE - 1) / 2)[:, None], (np.arange(SIDE) - (SIDE - 1) / 2)[None]
    along = np.cos(turn) * middle[1] + np.sin(turn) * middle[0]
    across = np.cos(turn) * middle[0] - np.sin(turn) * middle[1]
    label = np.full((SIDE, SIDE), FREE, dtype=np.int8)
    label[(np.abs(across) < thick / 2 + 0.5) & (np.abs(along) > width / 2)] = SURFACE
    return label, along, across


@settings(max_examples=30, deadline=None)
@given(st.integers(8, 2 * GAP_CELLS - 4), st.floats(-1.5, 1.5))
def test_a_door_is_a_gap_and_open_floor_is_none(width, turn):
    label, along, across = wall_with_a_door(width, turn)
    found = gaps(label)
    inside = min(width / 2 - 2, GAP_CELLS - width / 2 - 1)
    assert np.all(found[(np.abs(across) < 1) & (np.abs(along) < inside)])
    assert not np.any(found[np.abs(across) > GAP_CELLS / 2 + 3])
    assert not np.any(found[np.abs(along) > width / 2 + 2])


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 4])
def test_a_wide_opening_a_wall_and_a_corner_are_no_gaps(turn):
    assert not gaps(wall_with_a_door(2 * GAP_CELLS + 12, turn)[0]).any()
    assert not gaps(wall_with_a_door(0, turn)[0]).any()
    label, along, across = wall_with_a_door(0, turn)
    label[np.abs(along) < 2] = SURFACE
    assert not gaps(label)[np.hypot(along, across) > 1.5 * GAP_CELLS].any()


def test_a_map_that_is_as_its_labels_say_has_the_best_scores():
    truth = truth_from(1, CELL_M)
    corner = np.floor(np.array(truth.origin[::-1]) / CELL_M + 0.5).astype(int) - 20
    label = labels(truth, corner, CELL_M)
    log_odds = np.select([label == SURFACE, label == FREE], [9.0, -9.0]).astype(np.float32)
    x, y = (float(v) for v in corner[::-1] * CELL_M)
    scores = score(Grid(log_odds, log_odds != 0, CELL_M, (x, y)), truth)
    assert (scores.found, scores.wiped, scores.free, scores.false, scores.auc) == (1, 0, 1, 0, 1)
    moved = score(Grid(log_odds, log_odds != 0, CELL_M, (x + 3 * CELL_M, y)), truth)
    assert moved.auc < 0.99
