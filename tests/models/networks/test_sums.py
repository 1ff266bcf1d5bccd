"""The map that the set network keeps: sums that level off, floor that was stood on, and what is read out of it when.

What scans tell is drawn at random here, so that nothing has to be compiled.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.grid import GrowingGrid
from echogrid.models.model import Evidence
from echogrid.models.networks import surroundings
from echogrid.models.networks.set_layers import FUSE_UNITS, LOOKS, initial
from echogrid.models.networks.set_network import STOOD, STOOD_GAP_M, STOOD_SHARE, SetNetwork, _Told
from echogrid.robot import Robot

B21 = Robot.load("b21")
CELL_M = SetNetwork.cell_m
FOOTPRINT_M = 0.2
ROBOT = replace(B21, footprint_radius_m=FOOTPRINT_M)
SPAN = 60


def network_of(around=True, bayes=False):
    rng = np.random.default_rng(3)
    weights = initial(rng, 4)
    weights["wz"] = np.zeros((FUSE_UNITS, 1), np.float32) if bayes else 20 * weights["wz"]
    stack = surroundings.initial(rng)
    stack |= {name: (20 * stack[name]).astype(np.float32) for name in ("co",)}
    return SetNetwork(weights, stack if around else None, {})


def map_of(network, robot=ROBOT, half_life=None):
    fusion = network.fusion(robot, CELL_M, half_life)
    return fusion, GrowingGrid(CELL_M, fusion.blank)


def told_at(corner, shape, sums, poses, radius=STOOD_SHARE * FOOTPRINT_M, stamp=0.0, epoch=-np.inf):
    """What scans at poses told of a window of cells: four sums and looks, each [rows, cols]."""
    corner = np.asarray(corner)
    views = np.asarray(sums[4] > 0, np.int32)

    def add(layers, counted):
        for layer, added in zip((*layers, counted), (*sums, views), strict=True):
            layer += added

    told = _Told(add, stamp, epoch, np.asarray(poses, dtype=float).reshape(-1, 2), radius)
    return Evidence(corner, corner + shape, told)


def random_sums(rng, shape, share=0.7):
    """Of one look or none at each cell."""
    said = rng.normal(0, 1.5, shape) * (rng.random(shape) < share)
    sums = [np.maximum(side * said, 0) ** k for k in (1, 2) for side in (1, -1)]
    return [np.float32(each) for each in (*sums, said != 0)]


def fused(fusion, grown, evidence):
    grown.reserve(evidence.corner, evidence.end)
    fusion.fuse(grown, evidence)


def read(fusion, grown, corner=None, shape=None):
    fusion.read_out(grown, *grown.reserved(corner, shape))
    return grown.grid()


PLACES = [(0.8 * i, 0.8 * k) for i in range(-1, 3) for k in range(-1, 3)]
"""So far from each other that no way is drawn from one to another, whatever their order."""

windows = st.lists(
    st.tuples(st.integers(-SPAN, SPAN), st.integers(-SPAN, SPAN), st.integers(1, 90), st.integers(1, 90)), max_size=3
)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.lists(windows, min_size=2, max_size=4))
def test_neither_the_order_of_scans_nor_when_which_part_is_read_changes_the_map(seed, looks):
    rng = np.random.default_rng(seed)
    told = []
    for place in rng.permutation(PLACES)[: len(looks)]:
        shape = tuple(int(n) for n in rng.integers(20, 45, 2))
        # Round the robot, as windows of scans are.
        corner = np.floor(place[::-1] / CELL_M).astype(int) - rng.integers(8, 12, 2)
        told.append(told_at(corner, shape, random_sums(rng, shape), place))
    network = network_of()
    fusion, grown = map_of(network)
    for evidence, parts in zip(told, looks, strict=True):
        fused(fusion, grown, evidence)
        for row, col, rows, cols in parts:
            read(fusion, grown, np.array([row, col]), (rows, cols))
    once, whole = map_of(network)
    for evidence in (told[i] for i in rng.permutation(len(told))):
        fused(once, whole, evidence)
    some, all_ = read(fusion, grown), read(once, whole)
    assert some.origin == all_.origin
    np.testing.assert_allclose(some.log_odds, all_.log_odds, atol=1e-4)
    np.testing.assert_array_equal(some.observed, all_.observed)
    assert np.std(all_.log_odds[all_.observed]) > 0.5


@pytest.mark.parametrize("around", [True, False], ids=["surroundings", "each cell alone"])
def test_a_part_that_is_read_is_that_of_the_whole_and_the_rest_follows(around):
    rng = np.random.default_rng(0)
    network, shape = network_of(around), (90, 80)
    first, second = (
        told_at(corner, shape, random_sums(rng, shape), place)
        for corner, place in (([-50, -40], (0.0, 0.0)), ([-20, 0], (1.0, 1.0)))
    )
    fusion, grown = map_of(network)
    fused(fusion, grown, first)
    read(fusion, grown)
    before = grown.part(first.corner, shape).log_odds
    fused(fusion, grown, second)
    # Exactly what the second told; round it the surroundings changed as well.
    read(fusion, grown, second.corner, shape)
    part = grown.part(second.corner, shape)
    whole = read(fusion, grown)
    # Rows are worked out several at a time, and which go together depends on the part that is read.
    np.testing.assert_allclose(part.log_odds, grown.part(second.corner, shape).log_odds, atol=1e-5)
    once, anew = map_of(network)
    for evidence in (first, second):
        fused(once, anew, evidence)
    np.testing.assert_allclose(whole.log_odds, read(once, anew).log_odds, atol=1e-4)
    ring = grown.part(first.corner, shape).log_odds[:30] != before[:30]
    assert ring.any() == around


OTHER = replace(ROBOT, mounts=B21.mounts[:9], beam_width_rad=0.9)


@pytest.mark.parametrize(
    ("place", "other"),
    [((0.0, 0.0), ROBOT), ((1.5, -2.0), ROBOT), ((-2.0, 1.5), ROBOT), ((0.0, 0.0), OTHER)],
    ids=["a few cells", "floor behind them", "floor before them", "another array"],
)
def test_what_changes_later_is_read_as_if_it_had_been_there_from_the_beginning(place, other):
    rng = np.random.default_rng(1)
    network, wide, few = network_of(), (200, 210), (6, 9)
    first = told_at([-100, -105], wide, random_sums(rng, wide), (0.0, 0.0))
    second = told_at([-3, -4], few, random_sums(rng, few, 1.0), place)
    fusion, grown = map_of(network)
    fused(fusion, grown, first)
    before = read(fusion, grown).log_odds.copy()
    if other is not ROBOT:
        fusion.equip(other)
    fused(fusion, grown, second)
    after = read(fusion, grown)
    once, anew = map_of(network, other)
    for evidence in (first, second):
        fused(once, anew, evidence)
    expected = read(once, anew)
    np.testing.assert_allclose(after.log_odds, expected.log_odds, atol=1e-5)
    np.testing.assert_array_equal(after.observed, expected.observed)
    # All round.
    changed = np.argwhere(np.abs(after.log_odds - before) > 1e-5)
    assert np.all(changed.min(axis=0) < (97, 101))
    assert np.all(changed.max(axis=0) > (103, 110))


def passes_of(network, counts, seed=0):
    """Log-odds after so many passes over the same evidence, but for floor that was stood on."""
    rng = np.random.default_rng(seed)
    shape = (70, 70)
    evidence = [told_at([-35, -35], shape, random_sums(rng, shape, 1.0), (0, 0), radius=0.0) for _ in range(4)]
    fusion, grown = map_of(network)
    for i in range(1, max(counts) + 1):
        for each in evidence:
            fused(fusion, grown, each)
        if i in counts:
            yield read(fusion, grown).log_odds.copy()


@pytest.mark.parametrize("around", [True, False], ids=["surroundings", "each cell alone"])
def test_more_passes_over_the_same_evidence_level_off(around):
    one, eight, thirty, sixty = passes_of(network_of(around), (1, 8, 30, 60))
    scale = np.abs(thirty).max()
    # Of four looks a pass 24 (1 - exp(-32 / 24)) count after eight passes, and nearly 24 after thirty.
    clear = np.abs(thirty) > 0.05 * scale
    assert np.mean(np.sign(thirty)[clear] != np.sign(eight)[clear]) < 0.01
    assert np.abs(sixty - thirty).max() < 0.02 * scale
    assert np.abs(eight - one).max() > 0.1 * scale


def test_by_bayes_rule_no_number_of_passes_turns_a_cell_over_or_makes_it_surer_than_looks_say():
    one, eight, thirty = passes_of(network_of(False, bayes=True), (1, 8, 30))
    mean = one / (-LOOKS * np.expm1(-4 / LOOKS))
    for count, log_odds in ((8, eight), (30, thirty)):
        clear = np.abs(one) > 1e-3
        np.testing.assert_array_equal(np.sign(log_odds[clear]), np.sign(one[clear]))
        assert np.all(np.abs(log_odds) >= np.abs(one) - 1e-4)
        assert np.all(np.abs(log_odds) <= count * np.abs(one) + 1e-4)
        # Where fewer of the passes' looks fell they are worth more each, but never more than all that LOOKS allows.
        assert np.all(np.abs(log_odds) <= 4.5 * LOOKS * np.abs(mean) + 1e-4)


def walls(corner, shape, poses, **told):
    """Evidence of a surface in every cell, as sure as it comes."""
    return told_at(corner, shape, wall_sums(shape), poses, **told)


def wall_sums(shape):
    return [np.full(shape, value, dtype=np.float32) for value in (80.0, 0.0, 320.0, 0.0, 20.0)]


def distances(points, way):
    """From points [n, 2] to places, and to what was drawn of the way between them, m."""
    at = np.min(np.hypot(*(points[:, None] - way).T), axis=0)
    to_way = at.copy()
    for a, b in pairwise(way):
        if 0 < np.hypot(*(b - a)) <= STOOD_GAP_M:
            t = np.clip((points - a) @ (b - a) / np.sum((b - a) ** 2), 0, 1)
            to_way = np.minimum(to_way, np.hypot(*(points - a - t[:, None] * (b - a)).T))
    return at, to_way


ways = st.tuples(st.integers(0, 2**32), st.integers(1, 9), st.sampled_from([0.01, 0.2, 0.45]), st.booleans())


@settings(max_examples=30, deadline=None)
@given(ways)
def test_floor_that_was_stood_on_or_come_over_is_free_and_no_other_is(drawn):
    seed, count, spread, around = drawn
    rng = np.random.default_rng(seed)
    way = np.cumsum(rng.normal(0, spread, (count, 2)), axis=0)
    way = np.clip(way, -1.4, 1.4)
    cut = int(rng.integers(0, count + 1))
    fusion, grown = map_of(network_of(around, bayes=True))
    for part in (way[:cut], way[cut:]):
        if len(part):
            fused(fusion, grown, walls([-45, -45], (90, 90), part))
    grid = read(fusion, grown)
    points = grid.centre_of(np.argwhere(np.ones(grid.shape)))
    _, off = distances(points, way)
    log_odds, radius = grid.log_odds.ravel(), STOOD_SHARE * FOOTPRINT_M
    assert np.all(log_odds[off < radius - 0.006] <= STOOD)
    assert grid.observed.all()
    other, untouched = map_of(network_of(around, bayes=True))
    for part in (way[:cut], way[cut:]):
        if len(part):
            fused(other, untouched, walls([-45, -45], (90, 90), part, radius=0.0))
    expected = read(other, untouched).log_odds.ravel()
    if not around:  # which know what was stood on
        np.testing.assert_allclose(log_odds[off > radius + 1e-6], expected[off > radius + 1e-6], atol=1e-4)
    assert np.all(grown.layers()["stood"].ravel()[off > radius + 1e-6] == 0)


@pytest.mark.parametrize("radius", [0.04, 0.15, 0.6])
def test_of_the_way_between_scans_no_gap_is_left_by_robots_of_any_size(radius):
    fusion, grown = map_of(network_of(False, bayes=True))
    way = np.array([[-0.25, -0.25], [0.31, -0.1]])
    fused(fusion, grown, walls([-45, -45], (90, 90), way, radius=radius))
    grid = read(fusion, grown)
    _, off = distances(grid.centre_of(np.argwhere(np.ones(grid.shape))), way)
    lane = off < 0.95 * radius
    assert np.all(grid.log_odds.ravel()[lane] <= STOOD)
    assert lane.sum() > 0.9 * (np.pi * radius + 2 * 0.58) * radius / CELL_M**2


@pytest.mark.parametrize(("step", "drawn"), [(STOOD_GAP_M - 0.01, True), (STOOD_GAP_M + 0.01, False)])
def test_a_straight_way_is_believed_between_scans_that_are_near_each_other_alone(step, drawn):
    for together in (True, False):
        fusion, grown = map_of(network_of(False, bayes=True))
        ends = np.array([[0.02, 0.02], [0.02 + step, 0.02]])
        for poses in [ends] if together else ends[:, None]:
            fused(fusion, grown, walls([-45, -45], (90, 90), poses))
        grid = read(fusion, grown)
        middle = grid.log_odds[grid.index_of(ends.mean(axis=0))[0], grid.index_of(ends.mean(axis=0))[1]]
        assert middle <= STOOD if drawn else middle > 1
        assert np.all(grid.probability_at(ends) < 0.03)


def test_floor_that_was_stood_on_counts_as_observed_and_free_though_no_sonar_spoke():
    fusion, grown = map_of(network_of())
    nothing = [np.zeros((40, 40), np.float32)] * 5
    fused(fusion, grown, told_at([-20, -20], (40, 40), nothing, (0, 0)))
    grid = read(fusion, grown)
    off = np.hypot(*grid.centre_of(np.argwhere(np.ones(grid.shape))).T).reshape(grid.shape)
    np.testing.assert_array_equal(grid.observed, off < STOOD_SHARE * FOOTPRINT_M)
    assert np.all(grid.log_odds[grid.observed] <= STOOD)
    assert np.all(grid.log_odds[~grid.observed] == 0)


def test_that_a_robot_stood_there_is_forgotten_as_its_evidence_is():
    here, there, shape = (0.0, 0.0), (1.5, 1.5), (90, 90)
    nothing = [np.zeros(shape, np.float32)] * 5
    for ages, free in ((2.0, True), (6.0, False)):
        fusion, grown = map_of(network_of(bayes=True), half_life=10.0)
        fused(fusion, grown, told_at([-45, -45], shape, nothing, here, epoch=0.0))
        assert read(fusion, grown).probability_at(np.zeros((1, 2)))[0] < 0.03
        sums = [2**ages * each for each in wall_sums(shape)]
        fused(fusion, grown, told_at([-45, -45], shape, sums, there, stamp=10.0 * ages, epoch=0.0))
        grid = read(fusion, grown)
        assert (grid.probability_at(np.zeros((1, 2)))[0] < 0.03) == free
        assert grid.probability_at(np.array([there]))[0] < 0.03
    # And when all is forgotten the floor is as unknown to the surroundings as any.
    cells = {name: np.zeros((2, 2), np.float32) for name in fusion.blank}
    cells["stood"] += np.float32(1e-9)
    np.testing.assert_array_equal(fusion.telling(cells), fusion.telling(cells | {"stood": 0 * cells["stood"]}))


@pytest.mark.parametrize("radius", [0.0, 3.0, 9.0])
def test_robots_of_no_size_and_those_larger_than_their_sonars_reach_are_mapped(radius):
    fusion, grown = map_of(network_of(False, bayes=True), replace(ROBOT, footprint_radius_m=radius))
    way = np.column_stack([0.25 * np.arange(4), np.zeros(4)])
    for poses in (way[:2], way[2:]):
        fused(fusion, grown, walls([-45, -45], (90, 90), poses, radius=radius))
    grid = read(fusion, grown)
    assert np.all(grid.log_odds <= STOOD) if radius else np.all(grid.log_odds > 1)
