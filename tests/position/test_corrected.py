"""Poses are found from ranges and odometry that drifts: laws on the shipped sample, a drive whose poses are true."""

import re
from copy import copy
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from commands import SAMPLE
from echogrid import Frame, Log, Robot, load_log, slam
from echogrid.errors import InputError, UsageError
from echogrid.geometry import compose, inverse
from echogrid.metrics import trajectory_error
from echogrid.position import motion
from echogrid.position.contradictions import Compared
from echogrid.position.corrected import LEAST_SONARS, _alone, _loose, _slipped, at_odds, stretched
from echogrid.position.drive import Drive, MatchEdge
from echogrid.position.graph import Edges
from echogrid.position.slam import Found
from experiments.studies.position.odometry import Odometry

B21 = Robot.load("b21")
FRAMES = list(load_log(SAMPLE, B21))
TRUTH = np.array([frame.pose for frame in FRAMES])


def posed(poses):
    return [replace(frame, pose=pose) for frame, pose in zip(FRAMES, poses, strict=True)]


@cache
def drifting(seed=3):
    return Odometry().times(2).of(TRUTH, np.random.default_rng(seed))


@cache
def found():
    return slam(Log.of(posed(drifting())), B21)


SHORT = 260


@cache
def found_of_less():
    return slam(Log.of(posed(drifting())[:SHORT]), B21)


def test_good_odometry_is_not_spoilt():
    drive = slam(Log.of(FRAMES), B21)
    assert trajectory_error(drive.poses, TRUTH).aligned_rms_m < 0.03


@pytest.mark.unchecked
@pytest.mark.parametrize(("seed", "share"), [(1, 0.3), (3, 0.2)])
def test_odometry_that_drifts_is_brought_back(seed, share):
    drive = found() if seed == 3 else slam(Log.of(posed(drifting(seed))), B21)
    told, now = (trajectory_error(poses, TRUTH).aligned_rms_m for poses in (drive.odometry, drive.poses))
    assert now < share * told
    assert now < 0.15


def test_the_first_pose_and_what_the_log_said_stay():
    drive = found()
    np.testing.assert_allclose(drive.poses[0], drifting()[0], atol=1e-9)
    np.testing.assert_array_equal(drive.odometry, drifting())
    frames = list(drive.log)
    np.testing.assert_array_equal([frame.pose for frame in frames], drive.poses)
    np.testing.assert_array_equal([frame.odom for frame in frames], drive.odometry)
    np.testing.assert_array_equal([frame.ranges for frame in frames], [frame.ranges for frame in FRAMES])
    assert drive.stamps.tolist() == [frame.stamp for frame in FRAMES]
    assert all(0 <= i < len(FRAMES) and 0 <= j < len(FRAMES) for i, j in drive.loops)
    assert drive.loops


@pytest.mark.unchecked
def test_where_the_log_begins_does_not_matter():
    to = np.array([40.0, -7.0, 2.0])
    moved = slam(Log.of(posed(compose(to, drifting()))[:SHORT]), B21)
    # What differs in the last bit makes other cells, and other points are chosen from them.
    assert trajectory_error(compose(inverse(to), moved.poses), found_of_less().poses).aligned_rms_m < 0.06


@pytest.mark.slow
def test_a_mirrored_drive_has_the_mirrored_trajectory():
    mirror = np.array([1.0, -1.0, -1.0])
    drive = slam(Log.of(posed(drifting() * mirror)[:SHORT]), replace(B21, mounts=B21.mounts * mirror))
    assert trajectory_error(drive.poses * mirror, found_of_less().poses).aligned_rms_m < 0.06


def test_found_again_it_is_the_same_to_the_last_bit():
    again = slam(Log.of(posed(drifting())[:SHORT]), B21)
    np.testing.assert_array_equal(again.poses, found_of_less().poses)
    assert again.loops == found_of_less().loops


