"""Poses are found scan by scan, on the shipped sample whose odometry is made to drift."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from commands import SAMPLE
from echogrid import Mapper, Robot, load_log
from echogrid.errors import UsageError
from echogrid.geometry import compose, inverse
from echogrid.metrics import trajectory_error
from echogrid.position.drive import MatchEdge
from echogrid.position.forgetting import handed_on
from echogrid.position.graph import Edges, residuals
from echogrid.position.online import STOOD, OnlineSlam
from echogrid.position.remapping import Remapping
from experiments.studies.position.odometry import Odometry

B21 = Robot.load("b21")
FRAMES = list(load_log(SAMPLE, B21))
TRUTH = np.array([frame.pose for frame in FRAMES])
STILL = 135
"""A scan at which the robot does not turn."""


def posed(poses):
    return [replace(frame, pose=pose) for frame, pose in zip(FRAMES, poses, strict=True)]


@cache
def drifting():
    return posed(Odometry().times(2).of(TRUTH, np.random.default_rng(3)))


@pytest.fixture
def finder():
    made = OnlineSlam(B21)
    yield made
    made.close()


def driven(finder, frames):
    """The poses as they were known when each scan came, what waits being placed before the next."""
    poses = []
    for frame in frames:
        finder.add(frame)
        finder.wait()
        poses.append(finder.pose)
    return np.array(poses)


def error(poses, truth=TRUTH):
    return trajectory_error(poses, truth).aligned_rms_m


@pytest.mark.unchecked
def test_odometry_that_drifts_is_brought_back_while_the_robot_drives(finder):
    told = np.array([frame.pose for frame in drifting()])
    then = driven(finder, drifting())
    in_the_end = np.array([frame.pose for frame in finder.scans()])
    assert error(told) > 0.5
    assert error(then) < 0.3 * error(told)
    assert len(in_the_end) == len(FRAMES)
    assert error(in_the_end) < 0.2
    assert finder.graph.loops
    assert not finder.jumps


def test_the_correction_is_where_the_frame_of_the_odometry_lies_in_the_map(finder):
    np.testing.assert_array_equal(finder.correction, 0)
    for frame in drifting()[:200]:
        pose = finder.add(frame)
        np.testing.assert_allclose(compose(finder.correction, frame.pose), pose, atol=1e-9)
    finder.wait()
    assert np.hypot(*finder.correction[:2]) > 0.01


def test_good_odometry_is_not_spoilt(finder):
    assert error(driven(finder, FRAMES)) < 0.04


def test_scans_come_no_later_for_what_is_placed_beside_them(finder):
    """Nothing of what a piece costs is paid where scans are taken: 250 of them wait for no piece."""
    for frame in drifting()[:250]:
        finder.add(frame)
    assert finder.graph is None or finder.graph.taken < finder.kept / 2
    finder.wait()
    assert finder.graph.taken > 0.9 * finder.kept


def test_odometry_that_starts_anew_is_one_drive(finder):
    anew = posed(np.concatenate([TRUTH[:STILL], compose(inverse(TRUTH[STILL]), TRUTH[STILL:])]))
    then = driven(finder, anew[:250])
    assert [(jump.stamp, jump.anew) for jump in finder.jumps] == [(FRAMES[STILL].stamp, False)]
    assert finder.drives == 0
    assert error(then, TRUTH[:250]) < 0.1


@pytest.mark.parametrize("at", [20, STILL])
def test_a_base_that_was_restarted_is_so_though_it_was_silent_for_long(finder, at):
    """However near to where it began it stands, and though a robot could have driven back in that time."""
    anew = posed(np.concatenate([TRUTH[:at], compose(inverse(TRUTH[at]), TRUTH[at:])]))
    anew = [*anew[:at], *(replace(frame, stamp=frame.stamp + 5.0) for frame in anew[at:])]
    then = driven(finder, anew[: at + 60])
    assert [(jump.stamp, jump.anew) for jump in finder.jumps] == [(FRAMES[at].stamp + 5.0, False)]
    assert error(then, TRUTH[: at + 60]) < 0.1


def test_a_robot_that_was_not_heard_on_its_way_home_is_where_its_odometry_says(finder):
    there = np.array([0.9, 0.3, 0.2])
    for stamp, pose in [(0.0, np.zeros(3)), (0.1, there), (6.1, np.array([0.05, 0.04, 0.1]))]:
        last = finder.add(replace(FRAMES[0], stamp=stamp, pose=pose))
    assert not finder.jumps
    np.testing.assert_allclose(last, [0.05, 0.04, 0.1], atol=1e-6)


def test_a_drive_that_is_played_again_begins_anew(finder):
    driven(finder, drifting()[:100])
    assert finder.graph is not None
    finder.add(drifting()[0])
    assert finder.drives == 1
    assert finder.jumps[-1].anew
    assert finder.graph is None
    np.testing.assert_array_equal(finder.pose, drifting()[0].pose)
    driven(finder, drifting()[1:60])
    assert finder.kept == 60


def test_a_clock_that_is_set_back_while_the_robot_goes_on_is_no_jump(finder):
    late = [replace(frame, stamp=frame.stamp - 3600) for frame in drifting()[60:120]]
    driven(finder, [*drifting()[:60], *late])
    assert not finder.jumps
    assert finder.kept == 120


def test_who_stands_keeps_few_scans(finder):
    for k in range(1000):
        finder.add(replace(FRAMES[0], stamp=0.1 * k))
    assert finder.kept == STOOD + 1
    np.testing.assert_array_equal(finder.pose, FRAMES[0].pose)


def test_a_robot_that_gets_more_sonars_goes_on(finder):
    few = replace(B21, mounts=B21.mounts[:12])
    online = OnlineSlam(few)
    driven(online, [replace(frame, ranges=frame.ranges[:12]) for frame in FRAMES[:120]])
    online.equip(B21)
    driven(online, FRAMES[120:240])
    assert error(np.array([frame.pose for frame in online.scans()]), TRUTH[:240]) < 0.1
    online.close()


@pytest.mark.unchecked
def test_a_long_drive_is_forgotten_where_others_saw_the_same_and_stays_right(finder, monkeypatch):
    monkeypatch.setattr("echogrid.position.growing.MOST_PIECES", 60)
    monkeypatch.setattr("echogrid.position.growing.FORGOTTEN", 12)
    monkeypatch.setattr("echogrid.position.forgetting.RECENT", 20)
    then = driven(finder, drifting())
    graph = finder.graph
    assert len(graph.cut) <= 60
    assert graph.taken > len(graph.frames) == graph.cut[-1].end
    at = np.searchsorted([frame.stamp for frame in FRAMES], [frame.stamp for frame in graph.frames])
    assert error(graph.frame_poses(), TRUTH[at]) < 0.2
    assert np.hypot(*(then - TRUTH)[-100:, :2].T).max() < 0.5


def test_what_is_handed_on_is_as_far_off_as_before(finder):
    rng = np.random.default_rng(0)
    poses = rng.uniform(-2, 2, (4, 3))
    seen = compose(inverse(poses[1]), poses[2])
    root = rng.normal(size=(3, 3))
    edge = MatchEdge(1, 2, compose(seen, np.array([0.002, -0.001, 0.003])), root @ root.T, True)
    pose, information = handed_on(edge, poses, 0, 3)
    ends = ((1, 2, edge.pose, edge.information), (0, 3, pose, information))
    one, other = (
        Edges(np.array([a]), np.array([b]), measured[None], told[None], np.array([np.inf]))
        for a, b, measured, told in ends
    )
    chi2 = [
        float(np.einsum("i,ij,j", off, edges.information[0], off))
        for edges in (one, other)
        for off in (residuals(poses, edges).off[0],)
    ]
    assert chi2[1] == pytest.approx(chi2[0], rel=0.02)


def test_a_scan_that_cannot_be_changes_nothing(finder):
    driven(finder, drifting()[:20])
    pose = finder.pose
    with pytest.raises(UsageError):
        finder.add(replace(FRAMES[20], ranges=np.zeros(3)))
    np.testing.assert_array_equal(finder.pose, pose)


def test_what_fails_beside_the_driving_is_raised(finder, monkeypatch):
    monkeypatch.setattr("echogrid.position.growing.Growing.extend", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        driven(finder, drifting()[:200])


@pytest.mark.unchecked
def test_the_map_is_made_anew_as_the_poses_say_now(finder):
    mapper, now = Mapper(B21), 0.0
    remapping, renewed = Remapping(finder, Mapper), 0
    for frame in drifting()[:300]:
        pose = finder.add(frame)
        finder.wait()
        placed = replace(frame, pose=pose)
        mapper.add([placed])
        remapping.note(placed)
        if remapping._making is not None:
            remapping._making.thread.join()
        now += 0.1
        if (made := remapping.renewed(B21, now)) is not None:
            mapper, renewed = made.mapper, renewed + 1
            path = np.array([frame.pose[:2] for frame in finder.scans()])
            assert len(made.path) == len(path)
    assert 1 < renewed < 26  # no more often than once a second of the drive
    fresh = Mapper(B21)
    fresh.add(finder.scans())
    final = remapping.final(B21).mapper.grid()
    np.testing.assert_array_equal(final.log_odds, fresh.grid().log_odds)
    both = mapper.grid()
    cells = both.centre_of(np.argwhere(both.observed & (both.probability() > 0.65)))
    assert np.mean(final.probability_at(cells) > 0.35) > 0.9


def test_the_map_of_a_drive_that_is_over_goes_when_another_begins(finder):
    remapping = Remapping(finder, Mapper)
    driven(finder, drifting()[:100])
    finder.add(drifting()[0])
    made = remapping.renewed(B21, 0.0)
    assert made is not None
    np.testing.assert_array_equal(made.path, [drifting()[0].pose[:2]])
    one = Mapper(B21)
    one.add(drifting()[:1])
    np.testing.assert_array_equal(made.mapper.grid().log_odds, one.grid().log_odds)
