import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import inf, nan

from echogrid import Frame, Log, Robot, World
from echogrid.doubts import GLITCH_M, STAYS, Judge, Whereabouts, speeds
from echogrid.geometry import wrap
from echogrid.simulation.drive import tour

P3DX = Robot.load("p3dx")
MAX_M = P3DX.max_range_m


def drive(frames=400, seed=0):
    """Stamps, poses and readings of a robot that drives about, as a faultless log has them."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.1, frames)) + rng.uniform(-3, 3)
    step = rng.uniform(0.0, 0.06, frames)
    xy = rng.uniform(-20, 20, 2) + np.cumsum(step[:, None] * np.column_stack([np.cos(heading), np.sin(heading)]), 0)
    ranges = rng.uniform(0.2, MAX_M, (frames, P3DX.sonars))
    ranges[rng.random(ranges.shape) < 0.3] = inf
    return 1.7e9 + 0.1 * np.arange(frames), np.column_stack([xy, heading]), ranges


def notes(stamps, poses, ranges, robot=P3DX, part=64):
    judge = Judge(robot)
    for i in range(0, len(stamps), part):
        judge.see(stamps[i : i + part], poses[i : i + part], ranges[i : i + part])
    return judge.notes()


@given(st.integers(0, 10_000), st.sampled_from([1, 7, 64, 400]))
def test_a_faultless_drive_is_not_doubted(seed, part):
    assert notes(*drive(seed=seed), part=part) == {}


@pytest.mark.parametrize("part", [1, 7, 64, 400, 2000])
def test_jumps_are_counted_the_same_however_the_frames_come(part):
    stamps, poses, ranges = drive(2000)
    for at in (300, 700, 701, 1999):
        poses[at:, :2] += 3.0
    (told,) = notes(stamps, poses, ranges, part=part)
    assert "the pose jumps by 4." in told
    assert f"at {stamps[300]:.2f} s and 3 times more" in told


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_ranges_in_other_units_are_told_with_their_cause(unit):
    stamps, poses, ranges = drive()
    (told,) = notes(stamps, poses, unit * ranges)
    assert "past max_range" in told
    assert "cm or mm" in told


def test_an_array_that_never_hears_an_echo_is_told():
    stamps, poses, ranges = drive()
    (told,) = notes(stamps, poses, np.full_like(ranges, inf))
    assert told.startswith("no sonar ever heard an echo, all 6400 readings are no echo")
    ranges[:] = inf
    ranges[-1, 3] = 1.0
    assert notes(stamps, poses, ranges) == {}


@pytest.mark.parametrize("dead", [1, 8])
def test_sonars_that_never_hear_an_echo_though_the_others_do_are_told(dead):
    stamps, poses, ranges = drive()
    ranges[:, 3 : 3 + dead] = inf
    (told,) = notes(stamps, poses, ranges)
    assert told.startswith(f"{dead} of 16 sonars never hear an echo (r3")
    assert "the others do in 70% of their readings" in told
    # On a short way, or where the others hear little, that is no wonder.
    assert notes(stamps, poses * [0.01, 0.01, 1], ranges) == {}
    few = np.where(np.random.default_rng(1).random(ranges.shape) < 0.6, inf, ranges)
    assert notes(stamps, poses, few) == {}


def test_ranges_below_the_minimum_are_told():
    stamps, poses, ranges = drive()
    (told,) = notes(stamps, poses, ranges / 1000)
    assert "100% of the readings with an echo are below min_range" in told
    mostly = np.where(np.random.default_rng(1).random(ranges.shape) < 0.7, inf, ranges / 1000)
    assert "below min_range" in " ".join(notes(stamps, poses, mostly))


def test_stamps_in_milliseconds_are_told():
    stamps, poses, ranges = drive()
    (told,) = notes(1000 * (stamps - stamps[0]), poses, ranges)
    assert "are the stamps in ms?" in told


def test_headings_that_never_change_though_the_robot_drives_every_way_are_told():
    stamps, poses, ranges = drive(4000)
    (told,) = notes(stamps, poses * [1, 1, 0], ranges)
    assert told.startswith("theta is always 0, though the robot drives every way")
    poses[:, 1:] = 0.0  # to and fro along one line
    assert notes(stamps, poses, ranges) == {}


def test_one_longest_value_that_comes_again_and_again_is_the_sensors_no_echo():
    stamps, poses, ranges = drive()
    (told,) = notes(stamps, poses, np.where(np.isinf(ranges) | (ranges > 4.0), 4.0, ranges))
    assert told.startswith("the longest range, 4 m, comes")
    assert "max_range_m is 4" in told
    stale = ranges.copy()
    stale[1::2] = stale[::2]
    assert notes(stamps, poses, stale) == {}


@pytest.mark.parametrize(("unit", "per_radian"), [("degrees", 180 / np.pi), ("tenths of a degree", 1800 / np.pi)])
@pytest.mark.parametrize("backwards", [False, True])
def test_headings_in_degrees_are_told(unit, per_radian, backwards):
    stamps, poses, ranges = drive()
    poses[:, 2] += np.pi * backwards
    told = notes(stamps, poses * [1, 1, per_radian], ranges)
    assert list(told) == [f"the headings agree with the way driven if theta is in {unit}: it has to be in radians"]


def test_a_robot_that_drives_sideways_is_not_doubted():
    stamps, poses, ranges = drive()
    rng = np.random.default_rng(1)
    assert notes(stamps, poses + np.array([0, 0, 1.2]), ranges) == {}
    assert notes(stamps, poses * [1, 1, 0] + [0, 0, 1] * rng.uniform(-0.2, 0.2, (400, 1)), ranges) == {}


@given(st.integers(1, 398), st.floats(1.2, 200.0))
def test_a_jump_is_told_with_its_time_and_length(at, far):
    stamps, poses, ranges = drive()
    poses[at:, 0] += far
    (told,) = notes(stamps, poses, ranges)
    length = np.hypot(*np.diff(poses[at - 1 : at + 1, :2], axis=0)[0])
    assert told.startswith(f"the pose jumps by {length:.2f} m at {stamps[at]:.2f} s, faster than any robot")


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_poses_in_other_units_are_told_once(unit):
    stamps, poses, ranges = drive()
    rng = np.random.default_rng(3)
    poses[:, :2] = np.cumsum(0.05 + 0 * rng.random((400, 2)), axis=0)
    (told,) = notes(stamps, poses * [unit, unit, 1], ranges)
    assert "are the poses in mm or cm" in told


@given(st.integers(1, 398), st.integers(1, STAYS - 1))
def test_a_glitch_is_left_out_and_told(at, length):
    stamps, poses, ranges = drive()
    poses[at : at + length, 1] += 20_000.0
    told = notes(stamps, poses, ranges)
    left = len(poses[at : at + length])
    assert told == {"a scan left out: its pose is where no robot can have got to": left}


def test_a_place_at_which_the_robot_stays_is_taken():
    where = Whereabouts()
    taken = [where.takes(0.1 * i, 2 * GLITCH_M * (i > 4), 0.0) for i in range(60)]
    assert taken == [True] * 5 + [False] * STAYS + [True] * (55 - STAYS)


def test_speeds_are_those_of_the_steps_that_are_no_jumps():
    track = np.array(
        [[0.0, 0, 0, 0], [1.0, 0.5, 0, 0.3], [2.0, 0.5, 2.0, -0.2], [2.1, 50.0, 0, 0], [3.1, 50.0, 1, 0]]
    )
    found = speeds(track)
    np.testing.assert_array_equal(found.far, [False, False, True, False])
    assert found.fastest_m_s == pytest.approx(2.0)
    assert found.fastest_rad_s == pytest.approx(0.5)


def test_a_log_of_frames_tells_its_doubts_when_it_was_gone_through():
    stamps, poses, ranges = drive()
    poses[200:, 0] += 30.0
    log = Log.of(map(Frame, stamps.tolist(), poses, ranges))
    assert log.notes == {}
    for _ in range(2):
        assert len(list(log)) == 400
        assert [note.split(" by ")[0] for note in log.notes] == ["the pose jumps"]


def test_no_echo_that_is_said_as_0_is_told():
    stamps, poses, ranges = drive()
    (told,) = notes(stamps, poses, np.where(ranges == inf, 0.0, ranges))
    assert told.startswith("29% of the readings are 0 m")
    rare = np.where(np.random.default_rng(0).random(ranges.shape) < 0.1, 0.0, ranges)
    assert notes(stamps, poses, rare) == {}


def test_stamps_that_are_all_the_same_are_told():
    stamps, poses, ranges = drive()
    (told,) = notes(0 * stamps, poses, ranges)
    assert told.startswith("all stamps are 0 s")
    assert notes(np.floor(stamps), poses, ranges) == {}


@given(st.integers(1, 16), st.floats(0.4, 4.9))
def test_who_stands_before_a_wall_hears_the_same_again_and_again(sonars, far):
    stamps, poses, _ = drive()
    walls = far * np.linspace(0.5, 1.0, sonars) * np.ones((400, 1))
    assert notes(stamps, 0 * poses, walls) == {}
    (told,) = notes(stamps, poses, np.full((400, sonars), far))
    assert "the longest range" in told


def test_few_frames_are_not_doubted():
    for ranges in ([nan, nan], [inf, inf], [0.001, 0.002]):
        assert notes(np.array([0.0]), np.zeros((1, 3)), np.array([ranges])) == {}


def test_every_doubt_is_on_the_page_about_maps_that_look_wrong():
    page = (Path(__file__).parents[1] / "docs" / "how-to" / "when-a-map-looks-wrong.md").read_text(encoding="utf-8")
    stamps, poses, ranges = drive()
    jumped, glitch, sped = poses.copy(), poses.copy(), poses.copy()
    jumped[200:, 0] += 30.0
    glitch[200, 0] += 20_000.0
    sped[:, 0] = 50.0 * np.arange(400)
    faults = [
        (poses, np.full_like(ranges, inf)),
        (poses, 100 * ranges),
        (poses, ranges / 1000),
        (poses, np.where(np.isinf(ranges), MAX_M - 0.1, np.minimum(ranges, MAX_M - 0.1))),
        (poses * [1, 1, 180 / np.pi], ranges),
        (poses * [0, 0, 180 / np.pi] + np.arange(400)[:, None] * [0, 0, 2.0], ranges),
        *((each, ranges) for each in (jumped, glitch, sped)),
    ]
    for faulty_poses, faulty_ranges in faults:
        (told,) = notes(stamps, faulty_poses, faulty_ranges)
        words = [re.escape(word) for word in re.split(r"[\d.]+(?:e\+?\d+)?", told.split(":")[0]) if len(word) > 6]
        assert any(re.search(word, page) for word in words), told


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(8, 16), st.integers(0, 150), st.sampled_from([7, 64, 400]))
def test_sonars_that_repeat_one_value_while_the_robot_drives_are_told(seed, many, since, part):
    stamps, poses, ranges = drive(seed=seed)
    poses[:, :2] *= 3  # far enough for all seeds
    which = np.random.default_rng(seed).permutation(P3DX.sonars)[:many]
    ranges[since:, which] = np.linspace(1.0, 3.0, many)
    (told,) = notes(stamps, poses, ranges, part=part)
    assert told.startswith(f"{f'{many} of 16' if many < 16 else 'all 16'} sonars repeat one value to the last bit")
    (when,) = re.findall(r"since ([\d.]+) s while", told)
    assert float(when) - stamps[since] == pytest.approx(0.05, abs=0.07)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(1, 7), st.sampled_from([1, 64]))
def test_fewer_sonars_or_sonars_of_a_robot_that_stands_or_passes_a_wall_may_repeat_a_value(seed, few, part):
    stamps, poses, ranges = drive(seed=seed)
    ranges[:, :few] = 1.5
    assert notes(stamps, poses, ranges, part=part) == {}
    walls = np.linspace(1.0, 3.0, 16) * np.ones((400, 1))
    assert notes(stamps, 0 * poses, walls, part=part) == {}
    walls[:, 0] = 0.5 + 0.01 * np.arange(400)
    along = np.column_stack([0.02 * np.arange(400), np.zeros(400), np.pi * (-1.0) ** np.arange(400)])
    assert notes(stamps, along, walls, part=part) == {}


def test_sonars_that_fire_in_turn_and_repeat_one_value_are_told():
    stamps, poses, ranges = drive(2000)
    turns = np.arange(2000)[:, None] % 4 == np.arange(16) % 4
    assert notes(stamps, poses, np.where(turns, ranges, nan)) == {}
    (told,) = notes(stamps, poses, np.where(turns, np.linspace(1.0, 3.0, 16), nan))
    assert told.startswith("all 16 sonars repeat one value")


def passing_a_room(frames, seed):
    """Ranges in a box of 6 by 4 m along a drive through it, with noise."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0, 6, frames) + rng.uniform(0, 6)
    x, y = 2.0 * np.cos(turn), 1.2 * np.sin(turn)
    axes = turn[:, None] + np.linspace(0, 2 * np.pi, 16, endpoint=False)
    far = np.minimum(
        (3 - np.sign(np.cos(axes)) * x[:, None]) / np.abs(np.cos(axes)),
        (2 - np.sign(np.sin(axes)) * y[:, None]) / np.abs(np.sin(axes)),
    )
    return np.column_stack([x, y, turn + np.pi / 2]), far + rng.normal(0, 0.02, far.shape)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(0, 150), st.sampled_from([7, 64, 400]))
