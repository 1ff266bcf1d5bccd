"""Where a robot is in a map that is known."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from echogrid import Frame, Grid, Localiser, Robot, localise
from echogrid.errors import UsageError
from echogrid.geometry import compose, inverse, wrap
from echogrid.grid import logit
from echogrid.position.beams import REACH_M, Beams
from echogrid.position.hypotheses import Hypotheses, same_place
from echogrid.position.localise import _off_floor
from echogrid.position.localiser import FAIR
from echogrid.position.particles import Particles
from echogrid.position.usual import Usual
from echogrid.robot import parse_robot

CELL = 0.05
ROBOT = """
name: four
footprint_radius_m: 0.1
sonar: {transducer: polaroid-600, min_range_m: 0.05, max_range_m: 4.0, beam_width_deg: 10}
mounts: [[0, 0, 0], [0, 0, 90], [0, 0, 180], [0, 0, -90]]
"""


@pytest.fixture(scope="module")
def robot() -> Robot:
    return parse_robot(ROBOT, "four.yaml")


def plan(width: float = 5.0, height: float = 3.0) -> Grid:
    """A room whose lower left corner is the origin, with a closet that makes every place in it unlike the others."""
    rim = 4
    cells = np.ones((round(height / CELL) + 2 * rim, round(width / CELL) + 2 * rim), dtype=bool)
    cells[rim:-rim, rim:-rim] = False
    cells[rim : rim + 16, rim + 30 : rim + 50] = True
    log_odds = np.where(cells, logit(0.95), logit(0.05)).astype(np.float32)
    return Grid(log_odds, np.ones_like(cells), CELL, (-rim * CELL, -rim * CELL))


def ranges(grid: Grid, robot: Robot, pose) -> np.ndarray:
    """What narrow beams hear: steps of a millimetre along the axis, an oracle of its own."""
    taken = grid.log_odds > 0
    sonars = compose(np.asarray(pose)[None], robot.mounts)
    way = np.arange(0, robot.max_range_m, 0.001)
    heard = []
    for x, y, axis in sonars:
        cells = grid.index_of(np.stack([x + way * np.cos(axis), y + way * np.sin(axis)], axis=1))
        wall = taken[tuple(np.clip(cells, 0, np.array(grid.shape) - 1).T)]
        heard.append(way[np.argmax(wall)] if wall.any() else np.inf)
    return np.array(heard)


def drive() -> np.ndarray:
    """Round the room: along three sides, twice there and back."""
    corners = np.array([[0.6, 0.7], [0.6, 2.3], [4.2, 2.3], [4.2, 0.7]])
    corners = np.concatenate([corners, corners[-2::-1]])
    poses, heading = [], np.pi / 2
    for a, b in pairwise(corners):
        to = np.arctan2(*(b - a)[::-1])
        turn = wrap(to - heading)
        poses += [(*a, heading + turn * k / 10) for k in range(10)]
        n = round(np.hypot(*(b - a)) / 0.05)
        poses += [(*(a + (b - a) * k / n), to) for k in range(n)]
        heading = to
    return np.array(poses)


def drifting(poses: np.ndarray, bias: float = np.deg2rad(2.0)) -> np.ndarray:
    """Dead reckoning that begins at 0, turns by itself and measures 2 % too long."""
    steps = compose(inverse(poses[:-1]), poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])
    steps = np.column_stack([1.02 * steps[:, :2], steps[:, 2] + bias * way])
    found = [np.zeros(3)]
    for step in steps:
        found.append(compose(found[-1], step))
    return np.array(found)


def frames(grid: Grid, robot: Robot, poses: np.ndarray, odometry: np.ndarray) -> list[Frame]:
    return [Frame(0.1 * k, o, ranges(grid, robot, p)) for k, (p, o) in enumerate(zip(poses, odometry, strict=True))]


@pytest.fixture(scope="module")
def case(robot):
    grid, poses = plan(), drive()
    return grid, poses, frames(grid, robot, poses, drifting(poses))


def off(found: np.ndarray, poses: np.ndarray) -> np.ndarray:
    return np.hypot(*(found - poses)[:, :2].T)


def test_a_drive_is_tracked_though_its_odometry_drifts(case, robot):
    grid, poses, log = case
    by_odometry = compose(poses[0], np.array([f.pose for f in log]))
    assert off(by_odometry, poses).max() > 0.5
    found = localise(log, grid, robot, poses[0])
    assert found.sure.all()
    assert not found.events
    assert np.sqrt(np.mean(off(found.poses, poses) ** 2)) < 0.08
    assert np.abs(wrap(found.poses[:, 2] - poses[:, 2])).max() < np.deg2rad(8)


def test_poses_off_the_free_floor_are_known(case, robot):
    grid, poses, log = case
    assert not localise(log[:100], grid, robot, poses[0]).off_floor.any()
    places = np.array([(1.0, 1.5, 0.0), (-0.05, 1.5, 0.0), (-0.15, 1.5, 0.0), (2.0, 0.3, 0.0), (9.0, 9.0, 0.0)])
    np.testing.assert_array_equal(_off_floor(grid, places), [False, False, True, True, True])


def test_a_robot_is_found_anywhere_and_so_is_the_way_that_led_there(case, robot):
    grid, poses, log = case
    found = localise(log, grid, robot, seed=1)
    assert [event.what for event in found.events] == ["sure"]
    event = found.events[0]
    assert event.driven_m < 15
    assert event.stamp == log[event.frame].stamp
    assert found.sure.all()
    assert off(found.poses, poses).max() < 0.3


def test_a_place_that_cannot_be_told_is_not_sure(robot):
    # A round room looks the same from each heading.
    size = 100
    y, x = np.mgrid[:size, :size]
    round_room = np.hypot(x - 49.5, y - 49.5) > 30
    grid = Grid(
        np.where(round_room, 3.0, -3.0).astype(np.float32), np.ones((size, size), dtype=bool), CELL, (0.0, 0.0)
    )
    poses = np.array([(2.5, 2.5, 0.05 * k) for k in range(400)])
    found = localise(frames(grid, robot, poses, poses), grid, robot)
    assert not found.sure.any()
    assert found.events == []


def test_the_same_seed_gives_the_same_poses(case, robot):
    grid, poses, log = case
    first, again, other = (localise(log[:60], grid, robot, poses[0], seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.poses, again.poses)
    assert not np.array_equal(first.poses, other.poses)


def test_a_mirrored_drive_gives_the_mirrored_trajectory(case, robot):
    grid, poses, log = case
    mirrored = replace(
        grid, log_odds=grid.log_odds[::-1], origin=(grid.origin[0], -grid.origin[1] - grid.shape[0] * CELL)
    )
    flip = np.array([1, -1, -1])
    swapped = [0, 3, 2, 1]
    there = [Frame(f.stamp, f.pose * flip, f.ranges[swapped]) for f in log]
    one = localise(log, grid, robot, poses[0]).poses
    other = localise(there, mirrored, robot, poses[0] * flip).poses * flip
    assert off(one, other).max() < 0.12
    assert np.mean(off(one, other)) < 0.04


def test_what_stands_stays(case, robot):
    grid, poses, log = case
    localiser = Localiser(grid, robot, poses[0])
    for k in range(50):
        estimate = localiser.add(replace(log[0], stamp=0.1 * k))
        np.testing.assert_array_equal(estimate.pose, poses[0])


def test_an_odometry_that_begins_anew_is_told_and_survived(case, robot):
    grid, poses, log = case
    half = len(log) // 2
    anew = inverse(compose(log[half].pose, np.array([3.0, 1.0, 2.0])))
    log = log[:half] + [replace(f, pose=compose(anew, f.pose)) for f in log[half:]]
    found = localise(log, grid, robot, poses[0])
    assert [event.what for event in found.events] == ["jump"]
    assert found.events[0].frame == half
    assert off(found.poses, poses).max() < 0.3


def test_a_start_that_is_wrong_is_noticed(case, robot):
    grid, _, log = case
    found = localise(log, grid, robot, (4.2, 1.0, 0.0))
    assert "lost" in [event.what for event in found.events]


@pytest.mark.unchecked
def test_a_robot_that_is_carried_away_without_a_jump_says_so_and_is_found_again(robot):
    grid, poses = plan(8.0, 3.0), drive()
    there = poses * (1, 1, 1) + (3.0, 0, 0)  # the same way, where there is no closet
    odometry = np.concatenate([poses, compose(poses[-1], compose(inverse(there[0]), there))])
    truth = np.concatenate([poses, there])
    found = localise(frames(grid, robot, truth, odometry), grid, robot, poses[0])
    carried = len(poses)
    lost = [event.frame for event in found.events if event.what == "lost"]
    assert lost
    assert carried < lost[0] < carried + 150
    wrong = (off(found.poses, truth) > 0.5) & found.sure
    assert not wrong[:carried].any()
    assert not wrong[lost[0] + 1 :].any()


def test_what_is_usual_is_learned_and_what_is_far_below_it_is_poor():
    rng = np.random.default_rng(0)
    usual = Usual()
    agreements = rng.normal(10, 4, 2000).tolist()
    told = []
    for agreement in agreements:
        told.append(usual.poor(agreement))
        usual.add(agreement)
    assert not any(told[:12])
    assert np.mean(told) < 0.03
    assert usual.poor(-5.0)
    assert not usual.poor(5.0)


@pytest.mark.parametrize(
    ("start", "line"),
    [
        ((-0.1, 1.0, 0.0), "in a wall, expected free floor"),
        ((50.0, 1.0, 0.0), "outside of the map, expected a place in it: x -0.2 to 5.2, y -0.2 to 3.2 m"),
        ((1.0, np.nan, 0.0), "expected x, y, heading"),
        ((1.0, 2.0), "expected x, y, heading"),
    ],
)
def test_a_start_that_cannot_be_is_refused(robot, start, line):
    with pytest.raises(UsageError, match=line):
        Localiser(plan(), robot, start)


def test_a_start_of_which_the_map_knows_nothing_is_refused(robot):
    grid = plan()
    grid.observed[20:30, 20:30] = False
    with pytest.raises(UsageError, match="of which the map knows nothing"):
        Localiser(grid, robot, (*grid.centre_of(np.array([25, 25])), 0.0))


@pytest.mark.parametrize("value", [2.0, -2.0])
def test_a_map_without_walls_or_without_floor_is_refused(robot, value):
    grid = Grid(np.full((10, 10), value, np.float32), np.ones((10, 10), dtype=bool), CELL, (0.0, 0.0))
    with pytest.raises(UsageError, match=r"map: found no (wall|free floor), expected both"):
        Localiser(grid, robot)


def test_a_frame_that_cannot_be_changes_nothing(case, robot):
    grid, poses, log = case
    localiser, spared = Localiser(grid, robot, poses[0]), Localiser(grid, robot, poses[0])
    for frame in log[:30]:
        with pytest.raises(UsageError):
            localiser.add(replace(frame, ranges=np.array([1.0, -1.0, 1.0, 1.0])))
        np.testing.assert_array_equal(localiser.add(frame).pose, spared.add(frame).pose)


def test_beams_prefer_the_place_that_was_heard(robot):
    grid = plan()
    beams = Beams(grid, robot)
    rng = np.random.default_rng(0)
    for pose in drive()[::25]:
        poses = np.concatenate([pose[None], rng.uniform((0.1, 1.2, -3.2), (4.9, 2.9, 3.2), (400, 3))])
        logs = beams.log_likelihood(poses, ranges(grid, robot, pose), robot.mounts)
        assert np.mean(logs > logs[0]) < 0.03
        assert not beams.log_likelihood(poses, np.full(4, np.nan), robot.mounts).any()


def test_beams_see_no_farther_than_sonars(robot):
    assert robot.max_range_m < REACH_M
    beams = Beams(plan(12.0, 12.0), robot)
    middle = np.array([[6.0, 6.0, 0.3]])
    silence = beams.log_likelihood(middle, np.full(4, np.inf), robot.mounts)[0]
    assert silence == 0
    assert beams.log_likelihood(middle, np.full(4, 1.0), robot.mounts)[0] < -8


def test_particles_keep_their_distribution_when_they_are_drawn_anew():
    rng = np.random.default_rng(0)
    particles = Particles(rng.uniform(-3, 3, (20_000, 3)), np.zeros(20_000))
    particles.reweight(-0.5 * np.sum((particles.poses - 0.5) ** 2, axis=1))
    mean = particles.weights @ particles.poses
    particles.resample(20_000, 20_000, rng)
    np.testing.assert_allclose(particles.poses.mean(axis=0), mean, atol=0.02)
    assert particles.effective() == pytest.approx(20_000)


def test_fewer_places_need_fewer_particles():
    rng = np.random.default_rng(0)
    near = Particles(rng.normal(0, 0.05, (5000, 3)), np.zeros(5000)).wanted(500, 100_000)
    far = Particles(rng.normal(0, 3, (5000, 3)), np.zeros(5000)).wanted(500, 100_000)
    assert near <= 1500 < far


def test_heaps_of_particles_are_found_the_heaviest_first():
    rng = np.random.default_rng(0)
    middles = np.array([(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, np.pi)])
    counts = [600, 300, 100]
    heaps = [middle + 0.05 * rng.standard_normal((n, 3)) for middle, n in zip(middles, counts, strict=True)]
    poses = np.concatenate(heaps)
    particles = Particles(poses, np.zeros(1000))
    found = particles.places((0.5, 0.4), 5, 0.05)
    np.testing.assert_allclose([place.share for place in found], [0.6, 0.3, 0.1])
    np.testing.assert_allclose([place.pose[:2] for place in found], middles[:, :2], atol=0.02)
    assert len(particles.places((0.5, 0.4), 5, 0.2)) == 2
    assert particles.places((0.5, 0.4), 1, 0.9)[0].share == pytest.approx(0.6)


@pytest.fixture(scope="module")
def noted(case, robot) -> Hypotheses:
    """Places that a localiser thought possible in the first metres of the drive."""
    grid, _, log = case
    localiser, found, pieces = Localiser(grid, robot), Hypotheses(), 0
    for k, frame in enumerate(log):
        localiser.add(frame)
        if localiser.sure:
            break
        if localiser.pieces > pieces:
            found.note(localiser, k)
        pieces = localiser.pieces
    return found


def test_of_several_ways_the_one_is_taken_that_explains_the_whole_drive(case, robot, noted):
    grid, poses, log = case
    way = noted.likeliest(Localiser(grid, robot), log)
    assert off(way.poses, poses).max() < 0.3
    assert way.fair


def test_a_place_that_seemed_sure_is_given_up_where_another_explains_more(case, robot, noted):
    grid, poses, log = case
    wrong = (100, np.array([2.0, 1.5, 2.0]))
    way = noted.likeliest(Localiser(grid, robot), log, wrong)
    assert not same_place(way.poses[100], wrong[1])
    assert off(way.poses, poses).max() < 0.3
    right = noted.likeliest(Localiser(grid, robot), log, (100, poses[100]))
    assert same_place(right.poses[100], poses[100])


def test_in_the_map_of_another_place_none_is_sure_and_little_agrees(case, robot):
    _, poses, log = case
    other = plan(3.5, 3.5)
    assert not localise(log, other, robot, seed=1).sure.any()
    there, here = localise(log, other, robot, (1.0, 1.0, 0.0)), localise(log, case[0], robot, poses[0])
    assert there.agreement < FAIR < here.agreement / 1.5


def test_places_of_no_drive_have_no_way(case, robot):
    assert Hypotheses().likeliest(Localiser(case[0], robot), case[2]) is None
