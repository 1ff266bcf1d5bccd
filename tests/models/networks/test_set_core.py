"""The compiled core against the same network written in JAX, on random arrays, weights, scans and ranges."""

from functools import cache
from math import inf, nan, pi

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.models.networks import set_core, surroundings
from echogrid.models.networks.set_core import BEARINGS, REACH_M, ends_within
from echogrid.models.networks.set_layers import fused, initial, saturated
from echogrid.robot import Robot, preset_names
from polar_oracle import _bearing_of, array_of, asked, local_map, moved_view, told_until, view

MOST, SCANS = 48, 3
FOOTPRINT_M, CELL_M, SPAN = 0.2, 0.04, 140
MAP, VIEW, MOVED, UNTIL, SECTOR = (jax.jit(f) for f in (local_map, view, moved_view, told_until, _bearing_of))


@cache
def weights(units=8):
    """Of a network that has something to say of every point."""
    rng = np.random.default_rng(units)
    grown = {name: value + rng.normal(0, 0.3, value.shape) for name, value in initial(rng, units).items()}
    return {name: value.astype(np.float32) for name, value in grown.items()}


@cache
def core(units=8):
    return set_core.network(weights(units), None)


def drawn(seed, sonars, missing=0.2, least_m=0.1):
    """An array, some of whose sonars are not there, their ranges and scans of them."""
    rng = np.random.default_rng(seed)
    mounts = np.column_stack([rng.uniform(-0.3, 0.3, (sonars, 2)), rng.uniform(-pi, pi, sonars)])
    mounts[1:][rng.random(sonars - 1) < missing] = nan
    longest = np.exp(rng.uniform(np.log(least_m), np.log(6.0), sonars)).astype(np.float32)
    ranges = (longest * rng.uniform(0.02, 1.0, (SCANS, sonars))).astype(np.float32)
    ranges[rng.random(ranges.shape) < 0.3] = inf
    ranges[rng.random(ranges.shape) < 0.3] = nan
    return mounts, longest, ranges, rng.uniform(0, 1, (SCANS, 4)).astype(np.float32)


def padded(values, axis, fill):
    """Sonars that are not there, so that one compilation of the oracle serves all arrays."""
    pads = [(0, 0)] * values.ndim
    pads[axis] = (0, MOST - values.shape[axis])
    return np.pad(values, pads, constant_values=fill)


def oracle_array(mounts, longest, beam, ends):
    return array_of(padded(mounts, 0, nan), padded(longest, 0, 9.0), FOOTPRINT_M, beam, ends)


arrays = st.tuples(st.integers(0, 2**32), st.integers(1, MOST), st.floats(0.01, 1.5), st.booleans())


def told(array, units=8):
    """Polar tables of the core and of the oracle, and how far the scans tell."""
    seed, sonars, beam, near = array
    mounts, longest, ranges, traits = drawn(seed, sonars, least_m=0.1 if near else 3.5)
    ends = ends_within(mounts, longest)
    found = core(units).tables(set_core.sonar_array(mounts, longest, FOOTPRINT_M, beam, ends), ranges, traits)
    expected = oracle_array(mounts, longest, beam, ends)
    table = MAP(weights(units), expected, padded(ranges, 1, nan), traits)
    until = UNTIL(expected, padded(ranges, 1, nan)) if ends else np.full((SCANS, BEARINGS), REACH_M)
    return found, np.asarray(table), np.asarray(until)


@settings(max_examples=150, deadline=None)
@given(arrays)
def test_a_scan_tells_of_bearings_and_rings_what_the_oracle_says(array):
    found, table, until = told(array)
    np.testing.assert_allclose(found.values(), table, atol=1e-3)
    np.testing.assert_allclose(found.told_until(), until, atol=1e-4)


@pytest.mark.parametrize("units", [1, 2, 3, 5, 24, 50])
def test_networks_of_any_width_are_worked_out(units):
    found, table, _ = told((1, 20, 0.4, True), units)
    assert np.std(table) > 0.1
    np.testing.assert_allclose(found.values(), table, atol=1e-3)


