"""What a sonar tells ends at its own range, whatever the network says."""

from dataclasses import replace
from functools import cache
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.errors import DoubtWarning
from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.mapping.build import build_map
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import sensor_model
from echogrid.models.networks import set_core
from echogrid.models.networks.set_core import BEARINGS, REACH_M, RING_M, ends_within
from echogrid.models.networks.set_layers import initial
from echogrid.robot import Robot, preset_names

B21 = Robot.load("b21")
SCANS, MOST, POINTS, FOOTPRINT_M, BEAM_RAD = 3, 10, 4000, 0.1, 0.4


@cache
def talkative():
    """A network that has something to say of every point."""
    rng = np.random.default_rng(5)
    weights = {name: value + rng.normal(0, 0.3, value.shape) for name, value in initial(rng, 8).items()}
    return set_core.network(weights, None)


def drawn(seed, sonars, least):
    """An array of sonars of their own ranges, at least ``least`` past the robot's middle, and scans of it."""
    rng = np.random.default_rng(seed)
    mounts = np.column_stack([rng.uniform(-0.3, 0.3, (sonars, 2)), rng.uniform(-pi, pi, sonars)])
    longest = np.exp(rng.uniform(np.log(0.1), np.log(4.0), sonars))
    longest = np.maximum(longest, least + np.hypot(*mounts[:, :2].T))
    ranges = longest * rng.uniform(0.05, 1.0, (SCANS, sonars))
    ranges[rng.random(ranges.shape) < 0.4] = inf
    ranges[rng.random(ranges.shape) < 0.3] = nan
    return mounts, longest, ranges


def told(mounts, longest, ranges, points, moved):
    """Evidence of each scan for points [n, 2]."""
    elsewhere = mounts + np.array([0.2, -0.1, 1.0]) if moved else mounts
    array = set_core.sonar_array(elsewhere, longest, FOOTPRINT_M, BEAM_RAD, True)
    return seen(array, ranges, points, np.tile(mounts, (SCANS, 1, 1)) if moved else None)


def seen(array, ranges, points, mounts=None):
    x, y = (np.tile(v.astype(np.float32), (SCANS, 1)) for v in points.T)
    traits = np.full((SCANS, 4), 0.4, np.float32)
    return talkative().tables(array, ranges.astype(np.float32), traits, mounts).at(x, y)


def scattered(seed):
    rng = np.random.default_rng(seed)
    distance, bearing = REACH_M * np.sqrt(rng.random(POINTS)), rng.uniform(-pi, pi, POINTS)
    return np.stack([distance * np.cos(bearing), distance * np.sin(bearing)], axis=-1)


def left_of(mounts, longest, points):
    """How much of each sonar's range is left at points (m), and how far these lie off its axis: [n, sonars]."""
    x, y = np.moveaxis(points[:, None] - mounts[:, :2], -1, 0)
    return longest - np.hypot(x, y), np.abs(wrap(np.arctan2(y, x) - mounts[:, 2]))


arrays = st.tuples(st.integers(0, 2**32), st.integers(1, MOST), st.booleans())


@settings(max_examples=150, deadline=None)
@given(arrays)
def test_nothing_is_told_of_what_lies_past_the_range_of_all_sonars_that_fired(array):
    seed, sonars, moved = array
    mounts, longest, ranges = drawn(seed, sonars, least=0.02)
    points = scattered(seed)
    said = told(mounts, longest, ranges, points, moved)
    left, _ = left_of(mounts, longest, points)
    for reading, evidence in zip(ranges, said, strict=True):
        past = np.max(left, axis=1, where=~np.isnan(reading), initial=-9.0) < -1e-3
        past &= np.hypot(*points.T) > FOOTPRINT_M
        np.testing.assert_array_equal(evidence[past], 0.0)


@settings(max_examples=60, deadline=None)
@given(arrays)
def test_of_sonars_that_do_not_reach_the_middle_of_the_robot_hardly_more_is_told(array):
    """Between the near end of one and the far end of another rings and bearings of the local map are the limit."""
    seed, sonars, moved = array
    mounts, longest, ranges = drawn(seed, sonars, least=-9.0)
    points = scattered(seed)
    said = told(mounts, longest, ranges, points, moved)
    left, _ = left_of(mounts, longest, points)
    for reading, evidence in zip(ranges, said, strict=True):
        slack = 2 * RING_M + 2 * pi / BEARINGS * np.hypot(*points.T)
        past = np.max(left, axis=1, where=~np.isnan(reading), initial=-9.0) < -slack
        past &= np.hypot(*points.T) > FOOTPRINT_M
        np.testing.assert_array_equal(evidence[past], 0.0)


@settings(max_examples=60, deadline=None)
@given(st.tuples(st.integers(0, 2**32), st.integers(1, 6), st.booleans()))
def test_within_range_and_cone_something_is_told(array):
    seed, sonars, moved = array
    mounts, longest, ranges = drawn(seed, sonars, least=0.02)
    points = scattered(seed)
    said = told(mounts, longest, ranges, points, moved)
    left, off = left_of(mounts, longest, points)
    for reading, evidence in zip(ranges, said, strict=True):
        sure = np.any((left > RING_M) & (off < np.deg2rad(20)) & ~np.isnan(reading), axis=1)
        sure &= np.hypot(*points.T) < REACH_M - RING_M
        assert not sure.any() or np.mean(evidence[sure] != 0.0) > 0.95


