"""The bench for positions: its buildings, drives, odometry, cases and table."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.metrics import trajectory_error
from echogrid.robot import Robot
from echogrid.simulation.world import inside_room
from experiments.studies.position.buildings import KINDS, WALLS, building
from experiments.studies.position.cases import Case, Facts, cases_of, picked, write_case
from experiments.studies.position.driving import RATE_HZ, TURN_RAD_S, driven, length_of
from experiments.studies.position.measures import entropy_of_hits, hits
from experiments.studies.position.odometry import Odometry
from experiments.studies.position.simulated import SET, robot_of

ROOT = Path(__file__).parents[2]
LENGTHS_M = {"flat": (120, 162), "ring": (158, 182), "hall": (180, 195), "floors": (480, 545)}
ROBOTS = ("b21", "p3dx", "uneven11", "four")


@pytest.fixture(scope="module", params=[(kind, number) for kind in KINDS for number in (11, 12, 13)])
def drive(request):
    kind, number = request.param
    place = building(kind, "mixed", number)
    return kind, place, driven(place.way, 0.4)


def test_a_drive_meets_no_wall_and_is_as_long_as_its_kind_says(drive):
    kind, place, poses = drive
    assert place.world.clearance(poses[:, :2]).min() > max(robot_of(name).footprint_radius_m for name in ROBOTS)
    low, high = LENGTHS_M[kind]
    assert low < length_of(poses) < high


def test_a_building_has_no_leak(drive):
    _, place, poses = drive
    assert inside_room(place.world, poses[::50, :2]).all()


def test_a_drive_passes_near_all_its_waypoints(drive):
    _, place, poses = drive
    gaps = [np.min(np.hypot(*(poses[:, :2] - point).T)) for point in place.way]
    assert max(gaps) < 0.35


def test_a_drive_keeps_its_speed_and_turns_no_faster_than_it_can(drive):
    *_, poses = drive
    step = np.hypot(*np.diff(poses[:, :2], axis=0).T) * RATE_HZ
    turn = np.abs(wrap(np.diff(poses[:, 2]))) * RATE_HZ
    assert step.max() <= 0.4 + 1e-9
    assert turn.max() <= TURN_RAD_S + 1e-9
    # It drives where it looks: no sideways steps beyond what turning between two scans makes.
    moving = step > 0.02
    towards = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    assert np.abs(wrap(towards - poses[:-1, 2]))[moving].max() <= TURN_RAD_S / RATE_HZ + 1e-6


def test_a_hall_is_beyond_the_reach_of_sonars_and_other_places_are_not(drive):
    kind, place, poses = drive
    bearings = np.arange(24) * np.pi / 12
    sight = place.world.sight(np.repeat(poses[::100, :2], 24, axis=0), np.tile(bearings, len(poses[::100])))
    far = np.mean(sight > 5.0)
    assert far > 0.4 if kind == "hall" else far < 0.25


def test_the_form_of_a_building_does_not_depend_on_its_walls():
    smooth, rough = (building("ring", walls, 3) for walls in ("smooth", "rough"))
    np.testing.assert_array_equal(smooth.world.walls, rough.world.walls)
    np.testing.assert_array_equal(smooth.way, rough.way)
    assert smooth.world.roughness.max() < rough.world.roughness.min()
    assert not np.array_equal(smooth.way, building("ring", "smooth", 4).way)


def test_the_set_has_twelve_buildings_and_all_that_can_differ():
    parts = [name.split("-") for name in SET]
    assert len(set(SET)) == len(SET)
    assert len({(kind, number) for kind, _, _, number, *_ in parts}) >= 12
    for kind in ("flat", "ring", "hall"):
        assert {walls for k, walls, *_ in parts if k == kind} == set(WALLS)
    assert {robot for _, _, robot, *_ in parts} == set(ROBOTS)


def straight(metres):
    return np.column_stack([np.arange(0, metres + 1e-9, 0.05), np.zeros((round(metres / 0.05) + 1, 2))])


def test_wheels_without_errors_tell_the_truth():
    poses = driven(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.5], [0.0, 0.0]]), 0.4)
    told = Odometry(0, 0, 0, 0).of(poses, np.random.default_rng(0))
    np.testing.assert_allclose(told[:, :2], poses[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(told[:, 2] - poses[:, 2]), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("errors", "column", "sigma"),
    [
        (Odometry(0.01, 0, 0, 0), 0, 0.01 * 16),
        (Odometry(0, 1.0, 0, 0), 2, np.deg2rad(16.0)),
        (Odometry(0, 0, 0.03, 0), 0, 0.03 * 4),
        (Odometry(0, 0, 0, 1.0), 2, np.deg2rad(4.0)),
        (Odometry(0, 0, 0, 1.0).times(2.0), 2, np.deg2rad(8.0)),
    ],
)
def test_errors_grow_as_their_sigmas_say(errors, column, sigma):
    # After 16 m: what is constant 16 times, what is a random walk 4 times the error of a metre.
    truth = straight(16.0)
    off = [(errors.of(truth, np.random.default_rng(seed))[-1] - truth[-1])[column] for seed in range(400)]
    assert np.std(off) == pytest.approx(sigma, rel=0.12)
    assert abs(np.mean(off)) < 4 * sigma / 20


def test_the_noise_does_not_depend_on_how_often_wheels_are_read():
    errors, truth = Odometry(0, 0, 0, 1.0), straight(16.0)
    often, seldom = (
        np.std([errors.of(truth[::every], np.random.default_rng(seed))[-1, 2] for seed in range(400)])
        for every in (1, 8)
    )
    assert often == pytest.approx(seldom, rel=0.15)


def test_entropy_of_hits_by_hand():
    robot = Robot.load(ROOT / "experiments" / "studies" / "position" / "four.yaml")
    frames = [Frame(0.0, np.zeros(3), np.array([1.0, 1.0, np.inf, 3.0])), Frame(1.0, np.zeros(3), np.full(4, np.nan))]
    poses = np.array([[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(hits(frames, robot, poses), [[0.0, 1.1], [-1.1, 0.0]], atol=1e-12)
    assert entropy_of_hits(frames, robot, poses) == pytest.approx(np.log(2))
    assert entropy_of_hits(frames[:1] * 2, robot, np.repeat(poses[:1], 2, axis=0)) == pytest.approx(np.log(2))


@pytest.fixture
def case(tmp_path):
    rng = np.random.default_rng(0)
    robot = robot_of("four")
    truth = driven(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.5]]), 0.4)
    frames = [Frame(100 + i / 10, pose, robot.clean(rng.uniform(0.1, 5.0, 4))) for i, pose in enumerate(truth)]
    told = Odometry().of(truth, rng)
    facts = Facts("flat", "mixed", "four", length_of(truth), "default")
    write_case(tmp_path / "flat-mixed-four-1", facts, robot, frames, {"odometry": told}, truth)
    return Case(tmp_path / "flat-mixed-four-1"), frames, told, truth


def test_a_case_comes_back_from_its_files(case):
    case, frames, told, truth = case
    (found,) = cases_of(case.folder.parent)
    assert found == case
    np.testing.assert_allclose(found.truth(), truth, atol=1e-6)
    np.testing.assert_array_equal([frame.ranges for frame in found.log()], [frame.ranges for frame in frames])
    np.testing.assert_array_equal([frame.pose for frame in found.log()], told)
    np.testing.assert_allclose([frame.pose for frame in found.log("true")], truth, atol=1e-6)
    assert (found.has("odometry"), found.has("twice"), found.has("true")) == (True, False, True)
    assert found.facts.length_m == length_of(truth)


def table(*arguments):
    command = [sys.executable, "-m", "experiments.studies.position", *map(str, arguments)]
    return subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)


def test_the_table_tells_the_errors_of_odometry(case, tmp_path):
    case, _, told, truth = case
    result = table(case.folder.parent, "--out", tmp_path / "out")
    assert (result.returncode, result.stderr) == (0, "")
    error = trajectory_error(told, truth)
    assert f"{error.aligned_rms_m:.3f} | {error.first_rms_m:.3f} | {error.aligned_rms_m:.3f}" in result.stdout
    (found,) = json.loads((tmp_path / "out" / "position_odometry_odometry.json").read_text())["found"]
    assert found["found"]["aligned_rms_m"] == pytest.approx(error.aligned_rms_m, abs=1e-4)
    assert (tmp_path / "out" / "flat-mixed-four-1.tum").read_text().count("\n") == len(truth)


def test_the_table_says_in_one_line_what_is_wrong(case, tmp_path):
    case, *_ = case
    for arguments, said in [
        ([tmp_path / "none"], "no case"),
        ([case.folder, "--method", "nowhere:slam"], "expected odometry, slam or MODULE:FUNCTION"),
        ([case.folder, "--errors", "twice"], "no case with poses of twice"),
    ]:
        result = table(*arguments)
        assert result.returncode == 2
        assert said in result.stderr.splitlines()[-1]
        assert "Traceback" not in result.stderr


def refuse(log, robot):
    raise InputError(log.name, "a log", "none")


def test_a_method_that_fails_keeps_its_row(case):
    case, told, truth = case[0], *case[2:]
    result = table(case.folder, "--method", "tests.experiments.test_position:refuse")
    assert result.returncode == 0
    error = f"{trajectory_error(told, truth).aligned_rms_m:.3f}"
    assert f"it failed: {case.folder}/log.csv: found a log, expected none" in result.stdout
    assert f"{error} |" in result.stdout


def test_words_pick_names():
    names = ["flat-1", "flat-10", "ring-1"]
    assert picked(names, []) == names
    assert picked(names, ["flat-1"]) == ["flat-1"]
    assert picked(names, ["flat"]) == ["flat-1", "flat-10"]
    assert picked(names, ["hall"]) == []
