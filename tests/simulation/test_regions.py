from math import inf, nan, pi, radians

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.errors import UsageError
from echogrid.geometry import wrap
from echogrid.robot import TRANSDUCERS
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.regions import regions_of_constant_depth
from echogrid.simulation.simulate import rotary_scan
from echogrid.simulation.world import World, polyline

DEGREES = np.deg2rad(np.arange(360.0))


def scan(pieces, fill=inf):
    """A scan of 1 degree steps: ranges from a degree on, ``fill`` elsewhere."""
    ranges = np.full(360, fill)
    for first, values in pieces.items():
        ranges[(first + np.arange(len(values))) % 360] = values
    return ranges


def found(ranges, **rule):
    """First bearing, last bearing and mean bearing in degrees, mean range in m, of each region."""
    regions = regions_of_constant_depth(DEGREES, ranges, **rule)
    angles = [(region.first_bearing, region.last_bearing, region.bearing) for region in regions]
    return [(*np.round(np.rad2deg(a), 6), round(r.mean_range, 6)) for a, r in zip(angles, regions, strict=True)]


def test_a_scan_without_echo_has_no_region():
    assert found(scan({})) == []
    assert found(scan({}, fill=nan)) == []


def test_a_flat_piece_is_a_region():
    assert found(scan({40: [1.5] * 21})) == [(40, 60, 50, 1.5)]


def test_a_region_may_wrap_round_the_end_of_the_scan():
    [region] = regions_of_constant_depth(DEGREES, scan({350: [2.0] * 21}))
    np.testing.assert_array_equal(region.readings, [*range(350, 360), *range(11)])
    assert found(scan({350: [2.0] * 21})) == [(-10, 10, 0, 2.0)]


def test_a_scan_of_one_range_is_one_region_round_the_circle():
    [region] = regions_of_constant_depth(DEGREES, np.ones(360))
    assert len(region.readings) == 360
    assert region.width == pytest.approx(radians(359))


def test_narrow_pieces_are_dropped():
    assert found(scan({40: [1.5] * 11})) == [(40, 50, 45, 1.5)]
    assert found(scan({40: [1.5] * 10})) == []
    assert found(scan({40: [1.5] * 10}), least_width=radians(9)) == [(40, 49, 44.5, 1.5)]
    assert found(scan({40: [1.5]}), least_width=0.0) == [(40, 40, 40, 1.5)]


def test_a_step_ends_a_region():
    low_and_high = scan({40: [1.5] * 21 + [1.6] * 21})
    assert found(low_and_high) == [(40, 60, 50, 1.5), (61, 81, 71, 1.6)]
    assert found(low_and_high, delta_m=0.11) == [(40, 81, 60.5, 1.55)]


def test_the_ranges_of_a_region_differ_by_less_than_delta():
    slope = [2.0 + 0.25 * i for i in range(21)]
    assert found(scan({100: slope}), delta_m=2.75) == [(100, 110, 105, 3.25)]
    assert found(scan({100: slope}), delta_m=2.5) == []


def test_delta_may_grow_with_range():
    wavy = [4.0, 4.0625] * 8
    assert found(scan({100: wavy})) == []
    assert found(scan({100: wavy}), delta_share=1 / 64) == []
    assert found(scan({100: wavy}), delta_share=1 / 63) == [(100, 115, 107.5, 4.03125)]
    assert found(scan({100: [4.0, 4.01] * 8}), delta_share=1e-3) == [(100, 115, 107.5, 4.005)]


@pytest.mark.parametrize("lost", [inf, nan])
def test_a_reading_without_echo_ends_a_region(lost):
    assert found(scan({40: [1.5] * 11 + [lost] + [1.5] * 12})) == [(40, 50, 45, 1.5), (52, 63, 57.5, 1.5)]
    assert found(scan({40: [1.5] * 8 + [lost] + [1.5] * 8})) == []


def test_a_few_lost_echoes_may_be_bridged():
    assert found(scan({40: [1.5] * 8 + [inf] + [1.5] * 8}), bridge=1) == [(40, 56, 48, 1.5)]
    assert found(scan({40: [1.5] * 8 + [inf] * 2 + [1.5] * 8}), bridge=1) == []
    assert found(scan({40: [1.5] * 8 + [nan, inf] + [1.5] * 8}), bridge=2) == [(40, 57, 48.5, 1.5)]
    assert found(scan({355: [1.5] * 4 + [inf] + [1.5] * 8}), bridge=1) == [(-5, 7, 1, 1.5)]
    # Neither a reading of another range nor the silence at the ends is bridged.
    assert found(scan({40: [1.5] * 8 + [9.0] + [1.5] * 8}), bridge=3) == []
    assert found(scan({40: [1.5] * 11}), bridge=3) == [(40, 50, 45, 1.5)]
    [region] = regions_of_constant_depth(DEGREES, scan({40: [1.5] * 8 + [inf] + [1.5] * 8}), bridge=1)
    np.testing.assert_array_equal(region.readings, [*range(40, 48), *range(49, 57)])


