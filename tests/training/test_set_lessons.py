from math import pi

import numpy as np
import pytest

from echogrid.errors import UsageError
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.models.networks.memory import TRAITS, Memory
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.drive import truth_of
from echogrid.simulation.rooms import SHAPES, random_world
from echogrid.simulation.simulate import sonar_poses
from echogrid.simulation.world import World, polyline
from echogrid.training import drives
from echogrid.training import set_lessons as making
from echogrid.training.set_lessons import (
    FRAMES,
    KIND,
    MOST_SONARS,
    NEAR_M,
    NEAR_SHARE,
    POINTS,
    REACH_M,
    TRUTH_M,
    lessons,
    random_way,
)

P3DX, B21 = Robot.load("p3dx"), Robot.load("b21")
DRIVES = 8
SURFACES, NEAR, FAR, BEHIND, DEEP = np.split(np.arange(sum(POINTS)), np.cumsum(POINTS)[:-1])
"""Which of a drive's points are of which kind."""


@pytest.fixture(scope="module", autouse=True)
def small_chunks():
    """Few drives are simulated together, so that few drives are quick and make several chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drives, "_CHUNK", 4)
        yield


@pytest.fixture(scope="module")
def made():
    return lessons(None, DRIVES, seed=3)


@pytest.fixture(scope="module")
def with_b21():
    return lessons(B21, 4, seed=3)


def drives_laid_out(count=6, robot=P3DX):
    return [drives.random_drive(np.random.default_rng(seed), robot, KIND) for seed in range(5, 5 + count)]


@pytest.fixture(scope="module")
def laid_out():
    return drives_laid_out()


def test_lessons_have_the_shapes_that_they_promise(made):
    most = MOST_SONARS[1]
    assert made.ranges.shape == (DRIVES, FRAMES, most)
    assert made.mounts.shape == (DRIVES, most, 3)
    assert made.max_range.shape == (DRIVES, most)
    assert made.beam.shape == (DRIVES,)
    assert made.poses.shape == (DRIVES, FRAMES, 3)
    assert made.weight.shape == (DRIVES, FRAMES)
    assert made.traits.shape == (DRIVES, FRAMES, TRAITS)
    assert made.points.shape == (DRIVES, sum(POINTS), 2)
    assert made.label.shape == (DRIVES, sum(POINTS))
    assert made.ranges.dtype == np.float16
    for field in (made.poses, made.weight, made.traits, made.points, made.max_range, made.beam):
        assert np.isfinite(field).all()


def test_labels_come_in_fixed_numbers_in_a_fixed_order(made):
    kinds = np.repeat([SURFACE, FREE, FREE, HIDDEN, HIDDEN], POINTS)
    np.testing.assert_array_equal(made.label, np.tile(kinds, (DRIVES, 1)))


def test_readings_are_those_of_sonars_that_are_there(made):
    missing = np.isnan(made.mounts).all(axis=-1)
    assert np.isnan(np.moveaxis(made.ranges, 1, -1)[missing]).all()
    there = np.moveaxis(made.ranges, 1, -1)[~missing]
    finite = there[np.isfinite(there)]
    assert finite.min() > 0.05
    assert np.isposinf(there).any()
    assert not np.isneginf(there).any()
    for ranges, longest in zip(made.ranges, made.max_range, strict=True):
        # float16 has 2 mm at 4 m.
        assert np.all(np.max(ranges, axis=0, where=np.isfinite(ranges), initial=0.0) <= longest * (1 + 1e-3))
    # The sonars that are there come first.
    np.testing.assert_array_equal(missing, np.sort(missing, axis=1))
    assert 1 <= np.sum(~missing, axis=1).min() < MOST_SONARS[0]


def test_what_is_recalled_is_of_the_drive(made):
    for k in range(DRIVES):
        sonars = ~np.isnan(made.mounts[k, :, 0])
        memory = Memory(made.mounts[k, sonars].astype(float))
        recalled = memory.take(made.poses[k].astype(float), made.ranges[k][:, sonars].astype(float))
        # A pose may lie where rounding decides its place, and float16 has 2 mm of a reading.
        assert np.mean(recalled.weight != made.weight[k]) < 0.1
        np.testing.assert_allclose(recalled.traits, made.traits[k], atol=0.03)
    np.testing.assert_array_equal(made.weight[:, 0], 1)


def test_a_robot_drives_with_its_own_array(with_b21):
    sonars = B21.sonars
    np.testing.assert_allclose(with_b21.mounts[:, :sonars], np.tile(B21.mounts, (4, 1, 1)), atol=1e-6)
    assert np.isnan(with_b21.mounts[:, sonars:]).all()
    np.testing.assert_allclose(with_b21.max_range[:, :sonars], B21.max_range_m)
    np.testing.assert_allclose(with_b21.beam, B21.beam_width_rad)


def test_a_seed_gives_the_same_lessons_however_many_are_asked_for(made):
    for some, all_ in zip(lessons(None, 5, seed=3), made, strict=True):
        np.testing.assert_array_equal(some, all_[:5])


def test_another_seed_gives_other_lessons(with_b21):
    other = lessons(B21, 4, seed=4)
    for name in ("ranges", "poses", "points"):
        assert not np.array_equal(getattr(other, name), getattr(with_b21, name), equal_nan=True)


def test_points_are_of_the_truth_and_of_their_kinds(laid_out):
    for d in laid_out:
        truth = truth_of(d.world, d.poses, TRUTH_M, REACH_M)
        at = (d.points - truth.origin) / truth.resolution
        np.testing.assert_allclose(at % 1, 0.5, atol=1e-6)
        col, row = at.astype(int).T
        np.testing.assert_array_equal(truth.cells[row, col], d.label)
        rows, cols = np.nonzero(truth.cells == SURFACE)
        surface = (np.column_stack([cols, rows]) + 0.5) * truth.resolution + truth.origin
        gap = np.min(np.linalg.norm(d.points[:, None] - surface, axis=-1), axis=1)
        assert np.all(gap[SURFACES] < 1e-6)
        assert np.all((gap[NEAR] > 0) & (gap[NEAR] < 0.4))
        assert np.all(gap[FAR] >= 0.4 - 1e-6)
        assert np.all(gap[BEHIND] < 0.3)
        assert np.all((gap[DEEP] >= 0.3 - 1e-6) & (gap[DEEP] < 1.0))


def test_points_lie_at_walls_in_the_open_and_behind_walls(laid_out):
    half = TRUTH_M / np.sqrt(2)
    for d in laid_out:
        clearance = d.world.clearance(d.points)
        # A surface cell holds the end of a sight line, moved by a centimetre.
        assert np.abs(clearance[SURFACES]).max() < half + 0.011
        assert clearance[FAR].min() > 0.4 - half - 0.011
        assert np.all(clearance[NEAR] > 0)
        # Free is what a straight line from some pose reaches.
        free = np.concatenate([NEAR, FAR])
        to = d.points[free, None] - d.poses[:, :2]
        distance = np.linalg.norm(to, axis=-1)
        start = np.broadcast_to(d.poses[:, :2], to.shape).reshape(-1, 2)
        sight = d.world.sight(start, np.arctan2(to[..., 1], to[..., 0]).ravel()).reshape(distance.shape)
        assert np.mean(np.any((sight > distance) & (distance < REACH_M), axis=1)) > 0.95


def test_most_points_lie_near_the_path(laid_out):
    for d in laid_out:
        near = np.min(np.linalg.norm(d.points[:, None] - d.poses[:, :2], axis=-1), axis=1) < NEAR_M + TRUTH_M
        for kind, count in zip((SURFACES, NEAR, FAR, BEHIND, DEEP), POINTS, strict=True):
            assert near[kind].sum() >= round(NEAR_SHARE * count)


def test_the_mapper_is_told_poses_that_are_nearly_true(laid_out):
    for d in drives_laid_out(2) + laid_out:
        off = d.believed - d.poses
        assert np.abs(off).max() < 0.1
        assert d.poses.shape == (FRAMES, 3)
    assert any(np.any(d.believed != d.poses) for d in laid_out)


def ways(shape, clearance, count=8):
    for seed in range(count):
        rng = np.random.default_rng(seed)
        world = random_world(rng, shape)
        poses = random_way(rng, world, clearance)
        if poses is not None:
            yield world, poses


@pytest.mark.parametrize("shape", SHAPES)
def test_a_way_keeps_its_clearance(shape):
    found = 0
    for world, poses in ways(shape, 0.25):
        found += 1
        assert poses.shape == (FRAMES, 3)
        assert np.isfinite(poses).all()
        assert world.clearance(poses[:, :2]).min() > 0.75 * 0.25
        assert np.all(np.abs(poses[:, 2]) <= pi)
        assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() <= 0.5 + 1e-9
    assert found > 4


@pytest.mark.parametrize(("shape", "seed"), [("corridor", 6), ("hall", 126), ("hall", 7), ("corridor", 101)])
def test_a_way_goes_round_posts(shape, seed):
    rng = np.random.default_rng(seed)
    world = random_world(rng, shape)
    way = random_way(rng, world, 0.17)
    assert way is not None
    assert world.clearance(way[:, :2]).min() > 0.75 * 0.17


def test_some_robots_drive_some_stand_and_some_turn():
    kinds = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        way = random_way(rng, random_world(rng, "room"), 0.2)
        if way is not None:
            stands, looks = np.ptp(way[:, :2], axis=0).max() == 0, np.ptp(np.unwrap(way[:, 2])) == 0
            kinds.add((stands, looks))
    assert kinds == {(True, True), (True, False), (False, True), (False, False)}


def test_where_there_is_no_room_there_is_no_way():
    cell = World(
        "cell", polyline([[0, 0], [0.3, 0], [0.3, 0.3], [0, 0.3]], closed=True), np.zeros(4), np.zeros((0, 3))
    )
    assert random_way(np.random.default_rng(0), cell, 0.2) is None


def test_a_robot_for_which_there_is_no_room_is_one_line(monkeypatch):
    monkeypatch.setattr(drives, "_MOST_TRIES", 3)
    giant = Robot("giant", 9.0, P3DX.transducer, 0.1, 5.0, P3DX.beam_width_rad, P3DX.mounts)
    with pytest.raises(
        UsageError, match=r"^robot giant: found no room .* among 3, expected a footprint_radius_m .* 9\)"
    ):
        lessons(giant, 1, seed=0)


def test_the_shares_of_worlds_are_of_worlds_that_there_are():
    assert KIND.shape_shares.keys() == SHAPES.keys()
    assert sum(KIND.shape_shares.values()) == pytest.approx(1)


def readings(monkeypatch, people, in_turn, count=6):
    """Readings of drives whose every sonar would read 3 m, but for people and for sonars that do not fire."""
    monkeypatch.setattr(making, "PEOPLE_SHARE", people)
    monkeypatch.setattr(making, "IN_TURN_SHARE", in_turn)
    rng = np.random.default_rng(0)
    d = drives.random_drive(rng, P3DX, KIND)
    placed, true = sonar_poses(P3DX.mounts, d.poses), np.full((FRAMES, P3DX.sonars), 3.0)
    calm = Physics(lost=0, cross_talk=0, stale=0, range_noise=0, range_scale=0)
    for _ in range(count):
        yield making._lesson(rng, drives.Driven(d, calm, placed, true)).ranges[:, : P3DX.sonars].astype(float)


def test_sonars_that_fire_in_turn_fire_group_after_group(monkeypatch):
    frame, sonar = np.indices((FRAMES, P3DX.sonars))
    for ranges in readings(monkeypatch, people=0.0, in_turn=1.0):
        fired = ~np.isnan(ranges)
        assert any(np.array_equal(fired, (frame - sonar) % groups == 0) for groups in (2, 3, 4, 8))


def test_people_shorten_some_readings_and_lengthen_none(monkeypatch):
    plain = np.concatenate(list(readings(monkeypatch, people=0.0, in_turn=0.0)))
    passed = np.concatenate(list(readings(monkeypatch, people=1.0, in_turn=0.0)))
    assert np.nanmin(plain) > 2.98
    assert np.nanmax(passed) < 3.02
    assert 0.001 < np.mean(passed < 2.9) < 0.5
    assert not np.isinf(passed).any()
