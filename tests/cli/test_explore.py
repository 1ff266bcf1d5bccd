"""``echogrid explore``: a world in; a map, the drive that made it and its figures out."""

import json
from dataclasses import replace

import numpy as np
import pytest

from commands import MAP_FILES, assert_refused, put
from echogrid import Robot, load_log, metrics, read_map, read_truth
from echogrid.metrics import score, trajectory_error
from echogrid.output.trajectory import read_tum
from echogrid.planning import explore


def test_a_room_is_explored_and_all_of_it_written(run, place):
    out = place / "explored"
    status, said, noted = run("explore", "box.yaml", "--robot", "b21", "--seed", "2", "--out", out)
    assert (status, noted) == (0, "")
    assert {path.name for path in out.iterdir()} == {
        *MAP_FILES, "map.html", "drive.csv", "drive.truth.npz", "explore.json"
    }  # fmt: skip
    told = json.loads((out / "explore.json").read_text())
    assert told["seen"] >= 0.99
    assert told["collisions"] == 0
    assert told["home_m"] < 0.1
    assert told["ate_m"] is None
    soon = told["until"]["95%"]["way_m"]
    assert f"of the floor in reach (95% by {soon:.1f} m), drove {told['way_m']:.1f} m, no collisions" in said
    assert score(read_map(out), read_truth(out / "drive.truth.npz")).free > 0.9
    # The log is that of the map: mapped again it gives the same one.
    log = load_log(out / "drive.csv", Robot.load("b21"))
    assert sum(1 for _ in log) * 0.04 == pytest.approx(told["time_s"], abs=0.1)
    assert run("map", out / "drive.csv", "--robot", "b21", "--out", place / "again")[0] == 0
    first, again = read_map(out), read_map(place / "again")
    middles = first.centre_of(np.argwhere(first.observed))
    assert np.mean(np.abs(first.probability_at(middles) - again.probability_at(middles)) < 0.1) > 0.95


@pytest.mark.unchecked
def test_poses_that_it_finds_are_written_beside_those_of_its_wheels(run, place):
    out = place / "explored"
    status, _, noted = run("explore", "box.yaml", "--robot", "b21", "--seed", "2", "--slam", "--out", out)
    assert (status, noted) == (0, "")
    told = json.loads((out / "explore.json").read_text())
    assert told["seen"] >= 0.97
    assert told["collisions"] == 0
    (stamps, found), (same, wheels) = (read_tum(out / f"{name}.tum") for name in ("trajectory", "odometry"))
    np.testing.assert_array_equal(stamps, same)
    log = {round(frame.stamp, 3): frame for frame in load_log(out / "drive.csv", Robot.load("b21"))}
    true, told_by_wheels = (
        np.array([getattr(log[round(stamp, 3)], name) for stamp in stamps]) for name in ("pose", "odom")
    )
    np.testing.assert_allclose(wheels[:, :2], told_by_wheels[:, :2], atol=1e-5)
    off, drift = (np.max(np.hypot(*(poses - true)[:, :2].T)) for poses in (found, wheels))
    assert 0 < off < 0.2
    assert told["ate_m"] == pytest.approx(trajectory_error(found, true).aligned_rms_m, abs=1e-3)
    assert off < drift + 0.1  # in so small a room nothing has drifted far


def test_a_map_that_lies_elsewhere_than_the_world_is_told(run, place, monkeypatch):
    """An error of the poses is given: in so small a room they are found."""
    monkeypatch.setattr(
        explore, "trajectory_error", lambda *given: replace(trajectory_error(*given), aligned_rms_m=0.62)
    )
    status, _, noted = run("explore", "box.yaml", "--robot", "b21", "--seed", "2", "--slam", "--out", place / "off")
    assert status == 0
    assert json.loads((place / "off" / "explore.json").read_text())["ate_m"] == 0.62
    (note,) = noted.splitlines()
    assert note.startswith("note: the poses that were found are 0.62 m off the true ones (root mean square)")


def test_what_the_map_lacks_and_the_robot_is_too_wide_for_is_told(run, place, monkeypatch):
    """A score that wipes walls is given: which walls a map loses is chance."""
    monkeypatch.setattr(metrics, "score", lambda *given: replace(score(*given), wiped=0.05))
    put(place / "two.yaml", "name: two\nstart: [0.6, 0.6]\nwalls:\n"
        "- {points: [[0, 0], [2, 0], [2, 1.2], [0, 1.2]], closed: true, roughness_mm: 1}\n"
        "- {points: [[1.2, 0], [1.2, 0.4]], roughness_mm: 1}\n"
        "- {points: [[1.2, 0.8], [1.2, 1.2]], roughness_mm: 1}\n")  # fmt: skip
    status, _, noted = run("explore", "two.yaml", "--robot", "b21", "--out", place / "two")
    assert status == 0
    narrow, wiped = noted.splitlines()
    assert "% of the floor is behind ways less than 0.73 m wide, which b21 takes for too narrow" in narrow
    assert wiped.startswith("note: 5.0% of the walls are free floor in the map")
    told = json.loads((place / "two" / "explore.json").read_text())
    assert told["wiped"] == 0.05
    assert 0.3 < told["too_narrow"] < 0.6


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--start", "1"], "--start: found 1, expected X,Y,DEG"),
        (["--start", "1,nan,0"], "--start: found 1,nan,0, expected"),
        (["--start", "0.1,1,0"], "world box: start: found (0.10, 1.00) m, less than 0.36 m from a wall"),
        (["--start", "9,1,0"], "world box: start: found (9.00, 1.00) m"),
        (["--seed", "-1"], "--seed: found -1"),
        (["--robot", "b22"], "robot: found b22"),
        (["--physics.beam", "laser"], "--physics.beam: found laser"),
        (["--out", "file"], "file: found a file, expected a folder"),
        (["--robot", "point.yaml"], "robot point: footprint_radius_m: found 0, expected the radius"),
        (["WORLD", "nowhere"], "world: found nowhere"),
        (["WORLD", "hole.yaml"], "world hole: found a hole through which the robot gets out"),
        (["WORLD", "cell.yaml"], "world cell: found no free space"),
    ],
)
def test_what_cannot_be_is_one_line(run, place, arguments, line):
    walls = "[[0, 0], [3, 0], [3, 2], [0, 2]]"
    put(place / "hole.yaml", f"name: hole\nstart: [1, 1]\nwalls: [{{points: {walls}, roughness_mm: 1}}]\n")
    put(place / "point.yaml", "name: point\nfootprint_radius_m: 0\nsonar: {transducer: polaroid-600, "
        "min_range_m: 0.1, max_range_m: 5, beam_width_deg: 25}\nmounts: [[0.1, 0, 0]]\n")  # fmt: skip
    put(place / "cell.yaml", "name: cell\nwalls: [{points: [[0, 0], [0.4, 0], [0.4, 0.4], [0, 0.4]], closed: true, "
        "roughness_mm: 1}]\n")  # fmt: skip
    given = dict(zip(arguments[::2], arguments[1::2], strict=True))
    options = {"--robot": "b21", "--out": "way"} | {key: value for key, value in given.items() if key != "WORLD"}
    words = [word for pair in options.items() for word in pair]
    assert line in assert_refused(run, place, "explore", given.get("WORLD", "box.yaml"), *words)
