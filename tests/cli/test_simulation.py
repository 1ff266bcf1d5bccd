"""Drives and scans are simulated, and weights trained."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from commands import LOG, ROBOT, WORLD, Run, everything, put, scores, share, told
from echogrid.logs.formats import load_log
from echogrid.output.map_file import read_truth
from echogrid.robot import Robot, robot_yaml


def simulate(run: Run, out: Path, *args: object, world: object = "lab", robot: object = "b21") -> str:
    """A short simulated drive; what ``info`` says of it."""
    drive = put(out.with_suffix(".txt"), "1,1\n2,1  # a stop\n\n2,2\n")
    status, text, err = run("simulate", world, "--robot", robot, "--drive", drive, "--out", out, *args)
    assert (status, err) == (0, "")
    assert f"in {out}, truth in {out.with_suffix('.truth.npz')}" in text
    return run("info", out)[1]


def test_simulate_writes_a_log_and_its_truth(run, tmp_path):
    info = told(simulate(run, tmp_path / "drive.csv"))
    assert {path.name for path in tmp_path.iterdir()} == {"drive.csv", "drive.truth.npz", "drive.txt"}
    assert info["sonars"] == "24"
    assert info["drive"] == "2.00 m within x 1.00 .. 2.00, y 1.00 .. 2.00 m"
    truth = read_truth(tmp_path / "drive.truth.npz")
    assert set(np.unique(truth.cells)) == {0, 1, 2}
    assert run("map", tmp_path / "drive.csv", "--out", tmp_path / "map")[0] == 0
    assert scores(run, tmp_path / "map", tmp_path / "drive.truth.npz")["auc"] > 0.8


def test_the_drive_follows_its_waypoints(run, tmp_path):
    simulate(run, tmp_path / "drive.csv")
    poses = np.array([frame.pose for frame in load_log(tmp_path / "drive.csv")])
    np.testing.assert_allclose(poses[[0, -1]], [[1, 1, 0], [2, 2, np.pi / 2]], atol=1e-6)
    assert np.min(np.linalg.norm(poses[:, :2] - [2, 1], axis=1)) < 1e-6
    assert np.all((np.abs(poses[:, 1] - 1) < 1e-6) | (np.abs(poses[:, 0] - 2) < 1e-6))
    assert np.max(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)) < 0.06


def test_a_tour_drives_through_all_of_a_room(run, tmp_path):
    out = tmp_path / "tour.csv"
    assert run("simulate", put(tmp_path / "box.yaml", WORLD), "--robot", "p3dx", "--out", out)[0] == 0
    poses = np.array([frame.pose for frame in load_log(out, Robot.load("p3dx"))])
    assert np.all(poses[:, :2] > 0.28)
    assert np.all(poses[:, :2] < [3 - 0.28, 2 - 0.28])
    assert np.ptp(poses[:, 0]) > 1


def test_a_seed_repeats_a_drive_and_another_does_not(run, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        simulate(run, tmp_path / f"{name}.csv", "--seed", seed)
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c
    truths = {(tmp_path / f"{name}.truth.npz").read_bytes() for name in "abc"}
    assert len(truths) == 1


def test_rough_walls_are_heard_where_smooth_ones_are_not(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD.replace("[3, 2], [0, 2]", "[3, 3], [0, 3]"))
    smooth = share(simulate(run, tmp_path / "smooth.csv", "--walls", "smooth", world=world), "no echo")
    rough = share(simulate(run, tmp_path / "rough.csv", "--walls", "rough", world=world), "no echo")
    assert rough < smooth - 0.1
    simulate(run, tmp_path / "as-given.csv", world=world)  # smooth
    assert (tmp_path / "as-given.csv").read_bytes() == (tmp_path / "smooth.csv").read_bytes()


def test_the_switches_of_the_ranging_module_do_what_they_say(run, tmp_path):
    plain = simulate(run, tmp_path / "plain.csv")
    assert share(plain, "stale") < 0.02
    stale = simulate(run, tmp_path / "stale.csv", "--physics.stale", 0.5)
    assert share(stale, "stale") == pytest.approx(0.5, abs=0.1)
    assert told(simulate(run, tmp_path / "lost.csv", "--physics.lost", 1))["no echo"] == "100.0%"
    assert told(simulate(run, tmp_path / "lost.csv", "--physics.lost", 1))["ranges"] == "none"
    heard = share(simulate(run, tmp_path / "loud.csv", "--physics.level-db", 60), "no echo")
    assert heard < share(plain, "no echo") - 0.1


def test_a_scan_is_a_reading_a_degree(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD.replace("0.05", "2.0"))
    status, out, err = run("scan", world, "--at", "1.25,0.75", "--out", tmp_path / "scan")
    assert (status, err) == (0, "")
    assert out.startswith("box: 360 bearings, 100% with an echo")
    assert {path.name for path in (tmp_path / "scan").iterdir()} == {"scan.csv", "scan.png"}
    assert (tmp_path / "scan" / "scan.png").read_bytes().startswith(b"\x89PNG\r\n")
    lines = (tmp_path / "scan" / "scan.csv").read_text().splitlines()
    assert lines[0] == "bearing_deg,range_m,region"
    degrees, ranges, region = zip(*(line.split(",") for line in lines[1:]), strict=True)
    np.testing.assert_array_equal([float(d) for d in degrees], np.arange(360))
    # Square to the four walls the reading is the distance, late by a weak echo's walk error at the most.
    square = np.array(ranges, dtype=float)[[0, 90, 180, 270]]
    np.testing.assert_allclose(square, [1.75, 1.25, 1.25, 0.75], atol=0.03)
    # A rough wall is flat about its normal and nowhere else; regions are numbered as they follow one another.
    assert [region[i] for i in (45, 90, 180, 270)] == ["", "1", "2", "3"]
    assert region[359] == region[0] == "4"
    assert set(region) == {"", "1", "2", "3", "4"}


def test_a_scan_marks_the_regions_of_constant_depth_of_smooth_walls_and_corners(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD)
    assert run("scan", world, "--at", "1.3,0.8", "--out", tmp_path)[0] == 0
    rows = [line.split(",") for line in (tmp_path / "scan.csv").read_text().splitlines()[1:]]
    # Walls and corners in turn; the corners' bearings rounded to a degree.
    targets = {0: 1.7, 35: 2.0809, 90: 1.2, 137: 1.7692, 180: 1.3, 212: 1.5264, 270: 0.8, 335: 1.8788}
    for bearing, distance in targets.items():
        assert float(rows[bearing][1]) == pytest.approx(distance, abs=0.01)
    assert [rows[bearing][2] for bearing in targets] == ["8", "1", "2", "3", "4", "5", "6", "7"]


def test_a_scan_may_be_left_of_and_below_the_origin(run, tmp_path):
    box = WORLD.replace("[[0, 0], [3, 0], [3, 2], [0, 2]]", "[[-3, -2], [0, -2], [0, 0], [-3, 0]]")
    world = put(tmp_path / "box.yaml", box)
    assert run("scan", world, "--at", "-2,-1.5", "--walls", "rough", "--out", tmp_path)[0] == 0
    assert (tmp_path / "scan.csv").read_text().count("inf") < 36


@pytest.mark.slow
def test_weights_are_trained_and_map_a_log(run, tmp_path):
    weights = tmp_path / "mine.npz"
    status, out, err = run("train", "--robot", "p3dx", "--drives", 16, "--epochs", 1, "--seed", 5, "--out", weights)
    assert (status, err) == (0, "")
    assert out.startswith(f"{weights}: trained for p3dx in ")
    assert everything(tmp_path).keys() == {"mine.npz"}
    log = put(tmp_path / "drive.csv", LOG)
    robot = put(tmp_path / "duo.yaml", ROBOT)
    assert run("map", log, "--robot", robot, "--interpreter", weights, "--out", tmp_path / "out")[0] == 0
    settings = yaml.safe_load((tmp_path / "out" / "run.yaml").read_text())
    assert settings["weights"]["robot"] == robot_yaml(Robot.load("p3dx"))
    assert (settings["weights"]["drives"], settings["weights"]["seed"]) == (16, 5)
