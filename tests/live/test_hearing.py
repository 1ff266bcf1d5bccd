from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import inf, nan

from echogrid.live import hearing, live_map
from echogrid.live.clocks import FAR_STAMP, LEAPS
from echogrid.live.hearing import Heard
from echogrid.live.live_map import Settings
from echogrid.live.session import Live
from echogrid.robot import MAX_SONARS
from echogrid.ros.gathering import LATE, REPEATED
from live_drive import NETWORK, START_S, Drive, Recorder, odometry, range_of, tf, transform, turned, xyz


def test_late_and_repeated_readings_are_counted_and_not_mapped(drive):
    drive.run(40)
    stamp = START_S + drive.time - 0.1
    drive.ranges([9.0, None, None, None], stamp)
    drive.ranges([None, 9.0, None, None], stamp - 0.2)
    drive.run(10)
    assert len(drive.frames) == 50
    assert all(frame.ranges[0] == 1.0 and frame.ranges[1] == 2.0 for frame in drive.frames)
    assert drive.live.refused == {REPEATED: 1, LATE: 1}


def test_one_stamp_of_another_clock_is_refused_and_many_are_a_clock_that_jumped(drive):
    drive.run(40)
    drive.take(Heard.RANGE, "/s0", range_of(2e9, "sonar_0", 3.0))
    drive.take(Heard.TF, "/tf", tf(transform(1.0, "odom", "base_link", 50, 50, 0)))
    drive.run(10)
    assert drive.live.refused[FAR_STAMP] == 2
    assert len(drive.frames) == 50
    drive.live._hearing.clock.newest += (
        500.0  # from here on the robot's clock is 500 s behind, as when a simulation restarts
    )
    drive.run(20)
    assert drive.live.refused["a clock that jumped"] == 1
    assert drive.live.refused[FAR_STAMP] == 2 + LEAPS - 1
    assert len(drive.frames) >= 50 + 20 - LEAPS // 5 - 2


def test_a_map_of_its_place_is_made_from_odometry_alone_and_from_its_first_topic(live):
    drive = Drive(live)
    for i in range(40):
        drive.take(Heard.ODOMETRY, "/odom", odometry(START_S + drive.time, 0.01 * i, 0.0, 0.0))
        drive.take(Heard.ODOMETRY, "/filtered", odometry(START_S + drive.time + 0.05, 30.0, 0.0, 0.0))
        drive.ranges([1.0] * 4)
        drive.step()
    np.testing.assert_allclose(
        [frame.pose for frame in drive.frames], [[0.01 * i, 0, 0] for i in range(40)], atol=1e-9
    )
    assert live.refused == {"odometry on a second topic": 40}


@pytest.mark.parametrize(
    ("heard", "message", "reason"),
    [
        (Heard.RANGE, range_of(START_S, "", 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(START_S, "x" * 1000, 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(START_S, "a\nb", 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(-5.0, "a", 1.0), "a stamp that cannot be"),
        (Heard.RANGE, range_of(0.0, "a", 1.0), "a reading without a stamp before any transform"),
        (Heard.RANGE, SimpleNamespace(), "a message that is no sensor_msgs/Range"),
        (Heard.TF, SimpleNamespace(transforms=[None]), "a message that is no tf2_msgs/TFMessage on /tf"),
        (Heard.TF, tf(transform(START_S, "odom", "b", nan, 0, 0)), "a transform that is not finite"),
        (Heard.TF, tf(transform(START_S, "b", "b", 0, 0, 0)), "a transform without two frames"),
        (
            Heard.STATIC,
            tf(transform(0, "a", "b", 0, 0, 0), transform(0, "b", "c", 0, 0, 0), transform(0, "c", "a", 0, 0, 0)),
            "a transform that closes a circle",
        ),
        (Heard.ODOMETRY, odometry(START_S, inf, 0, 0), "a transform that is not finite"),
    ],
)
def test_what_cannot_be_is_counted_by_its_reason(live, heard, message, reason):
    live.take(heard, "/t", message, 0.0)
    assert live.refused == {reason: 1}


def test_a_rotation_of_zero_is_refused(live):
    message = transform(START_S, "odom", "base_link", 0, 0, 0)
    message.transform.rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    live.take(Heard.TF, "/tf", tf(message), 0.0)
    assert live.refused == {"a rotation that is no unit quaternion": 1}


def test_thousands_of_frames_leave_memory_bounded_and_the_robot_heard(drive):
    drive.run(40)
    for i in range(5000):
        drive.take(Heard.RANGE, "/evil", range_of(START_S + drive.time, f"evil_{i}", 1.0))
        drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "odom", f"evil_{i}", 0, 0, 0)))
    drive.run(10)
    assert len(drive.frames) == 50
    assert len(drive.live._hearing.sonars) <= MAX_SONARS
    assert len(drive.live._hearing.transforms.children()) < 10
    assert sum(drive.live.refused.values()) == 5000