def test_of_overlapping_runs_the_longer_is_a_region_and_the_rest_of_the_other_may_be_one():
    # 20 readings of 1 m, 5 between, 12 of 1.03 m: those between go with the 20, and 12 are left.
    assert found(scan({0: [1.0] * 20 + [1.015] * 5 + [1.03] * 12})) == [(0, 24, 12, 1.003), (25, 36, 30.5, 1.03)]
    # Of two that are 20 wide the flatter takes those between.
    assert found(scan({0: [1.0] * 15 + [1.018] * 5 + [1.03] * 15})) == [(0, 14, 7, 1.0), (15, 34, 24.5, 1.027)]


def test_bearings_may_begin_anywhere():
    bearing = DEGREES + radians(170.5)
    [region] = regions_of_constant_depth(bearing, scan({0: [1.0] * 21}))
    assert np.rad2deg([region.first_bearing, region.bearing, region.last_bearing]) == pytest.approx(
        [170.5, -179.5, -169.5]
    )


@pytest.mark.parametrize(
    "bearing", [DEGREES[::-1], DEGREES / 3, np.append(DEGREES[:-1], 0.1)], ids=["clockwise", "a sector", "a jump"]
)
def test_bearings_that_do_not_go_round_evenly_are_refused(bearing):
    with pytest.raises(UsageError, match="found uneven steps, expected 360 even ones round the circle"):
        regions_of_constant_depth(bearing, np.ones(360))


readings = st.sampled_from([1.0, 1.015, 1.03, 2.0, inf])
scans = st.lists(st.tuples(readings, st.integers(1, 25)), min_size=1, max_size=20).map(
    lambda pieces: np.repeat([r for r, _ in pieces], [n for _, n in pieces])
)
WIDE = radians(15)


def evenly(ranges):
    return np.arange(len(ranges)) * (2 * pi / len(ranges))


@given(scans, st.integers(0, 2**32 - 1))
def test_a_scan_that_begins_elsewhere_has_the_same_regions(ranges, seed):
    # Noise tells runs of equal length apart, of which the first would otherwise be taken.
    rng = np.random.default_rng(seed)
    ranges = ranges + rng.uniform(0, 1e-3, len(ranges))
    turn = rng.integers(len(ranges))
    bearing = evenly(ranges)
    plain = regions_of_constant_depth(bearing, ranges, least_width=WIDE)
    rolled = regions_of_constant_depth(np.roll(bearing, turn), np.roll(ranges, turn), least_width=WIDE)
    # As sets: a run all round the circle begins where the scan does.
    assert {frozenset(r.readings) for r in plain} == {frozenset((r.readings - turn) % len(ranges)) for r in rolled}
    assert sorted(r.mean_range for r in plain) == pytest.approx(sorted(r.mean_range for r in rolled))


@given(scans, st.floats(-10, 10))
def test_turning_the_frame_turns_the_regions(ranges, turn):
    bearing = evenly(ranges)
    plain = regions_of_constant_depth(bearing, ranges, least_width=WIDE)
    turned = regions_of_constant_depth(bearing + turn, ranges, least_width=WIDE)
    assert [tuple(r.readings) for r in plain] == [tuple(r.readings) for r in turned]
    for a, b in zip(plain, turned, strict=True):
        assert abs(wrap(b.bearing - a.bearing - turn)) < 1e-6


@given(scans)
def test_regions_are_apart_flat_and_wide_enough_and_leave_no_run_that_is(ranges):
    regions = regions_of_constant_depth(evenly(ranges), ranges, least_width=WIDE)
    taken = [i for region in regions for i in region.readings]
    assert len(taken) == len(set(taken))
    pitch = 2 * pi / len(ranges)
    for region in regions:
        assert np.ptp(ranges[region.readings]) < 0.02
        assert region.width >= WIDE - 1e-6
        assert np.all(np.diff(region.readings) % len(ranges) == 1)
        assert region.width == pytest.approx((len(region.readings) - 1) * pitch)
    rest = ranges.copy()
    rest[taken] = inf
    assert regions_of_constant_depth(evenly(ranges), rest, least_width=WIDE) == []


def test_the_middle_of_a_simulated_region_is_the_normal_of_the_wall_and_its_range_the_distance():
    # Seen from (1.5, 1) the walls of the room lie at 1.5 m east, 2.5 m north, 1.5 m west and 1 m south.
    room = polyline([[0, 0], [3, 0], [3, 3.5], [0, 3.5]], closed=True)
    world = World("room", room, np.zeros(4), np.zeros((0, 3)))
    bearing, ranges = rotary_scan(world, TRANSDUCERS["polaroid-600"], 10.0, (1.5, 1.0), Physics(walk_error=0.0))
    regions = regions_of_constant_depth(bearing, ranges)
    for normal, distance in [(0, 1.5), (90, 2.5), (180, 1.5), (270, 1.0)]:
        [wall] = [
            r for r in regions if abs(r.mean_range - distance) < 1e-4 and abs(wrap(r.bearing - radians(normal))) < 0.2
        ]
        assert abs(wrap(wall.bearing - radians(normal))) < radians(0.6)
