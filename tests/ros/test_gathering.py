from collections import Counter
from math import inf, isnan, nan, pi

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.geometry import compose, wrap
from echogrid.robot import Robot
from echogrid.ros import gathering as scans
from echogrid.ros.gathering import BACK, BACK_S, LATE, LONGEST_S, NO_POSE, PAUSE_S, REPEATED, SAME_M, SAME_RAD, Scans
from echogrid.ros.sonars import robot_of
from echogrid.ros.transforms import Transforms

B21 = Robot.load("b21")
FLAT = (0.0, 0.0, 0.0, 1.0)
few = settings(max_examples=60)


def robot(sonars):
    return robot_of("ring", B21.mounts[:sonars], [0.4], [(0.1, 5.0)])


def standing(sonars=4):
    """Scans of a robot whose pose is known at all times."""
    transforms = Transforms()
    transforms.put("odom", "base", 0.0, (1, 2, 0), FLAT, static=True)
    return Scans(robot(sonars), transforms, "odom", "base")


def turned(yaw):
    return (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))


def fed(gathered, readings):
    """Frames of (sonar, stamp, range) as they come; which were taken."""
    frames, taken = [], []
    for sonar, stamp, value in readings:
        if gathered.add(sonar, stamp, value) is None:
            taken.append((sonar, stamp, value))
        frames += gathered.frames()
    return [*frames, *gathered.frames(final=True)], taken


def ring(sonars, scans, period, width, first=0, start=0.0):
    """Sonars that fire one after another within ``width`` of each period, from one of them on."""
    fired = [(k, start + n * period + k * width / sonars) for n in range(scans) for k in range(sonars)]
    return [(sonar, stamp, 1.0 + 1e-4 * i) for i, (sonar, stamp) in enumerate(fired[first:])]


def held(frame):
    return {number: value for number, value in enumerate(frame.ranges.tolist()) if not isnan(value)}


@st.composite
def messages(draw):
    """Readings of a ring that is not what it should be: late, twice, lost, silent for a while, out of order."""
    sonars = draw(st.integers(1, 5))
    period = draw(st.sampled_from([0.05, 0.1, 0.5, 1.5]))
    width = period * draw(st.sampled_from([0.0, 0.3, 0.9, 1.0]))
    said = ring(sonars, draw(st.integers(1, 12)), period, width, first=draw(st.integers(0, sonars - 1)))
    out = []
    for each in said:
        match draw(st.sampled_from(["as it is"] * 8 + ["lost", "twice", "late", "old", "later"])):
            case "lost":
                continue
            case "twice":
                out += [each, each]
            case "late":
                out.insert(max(0, len(out) - draw(st.integers(1, 3))), each)
            case "old":
                out.append((each[0], each[1] - draw(st.sampled_from([0.01, 0.4, 3.0])), each[2]))
            case "later":
                out.append((each[0], each[1] + draw(st.sampled_from([0.01, 0.4, 3.0])), each[2]))
            case _:
                out.append(each)
    return sonars, out


@given(messages())
@few
def test_each_reading_that_is_taken_is_in_exactly_one_frame(case):
    sonars, said = case
    gathered = standing(sonars)
    frames, taken = fed(gathered, said)
    assert sum(gathered.dropped.values()) == len(said) - len(taken)
    assert Counter((n, value) for frame in frames for n, value in held(frame).items()) == Counter(
        (sonar, value) for sonar, _, value in taken
    )


@given(messages())
@few
def test_frames_keep_the_order_of_time_and_no_frame_is_long(case):
    sonars, said = case
    frames, taken = fed(standing(sonars), said)
    stamp_of = {(sonar, value): stamp for sonar, stamp, value in taken}
    assert [frame.stamp for frame in frames] == sorted(frame.stamp for frame in frames)
    last = {}
    for frame in frames:
        stamps = {n: stamp_of[n, value] for n, value in held(frame).items()}
        assert stamps, "a frame without a reading"
        assert max(stamps.values()) <= frame.stamp
        assert max(stamps.values()) - min(stamps.values()) <= 2 * LONGEST_S
        for number, stamp in stamps.items():
            assert stamp > last.get(number, -inf), "a sonar's readings keep their order"
            last[number] = stamp


@given(
    st.integers(2, 8),
    st.sampled_from([0.04, 0.1, 0.5, 1.2]),
    st.sampled_from([0.0, 0.1, 0.25, 1.0]),
    st.integers(0, 7),
)
@few
def test_a_start_in_the_middle_heals(sonars, period, width, first):
    frames, taken = fed(standing(sonars), ring(sonars, 12, period, width * period, first % sonars))
    stamp_of = {(sonar, value): stamp for sonar, stamp, value in taken}
    for frame in frames[3:-1]:
        assert len(held(frame)) == sonars
        stamps = [stamp_of[each] for each in held(frame).items()]
        assert max(stamps) - min(stamps) <= max(width, (sonars - 1) / sonars * width) * period + 1e-9


