from dataclasses import replace

import numpy as np
import pytest
from numpy import inf, nan

from echogrid import Robot, World
from echogrid.errors import UsageError
from echogrid.simulation.world import ROUGH_M, SMOOTH_M, polyline
from experiments.common import mujoco_sonar

ROBOT = replace(Robot.load("b21"), mounts=np.zeros((1, 3)), min_range_m=0.2, max_range_m=5.0)
"""One sonar, at the pose."""


@pytest.fixture(autouse=True)
def exact(monkeypatch):
    monkeypatch.setattr(mujoco_sonar, "NOISE", 0.0)


def room(*walls, cylinders=(), rough=False):
    pieces = np.concatenate([np.zeros((0, 4)), *walls])
    heights = np.full(len(pieces), ROUGH_M if rough else SMOOTH_M)
    return World("test", pieces, heights, np.array(cylinders, float).reshape(-1, 3))


def heard(world, *poses):
    """Readings from poses (m, m, degrees)."""
    pytest.importorskip("mujoco")
    where = np.array(poses, float) * [1, 1, np.pi / 180]
    return mujoco_sonar.mujoco_ranges(world, ROBOT, where, np.random.default_rng(0))[:, 0]


def close(metres):
    """A reading that is exact but for the thickness of the walls."""
    return pytest.approx(metres, abs=3e-4)


WALL = polyline([[2, -4], [2, 4]])


@pytest.mark.parametrize("turn_deg", [-14.0, -5.3, 0.0, 7.7, 12.0])
@pytest.mark.parametrize("distance", [0.3, 1.0, 1.9])
def test_a_smooth_wall_in_the_cone_is_heard_at_its_perpendicular_distance(turn_deg, distance):
    assert heard(room(WALL), (2 - distance, 0.3, turn_deg)) == close(distance)


def test_a_smooth_wall_met_obliquely_is_not_heard_and_a_rough_one_is():
    assert heard(room(WALL), (1, 0, 30), (1, 0, 45)).tolist() == [inf, inf]
    # Not before the near rim of the cone meets it, nor after the axis does.
    for turn_deg in (30, 45, 55):
        (reading,) = heard(room(WALL, rough=True), (1, 0, turn_deg))
        assert 1 / np.cos(np.deg2rad(turn_deg - 12.5)) < reading < 1 / np.cos(np.deg2rad(turn_deg))
    assert heard(room(WALL, rough=True), (1, 0, 75)).tolist() == [inf]


def test_a_square_corner_sends_the_sound_back_from_wherever_in_the_cone_it_is():
    corner = room(polyline([[2, -5], [2, 1], [-5, 1]]))
    for x, y in [(1, 0), (0.3, -0.2), (-1, -1.1), (1.1, -0.2), (-1.4, -2.4)]:
        bearing = np.rad2deg(np.arctan2(1 - y, 2 - x))
        readings = heard(corner, *((x, y, bearing + off) for off in (-9, 0, 4)), (x, y, bearing + 15))
        assert readings.tolist() == [*[close(np.hypot(2 - x, 1 - y))] * 3, inf]


def vee(degrees):
    half = np.deg2rad(degrees) / 2
    x, y = 3.5 - 4 * np.cos(half), 4 * np.sin(half)
    return polyline([[x, y], [3.5, 0], [x, -y]])


def test_a_corner_that_is_not_square_is_heard_as_its_image_or_not_at_all():
    assert heard(room(vee(110)), (0, 0, 0)).tolist() == [inf]
    # Mirrored in both walls the sonar is turned about the vertex by twice the angle between them.
    assert heard(room(vee(84)), (0, 0, 0)).tolist() == [close(3.5 * np.sin(np.deg2rad(84)))]


def test_a_corner_is_not_heard_where_something_stands_in_one_of_the_two_ways():
    # It is left at 6 degrees to one side and comes home at 6 degrees to the other.
    for side in (-1, 1):
        screen = polyline([[1.75, side * 0.02], [2.2, side * 0.47]])
        assert heard(room(vee(84), screen), (0, 0, 0)).tolist() == [inf]


