"""Scans in which a part of the sonars fired are completed with what the others heard just before."""

from dataclasses import replace
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.mapping.build import build_map
from echogrid.metrics import score
from echogrid.models.networks.memory import RECENT_FRAMES, RECENT_M, RECENT_RAD, RECENT_S, Memory, Recent
from echogrid.robot import Robot
from echogrid.simulation.drive import tour, truth_of
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import World

RING = np.column_stack(
    [0.2 * np.cos(np.arange(6) * pi / 3), 0.2 * np.sin(np.arange(6) * pi / 3), np.arange(6) * pi / 3]
)


def wandering(count, seed=0, step=0.02):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(0, [step, step, 0.02], (count, 3)), axis=0)


def of_turns(groups, poses, seed=0, mounts=None):
    """Frames of which each has the readings of one group of sonars."""
    rng = np.random.default_rng(seed)
    heard = rng.uniform(0.3, 3, (len(poses), 6))
    heard[rng.random(heard.shape) < 0.2] = inf
    quiet = (np.arange(len(poses))[:, None] - np.arange(6)) % groups != 0
    ranges = np.where(quiet, nan, heard)
    return [
        Frame(0.1 * i, pose, row, mounts=None if mounts is None else mounts[i])
        for i, (pose, row) in enumerate(zip(poses, ranges, strict=True))
    ]


def completed(frames, mounts=RING):
    return Recent(mounts).completed(frames)


def test_scans_in_which_all_fired_are_left_as_they_are():
    frames = [replace(frame, ranges=np.arange(1.0, 7.0)) for frame in of_turns(1, wandering(20))]
    whole, new = completed(frames)
    assert all(a is b for a, b in zip(whole, frames, strict=True))
    np.testing.assert_array_equal(new, 1)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([2, 3, 6]), st.integers(0, 99), st.booleans())
def test_a_silent_sonar_hears_what_it_last_heard_from_where_that_was(groups, seed, moved):
    poses = wandering(30, seed)
    own = RING + np.random.default_rng(seed).normal(0, 0.05, (30, 6, 3)) if moved else None
    frames = of_turns(groups, poses, seed, own)
    whole, new = completed(frames)
    np.testing.assert_allclose(new[groups - 1 :], 1 / groups)
    for i in range(groups - 1, 30):
        for sonar in range(6):
            last = max(k for k in range(i + 1) if not np.isnan(frames[k].ranges[sonar]))
            looked = RING if own is None else own[last]
            assert whole[i].ranges[sonar] == frames[last].ranges[sonar]
            np.testing.assert_allclose(
                compose(whole[i].pose, whole[i].mounts[sonar]), compose(poses[last], looked[sonar]), atol=1e-9
            )
        assert frames[i].mounts is (None if own is None else frames[i].mounts)
    assert np.isnan(whole[0].ranges).sum() == 6 - 6 // groups


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 99), st.integers(1, 29))
def test_how_scans_are_handed_over_makes_no_difference(seed, cut):
    frames = of_turns(3, wandering(30, seed), seed)
    whole, new = completed(frames)
    recent = Recent(RING)
    parts = [recent.completed(part) for part in (frames[:cut], frames[cut:])]
    for a, b in zip(whole, [*parts[0][0], *parts[1][0]], strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges)
    np.testing.assert_array_equal(new, np.concatenate([parts[0][1], parts[1][1]]))


@pytest.mark.parametrize(
    ("moved", "later", "taken"),
    [
        ([0.9 * RECENT_M, 0, 0], 0.1, True),
        ([0, 1.1 * RECENT_M, 0], 0.1, False),
        ([0, 0, 0.9 * RECENT_RAD], 0.1, True),
        ([0, 0, -1.1 * RECENT_RAD], 0.1, False),
        ([0, 0, 0], 0.9 * RECENT_S, True),
        ([0, 0, 0], 1.1 * RECENT_S, False),
    ],
)
def test_what_was_heard_elsewhere_or_long_ago_is_not_taken(moved, later, taken):
    some, others = np.array([1.0, 2, 3, nan, nan, nan]), np.array([nan, nan, nan, 4.0, 5, 6])
    start = np.array([3.0, -2.0, pi - 0.05])
    pose = start + np.array(moved)
    whole, new = completed([Frame(5.0, start, some), Frame(5.0 + later, pose, others)])
    assert np.isnan(whole[1].ranges).sum() == (0 if taken else 3)
    assert new[1] == (0.5 if taken else 1.0)
    assert (whole[1].mounts is None) == (not taken)


def test_a_sonar_that_fell_silent_is_not_heard_for_ever():
    ranges = np.ones(6)
    frames = [Frame(0.01 * i, np.zeros(3), np.where(np.arange(6) < 5, ranges, nan)) for i in range(40)]
    frames[0] = replace(frames[0], ranges=ranges)
    whole, _ = completed(frames)
    assert not np.isnan(whole[RECENT_FRAMES].ranges).any()
    assert np.isnan(whole[RECENT_FRAMES + 1].ranges[5])


def test_a_sonar_that_is_not_there_is_not_waited_for():
    mounts = np.concatenate([RING, np.full((2, 3), nan)])
    frame = Frame(0.0, np.zeros(3), np.array([*range(1, 7), nan, nan], dtype=float))
    whole, new = completed([frame, frame], mounts)
    assert whole[1] is frame
    np.testing.assert_array_equal(new, 1)


def test_readings_that_are_repeated_do_not_count_again():
    """A robot that stands has looked once when each of its sonars has fired."""
    poses = np.tile([0.05, 0.05, 0.1], (60, 1))
    frames = of_turns(3, poses)
    whole, new = completed(frames)
    weight = Memory(RING).take(poses, np.array([f.ranges for f in whole]), None, new).weight
    rounds = weight.reshape(20, 3).sum(axis=1)
    np.testing.assert_allclose(rounds[3:], 1 / np.arange(4, 21), rtol=0.15)
    assert rounds[0] <= 2


def test_sonars_that_fire_in_turn_show_more_than_each_alone_would(monkeypatch):
    world, robot = World.load("corridor"), Robot.load("b21")
    poses = tour(world, robot.footprint_radius_m + 0.1)[:240]
    truth = truth_of(world, poses)
    sonar = np.arange(robot.sonars)
    frames = list(Simulator(world, robot).frames(poses, seed=1))
    turns = [replace(f, ranges=np.where((sonar - i) % 4 == 0, f.ranges, nan)) for i, f in enumerate(frames)]

    def scores():
        return score(list(build_map(turns, robot))[-1], truth)

    together = scores()
    monkeypatch.setattr(Recent, "completed", lambda self, frames: (frames, np.ones(len(frames))))
    alone = scores()
    assert together.nll < 0.8 * alone.nll
    assert together.found > alone.found
