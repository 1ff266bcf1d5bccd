import numpy as np
import pytest
from numpy import inf

from echogrid.live.hearing import Heard
from live_drive import MOUNTS, START_S, Drive, range_of, tf, transform


def test_scans_reach_the_map_with_their_poses_and_none_is_lost_at_the_start(drive):
    drive.run(40)
    assert drive.notices[0].startswith("mapping in odom with 4 sonars of base_link: sonar_0, ")
    assert len(drive.frames) == drive.live.scans == 40
    assert drive.live.readings == 160
    for i, frame in enumerate(drive.frames):
        assert frame.stamp == pytest.approx(START_S + 0.1 * i)
        np.testing.assert_allclose(frame.pose, [0.01 * i, 0, 0], atol=1e-9)
        np.testing.assert_array_equal(frame.ranges, [1.0, 2.0, inf, 0.5])
    np.testing.assert_allclose(drive.mapper.robot.mounts, MOUNTS, atol=1e-12)
    assert not drive.live.refused


def test_readings_of_one_scan_in_any_order_are_one_scan(drive):
    drive.run(40)
    drive.pose(x=0.1 * drive.time)
    for i in (3, 0, 2, 1):
        drive.take(Heard.RANGE, f"/s{i}", range_of(START_S + drive.time - 0.001 * i, f"sonar_{i}", 1.0))
    drive.step()
    assert len(drive.frames) == 41
    np.testing.assert_array_equal(drive.frames[-1].ranges, 1.0)


def test_a_scan_waits_for_its_pose_and_no_longer_than_it_must(drive):
    drive.run(40)
    drive.ranges([1.0] * 4)
    drive.step()
    assert len(drive.frames) == 40  # its pose may come
    for _ in range(3):
        drive.ranges([1.0] * 4)
        drive.step()
    assert len(drive.frames) > 40  # it did not: the robot is taken to go on
    np.testing.assert_allclose(drive.frames[40].pose, [0.4, 0, 0], atol=1e-9)


def test_a_sonar_without_a_place_is_left_out_and_joins_when_it_has_one(live):
    drive = Drive(live, MOUNTS[:3])
    drive.mounts = MOUNTS
    drive.run(60)
    assert drive.mapper.robot.sonars == 3
    assert live.refused["a reading of a sonar that is new, or whose place is not known"] > 0
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(30)
    assert drive.notices[-1] == "new: sonar_3"
    assert drive.mapper.robot.sonars == 4
    np.testing.assert_array_equal(drive.frames[-1].ranges, [1.0, 2.0, inf, 0.5])


@pytest.mark.parametrize("lack", ["its place", "its readings"])
def test_a_sonar_that_turns_up_soon_after_the_others_is_in_the_map_from_the_start(live, lack):
    drive = Drive(live, MOUNTS if lack == "its readings" else MOUNTS[:3])
    drive.mounts = MOUNTS
    drive.run(10, (1.0, 2.0, inf, None if lack == "its readings" else 0.5))
    assert drive.mapper.robot.sonars == 3
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(40)
    assert drive.notices[1] == "new: sonar_3; the map begins anew with what all heard"
    assert drive.notices[2].startswith("mapping in odom with 4 sonars")
    assert len(drive.notices) == 3
    assert len(drive.frames) == live.scans == 50
    assert not drive.mapper.before
    assert not live.refused
    missed = 10 if lack == "its readings" else 0
    assert live.readings == 200 - missed
    fourth = np.array([frame.ranges[3] for frame in drive.frames])
    assert np.isnan(fourth[:missed]).all()
    np.testing.assert_array_equal(fourth[missed:], 0.5)


def test_a_frame_to_map_in_that_comes_late_is_told_of(drive):
    drive.run(40)
    drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "map", "odom", 5.0, 0.0, 0.0)))
    drive.run(40)
    assert drive.notices.count("there is map now; to map in it rather than in odom, start again") == 1
    assert len(drive.frames) == 80
    assert drive.pictures[-1].frame == "odom"


def test_scans_that_wait_are_mapped_before_a_sonar_joins(live):
    drive = Drive(live, MOUNTS[:3])
    drive.mounts = MOUNTS
    drive.run(40)
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    for _ in range(60):  # so many at once that they have to wait
        for _ in range(30):
            drive.pose()
            drive.ranges((1.0, 2.0, inf, 0.5))
            drive.time = round(drive.time + 0.02, 6)
        drive.step()
    before = drive.mapper.before
    assert all(len(frame.ranges) == 3 for frame in before)
    assert all(len(frame.ranges) == 4 for frame in drive.frames)
    assert len(before) + len(drive.frames) == live.scans


def test_a_drive_that_is_over_before_it_is_sure_that_all_sonars_were_heard_is_mapped(drive):
    drive.run(2)
    assert not drive.live.scans
    for _ in range(40):  # nothing comes any more; the robot does not stop for that
        drive.step()
    assert drive.live.scans == 2
    assert drive.pictures
    assert any(notice.startswith("silent: ") for notice in drive.notices)


def test_mapping_begins_when_no_further_sonar_can_be_waited_for(drive):
    drive.run(4)
    assert drive.live.scans == 4


@pytest.mark.parametrize("doubtful", ["a clock 3 s behind", "a topic without a sonar"])
def test_mapping_begins_later_where_something_is_doubtful(drive, doubtful):
    for _ in range(10):
        drive.pose()
        drive.ranges((1.0, 2.0, inf, 0.5), START_S + drive.time - 3.0 * (doubtful == "a clock 3 s behind"))
        if doubtful == "a topic without a sonar":
            drive.take(Heard.RANGE, "/other", range_of(START_S - 500.0, "other", 1.0))
        drive.step()
    assert not any(notice.startswith("mapping in") for notice in drive.notices)


def test_a_frame_to_map_in_that_comes_soon_is_mapped_in(drive):
    drive.run(10)
    assert drive.notices[-1].startswith("mapping in odom")
    drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "map", "odom", 5.0, 0.0, 0.0)))
    drive.run(40)
    assert drive.notices[1] == "there is map now: the map begins anew in it, not in odom"
    assert drive.notices[2].startswith("mapping in map")
    assert drive.frames[-1].pose[0] > 5