def test_a_scan_is_there_as_soon_as_its_last_sonar_was_heard():
    gathered = standing(3)
    for sonar, stamp, value in ring(3, 5, 0.1, 0.03):
        gathered.add(sonar, stamp, value)
        assert gathered.pending == (sonar == 2)
        assert len(list(gathered.frames())) == (sonar == 2)


def test_a_sonar_that_fell_silent_is_waited_for_a_while_and_then_no_more():
    gathered = standing(3)
    said = [each for each in ring(3, 60, 0.1, 0.03) if each[0] != 1 or not 1.0 < each[1] < 4.0]
    late = []
    for sonar, stamp, value in said:
        gathered.add(sonar, stamp, value)
        if gathered.pending and sonar == 2:
            late.append(stamp)
        for frame in gathered.frames():
            assert stamp - frame.stamp <= 0.1, "no scan waits longer than for the next"
        assert gathered.silent() == ([1] if 1.915 < stamp < 4.005 else [])  # last heard at 0.91
    assert [stamp for stamp in late if 2.3 < stamp < 3.9], "without it scans are whole again"
    assert not gathered.silent()
    assert sum(gathered.dropped.values()) == 0


def test_a_sonar_that_was_never_heard_does_not_hold_up_the_others():
    gathered = standing(4)
    frames = [
        (stamp, frame)
        for sonar, stamp, value in ring(4, 40, 0.1, 0.04)
        if sonar != 3 and gathered.add(sonar, stamp, value) is None
        for frame in gathered.frames()
    ]
    assert gathered.silent() == [3]
    assert all(stamp - frame.stamp < 0.1 for stamp, frame in frames)
    assert len(frames) >= 38
    assert all(len(held(frame)) == 3 for _, frame in frames)


def test_slow_sonars_are_not_taken_for_silent():
    gathered = standing(2)
    frames, _ = fed(gathered, ring(2, 8, 1.6, 0.1))
    assert [len(held(frame)) for frame in frames] == [2] * 8


def test_sonars_of_different_rates_lose_nothing():
    said = sorted(
        [(0, 0.1 * n, 1 + 1e-3 * n) for n in range(50)] + [(1, 0.25 * n + 0.01, 2 + 1e-3 * n) for n in range(20)],
        key=lambda each: each[1],
    )
    frames, taken = fed(standing(2), said)
    assert len(taken) == 70
    assert sum(len(held(frame)) for frame in frames) == 70


def test_what_is_late_or_comes_twice_or_back_is_told_apart():
    gathered = standing(2)
    assert gathered.add(0, 10.0, 1.0) is None
    assert gathered.add(0, 10.0, 1.0) == REPEATED
    assert gathered.add(0, 9.9, 1.0) == LATE
    assert gathered.add(0, 10.0 - BACK_S - 0.1, 1.0) == BACK
    assert gathered.add(1, 9.0, 1.0) is None, "another sonar has a time of its own"
    assert gathered.dropped == {REPEATED: 1, LATE: 1, BACK: 1}


def test_readings_far_apart_in_time_are_no_one_scan():
    frames, _ = fed(standing(3), [(0, 0.0, 1.0), (1, 0.01, 2.0), (2, LONGEST_S + 0.1, 3.0)])
    assert [held(frame) for frame in frames] == [{0: 1.0, 1: 2.0}, {2: 3.0}]


def test_no_echo_and_not_valid_come_through_as_they_are():
    frames, _ = fed(standing(3), [(0, 0.0, inf), (1, 0.0, nan), (2, 0.0, 2.0)])
    np.testing.assert_array_equal(frames[0].ranges, [inf, nan, 2.0])
    assert frames[0].mounts is None
    np.testing.assert_allclose(frames[0].pose, [1, 2, 0])


def driving(speed, turn, until=3.0, step=0.05):
    """A robot that drives a circle, its pose told every ``step``, and where it is at a time."""
    transforms = Transforms()

    def pose(stamp):
        if abs(turn) < 1e-9:
            return np.array([speed * stamp, 0.0, 0.0])
        return np.array(
            [speed / turn * np.sin(turn * stamp), speed / turn * (1 - np.cos(turn * stamp)), turn * stamp]
        )

    for stamp in np.arange(0.0, until + step, step):
        x, y, yaw = pose(stamp)
        transforms.put("odom", "base", float(stamp), (x, y, 0.0), turned(yaw))
    return transforms, pose


