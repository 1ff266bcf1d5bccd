"""The simulated robot as a base: commands in whatever shape, and silence."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.live.base import SILENT_S, Base
from echogrid.simulation.vehicle import TICK_S, Vehicle
from echogrid.simulation.world import polyline
from live_drive import xyz

BOX = World("box", polyline([[0, 0], [6, 0], [6, 4], [0, 4]], closed=True), np.full(4, 2e-3), np.zeros((0, 3)))


@pytest.fixture
def base():
    return Base(Vehicle(BOX, Robot.load("p3dx"), np.array([2.0, 2.0, math.pi / 2])), 1000.0)


def twist(speed, turn=0.0, aside=0.0):
    return SimpleNamespace(linear=xyz(speed, aside), angular=xyz(0.0, 0.0, turn))


def drive(base, seconds, said=None, source=None):
    for _ in range(round(seconds / TICK_S)):
        if said is not None:
            base.take(said, source)
        base.go_on(1)


def test_it_goes_as_it_is_told_and_stops_where_nothing_is_said(base):
    drive(base, 2.0, twist(0.3))
    assert base.vehicle.velocity[0] == pytest.approx(0.3)
    drive(base, SILENT_S - TICK_S)
    assert base.vehicle.velocity[0] == pytest.approx(0.3)
    drive(base, 0.3 / base.vehicle.limits.acceleration_m_s2 + 3 * TICK_S)
    np.testing.assert_array_equal(base.vehicle.velocity, 0)
    assert base.stamp == pytest.approx(1000.0 + base.vehicle.time_s)
    assert base.notices() == []


@pytest.mark.parametrize("said", [twist(math.nan), twist(0.1, math.inf), twist("fast"), None, SimpleNamespace()])
def test_what_is_no_number_stops_it_and_is_told_once(base, said):
    drive(base, 1.0, twist(0.3))
    base.take(said)
    drive(base, 1.0)
    np.testing.assert_array_equal(base.vehicle.velocity, 0)
    base.take(said)
    assert [len(base.notices()), len(base.notices())] == [1, 0]
    assert "2 x a command that is no finite number" in base.told()


def test_of_a_flood_the_last_counts(base):
    for speed in np.linspace(-9, 0.2, 5000):
        base.take(twist(float(speed)))
    drive(base, SILENT_S - TICK_S)
    assert base.vehicle.velocity[0] == pytest.approx(0.2)


def test_two_who_command_at_once_are_told_and_one_after_the_other_are_not(base):
    drive(base, 0.2, twist(0.1), "teleop")
    drive(base, 1.0)
    drive(base, 0.2, twist(0.1), "nav2")
    assert base.notices() == []
    base.take(twist(0.0), "teleop")  # who only says stop is no second driver
    assert base.notices() == []
    base.take(twist(0.2), "teleop")
    assert base.notices() == ["commands come from 2 programs at once: stop all but one"]


def test_sideways_is_passed_over_and_told(base):
    base.take(twist(0.2, aside=0.3))
    (notice,) = base.notices()
    assert "sideways" in notice
    drive(base, 0.4)
    assert base.vehicle.pose[0] == pytest.approx(2.0)
    assert base.vehicle.pose[1] > 2.0


def test_its_wheels_begin_at_nothing_and_each_sonar_fires_once_a_cycle(base):
    np.testing.assert_allclose(base.pose(base.vehicle.odometry), 0, atol=1e-12)
    fired = [pair for frame in base.go_on(4) for pair in base.fired(frame)]
    assert sorted(number for number, _ in fired) == list(range(16))
    assert not any(math.isnan(value) for _, value in fired)
    drive(base, 1.0, twist(0.3))
    x, y, _ = base.pose(base.vehicle.odometry)
    assert x > 0.1  # forward is x, however it stands in the world
    assert abs(y) < 0.05


def test_what_is_too_near_to_be_measured_is_told_as_ros_has_it():
    base = Base(Vehicle(BOX, Robot.load("p3dx"), np.array([0.3, 2.0, math.pi])), 0.0)
    values = [value for frame in base.go_on(4) for _, value in base.fired(frame)]
    assert -math.inf in values


def test_a_touch_is_told_once_and_counted(base):
    for _ in range(2):
        drive(base, 9.0, twist(0.4))
        drive(base, 2.0, twist(-0.4))
    notices = base.notices() + base.notices()
    assert len(notices) == 1
    assert notices[0].startswith("touches something for the first time")
    assert ", 2 collisions, 0.00 m or more beside it" in base.told()
