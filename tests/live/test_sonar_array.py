import numpy as np

from echogrid.live.hearing import Heard
from echogrid.live.live_map import Settings
from echogrid.live.session import Live
from echogrid.ros.gathering import REPEATED
from echogrid.ros.messages import Choice
from live_drive import NETWORK, START_S, Drive, range_of, tf, transform


def test_the_array_has_the_order_of_the_names(live):
    drive = Drive(live, [(0.1, 0.0, 0.1 * i) for i in range(12)])
    drive.run(30, [1.0] * 12)
    assert list(live.snapshot().settings["sonars"]) == [f"sonar_{i}" for i in range(12)]


def test_a_silent_sonar_is_told_of_once_and_so_is_its_return(drive):
    drive.run(40)
    drive.run(50, (1.0, 2.0, None, 0.5))
    assert [n for n in drive.notices if n.startswith("silent")] == [
        "silent: sonar_2; what they look at is left as it is"
    ]
    assert "silent: sonar_2" in drive.live.status()
    drive.run(40)
    assert [n for n in drive.notices if n.startswith("back")] == ["back: sonar_2"]
    assert sum("silent" in n for n in drive.notices) == 1
    without = [frame for frame in drive.frames if np.isnan(frame.ranges[2])]
    assert len(without) == 50
    assert all(np.isfinite(frame.ranges[[0, 1, 3]]).all() for frame in without)


def test_silence_of_all_sonars_is_told(drive):
    drive.run(40)
    for _ in range(50):
        drive.pose(x=4.0)
        drive.step()
    assert sum(n.startswith("silent: sonar_0, sonar_1, sonar_2, sonar_3") for n in drive.notices) == 1


def test_map_is_preferred_and_the_user_chooses(recorded):
    for fixed, expected in ((None, "map"), ("odom", "odom")):
        live = Live(NETWORK, Settings(Choice(fixed=fixed)))
        drive = Drive(live)
        drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "map", "odom", 1.0, 2.0, 0.0)))
        drive.run(30)
        assert drive.pictures[-1].frame == expected
        np.testing.assert_allclose(drive.frames[0].pose, [1, 2, 0] if fixed is None else [0, 0, 0], atol=1e-9)


def test_what_is_missing_is_said(live):
    assert live.status() == "heard no sensor_msgs/Range yet"
    live.take(Heard.RANGE, "/s0", range_of(START_S, "sonar_0", 1.0), 0.0)
    assert live.status() == "heard sonar_0, but no transform of them (/tf_static)"
    drive = Drive(live)
    assert "no pose of the robot" in live.status()
    drive.run(30)
    assert live.status() == "30 scans of 4 sonars in odom; not taken: 1 x " + REPEATED


def test_a_frame_that_is_put_in_between_later_is_followed(drive):
    drive.run(40)
    for _ in range(40):
        stamp = START_S + drive.time
        drive.take(Heard.TF, "/tf", tf(transform(stamp, "base_footprint", "base_link", 0.0, 0.0, 0.0)))
        drive.take(Heard.TF, "/tf", tf(transform(stamp, "odom", "base_footprint", 0.5, 0.0, 0.0)))
        drive.ranges([1.0] * 4)
        drive.step()
    assert len(drive.frames) >= 65
    np.testing.assert_allclose(drive.frames[-1].pose, [0.5, 0, 0], atol=1e-9)