def test_an_edge_is_heard_from_near_and_only_from_outside():
    end = room(polyline([[1, 0.1], [3, 2.1]]))
    assert heard(end, (0, 0, 0)).tolist() == [close(np.hypot(1, 0.1))]
    assert heard(end, (0, 0, 25), (-0.7, 0, 0)).tolist() == [inf, inf]
    # 120 degrees as seen from within, no edge from there and too wide for an echo of two bounces.
    bend = room(polyline([[1 - 3 * np.cos(np.pi / 3), -3 * np.sin(np.pi / 3)], [1, 0], [1 - 1.5, 1.5 * np.sqrt(3)]]))
    assert heard(bend, (0, 0, 0), (2, 0, 180)).tolist() == [inf, close(1.0)]


def test_what_stands_behind_a_wall_is_not_heard():
    screen = polyline([[0.7, -1.0], [1.7, 1.0]])
    pillar = [[3, 0, 0.4]]
    assert heard(room(cylinders=pillar), (0, 0, 0), (0, 0, -11), (0, 0, 14)).tolist() == [close(2.6), close(2.6), inf]
    assert heard(room(screen, cylinders=pillar), (0, 0, 0)).tolist() == [inf]


def test_a_mirror_makes_the_wall_beside_it_read_too_far():
    mirror, side = polyline([[0.3, -0.7], [1.7, 0.7]]), polyline([[-0.5, 1.5], [2.5, 1.5]])
    assert heard(room(mirror, side), (0, 0, 0)).tolist() == [close(2.5)]
    assert heard(room(mirror), (0, 0, 0)).tolist() == [inf]


def test_a_pillar_is_no_mirror():
    floor = polyline([[-5, -1.5], [6, -1.5]])
    assert heard(room(floor, cylinders=[[1, 0.4, 0.5]]), (0, 0, 0)).tolist() == [inf]


def test_a_turned_and_moved_room_gives_the_same_readings():
    rng = np.random.default_rng(5)
    walls = polyline([[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]], closed=True)
    box = polyline([[0.8, 0.2], [1.3, 0.4], [1.1, 0.9], [0.6, 0.7]], closed=True)
    world = World("test", np.concatenate([walls, box]), rng.choice([SMOOTH_M, ROUGH_M], 8), np.array([[-1, 1, 0.1]]))
    angle, moved = 0.7, np.array([30.0, -8.0])
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    other = replace(
        world,
        walls=(world.walls.reshape(-1, 2) @ turn + moved).reshape(-1, 4),
        cylinders=np.column_stack([world.cylinders[:, :2] @ turn + moved, world.cylinders[:, 2]]),
    )
    poses = [(*rng.uniform(-0.4, 0.4, 2), axis) for axis in range(0, 360, 7)]
    there = [(*(np.array([x, y]) @ turn + moved), axis + np.rad2deg(angle)) for x, y, axis in poses]
    here = heard(world, *poses)
    assert np.isfinite(here).mean() > 0.3
    np.testing.assert_allclose(heard(other, *there), here, atol=1e-6)


def test_readings_follow_the_rule_for_no_echo():
    near_and_far = room(WALL, polyline([[-4, -4], [-4, 4]]))
    readings = heard(near_and_far, (1.9, 0, 0), (1.9, 0, 180), (0, 0, 180))
    assert readings == pytest.approx([nan, inf, 4], abs=1e-3, nan_ok=True)


def test_the_noise_is_half_a_percent(monkeypatch):
    monkeypatch.setattr(mujoco_sonar, "NOISE", 0.005)
    readings = heard(room(WALL), *[(0, 0, 0)] * 2000)
    assert readings.std() == pytest.approx(0.01, rel=0.1)


def test_without_mujoco_there_is_one_line(monkeypatch):
    monkeypatch.setattr(mujoco_sonar, "available", lambda: False)
    with pytest.raises(UsageError, match=r"^mujoco: not installed, expected the package \(pip install .*\)$"):
        mujoco_sonar.mujoco_ranges(room(WALL), ROBOT, np.zeros((1, 3)), np.random.default_rng(0))