def test_beams_narrower_than_a_degree_are_alike_and_wider_ones_are_told_apart():
    mounts, longest, ranges, traits = drawn(1, 20)

    def told_of(beam_deg):
        array = set_core.sonar_array(mounts, longest, FOOTPRINT_M, np.deg2rad(beam_deg), True)
        return core().tables(array, ranges, traits).values()

    np.testing.assert_array_equal(told_of(0.0), told_of(1.0))
    assert min(np.max(np.abs(told_of(wide) - told_of(1.0))) for wide in (1.2, 3, 9)) > 0.01


@pytest.mark.parametrize("name", preset_names())
def test_ties_between_the_sonars_of_a_regular_array_are_broken_alike(name):
    robot = Robot.load(name)
    ranges = np.random.default_rng(0).uniform(0.1, 3, (SCANS, robot.sonars)).astype(np.float32)
    traits = np.full((SCANS, 4), 0.4, np.float32)
    given_ = robot.mounts, robot.max_ranges_m, robot.footprint_radius_m, robot.beam_width_rad
    found = core().tables(set_core.sonar_array(*given_, False), ranges, traits)
    table = MAP(weights(), array_of(*given_), ranges, traits)
    np.testing.assert_allclose(found.values(), np.asarray(table), atol=1e-3)


class Drive:
    """Scans at places in a window of the map."""

    def __init__(self, seed, scans=SCANS):
        rng = np.random.default_rng(seed)
        self.side = int(np.ceil(2 * REACH_M / CELL_M)) + 2
        place = rng.uniform(0, 0.3, (scans, 2))
        home = np.floor(place / CELL_M).astype(np.int64) - self.side // 2
        self.corner = ((home + 0.5) * CELL_M - place).astype(np.float32)
        self.heading = rng.uniform(0, 2 * pi, scans)
        self.first = (home - home.min(axis=0))[:, ::-1].astype(np.int32)
        self.weight = rng.choice([0.0, 0.1, 1.0], scans, p=[0.1, 0.3, 0.6]).astype(np.float32)

    def points(self, dtype=np.float32):
        """Of the cells of the window, in the robot's frame of each scan, m: x and y [scans, SPAN, SPAN]."""
        steps = np.arange(SPAN)
        x = self.corner[:, 0, None, None] + (steps - self.first[:, 1, None])[:, None, :] * CELL_M
        y = self.corner[:, 1, None, None] + (steps - self.first[:, 0, None])[:, :, None] * CELL_M
        cos, sin = (f(self.heading)[:, None, None] for f in (np.cos, np.sin))
        return (cos * x + sin * y).astype(dtype), (cos * y - sin * x).astype(dtype)

    def sums(self, found):
        """Of what scans tell of the cells [scans, SPAN, SPAN]."""
        weight = self.weight[:, None, None]
        sides = np.maximum(found, 0), np.maximum(-found, 0)
        looked = (found != 0) & (weight > 0)
        layers = [weight * side**k for k in (1, 2) for side in sides]
        return [np.sum(each, axis=0) for each in (*layers, weight * looked, looked)]

    def added(self, tables, rows=SPAN, cols=SPAN):
        layers = [np.zeros((rows, cols), np.float32) for _ in range(5)]
        views = np.zeros((rows, cols), np.int32)
        tables.add(self.corner, self.heading, self.first, self.weight, CELL_M, layers, views)
        return [*layers, views]


def on_the_rim(drive, until):
    """Cells whose middle lies, but for rounding, where a scan ends to tell or where another sector begins."""
    x, y = drive.points()
    sector, distance = np.asarray(SECTOR(x, y)), np.hypot(x, y)
    index = np.clip(sector.astype(int), 0, BEARINGS - 1)
    rim = np.abs(distance - until[np.arange(len(x))[:, None, None], index]) < 1e-5
    if np.any(until != REACH_M):
        rim |= (np.abs(sector - np.round(sector)) < 1e-4) & (distance < REACH_M + 1e-5)
    return rim.any(axis=0)