@pytest.mark.unchecked
def test_odometry_that_starts_anew_half_way_is_one_drive():
    anew = np.concatenate([TRUTH[:300], compose(inverse(TRUTH[300]), TRUTH[300:])])
    drive = slam(Log.of(posed(anew)), B21)
    assert trajectory_error(drive.poses, TRUTH).aligned_rms_m < 0.1
    (note,) = [note for note in drive.notes if "anew" in note]
    assert "starts anew at 0 at 60.00 s" in note


@pytest.mark.unchecked
def test_a_robot_that_stands_for_a_minute_is_where_it_stood():
    stood = [replace(FRAMES[0], stamp=FRAMES[0].stamp - 60 + i / 10) for i in range(600)]
    drive = slam(Log.of(stood + FRAMES[:SHORT]), B21)
    assert np.ptp(drive.poses[:600], axis=0).max() < 0.02
    assert trajectory_error(drive.poses[600:], TRUTH[:SHORT]).aligned_rms_m < 0.06


@pytest.mark.parametrize(
    ("frames", "note"),
    [
        (FRAMES[:1], "one scan: no poses to find"),
        ([replace(frame, pose=TRUTH[0]) for frame in FRAMES], "the robot never gets farther than 0.00 m"),
        ([replace(frame, ranges=np.full(24, np.inf)) for frame in FRAMES], "no sonar heard an echo: nothing"),
        ([replace(frame, ranges=np.full(24, np.nan)) for frame in FRAMES], "no sonar heard an echo: nothing"),
    ],
)
def test_where_there_is_nothing_to_find_the_odometry_stays_and_that_is_told(frames, note):
    drive = slam(Log.of(frames), B21)
    np.testing.assert_array_equal(drive.poses, [frame.pose for frame in frames])
    assert drive.found is None
    assert [told for told in drive.notes if told.startswith(note)]


@pytest.mark.unchecked
def test_a_long_way_without_an_echo_is_told():
    deaf = [replace(frame, ranges=np.full(24, np.inf)) for frame in FRAMES[100:SHORT]]
    drive = slam(Log.of(FRAMES[:100] + deaf), B21)
    assert np.isfinite(drive.poses).all()
    assert any(note.startswith("no sonar heard an echo for 8.0 m, from 19.80 to 51.80 s") for note in drive.notes)


def test_progress_comes_to_its_end():
    seen = []
    slam(Log.of(FRAMES[:80]), B21, lambda done, of: seen.append((done, of)))
    assert all(0 <= done <= of for done, of in seen)
    assert not seen or seen[-1][0] == seen[-1][1]


def test_what_is_no_odometry_is_refused_in_one_line():
    with pytest.raises(InputError, match="found no frames, expected at least one"):
        slam(Log.of([]), B21)
    with pytest.raises(
        InputError, match=r"found \d+% of the steps of the odometry faster than 10 m/s, expected poses"
    ):
        slam(Log.of(posed(TRUTH * [1000, 1000, 1])), B21)
    few = replace(B21, mounts=B21.mounts[: LEAST_SONARS - 1])
    with pytest.raises(InputError, match=r"found 3 sonars, expected at least 4 to find poses by"):
        slam([Frame(0.0, np.zeros(3), np.ones(3))], few)
    with pytest.raises(UsageError, match=r"frame 1 .*found x = nan"):
        slam(posed(TRUTH * np.where(np.arange(521)[:, None] == 1, np.nan, 1.0)), B21)


def laps(gap_m, loops, alike=0, against=0):
    """What is found of two laps on one line of 20 m, so far beside each other, whose walls lie so to each other."""
    x = np.concatenate([np.arange(0, 20, 0.5), np.arange(20, 0, -0.5)])
    nodes = np.column_stack([x, np.where(np.arange(80) < 40, 0.0, gap_m), np.zeros(80)])
    none = np.zeros(0, dtype=int)
    edges = Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    together = Compared(*np.outer([20, alike, against], np.ones(80, dtype=int)))
    matches = [MatchEdge(a, b, np.zeros(3), np.eye(3), True) for a, b in loops]
    drive = cast(Drive, SimpleNamespace(count=80, poses=nodes, matches=matches))
    loose = Drive.loose(drive, together)
    return Found(nodes, nodes, np.arange(80), edges, loops, np.zeros(3), together, loose)


