from dataclasses import replace

import numpy as np
import pytest

from echogrid.frame import Frame
from echogrid.logs.csv_log import write_csv
from echogrid.robot import Robot, robot_yaml
from mirror_room import changed, frames_of, ring


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    home = tmp_path_factory.mktemp("calibrating")
    robot = ring()
    write_csv(home / "drive.csv", iter(frames_of(robot)), robot.sonars)
    (home / "ring.yaml").write_text(robot_yaml(robot))
    mirrored = replace(robot, mounts=robot.mounts * [1, -1, -1])
    (home / "mirrored.yaml").write_text(robot_yaml(mirrored))
    return home


def test_a_robot_file_comes_out_that_is_taken(folder, run):
    status, out, err = run(
        "calibrate", folder / "drive.csv", "--robot", folder / "ring.yaml", "--out", folder / "cal"
    )
    assert (status, err) == (0, "")
    assert {file.name for file in (folder / "cal").iterdir()} == {"robot.yaml", "calibration.csv", "calibration.png"}
    assert Robot.load(folder / "cal" / "robot.yaml").sonars == ring().sonars
    assert "cannot be told: an offset of all ranges" in out
    assert "found:" not in out
    assert len((folder / "cal" / "calibration.csv").read_text().splitlines()) == 1 + ring().sonars


def test_doctor_has_nothing_to_say_of_a_faultless_log(folder, run):
    status, out, err = run("doctor", folder / "drive.csv", "--robot", folder / "ring.yaml")
    assert (status, err) == (0, "")
    assert out.count("\n") == 1
    assert "nothing amiss found in 420 scans" in out


def test_doctor_tells_mirrored_mounts(folder, run):
    status, out, _ = run("doctor", folder / "drive.csv", "--robot", folder / "mirrored.yaml")
    assert status == 0
    assert "found: left and right are swapped" in out
    assert "1 finding in" in out


def test_doctor_tells_of_dead_sonars_once_and_of_mirrored_mounts_besides(folder, run, tmp_path):
    def change(ranges):
        ranges[:, [1, 6]] = np.inf
        return ranges

    write_csv(tmp_path / "dead.csv", iter(changed(frames_of(ring()), change)), ring().sonars)
    _, out, _ = run("doctor", tmp_path / "dead.csv", "--robot", folder / "mirrored.yaml")
    assert "found: r1, r6: no echo ever" in out
    assert "found: left and right are swapped" in out
    assert "2 findings in" in out


def test_doctor_tells_what_is_noted_of_a_log(folder, run, tmp_path):
    far = changed(frames_of(ring()), lambda ranges: np.full_like(ranges, 9.0))
    write_csv(tmp_path / "far.csv", iter(far), ring().sonars)
    _, out, _ = run("doctor", tmp_path / "far.csv", "--robot", folder / "ring.yaml")
    assert "found: no sonar ever heard an echo" in out


def test_a_longest_range_that_means_no_echo_is_one_finding(folder, run, tmp_path):
    full = changed(frames_of(ring()), lambda ranges: np.where(ranges > 1.5, 4.0, ranges))
    write_csv(tmp_path / "full.csv", iter(full), ring().sonars)
    _, out, _ = run("doctor", tmp_path / "full.csv", "--robot", folder / "ring.yaml")
    assert "found: the longest range, 4 m, comes" in out
    assert "1 finding in" in out


def test_doctor_tells_of_a_robot_that_stands(folder, run, tmp_path):
    frames = frames_of(ring())[:1] * 60
    write_csv(tmp_path / "stands.csv", (Frame(i / 10, f.pose, f.ranges) for i, f in enumerate(frames)), ring().sonars)
    _, out, _ = run("doctor", tmp_path / "stands.csv", "--robot", folder / "ring.yaml")
    assert "found: the robot stays within 0.00 m" in out


@pytest.mark.parametrize("command", ["doctor", "calibrate"])
def test_a_log_that_cannot_be_read_is_one_line(command, folder, run, tmp_path):
    (tmp_path / "bad.csv").write_text("t,x,y,theta,r0\n0,0,0,zero,1\n")
    status, out, err = run(command, tmp_path / "bad.csv", "--robot", folder / "ring.yaml")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1


def test_of_a_log_in_other_units_nothing_is_calibrated(folder, run, tmp_path):
    frames = (Frame(f.stamp, f.pose * [1000, 1000, 1], f.ranges) for f in frames_of(ring()))
    write_csv(tmp_path / "mm.csv", frames, ring().sonars)
    status, _, err = run("calibrate", tmp_path / "mm.csv", "--robot", folder / "ring.yaml", "--out", tmp_path / "cal")
    assert status == 2
    assert "are the poses in mm or cm" in err
    assert "expected a log in m, s and radians" in err
    assert not (tmp_path / "cal").exists()


def test_nothing_is_left_of_a_calibration_that_fails(folder, run, tmp_path):
    write_csv(tmp_path / "short.csv", iter(frames_of(ring())[:30]), ring().sonars)
    out = tmp_path / "cal"
    status, _, err = run("calibrate", tmp_path / "short.csv", "--robot", folder / "ring.yaml", "--out", out)
    assert status == 2
    assert "echoes that touch" in err
    assert not out.exists()