@settings(max_examples=40, deadline=None)
@given(arrays)
def test_the_sums_of_scans_are_those_of_the_oracle(array):
    seed, sonars, beam, near = array
    mounts, longest, ranges, traits = drawn(seed, sonars, least_m=0.1 if near else 3.5)
    ends = ends_within(mounts, longest)
    drive = Drive(seed)
    tables = core().tables(set_core.sonar_array(mounts, longest, FOOTPRINT_M, beam, ends), ranges, traits)
    found = VIEW(
        weights(), oracle_array(mounts, longest, beam, ends), padded(ranges, 1, nan), traits, *drive.points()
    )
    check_sums(drive, tables, np.asarray(found))


def check_sums(drive, tables, found):
    rim = on_the_rim(drive, tables.told_until())
    assert np.mean(rim) < 5e-3
    for sums, expected in zip(drive.added(tables), drive.sums(found), strict=True):
        np.testing.assert_allclose(sums[~rim], expected[~rim], atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(arrays)
def test_sonars_look_from_where_they_are_in_each_scan(array):
    seed, sonars, beam, near = array
    mounts, longest, ranges, traits = drawn(seed, sonars, least_m=0.1 if near else 3.5)
    rng = np.random.default_rng(seed)
    looked = mounts + rng.uniform(-0.2, 0.2, (SCANS, 1, 3)) + rng.uniform(-0.01, 0.01, (SCANS, sonars, 3))
    ends = ends_within(looked, longest)
    drive = Drive(seed)
    array_ = set_core.sonar_array(mounts, longest, FOOTPRINT_M, beam, ends)
    tables = core().tables(array_, ranges, traits, np.ascontiguousarray(looked))
    full = padded(looked, 1, nan)
    found = MOVED(
        weights(), oracle_array(mounts, longest, beam, ends), padded(ranges, 1, nan), traits, *drive.points(),
        full.astype(np.float32), asked(full),
    )  # fmt: skip
    check_sums(drive, tables, np.asarray(found))


def test_the_number_of_threads_changes_no_bit():
    mounts, longest, _, _ = drawn(3, 24, least_m=0.5)
    rng = np.random.default_rng(3)
    ranges = rng.uniform(0.1, 3, (40, 24)).astype(np.float32)
    traits = rng.random((40, 4)).astype(np.float32)
    drive = Drive(3, 40)
    maps = []
    before = _core.threads()
    try:
        for threads in (1, 2, 5):
            _core.set_threads(threads)
            array = set_core.sonar_array(mounts, longest, FOOTPRINT_M, 0.4, True)
            sums = drive.added(core().tables(array, ranges, traits))
            maps.append([*sums, *read(random_cells(3, (60, 70)), around(4))])
    finally:
        _core.set_threads(before)
    for other in maps[1:]:
        for a, b in zip(maps[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


@cache
def around(seed):
    rng = np.random.default_rng(seed)
    grown = {name: value + rng.normal(0, 0.05, value.shape) for name, value in surroundings.initial(rng).items()}
    return {name: value.astype(np.float32) for name, value in grown.items()}


def random_cells(seed, shape):
    """Sums of a map: four of evidence, looks, and where the robot stood."""
    rng = np.random.default_rng(seed)
    looks = (rng.exponential(8, shape) * (rng.random(shape) < 0.8)).astype(np.float32)
    looks[rng.random(shape) < 0.1] *= np.float32(1e-4)
    sums = [looks * rng.uniform(0, 3, shape).astype(np.float32) for _ in range(4)]
    return [*sums, looks, (rng.random(shape) < 0.05).astype(np.float32)]


TOLD = np.random.default_rng(0).random(surroundings.TOLD).astype(np.float32)


def read(cells, stack, begin=(0, 0), squares=None, least=0.0, faded=1.0):
    """Read out cells [rows, cols] that lie at ``begin`` of a rectangle of squares."""
    shape = cells[0].shape
    squares = squares or tuple(-(-n // surroundings.PACK) for n in shape)
    log_odds, observed = np.zeros(shape, np.float32), np.zeros(shape, bool)
    network = set_core.network(weights(), stack)
    network.read_out(
        cells, begin, squares, set_core.begun(stack, TOLD), faded, least, -4.0, log_odds, observed, begin
    )
    return log_odds, observed


def oracle_read(cells, stack, begin, squares, least, faded):
    rows, cols = (surroundings.PACK * n for n in squares)
    shape, full = cells[0].shape, np.zeros((6, rows, cols), np.float32)
    part = np.s_[begin[0] : begin[0] + shape[0], begin[1] : begin[1] + shape[1]]
    for layer, values in zip(full, cells, strict=True):
        layer[part] = np.float32(faded) * values
    *sums, looks, stood = full
    observed, stood = sums[0] + sums[1] > least, stood > least
    sums = saturated(looks, *sums, xp=np)
    alone = np.where(looks > 0, fused(weights(), *sums, xp=np), 0)
    log_odds = alone
    if stack is not None:
        features = surroundings.features(sums, looks, alone, stood.astype(np.float32))
        log_odds = surroundings.corrected(stack, features, TOLD)
    log_odds = np.where(stood, np.minimum(log_odds, -4.0), np.where(observed, log_odds, 0))
    return log_odds[part], (observed | stood)[part]


rectangles = st.tuples(
    st.integers(0, 2**32), st.integers(1, 70), st.integers(1, 260), st.integers(0, 9), st.integers(0, 40)
)


@settings(max_examples=60, deadline=None)
@given(rectangles, st.booleans(), st.sampled_from([(0.0, 1.0), (0.05, 0.3)]))
def test_cells_are_read_out_as_by_the_oracle(rectangle, alone, fading):
    seed, rows, cols, row, col = rectangle
    cells, begin = random_cells(seed, (rows, cols)), (row, col)
    squares = (rows + row + 5) // 2, (cols + col + 3) // 2
    stack = None if alone else around(seed % 3)
    log_odds, observed = read(cells, stack, begin, squares, *fading)
    expected, known = oracle_read(cells, stack, begin, squares, *fading)
    np.testing.assert_array_equal(observed, known)
    np.testing.assert_allclose(log_odds, expected, atol=1e-4)


def test_a_look_too_faint_to_count_is_read_out_with_all_its_digits():
    looks = np.array([[1e-7, 1e-5, 1e-3, 0.1, 1, 7.1, 7.3, 24, 1e4]], np.float32)
    cells = [2 * looks, looks, looks, looks, looks, 0 * looks]
    log_odds, _ = read(cells, None)
    expected, _ = oracle_read(cells, None, (0, 0), (1, 5), 0.0, 1.0)
    np.testing.assert_allclose(log_odds, expected, atol=2e-5)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"ranges": np.zeros((2, 4), np.float32)}, "ranges: found 2 x 4, expected 2 x 5"),
        ({"traits": np.zeros((1, 4), np.float32)}, "traits: found 1 x 4, expected 2 x 4"),
        ({"mounts": np.zeros((2, 5, 2))}, "mounts: found 2 x 5 x 2, expected 2 x 5 x 3"),
    ],
)
def test_arrays_of_other_shapes_are_told(change, text):
    array = set_core.sonar_array(np.zeros((5, 3)), 3.0, 0.2, 0.4, False)
    told_ = {"ranges": np.zeros((2, 5), np.float32), "traits": np.zeros((2, 4), np.float32), "mounts": None}
    with pytest.raises(UsageError, match=f"^{text}$"):
        core().tables(array, **told_ | change)


def test_a_window_that_vectors_do_not_fit_in_is_refused():
    array = set_core.sonar_array(np.zeros((1, 3)), 3.0, 0.2, 0.4, False)
    tables = core().tables(array, np.ones((1, 1), np.float32), np.zeros((1, 4), np.float32))
    with pytest.raises(UsageError, match=r"^add: found a window of 9 columns, expected 16 or more$"):
        Drive(1, 1).added(tables, cols=9)