def test_laps_beside_each_other_that_nothing_ties_are_told():
    far = [(0, 79)]
    (note,) = _loose(laps(1.0, far))
    assert re.search(r"nothing ties them: walls may be double there \(longest, \d+\.\d m, from x ", note)
    assert _loose(laps(5.0, far)) == {}
    assert _loose(laps(1.0, [(i, 79 - i) for i in range(0, 40, 4)])) == {}
    assert _loose(laps(1.0, far, alike=18)) == {}
    # One wall of a corridor may be that of the corridor beside it.
    assert _loose(laps(1.0, far, alike=10)) != {}
    # That there is no loop at all is told otherwise.
    assert _loose(laps(1.0, [])) == {}


def odds(drive):
    return at_odds(drive.poses, drive.together)


def test_laps_whose_walls_contradict_each_other_are_told():
    (note,) = odds(laps(1.0, [], alike=12, against=8))
    where = r"walls are double there \(longest, 40\.1 m, from x 0\.0, y 0\.0 m\)"
    assert re.search(rf"^along 40\.1 m of the drive .* free floor: {where}, or something was moved", note)
    assert odds(laps(1.0, [], alike=20, against=8)) == {}
    assert odds(laps(1.0, [], alike=2, against=2)) == {}


@pytest.mark.unchecked
@pytest.mark.parametrize(("since", "share"), [(0.3, 2.0), (0.6, 0.0)])
def test_wheels_that_slip_are_told_of(since, share):
    """For 2 m they tell of no way, or of twice as much: what cannot be mended is told, and where."""
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(TRUTH[:, :2], axis=0).T)))
    slips = (way[1:] > since * way[-1]) & (way[1:] <= since * way[-1] + 2.0)
    step = motion.steps(drifting(1))
    step[slips, :2] *= share
    drive = slam(Log.of(posed(motion.chained(TRUTH[0], step))), B21)
    assert trajectory_error(drive.poses, TRUTH).aligned_rms_m < 0.1 or any(
        "wheels slip there" in note or "walls are double" in note for note in drive.notes
    )


def test_it_is_told_where_odometry_is_off_what_was_seen():
    drive = laps(5.0, [])
    short = drive.poses - [[0.7, 0, 0]] * (np.arange(80) >= 20)[:, None]
    (note,) = _slipped(replace(drive, odometry=short))
    assert note.startswith("odometry is off what was seen by 0.7 m in 2 m of way, from x 8.0, y 0.0 m on")
    assert _slipped(drive) == {}
    # A scale that is known to be wrong is not told of.
    scale = np.array([1 / 0.7 - 1, 0, 0])
    assert _slipped(replace(drive, odometry=drive.poses * [0.7, 0.7, 1], drift=scale)) == {}
    assert _slipped(replace(drive, odometry=drive.poses * [0.7, 0.7, 1])) != {}


def test_a_map_of_another_size_than_odometry_makes_it_is_told():
    (note,) = stretched(np.array([-0.153, 0.0, 0.0]))
    assert note.startswith("what was seen makes all ways 15% shorter than the odometry says: drive one that")
    assert note.endswith("the map is too small")
    (note,) = stretched(np.array([0.12, 0.0, 0.0]))
    assert "12% longer" in note
    assert note.endswith("the map is too large")
    assert stretched(np.array([0.06, 0.03, -0.1])) == {}


@pytest.mark.unchecked
def test_a_robot_that_is_carried_is_told_of():
    """Without a jump in the odometry: what it sees then stands where there was free floor."""
    on = np.arange(len(TRUTH)) >= 300
    carried = np.where(on[:, None], compose(TRUTH[299], compose(inverse(TRUTH[400]), TRUTH)), TRUTH)
    frames = [replace(frame, pose=pose) for frame, pose in zip(FRAMES, carried, strict=True)]
    drive = slam(Log.of(frames[:300] + frames[400:]), B21)
    assert trajectory_error(drive.poses, np.delete(TRUTH, range(300, 400), axis=0)).aligned_rms_m < 0.1 or any(
        "walls" in note or "no place was seen twice" in note for note in drive.notes
    )


