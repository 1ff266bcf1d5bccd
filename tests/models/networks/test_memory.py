from itertools import pairwise
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.models.networks.memory import FADE, FAR_M, PLACE_M, SAME_M, TRAITS, TURN_RAD, Memory
from echogrid.robot import Robot

B21 = Robot.load("b21").mounts
PAIR = np.array([[0.1, 0.02, 0.1], [0.1, -0.02, -0.1]])
"""Two sonars that are neighbours."""

LATTICE = np.array([PLACE_M, PLACE_M, TURN_RAD])
ORIGIN = LATTICE / 2
"""In the middle of a cell of the lattice."""

no_echo, agree, apart, far = range(TRAITS)


def random_scans(sonars, count=30, seed=0):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 6, (count, sonars))
    ranges[rng.random(ranges.shape) < 0.3] = inf
    ranges[rng.random(ranges.shape) < 0.3] = nan
    return ranges


def random_mounts(sonars, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.3, 0.3, (sonars, 2)), rng.uniform(-pi, pi, sonars)])


def weights_of(poses):
    """What scans from some poses count, one after the other."""
    return Memory(PAIR).take(np.array(poses), np.ones((len(poses), 2))).weight


def traits_of(mounts, scans):
    """What is recalled after each scan of a robot that stands still."""
    scans = np.array(scans, dtype=float)
    return Memory(mounts).take(np.tile(ORIGIN, (len(scans), 1)), scans).traits


def after_many(mounts, scan, count=400):
    """Traits of surroundings that always look the same; the beginning has faded by then."""
    return traits_of(mounts, [scan] * count)[-1]


@pytest.mark.parametrize("count", [1, 2, 600])
def test_scans_from_one_pose_count_the_harmonic_sum(count):
    np.testing.assert_allclose(weights_of([ORIGIN] * count), 1 / np.arange(1, count + 1), rtol=1e-6)


@settings(max_examples=30)
@given(st.integers(-200, 200), st.integers(-200, 200), st.integers(1, int(2 * pi / TURN_RAD) - 2))
def test_each_place_and_heading_counts_for_itself(x, y, heading):
    steps = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    within = [[0.5, 0.5, 0.5], [0.1, 0.9, 0.1], [0.9, 0.1, 0.9]]
    poses = [(steps + place + [x, y, heading]) * LATTICE for place in within]
    np.testing.assert_allclose(weights_of(np.concatenate(poses)), np.repeat([1, 1 / 2, 1 / 3], len(steps)))


@pytest.mark.parametrize("turns", [-3, -1, 1, 7])
def test_a_heading_and_the_same_heading_turns_later_are_one(turns):
    np.testing.assert_allclose(weights_of([ORIGIN, np.add(ORIGIN, [0, 0, 2 * pi * turns])]), [1, 1 / 2])


def test_a_robot_that_comes_again_counts_on():
    away = np.add(ORIGIN, [1, 0, 0])
    np.testing.assert_allclose(weights_of([ORIGIN, away, ORIGIN, away, ORIGIN]), [1, 1, 1 / 2, 1 / 2, 1 / 3])


@pytest.mark.parametrize("parts", [[30], [1] * 30, [1, 7, 0, 22]], ids=["at once", "one by one", "in parts"])
def test_it_does_not_matter_how_many_scans_are_taken_at_once(parts):
    scans = random_scans(24)
    poses = np.random.default_rng(1).uniform(-0.2, 0.2, (30, 3))
    whole, memory = Memory(B21).take(poses, scans), Memory(B21)
    ends = np.cumsum(parts)
    taken = [memory.take(poses[e - n : e], scans[e - n : e]) for n, e in zip(parts, ends, strict=True)]
    np.testing.assert_array_equal(np.concatenate([part.weight for part in taken]), whole.weight)
    np.testing.assert_allclose(np.concatenate([part.traits for part in taken]), whole.traits, atol=1e-6)
    assert 0 < whole.weight.min() < 1


