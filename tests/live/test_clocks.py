from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.live.clocks import APART_S, LEAPS, Clock, Offset, Stamps
from echogrid.live.hearing import Heard
from live_drive import START_S, range_of, tf, transform


def offset(ahead_s, period_s, rate=1.0, seconds=12.0, pause=(0.0, 0.0), delay_s=0.0):
    """The offset of a topic that is sent at a period, whose clock runs ``rate`` times as fast; nothing is heard in a
    pause, and all of it after.
    """
    found = Offset()
    for sent in np.arange(0.0, seconds, period_s / rate):
        came = sent + delay_s
        found.add(START_S + rate * sent + ahead_s, pause[1] if pause[0] <= came < pause[1] else came)
    return found


@given(
    ahead_s=st.floats(-9, 9),
    periods=st.tuples(st.sampled_from([0.02, 0.05, 0.1, 0.3]), st.sampled_from([0.05, 0.1, 0.25])),
    rate=st.sampled_from([0.5, 1.0, 2.0, 4.0]),
    start=st.floats(0, 6),
    length=st.floats(0, 4),
)
def test_how_far_two_clocks_are_apart_is_told_whatever_the_rate_and_the_pauses(ahead_s, periods, rate, start, length):
    pause = start, start + length
    one, other = offset(ahead_s, periods[0], rate, pause=pause), offset(0.0, periods[1], rate, pause=pause)
    assert np.median(one.ahead_of(other)) == pytest.approx(ahead_s, abs=max(periods) + 1e-3)


def test_the_last_second_is_not_judged_before_it_is_over():
    assert len(offset(3.0, 0.1, seconds=4.0).ahead_of(offset(0.0, 0.1, seconds=4.0))) == 3


def test_the_clock_is_that_of_the_poses_whichever_comes_first():
    for poses_first in (False, True):
        clock = Clock()
        for i in range(50):
            stamps = [(True, START_S + 0.1 * i), *[(False, 5.0 + 0.1 * i)] * 24]
            for pose, stamp in stamps if poses_first else stamps[::-1]:
                clock.admit(stamp, pose)
        assert clock.newest == pytest.approx(START_S + 4.9)


@given(st.lists(st.sampled_from([True, False]), min_size=LEAPS, max_size=LEAPS))
def test_a_clock_jumps_with_the_poses_alone(kinds):
    clock = Clock()
    clock.admit(START_S, pose=True)
    jumped = [clock.admit(5.0 + 0.01 * i, pose) for i, pose in enumerate(kinds)]
    assert (True in jumped) == any(kinds)