def test_ranges_past_the_local_map_change_nothing():
    points = scattered(1)
    mounts, _, ranges = drawn(3, 8, least=0.0)
    arrays = (set_core.sonar_array(mounts, 3.5, FOOTPRINT_M, BEAM_RAD, ends) for ends in (False, True))
    alike, same = (seen(array, ranges, points) for array in arrays)
    np.testing.assert_allclose(alike, same, atol=1e-5)


@pytest.mark.parametrize("name", preset_names())
def test_the_presets_reach_past_the_local_map(name):
    robot = Robot.load(name)
    assert not ends_within(robot.mounts, robot.max_ranges_m)
    assert ends_within(robot.mounts, np.where(np.arange(robot.sonars) == 1, 0.9, robot.max_ranges_m))


CELL_M = 0.04
"""As the set network keeps its map: a larger cell is observed if a part of it is."""

POSES = np.array([[0.13 * i, 0.05 * i, 0.3 * i] for i in range(12)])


def mixed_robot():
    ring = np.array([[0.2 * np.cos(a), 0.2 * np.sin(a), a] for a in np.arange(8) * pi / 4])
    own = np.array([4.0, 0.9, 0.5, 0.9, 0.3, 1.2, 0.9, 0.5])
    return replace(B21, name="mixed", mounts=ring, max_range_m=4.0, own_max_ranges_m=own, min_range_m=0.02)


def drive(robot, moving, in_turn):
    rng = np.random.default_rng(2)
    for i, pose in enumerate(POSES):
        ranges = np.where(rng.random(robot.sonars) < 0.4, inf, rng.uniform(0.05, 0.95, robot.sonars))
        ranges = robot.clean(ranges)
        # The sonar of 4 m never fires: what reaches 0.3 to 1.2 m is alone.
        ranges[0] = nan
        if in_turn:
            ranges[np.arange(robot.sonars) % 3 != i % 3] = nan
        lag = np.array([[-0.02 * k, 0.01, -0.03 * k] for k in range(robot.sonars)])
        mounts = np.array([compose(a, b) for a, b in zip(lag, robot.mounts, strict=True)]) if moving else None
        yield Frame(0.1 * i, pose, ranges, mounts=mounts)


def nearest_end(frames, robot, points):
    """How much of a range is left at points, at most, over all sonars that fired; m."""
    most = np.full(len(points), -9.0)
    for frame in frames:
        mounts = robot.mounts if frame.mounts is None else frame.mounts
        placed = np.array([compose(frame.pose, mount) for mount in mounts])
        left, _ = left_of(placed, robot.max_ranges_m, points)
        most = np.maximum(most, np.max(left, axis=1, where=~np.isnan(frame.ranges), initial=-9.0))
    return most


@pytest.mark.parametrize("model", ["set-network", "network"])
@pytest.mark.parametrize("moving", [False, True], ids=["fixed", "moving"])
@pytest.mark.parametrize("in_turn", [False, True], ids=["together", "in turn"])
def test_a_map_knows_nothing_past_the_ranges_log_or_live(model, moving, in_turn):
    robot = mixed_robot()
    frames = list(drive(robot, moving, in_turn))
    *_, bulk = build_map(frames, robot, model, CELL_M)
    live = Mapper(robot, sensor_model(model), CELL_M)
    for frame in frames:
        live.add([frame])
    for grid in (bulk, live.grid()):
        every = np.argwhere(np.ones(grid.shape, dtype=bool))
        points, seen = grid.centre_of(every), grid.observed.ravel()
        stood = np.min(np.hypot(*(points[:, None] - POSES[:, :2]).T), axis=0) <= robot.footprint_radius_m + 1e-6
        left = nearest_end(frames, robot, points)
        past = (left < -1e-3) & ~stood
        assert not np.any(seen[past])
        assert np.all(grid.log_odds.ravel()[past] == 0.0)
        assert np.mean(seen[left > 0.1]) > (0.7 if in_turn or model == "network" else 0.9)


@pytest.mark.parametrize("model", ["set-network", "network"])
def test_an_array_that_is_unplugged_claims_no_floor_past_its_range(model):
    robot = replace(B21, max_range_m=0.5)
    frames = [Frame(0.1 * i, pose, np.full(robot.sonars, inf)) for i, pose in enumerate(POSES)]
    with pytest.warns(DoubtWarning, match="no sonar ever heard an echo"):
        *_, grid = build_map(frames, robot, model, CELL_M)
    points = grid.centre_of(np.argwhere(grid.observed))
    assert nearest_end(frames, robot, points).min() > -1e-3
    assert np.min(np.hypot(*(points[:, None] - POSES[:, :2]).T), axis=0).max() > robot.footprint_radius_m + 0.3


def test_sonars_that_looked_from_elsewhere_are_bound_there_though_the_robot_reaches_past_the_local_map():
    robot = replace(B21, max_range_m=2.8)
    assert not ends_within(robot.mounts, robot.max_ranges_m)
    lag = np.array([-0.6, 0.0, 0.0])
    mounts = np.array([compose(lag, mount) for mount in robot.mounts])
    frame = Frame(0.0, np.zeros(3), np.full(robot.sonars, inf), mounts=mounts)
    *_, grid = build_map([frame], robot, "set-network", CELL_M)
    left = nearest_end([frame], robot, grid.centre_of(np.argwhere(grid.observed)))
    assert left.min() > -1e-3
    assert left.max() > 2.0