def test_odometry_that_dies_while_the_robot_drives_is_told_with_its_times(seed, at, part):
    poses, ranges = passing_a_room(400, seed)
    stamps = 0.1 * np.arange(400)
    assert notes(stamps, poses, ranges, part=part) == {}
    poses[at : at + 200] = poses[at]
    (told,) = (each for each in notes(stamps, poses, ranges, part=part) if "jumps" not in each)
    assert told.startswith(
        f"the pose stays exactly the same from {stamps[at]:.2f} to {stamps[at + 199]:.2f} s while most sonars hear"
    )


@settings(max_examples=20)
@given(st.integers(0, 1000), st.floats(0.0, 0.1), st.sampled_from([7, 64]))
def test_a_robot_that_stands_among_people_is_not_doubted(seed, noise, part):
    rng = np.random.default_rng(seed)
    stamps, (poses, ranges) = 0.1 * np.arange(400), passing_a_room(400, seed)
    ranges = ranges[0] + rng.normal(0, noise, ranges.shape)
    for _ in range(40):  # people who come and go
        first, sonar, stay = rng.integers(0, 380), rng.integers(0, 15), rng.integers(5, 60)
        there = rng.uniform(0.4, 1.5) + 0.02 * np.arange(stay)[:, None]
        part_of = ranges[first : first + stay, sonar : sonar + 2]
        part_of[:] = np.minimum(part_of, there[: len(part_of)])
    assert notes(stamps, np.tile(poses[0], (400, 1)), np.maximum(ranges, 0.2), part=part) == {}