def stamps_of(nanoseconds, kept=None, period_s=0.1):
    """What is wrong with a topic whose messages say these times, ns since 0, while poses tell START_S."""
    clock = Clock()
    stamps = Stamps(clock)
    for i, ns in enumerate(nanoseconds):
        clock.admit(START_S + period_s * i, pose=True)
        stamp = SimpleNamespace(sec=int(ns // 10**9), nanosec=int(ns % 10**9))
        stamps.reading("/s", "sonar", (kept or (lambda s: s))(stamp), period_s * i)
    return list(stamps.useless())


TIMES = [int((START_S + 0.1 * i) * 1e9) for i in range(100)]


def unit(divisor):
    return lambda stamp: SimpleNamespace(sec=stamp.sec, nanosec=stamp.nanosec // divisor)


@pytest.mark.parametrize(
    ("times", "kept", "why"),
    [
        ([ns - 990 * 10**9 for ns in TIMES], None, "990 s behind those of tf"),
        ([ns + 12 * 10**9 for ns in TIMES], None, "12 s ahead of those of tf"),
        ([TIMES[0]] * 100, None, "that do not go on"),
        (TIMES, unit(10**9), "that do not go on"),
        (TIMES, unit(10**3), "nanosec are in another unit"),
        (TIMES, unit(10**6), "nanosec are in another unit"),
        (TIMES, lambda s: SimpleNamespace(sec=s.sec, nanosec=s.nanosec + 10**9), "nanosec past 999999999"),
    ],
)
def test_stamps_of_no_use_are_told_by_what_is_wrong_with_them(times, kept, why):
    (said,) = stamps_of(times, kept)
    assert why in said


@pytest.mark.parametrize("apart_ns", [0, -(10**9), 9 * 10**8, 8 * 10**9])
def test_stamps_that_tell_readings_apart_are_taken(apart_ns):
    assert stamps_of([ns + apart_ns for ns in TIMES]) == []
    assert stamps_of(sorted(TIMES * 2), period_s=0.05) == []
    once_a_second = [int((START_S + i) * 1e9) for i in range(100)]  # as of a simulation
    assert stamps_of(once_a_second, period_s=1.0) == []
    assert stamps_of([0] * 100) == []


def play(drive, seconds, ahead_s, number=4):
    """A drive in which the stamps of some sonars lie ahead of those of tf."""
    for _ in range(round(seconds * 10)):
        drive.pose(x=0.1 * drive.time)
        for i in range(4):
            stamp = START_S + drive.time + (ahead_s if i < number else 0.0)
            drive.take(Heard.RANGE, f"/s{i}", range_of(stamp, f"sonar_{i}", 1.0 + 0.1 * i))
        drive.step()
    drive.live.finish()
    drive.notices += drive.live.notices()
    return [notice for notice in drive.notices if "those of tf" in notice]


@pytest.mark.parametrize("ahead_s", [3.0, -3.0, 1.0, -8.0])
@pytest.mark.parametrize("number", [1, 4])
def test_sonars_whose_clock_is_not_that_of_tf_are_told_and_brought_to_it(drive, ahead_s, number):
    (said,) = play(drive, 15, ahead_s, number)
    topics = "/s* (4 of them)" if number == 4 else "/s0"
    assert said.startswith(
        f"{topics}: stamps {abs(ahead_s):g} s {'ahead of' if ahead_s > 0 else 'behind'} those of tf"
    )
    assert said in drive.live.snapshot().settings["notes"]
    assert len(drive.frames) == pytest.approx(150, abs=2)
    for frame in drive.frames:
        assert frame.pose[0] == pytest.approx(0.1 * (frame.stamp - START_S), abs=1e-6)
        assert np.isfinite(frame.ranges).all() or frame is drive.frames[0]


@pytest.mark.parametrize("ahead_s", [3.0, -3.0])
def test_a_clock_that_is_set_wrong_in_mid_drive_is_brought_back(drive, ahead_s):
    play(drive, 20, 0.0)
    (said,) = play(drive, 30, ahead_s)
    assert f"3 s {'ahead of' if ahead_s > 0 else 'behind'} those of tf" in said
    late = [frame for frame in drive.frames if frame.stamp > START_S + 40]
    assert len(late) > 80
    for frame in late:
        assert frame.pose[0] == pytest.approx(0.1 * (frame.stamp - START_S), abs=0.011)


def test_stamps_that_stray_are_told_and_left(drive):
    for step in range(300):
        drive.pose(x=0.1 * drive.time)
        drive.ranges([1.0] * 4, START_S + drive.time - 1.0 - 0.8 * (step // 20 % 2))
        drive.step()
    (said,) = [notice for notice in drive.notices if "those of tf" in notice]
    assert "now more, now less" in said


@pytest.mark.parametrize("ahead_s", [0.0, 0.3, -0.4])
def test_sonars_of_the_clock_of_tf_are_not_told_of(drive, ahead_s):
    assert abs(ahead_s) < APART_S
    assert play(drive, 15, ahead_s) == []


@pytest.mark.parametrize("number", [2, 4])
def test_sonars_that_count_since_boot_are_told_and_taken_by_the_time_of_receipt(drive, number):
    (said,) = play(drive, 30, 7.0 - START_S, number)
    topics = "/s*" if number == 4 else "/s0, /s1"
    assert said.startswith(topics)
    assert "993 s behind those of tf; taken by the time of receipt" in said
    assert drive.mapper.robot.sonars == 4
    late = [frame for frame in drive.frames if frame.stamp > START_S + 20]
    assert len(late) > 90
    for frame in late:
        np.testing.assert_allclose(frame.ranges, [1.0, 1.1, 1.2, 1.3])
        assert frame.pose[0] == pytest.approx(0.1 * (frame.stamp - START_S), abs=0.011)


def test_a_correction_that_is_dated_ahead_is_no_clock(drive):
    for _ in range(150):
        stamp = START_S + drive.time
        drive.take(Heard.TF, "/tf", tf(transform(stamp + 1.0, "map", "odom", 1.0, 0.0, 0.0)))
        drive.pose()
        drive.ranges([1.0] * 4)
        drive.step()
    assert not [notice for notice in drive.notices if "stamps" in notice]
