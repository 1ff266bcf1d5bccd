"""The simulated robot: wheels with limits, contact, odometry, sonars that fire in turn."""

import math

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.errors import UsageError
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.vehicle import TICK_S, Limits, Slip, Vehicle
from echogrid.simulation.world import polyline

BOX = polyline([[0, 0], [6, 0], [6, 4], [0, 4]], closed=True)
WORLD = World("box", BOX, np.full(4, 2e-3), np.zeros((0, 3)))
QUIET = Physics(level_noise_db=0.0, range_noise=0.0, range_scale=0.0, lost=0.0)
SURE = Slip(0, 0, 0, 0, 0, 0)


def vehicle(pose=(2.0, 2.0, 0.0), robot="p3dx", seed=0, **more):
    return Vehicle(WORLD, Robot.load(robot), np.array(pose), seed, **more)


def drive(one, speed, turn, seconds):
    one.command(speed, turn)
    return one.go_on(round(seconds / TICK_S))


def test_wheels_come_up_to_speed_as_fast_as_they_can_and_no_faster():
    one = vehicle(limits=Limits(speed_m_s=0.4, acceleration_m_s2=0.5))
    drive(one, 9.0, 0.0, 0.4)
    assert one.velocity[0] == pytest.approx(0.2)
    drive(one, 9.0, 0.0, 2.0)
    assert one.velocity[0] == pytest.approx(0.4)
    # From the ramp and from the time at full speed.
    assert one.pose[0] - 2.0 == pytest.approx(0.4 * 2.4 - 0.4**2 / (2 * 0.5), abs=0.01)
    assert one.way_m == pytest.approx(one.pose[0] - 2.0)


def test_a_turn_on_the_spot_moves_nothing_and_an_arc_closes():
    one = vehicle()
    drive(one, 0.0, 1.0, 3.0)
    np.testing.assert_array_equal(one.pose[:2], [2.0, 2.0])
    round_ = vehicle(limits=Limits(acceleration_m_s2=1e6, turn_acceleration_rad_s2=1e6))
    drive(round_, 0.3, 0.5, 2 * math.pi / 0.5)
    assert np.linalg.norm(round_.pose[:2] - [2.0, 2.0]) < 0.02


def test_a_wall_stops_it_and_is_counted_once_and_it_can_back_off():
    one = vehicle()
    drive(one, 0.4, 0.0, 15.0)
    assert one.bumps == 1
    assert one.touching
    assert 0 <= 6 - one.pose[0] - one.robot.footprint_radius_m < 0.01
    assert 0 <= one.least_m < 0.01
    drive(one, -0.4, 0.0, 2.0)
    assert not one.touching
    assert one.pose[0] < 5.3
    drive(one, 0.4, 0.0, 5.0)
    assert one.bumps == 2


def test_without_slip_the_wheels_tell_the_truth_and_with_it_they_drift():
    sure, odd = vehicle(slip=SURE), vehicle()
    for one in (sure, odd):
        for _ in range(3):
            drive(one, 0.3, 0.4, 8.0)
    np.testing.assert_allclose(sure.odometry, sure.pose, atol=1e-3)
    np.testing.assert_array_equal(sure.pose, odd.pose)
    assert 0.01 < np.linalg.norm(odd.odometry[:2] - odd.pose[:2]) < 1.0


@pytest.mark.parametrize("robot", ["p3dx", "b21", "scitos-g5"])
def test_in_a_cycle_each_sonar_fires_once(robot):
    one = vehicle(robot=robot)
    cycle = len(one.groups)
    fired = np.array([~np.isnan(frame.ranges) for frame in one.go_on(cycle)])
    near = one.robot.mounts  # a reading below the minimum is nan too; in the middle of the box there is none
    assert np.sum(fired, axis=0).tolist() == [1] * len(near)
    assert np.max(np.sum(fired, axis=1)) <= 4


def test_what_it_hears_is_what_the_simulator_says_of_where_it_is():
    one = vehicle(physics=QUIET)
    frames = drive(one, 0.3, 0.3, 1.0)
    poses = np.array([frame.pose for frame in frames])
    told = one.robot.clean(Simulator(WORLD, one.robot, QUIET).ranges(poses, np.random.default_rng(0)))
    heard = np.array([frame.ranges for frame in frames])
    fired = ~np.isnan(heard)
    assert fired.any()
    # Noise of at least a millimetre is on every reading.
    np.testing.assert_allclose(heard[fired], told[fired], atol=0.006)


def test_the_same_seed_drives_and_hears_the_same():
    first, again, other = (drive(vehicle(seed=seed), 0.3, 0.2, 1.0) for seed in (1, 1, 2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.ranges, b.ranges)
        np.testing.assert_array_equal(a.odom, b.odom)
    assert any(not np.array_equal(a.ranges, c.ranges, equal_nan=True) for a, c in zip(first, other, strict=True))


@pytest.mark.parametrize("speed", [math.nan, math.inf])
def test_a_command_that_is_no_number_is_refused_and_stops_it(speed):
    one = vehicle()
    drive(one, 0.3, 0.0, 1.0)
    with pytest.raises(UsageError, match=r"command: found .*, expected finite numbers"):
        one.command(speed, 0.0)
    one.go_on(50)
    np.testing.assert_array_equal(one.velocity, [0, 0])


def test_it_cannot_begin_in_a_wall():
    with pytest.raises(UsageError, match=r"world box: start \(5.90, 2.00\) m: found 0.10 m from the nearest wall"):
        vehicle(pose=(5.9, 2.0, 0.0))
