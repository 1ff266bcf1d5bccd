from typing import Any

import numpy as np
import pytest

from echogrid.live.driving import Drives
from echogrid.live.hearing import Heard
from echogrid.live.live_map import MAX_CELLS, Settings
from echogrid.live.session import Live
from echogrid.mapping.mapper import Mapper
from echogrid.planning.nearby import Nearby
from echogrid.robot import Robot
from live_drive import MOUNTS, NETWORK, START_S, Drive, tf, transform

P3DX = Robot.load("p3dx")


def test_the_map_comes_once_a_second_if_it_changed_and_the_local_map_after_each_scan(drive):
    drive.run(71)
    maps = [picture for picture in drive.pictures if not picture.local]
    locals_ = [picture for picture in drive.pictures if picture.local]
    later = [picture.stamp for picture in maps if picture.stamp > START_S + 3]  # all that waited at first is mapped
    assert len(later) == 4
    np.testing.assert_allclose(np.diff(later), 1.0, atol=0.11)
    assert len([picture for picture in locals_ if picture.stamp > START_S + 3]) == 40
    assert locals_[-1].frame == "odom"
    assert locals_[-1].origin == pytest.approx((0.1 * 7 - 3, -3))
    np.testing.assert_array_equal(locals_[-1].cells, 0)
    before = len(drive.pictures)
    drive.time += 2
    drive.step()
    drive.time += 2
    drive.step()
    assert len(drive.pictures) - before <= 1  # the last change, and nothing for nothing


def test_a_pose_far_off_does_not_make_the_map_grow(drive):
    drive.run(40)
    for far in (400.0, 1e6):
        drive.pose(x=far, y=far)
        drive.ranges([1.0] * 4)
        drive.step()
        drive.run(5)
    assert drive.live.refused == {"a pose so far off that the map would become too large": 1}
    left_out = "a scan left out: its pose is where no robot can have got to"
    assert drive.live.snapshot().settings["notes"][left_out] == 1
    poses = np.array([frame.pose[:2] for frame in drive.frames])
    assert np.prod((np.ptp(poses, axis=0) + 8) / 0.04) < MAX_CELLS


def test_a_scan_that_cannot_be_mapped_is_counted_and_the_rest_goes_on(drive, monkeypatch):
    drive.run(40)
    before = drive.live.scans
    with monkeypatch.context() as patch:
        patch.setattr(drive.mapper, "add", Mapper(P3DX, "cone").add)  # to which no scan of four sonars fits
        drive.run(5)
    assert drive.live.scans == before
    ((reason, count),) = drive.live.refused.items()
    assert (reason, count >= 4) == ("a scan whose stamp, pose or mounts cannot be", True)
    drive.run(5)
    assert drive.live.scans > before


def test_the_map_is_kept_when_a_sonar_joins():
    live: Any = Live(NETWORK, Settings(resolution=0.12))
    drive = Drive(live, MOUNTS[:3])
    drive.run(40)
    before = live.snapshot().grid
    drive.mounts = MOUNTS
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(40)
    after = live.snapshot().grid
    assert drive.mapper.robot.sonars == 4
    assert after.observed.sum() >= before.observed.sum()
    assert after.views.max() > before.views.max()


def test_a_sonar_that_joins_makes_the_robot_no_smaller_than_was_told(monkeypatch):
    radii = []
    monkeypatch.setattr(Nearby, "equip", lambda _, robot: radii.append(robot.footprint_radius_m))
    live: Any = Live(NETWORK, Settings(), Drives(0.6, itself=True))
    drive = Drive(live, MOUNTS[:3])
    drive.run(40)
    drive.mounts = MOUNTS
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(40)
    assert radii == [0.6]


def test_a_snapshot_does_not_change(live):
    drive = Drive(live)
    assert live.snapshot() is None
    drive.run(30)
    snapshot = live.snapshot()
    assert not np.shares_memory(snapshot.grid.log_odds, drive.mapper.grid().log_odds)
    assert snapshot.settings["frames"] == 30
    assert snapshot.path.shape[1] == 2