@settings(max_examples=40)
@given(st.integers(1, 30), st.integers(0, 1000))
def test_traits_are_from_0_to_1_and_are_float32(sonars, seed):
    traits = traits_of(random_mounts(sonars, seed), random_scans(sonars, seed=seed))
    assert traits.shape == (30, TRAITS)
    assert traits.dtype == np.float32
    assert traits.min() >= 0
    assert traits.max() <= 1


@settings(max_examples=20)
@given(st.integers(2, 30), st.integers(0, 1000))
def test_traits_do_not_depend_on_the_order_of_the_sonars(sonars, seed):
    mounts, scans = random_mounts(sonars, seed), random_scans(sonars, seed=seed)
    order = np.random.default_rng(seed).permutation(sonars)
    np.testing.assert_allclose(traits_of(mounts[order], scans[:, order]), traits_of(mounts, scans), atol=1e-5)


@settings(max_examples=20)
@given(st.integers(2, 30), st.integers(0, 1000), st.floats(-10, 10))
def test_traits_do_not_depend_on_the_frame_of_the_robot_nor_on_left_and_right(sonars, seed, angle):
    mounts, scans = random_mounts(sonars, seed), random_scans(sonars, seed=seed)
    c, s = np.cos(angle), np.sin(angle)
    turned = np.column_stack([mounts[:, :2] @ np.array([[c, s], [-s, c]]), mounts[:, 2] + angle])
    expected = traits_of(mounts, scans)
    np.testing.assert_allclose(traits_of(turned, scans), expected, atol=1e-5)
    np.testing.assert_allclose(traits_of(mounts * [1, -1, -1], scans), expected, atol=1e-5)


def test_traits_do_not_depend_on_the_poses():
    scans = random_scans(24)
    poses = np.random.default_rng(1).uniform(-5, 5, (len(scans), 3))
    np.testing.assert_array_equal(Memory(B21).take(poses, scans).traits, traits_of(B21, scans))


@pytest.mark.parametrize("silent", [1, 5, 50])
def test_scans_in_which_no_sonar_fired_leave_the_traits_at_their_last_value(silent):
    traits = traits_of(B21, [*random_scans(24), *np.full((silent, 24), nan)])
    assert np.ptp(traits[:30], axis=0).min() > 0.01
    # All that is known fades alike, until it counts no more than nothing at all.
    np.testing.assert_allclose(traits[30:], np.tile(traits[29], (silent, 1)), atol=1e-3)


def test_of_surroundings_of_which_nothing_is_known_the_traits_are_one_half():
    np.testing.assert_array_equal(traits_of(B21, np.full((3, 24), nan)), 0.5)
    np.testing.assert_allclose(after_many(B21[:1], [1.0]), [0, 0.5, 0.5, 1 / FAR_M], atol=1e-4)


LONG = 15_000
"""Frames of less than half an hour at 10 Hz; FADE to this power is no number of the machine's."""


def test_what_cannot_be_compared_stays_at_one_half_however_long_the_drive():
    assert FADE**LONG == 0
    assert after_many(B21[::6], [1.0] * 4, LONG)[agree] == pytest.approx(0.5)
    np.testing.assert_allclose(traits_of(B21, [[1.0] * 24, *np.full((LONG, 24), nan)])[-1], 0.5)


def test_the_share_of_no_echo_is_of_the_sonars_that_fired():
    scan = np.full(24, 1.0)
    scan[:6], scan[6:12] = inf, nan
    assert after_many(B21, scan)[no_echo] == pytest.approx(6 / 18, abs=1e-4)
    assert after_many(B21, np.full(24, inf))[no_echo] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("off", [0.0, SAME_M / 4, SAME_M / 2, SAME_M, 3 * SAME_M])
def test_neighbours_agree_by_how_near_their_readings_are(off):
    traits = after_many(PAIR, [1.0, 1.0 + off])
    assert traits[agree] == pytest.approx(max(1 - off / SAME_M, 0), abs=1e-4)
    assert traits[apart] == pytest.approx(off, abs=1e-4)