def test_a_long_drive_without_a_loop_is_told():
    drive = laps(5.0, [])
    half = drive.poses * [0.5, 0.5, 1]
    assert _alone(replace(drive, poses=half, odometry=half)) == {}
    # What was moved far is told of in a short drive too.
    assert _alone(replace(drive, poses=half)) != {}
    far = drive
    assert [note for note in _alone(far) if note.startswith("no place was seen twice")]
    assert _alone(replace(far, loops=[(0, 79)])) == {}


@cache
def without_loops():
    """A drive that was placed by odometry and the chain of its scans alone, from odometry four times as bad."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("echogrid.position.drive.LOOPS", 0)
        poses = Odometry().times(4).of(TRUTH, np.random.default_rng(5))
        drive = Drive(posed(poses), poses, B21)
        for k in range(1, drive.count):
            drive.place(k)
    return drive


def own(drive):
    """A copy that may be changed."""
    other = copy(drive)
    other.matches, other.poses = list(drive.matches), drive.poses.copy()
    return other


def off(drive):
    at = [piece.middle for piece in drive.cut]
    return trajectory_error(drive.poses, TRUTH[at]).aligned_rms_m


@pytest.mark.unchecked
def test_what_contradicts_itself_is_looked_at_once_more():
    drive = own(without_loops())
    before, against = off(drive), drive.compared().against.sum()
    assert drive.compared().doubtful.any()
    drive.reconcile()
    assert drive.compared().against.sum() < 0.5 * against
    assert off(drive) < 0.7 * before


def test_a_look_that_brings_less_together_is_undone(monkeypatch):
    drive = Drive(FRAMES[:SHORT], TRUTH[:SHORT], B21)
    for k in range(1, drive.count):
        drive.place(k)
    poses, balance = drive.poses.copy(), drive.compared().balance

    def torn(self, k, _, later=False):
        self.matches.append(MatchEdge(0, k, np.array([k, 0.0, 0.0]), np.eye(3) * 1e4, True))

    monkeypatch.setattr(Drive, "_close_loops", torn)
    monkeypatch.setattr("echogrid.position.drive.KERNEL", np.inf)
    monkeypatch.setattr("echogrid.position.contradictions.MOST_SHARE", -1.0)
    assert drive.compared().doubtful.any()
    drive.reconcile()
    assert drive.compared().balance == pytest.approx(balance, rel=0.02)
    np.testing.assert_allclose(drive.poses, poses, atol=0.05)


def contradicting(count, pieces):
    """What was seen at so many of some pieces stands on floor that others saw."""
    alike, against = np.full(pieces, 40), np.zeros(pieces, dtype=int)
    alike[:count], against[:count] = 0, 40
    return Compared(np.full(pieces, 40), alike, against)


def test_loops_that_do_not_agree_or_settle_nothing_are_none():
    drive = own(without_loops())
    before, now = contradicting(40, drive.count), contradicting(8, drive.count)

    def loops(wrong):
        """Ten, of which so many lie 3 m from where the poses are."""
        to = compose(inverse(drive.poses[0]), drive.poses[30:40])
        to[:wrong, 0] += 3.0
        return [MatchEdge(0, 30 + k, pose, np.eye(3) * 400, True) for k, pose in enumerate(to)]

    assert drive._settled(loops(0), before, now)
    assert drive._settled(loops(3), before, now)
    assert not drive._settled(loops(4), before, now)
    assert not drive._settled(loops(0), before, contradicting(36, drive.count))


def test_no_pose_is_doubted_farther_than_odometry_can_have_drifted():
    drive, most = without_loops(), np.array([0.4, 0.4, np.deg2rad(6)])
    for j in (0, 20, 50):
        near, far = (np.sqrt(np.diag(drive._doubted(j, k, most))) for k in (j + 4, drive.count - 1))
        assert np.all(near[:2] < 0.2)
        assert np.all(far <= most + 1e-9)
        assert np.all(near < far + 1e-9)
        assert np.all(far > 0.5 * most)