def test_what_waits_for_a_pose_is_bounded(live, monkeypatch):
    monkeypatch.setattr(hearing, "MAX_MOVES", 100)
    for i in range(1000):
        live.take(Heard.TF, "/tf", tf(transform(START_S + 1e-3 * i, "odom", "arm", 0, 0, 0)), 0.0)
        live.take(Heard.RANGE, "/s", range_of(START_S + 1e-3 * i, "sonar", 1.0), 0.0)
    assert len(live._hearing.transforms._edges["arm"].stamps) <= 101
    assert live._hearing._waiting.maxlen == hearing.MAX_WAITING


numbers = st.one_of(st.floats(width=32), st.floats(-3, 3), st.just(0.0))
stamps = st.builds(
    lambda sec, nanosec: SimpleNamespace(sec=sec, nanosec=nanosec),
    st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(1000, 1010)),
    st.one_of(st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1)),
)
names = st.one_of(st.sampled_from(["odom", "map", "base_link", "sonar_0", "sonar_1", "", "/", "/odom"]), st.text())
headers = st.builds(lambda stamp, name: SimpleNamespace(stamp=stamp, frame_id=name), stamps, names)
vectors = st.builds(xyz, numbers, numbers, numbers)
rotations = st.one_of(
    st.builds(turned, st.floats(-3, 3)),
    st.builds(lambda x, y, z, w: SimpleNamespace(x=x, y=y, z=z, w=w), numbers, numbers, numbers, numbers),
)
transforms = st.builds(
    lambda header, child, place, turn: SimpleNamespace(
        header=header, child_frame_id=child, transform=SimpleNamespace(translation=place, rotation=turn)
    ),
    headers,
    names,
    vectors,
    rotations,
)
junk = st.one_of(st.none(), st.integers(), st.text(), st.lists(st.none()), st.builds(SimpleNamespace))
messages = st.one_of(
    st.tuples(
        st.just(Heard.RANGE),
        st.builds(
            lambda header, fov, low, high, value: SimpleNamespace(
                header=header, field_of_view=fov, min_range=low, max_range=high, range=value
            ),
            headers,
            numbers,
            numbers,
            numbers,
            numbers,
        ),
    ),
    st.tuples(st.sampled_from([Heard.TF, Heard.STATIC]), st.builds(tf, transforms, transforms)),
    st.tuples(
        st.just(Heard.ODOMETRY),
        st.builds(
            lambda header, child, place, turn: SimpleNamespace(
                header=header,
                child_frame_id=child,
                pose=SimpleNamespace(pose=SimpleNamespace(position=place, orientation=turn)),
            ),
            headers,
            names,
            vectors,
            rotations,
        ),
    ),
    st.tuples(st.sampled_from(list(Heard)), junk),
)


@settings(max_examples=150, deadline=None)
@given(st.booleans(), st.lists(messages, max_size=60))
def test_strangers_do_no_harm(mapping, strange):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_map, "Mapper", Recorder)
        drive = Drive(Live(NETWORK, Settings()))
        if mapping:
            drive.run(25)
        for i, (heard, message) in enumerate(strange):
            drive.take(heard, "/strange", message)
            if i % 5 == 4:
                drive.run(1)
        drive.run(25)
        drive.live.finish()
        assert drive.live.status()
        assert all(reason.isprintable() for reason in drive.live.refused)
        if drive.live._map is not None:
            for frame in drive.frames:
                assert np.isfinite(frame.pose).all()
                assert not np.any(frame.ranges <= 0)