def test_sonars_that_look_different_ways_are_not_compared():
    opposite = np.array([[0.1, 0, 0], [-0.1, 0, pi]])
    for other in (1.0, 3.0):
        np.testing.assert_allclose(after_many(opposite, [1.0, other])[[agree, apart]], 0.5, atol=1e-6)


def test_beyond_the_far_range_all_readings_are_alike():
    near_by = [after_many(PAIR, [1.0, reading])[[apart, far]] for reading in (FAR_M, FAR_M + 1, 9.0, inf)]
    for one, other in pairwise(near_by):
        np.testing.assert_allclose(one, other, atol=1e-6)
    assert after_many(PAIR, [inf, inf])[far] == pytest.approx(1, abs=1e-4)
    assert after_many(PAIR, [1.0, 2.0])[far] == pytest.approx(1.5 / FAR_M, abs=1e-4)


def test_no_echo_neither_agrees_nor_disagrees_but_lies_far():
    traits = after_many(PAIR, [1.0, inf])
    assert traits[agree] == pytest.approx(0.5)
    assert traits[apart] == pytest.approx(1, abs=1e-4)


def test_an_earlier_scan_fades():
    first, second = np.full(24, inf), np.full(24, 1.0)
    shares = traits_of(B21, [first] * 400 + [second] * 10)[-10:, no_echo]
    np.testing.assert_allclose(shares, FADE ** np.arange(1, 11), atol=1e-3)


RING = np.column_stack([np.zeros((12, 2)), np.arange(12) * pi / 6])


def in_turn(groups, rounds):
    """Readings of a ring of which one group of sonars fires after the other."""
    scan, sonar = np.indices((groups * rounds, 12))
    return np.where(scan % groups == sonar % groups, 1.0, nan)


def weights_at(scans, mounts=RING, poses=None):
    poses = np.tile(ORIGIN, (len(scans), 1)) if poses is None else poses
    return Memory(mounts).take(poses, np.array(scans, dtype=float)).weight


@pytest.mark.parametrize("groups", [2, 3, 4, 6])
def test_sonars_that_fire_in_turn_have_looked_once_when_all_have_fired(groups):
    weight = weights_at(in_turn(groups, 20))
    # No part of the first whole scan repeats another.
    np.testing.assert_array_equal(weight[:groups], 1)
    # After so many rounds a part counts what a whole scan would.
    np.testing.assert_allclose(weight[groups - 1 :: groups], 1 / np.arange(1, 21), rtol=1e-6)
    assert np.all(np.diff(weight) <= 1e-9)
    # So a sonar counts in all what it counts where all fire together, but for what parts within a round differ.
    for group in range(groups):
        total, whole = weight[group::groups].sum(), np.sum(1 / np.arange(1, 21))
        assert whole - 1e-6 <= total < whole + 1


@settings(max_examples=40)
@given(st.lists(st.integers(0, 12), min_size=1, max_size=30), st.integers(0, 1000))
def test_a_scan_counts_what_came_before_by_the_share_of_the_sonars_that_fired(fired, seed):
    rng = np.random.default_rng(seed)
    scans = np.full((len(fired), 12), nan)
    for row, count in zip(scans, fired, strict=True):
        row[rng.permutation(12)[:count]] = rng.choice([1.0, inf])
    expected = 1 / np.maximum(np.cumsum(fired) / 12, 1)
    np.testing.assert_allclose(weights_at(scans), expected, rtol=1e-5)


def test_scans_in_which_no_sonar_fired_count_nothing_of_what_comes_after():
    scans = np.ones((4, 12))
    scans[:3] = nan
    np.testing.assert_array_equal(weights_at(scans), 1)


def test_sonars_that_are_not_there_do_not_fire():
    mounts = np.pad(RING, [(0, 12), (0, 0)], constant_values=nan)
    scans = np.ones((9, 24))
    scans[:, 12:] = nan
    np.testing.assert_array_equal(weights_at(scans, mounts), weights_at(scans[:, :12]))
    np.testing.assert_allclose(weights_at(scans, mounts), 1 / np.arange(1, 10), rtol=1e-6)