@given(st.integers(4, 1990), st.floats(70, 180), st.sampled_from([-1, 1]), st.sampled_from([7, 64, 400]))
@settings(max_examples=30)
def test_a_heading_that_jumps_is_told_with_its_time(at, degrees, side, part):
    stamps, poses, ranges = drive(2000)
    poses[:, :2] *= 4  # it never all but stands, where a turn that is not in the log is as likely as a jump
    poses[:, 2] = 0.5
    poses[at:, 2] += side * np.deg2rad(degrees)
    (told,) = notes(stamps, poses, ranges, part=part)
    assert told.startswith(f"the heading jumps by {degrees:.0f} degrees at {stamps[at]:.2f} s, ")


@pytest.mark.parametrize("rad_s", [0.5, 2.0, 5.0])
def test_a_robot_that_turns_on_the_spot_is_not_doubted(rad_s):
    stamps, poses, ranges = drive()
    poses[100:200, :2] = poses[100, :2]
    poses[200:, :2] += poses[100, :2] - poses[200, :2]
    poses[100:200, 2] = poses[100, 2] + rad_s * 0.1 * np.arange(100)
    poses[200:, 2] += poses[199, 2] - poses[200, 2]
    assert notes(stamps, poses, ranges) == {}


@pytest.mark.parametrize(("world", "robot"), [("corridor", "p3dx"), ("lab", "robuter2"), ("plant", "scitos-g5")])
@pytest.mark.parametrize("part", [7, 64])
def test_a_robot_whose_log_has_its_way_but_not_how_it_turned_is_not_doubted(world, robot, part):
    """As those have that keep a pose every few centimetres, and the simulator's."""
    poses = tour(World.load(world), Robot.load(robot).footprint_radius_m + 0.1)
    assert np.max(np.abs(wrap(np.diff(poses[:, 2])))) > 1.2
    ranges = np.random.default_rng(0).uniform(0.5, 3, (len(poses), 15))
    assert notes(0.2 * np.arange(len(poses)), poses, ranges, part=part) == {}