@given(st.floats(-1.0, 1.0), st.floats(-1.5, 1.5), st.sampled_from([0.0, 0.06, 0.4]))
@settings(max_examples=25)
def test_each_sonar_looks_from_where_it_was_when_it_fired(speed, turn, width):
    transforms, pose = driving(speed, turn)
    shape = robot(8)
    frames, taken = fed(Scans(shape, transforms, "odom", "base"), ring(8, 5, 0.5, width, start=0.2))
    stamp_of = {(sonar, value): stamp for sonar, stamp, value in taken}
    assert len(frames) == 5
    for frame in frames:
        stamps = {n: stamp_of[n, value] for n, value in held(frame).items()}
        assert frame.stamp == max(stamps.values())
        mounts = shape.mounts if frame.mounts is None else frame.mounts
        # Between two poses the robot is taken to go straight.
        sag = abs(turn * speed) * 0.05**2 / 4 + 1e-6
        near = (SAME_M + sag, SAME_RAD + 1e-6) if frame.mounts is None else (sag, 1e-6)
        for number, stamp in stamps.items():
            found = compose(frame.pose, mounts[number])
            expected = compose(pose(stamp), shape.mounts[number])
            assert np.hypot(*(found - expected)[:2]) <= near[0] * 2
            assert abs(wrap(found[2] - expected[2])) <= near[1] * 2
    moved = abs(speed) * width > 0.02 or abs(turn) * width > 0.05
    assert all((frame.mounts is not None) is moved for frame in frames) or not moved


def test_sonars_that_fire_at_once_share_the_pose_of_that_time():
    transforms, pose = driving(0.5, 1.0)
    frames, _ = fed(Scans(robot(4), transforms, "odom", "base"), ring(4, 3, 0.5, 0.0, start=0.3))
    assert [frame.mounts for frame in frames] == [None] * 3
    for frame in frames:
        np.testing.assert_allclose(frame.pose, pose(frame.stamp), atol=1e-3)


def test_a_scan_waits_for_its_pose():
    transforms = Transforms()
    gathered = Scans(robot(2), transforms, "odom", "base")
    for number in range(4):
        for sonar in range(2):
            gathered.add(sonar, 0.1 * number, 1.0)
    assert not list(gathered.frames())
    transforms.put("odom", "base", 0.0, (0, 0, 0), FLAT)
    transforms.put("odom", "base", 0.15, (1, 0, 0), FLAT)
    assert [frame.stamp for frame in gathered.frames()] == [0.0, 0.1]
    assert gathered.pending == 2
    assert [frame.stamp for frame in gathered.frames(reach=0.1, final=True)] == [0.2]
    assert gathered.dropped == {}  # 0.15 s after the last pose


@given(st.floats(-3.0, 3.0))
@few
def test_scans_without_a_pose_are_counted_but_for_those_just_outside_of_all_poses(outside):
    transforms = Transforms()
    for stamp in (10.0, 11.0, 14.0, 15.0):  # from 11 to 14 s nobody knows
        transforms.put("odom", "base", stamp, (stamp, 0, 0), FLAT)
    gathered = Scans(robot(1), transforms, "odom", "base")
    at = 10.0 + outside if outside < 0 else 15.0 + outside
    stamps = sorted({10.5, 11.05, 12.0, 13.95, 14.5, at})
    for stamp in stamps:
        gathered.add(0, stamp, 1.0)
    placed = len(list(gathered.frames(final=True)))
    assert placed == 2 + (at in (10.0, 15.0))
    assert gathered.dropped[NO_POSE] == 3 + (at < 9.5 or at > 15.5)


def test_a_scan_from_before_the_first_pose_is_left_out_at_once():
    transforms = Transforms()
    gathered = Scans(robot(1), transforms, "odom", "base")
    gathered.add(0, 1.0, 1.0)
    transforms.put("odom", "base", 5.0, (0, 0, 0), FLAT)
    gathered.add(0, 5.0, 2.0)
    assert [frame.ranges[0] for frame in gathered.frames()] == [2.0]
    assert gathered.dropped == {NO_POSE: 1}


def test_scans_do_not_wait_for_ever_nor_without_number(monkeypatch):
    gathered = Scans(robot(1), Transforms(), "odom", "base")
    for number in range(400):
        gathered.add(0, 0.2 * number, 1.0)
        assert not list(gathered.frames())
    assert gathered.pending <= PAUSE_S / 0.2 + 2
    assert gathered.pending + gathered.dropped[NO_POSE] == 400
    monkeypatch.setattr(scans, "WAITING", 50)
    gathered = Scans(robot(1), Transforms(), "odom", "base")
    for number in range(400):
        gathered.add(0, 0.001 * number, 1.0)
    assert gathered.pending == 50
    assert gathered.dropped == {NO_POSE: 350}


def test_the_heading_of_a_scan_is_that_of_the_robot_on_a_slope():
    transforms = Transforms()
    transforms.put("odom", "base", 0.0, (1, 2, 3), (0.0, np.sin(0.05), 0.0, np.cos(0.05)))
    transforms.put("base", "sonar", 0.0, (0, 0, 0), turned(pi / 2), static=True)
    gathered = Scans(robot(1), transforms, "odom", "base")
    gathered.add(0, 0.0, 1.0)
    (frame,) = gathered.frames(final=True)
    np.testing.assert_allclose(frame.pose, [1, 2, 0], atol=1e-12)
