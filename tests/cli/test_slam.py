"""``map --slam``: the poses of a log are found, and written beside the map."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import yaml
from evo.core import metrics, sync
from evo.tools.file_interface import read_tum_trajectory_file

from commands import MAP_FILES, SAMPLE, assert_refused, call, put
from echogrid.cli.poses import _mistake
from echogrid.frame import Frame, Log
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from echogrid.output.trajectory import read_tum, write_tum
from echogrid.position.corrected import Corrected
from echogrid.robot import Robot
from experiments.studies.position.odometry import Odometry

POSES = {"trajectory.tum", "odometry.tum", "graph.g2o"}
B21 = Robot.load("b21")
TRUE = list(load_log(SAMPLE, B21))


def drifting(count: int = len(TRUE)) -> list[Frame]:
    """The sample, its poses made to drift."""
    truth = np.array([frame.pose for frame in TRUE])
    told = Odometry().times(2).of(truth, np.random.default_rng(3))
    return [Frame(f.stamp, pose, f.ranges) for f, pose in zip(TRUE, told, strict=True)][:count]


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> Path:
    """The folder of a log that drifts, mapped with all that goes along."""
    folder = tmp_path_factory.mktemp("slam")
    write_csv(folder / "drive.csv", drifting(), 24)
    truth = np.array([frame.pose for frame in TRUE])
    write_tum(folder / "truth.tum", np.array([frame.stamp for frame in TRUE]), truth)
    assert call("map", folder / "drive.csv", "--slam", "--view", "--mcap", "--out", folder / "out") == 0
    return folder


def ape(truth: Path, found: Path) -> float:
    """As evo_ape tum TRUTH FOUND -a, m."""
    both = sync.associate_trajectories(*(read_tum_trajectory_file(path) for path in (truth, found)))
    both[1].align(both[0])
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data(both)
    return error.get_statistic(metrics.StatisticsType.rmse)


@pytest.mark.unchecked
def test_evo_finds_the_drive_where_the_odometry_has_lost_it(mapped):
    assert {path.name for path in (mapped / "out").iterdir()} == MAP_FILES | POSES | {"map.html", "map.mcap"}
    told, found = (ape(mapped / "truth.tum", mapped / "out" / name) for name in ("odometry.tum", "trajectory.tum"))
    assert told > 1.0
    assert found < 0.1 * told


def test_there_is_a_pose_for_each_frame_at_its_own_stamp_from_the_first_pose_on(mapped):
    frames = drifting()
    stamps, found = read_tum(mapped / "out" / "trajectory.tum")
    again, told = read_tum(mapped / "out" / "odometry.tum")
    assert stamps.tolist() == again.tolist() == [frame.stamp for frame in frames]
    np.testing.assert_allclose(told, [frame.pose for frame in frames], atol=1e-6)
    np.testing.assert_allclose(found[0], told[0], atol=1e-6)


def test_run_yaml_holds_what_was_found(mapped):
    run = yaml.safe_load((mapped / "out" / "run.yaml").read_text())
    assert run["slam"] is True
    assert run["loops"] > 0
    assert set(run["odometry"]) == {"way_times", "turns_times", "heading_deg_m"}


@pytest.mark.unchecked
def test_it_is_said_how_far_the_odometry_was_off_and_all_is_the_same_again(run, tmp_path):
    write_csv(tmp_path / "drive.csv", drifting(200), 24)
    for folder in ("out", "again"):
        status, out, err = run("map", tmp_path / "drive.csv", "--slam", "--out", tmp_path / folder)
        assert status == 0
        assert "trajectory.tum: the poses, with " in out.splitlines()[-1]
        assert err.startswith("robot: b21, as none was named\n")
    for name in POSES | {"map.npz", "map.pgm", "map.png"}:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()


def test_a_map_without_slam_drops_the_poses_of_an_older_one(run, tmp_path):
    write_csv(tmp_path / "drive.csv", drifting(60), 24)
    assert run("map", tmp_path / "drive.csv", "--slam", "--out", tmp_path / "out")[0] == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == MAP_FILES | POSES
    status, _, err = run("map", tmp_path / "drive.csv", "--out", tmp_path / "out")
    assert status == 0
    assert "note: removed trajectory.tum, odometry.tum, graph.g2o of an older map" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == MAP_FILES


def test_one_scan_is_mapped_and_it_is_said_that_no_pose_was_looked_for(run, tmp_path):
    write_csv(tmp_path / "one.csv", drifting(1), 24)
    status, out, err = run("map", tmp_path / "one.csv", "--slam", "--out", tmp_path / "out")
    assert (status, len(out.splitlines())) == (0, 1)
    assert "note: one scan: no poses to find, they are those of the odometry\n" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == MAP_FILES | POSES - {"graph.g2o"}
    assert yaml.safe_load((tmp_path / "out" / "run.yaml").read_text())["odometry"] is None


@pytest.mark.parametrize(
    ("args", "found"),
    [
        (["drive.csv", "--robot", "duo.yaml"], "drive.csv: found 2 sonars, expected at least 4 to find poses by"),
        (["mm.csv", "--robot", "b21"], "mm.csv: found 100% of the steps of the odometry faster than 10 m/s"),
    ],
)
def test_what_poses_cannot_be_found_of_is_refused(run, place, args, found):
    write_csv(place / "mm.csv", [Frame(f.stamp, f.pose * [1000, 1000, 1], f.ranges) for f in TRUE[:100]], 24)
    assert found in assert_refused(run, place, "map", *args, "--slam", "--out", "out")


def test_nothing_is_written_where_a_file_of_poses_cannot_be(run, place):
    write_csv(place / "short.csv", drifting(30), 24)
    (place / "out" / "graph.g2o").mkdir()
    assert "graph.g2o" in assert_refused(run, place, "map", "short.csv", "--slam", "--robot", "b21", "--out", "out")


def test_carmen_logs_have_odometry(run, tmp_path):
    mounts = " ".join(f"{v:.9f}" for v in B21.mounts.ravel())
    lines = ["# CARMEN Logfile"]
    for f in drifting(80):
        ranges = " ".join(f"{v:.4f}" for v in np.nan_to_num(f.ranges, nan=0.1, posinf=10.0))
        x, y, theta = f.pose
        lines.append(f"ODOM {x:.9f} {y:.9f} {theta:.9f} 0 0 0 {f.stamp} host {f.stamp}")
        lines.append(f"SONAR 0.43 24 {ranges} {mounts} {f.stamp} host {f.stamp}")
    log = put(tmp_path / "drive.log", "\n".join([*lines, ""]))
    assert run("map", log, "--robot", "b21", "--slam", "--out", tmp_path / "out")[0] == 0
    assert read_tum(tmp_path / "out" / "trajectory.tum")[1].shape == (80, 3)


@pytest.mark.parametrize(
    ("wrong", "told"), [("", None), ("mirrored", "left and right are swapped"), ("late", "clocks")]
)
def test_a_robot_file_or_clocks_that_no_poses_mend_are_told(wrong, told):
    robot = replace(B21, mounts=B21.mounts * [1, -1, -1]) if wrong == "mirrored" else B21
    later = TRUE[3:] if wrong == "late" else TRUE  # some 0.6 s
    kept = [replace(frame, odom=each.pose) for frame, each in zip(TRUE, later, strict=False)]
    notes = list(_mistake(cast(Corrected, SimpleNamespace(log=Log.of(kept))), robot))
    assert len(notes) == (told is not None)
    assert all(told in note and "echogrid doctor" in note for note in notes)
