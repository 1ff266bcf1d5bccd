"""Odometry that no robot can have is mended, and told; what a robot can have stays as it is."""

import numpy as np
import pytest

from echogrid.geometry import compose, inverse, wrap
from echogrid.position.odometry import mended

RATE_HZ, SPEED_M_S = 10.0, 0.4


@pytest.fixture
def drive():
    """Stamps, poses and ranges of 60 s along an arc; the ranges change as those of one who drives past walls."""
    stamps = np.arange(600) / RATE_HZ
    theta = 0.05 * stamps
    x, y = np.cumsum(SPEED_M_S / RATE_HZ * np.stack([np.cos(theta), np.sin(theta)]), axis=1)
    ranges = 2.0 + np.sin(stamps[:, None] / 4 + np.arange(6)) + 0.01 * np.sin(40 * stamps[:, None] + np.arange(6))
    return stamps, np.stack([x, y, wrap(theta)], axis=1), ranges


def off(found, truth):
    difference = found - truth
    return np.abs(np.concatenate([difference[:, :2], wrap(difference[:, 2:])], axis=1)).max()


def test_what_a_robot_can_have_driven_stays_to_the_last_bit(drive):
    stamps, poses, ranges = drive
    found = mended(stamps, poses, ranges)
    np.testing.assert_array_equal(found.poses, poses)
    assert (found.notes, found.impossible) == ({}, 0.0)


def test_odometry_that_starts_anew_after_a_silence_is_not_taken_for_a_way(drive):
    stamps, poses, ranges = drive
    anew = np.concatenate([poses[:300], compose(inverse(poses[300]), poses[300:])])
    found = mended(np.where(np.arange(len(stamps)) < 300, stamps, stamps + 600), anew, ranges)
    assert off(found.poses, poses) < 2 * SPEED_M_S / RATE_HZ
    (note,) = found.notes
    assert note.startswith("the odometry starts anew at 0 at 630.00 s, from x ")


def test_odometry_that_starts_anew_goes_on_from_where_it_was(drive):
    stamps, poses, ranges = drive
    anew = np.concatenate([poses[:300], compose(inverse(poses[300]), poses[300:])])
    found = mended(stamps, anew, ranges)
    # What was driven between the two scans is lost.
    assert off(found.poses, poses) < 2 * SPEED_M_S / RATE_HZ
    (note,) = found.notes
    assert note.startswith("the odometry starts anew at 0 at 30.00 s, from x ")


def test_a_jump_is_taken_as_it_is_where_the_sonars_hear_another_place(drive):
    stamps, poses, ranges = drive
    away = poses + np.where(np.arange(600)[:, None] < 300, 0, [4.0, 1.0, 0])
    other = np.where(np.arange(600)[:, None] < 300, ranges, ranges[::-1] * 0.5)
    found = mended(stamps, away, other)
    np.testing.assert_allclose(found.poses, away, atol=1e-9)
    (note,) = found.notes
    assert "jumps to x" in note
    assert "the sonars hear another place" in note
    same = mended(stamps, away, ranges)
    assert off(same.poses, poses) < 2 * SPEED_M_S / RATE_HZ


@pytest.mark.parametrize("frames", [5, 15])
def test_a_log_of_stops_stays_as_it_is(drive, frames):
    _, poses, ranges = drive
    stops = np.repeat(poses[::30], frames, axis=0)  # 1.2 m from one to the next, in one tenth of a second
    stops += np.random.default_rng(0).normal(0, 0.01, stops.shape)
    count = len(stops)
    found = mended(np.arange(count) / RATE_HZ, stops, np.resize(ranges, (count, ranges.shape[1])))
    np.testing.assert_array_equal(found.poses, stops)
    assert (found.notes, found.impossible) == ({}, 0.0)


def test_poses_in_centimetres_are_no_stops(drive):
    stamps, poses, ranges = drive
    assert mended(stamps, poses * [100, 100, 1], ranges).impossible > 0.9


def test_a_robot_that_stands_has_glitches_and_no_stops(drive):
    stamps, poses, ranges = drive
    stands = np.tile(poses[0], (600, 1))
    glitched = stands.copy()
    for first in range(50, 600, 50):
        glitched[first : first + 5] += [1.5, 0.0, 0.0]
    found = mended(stamps, glitched + np.arange(600)[:, None] * 1e-6, ranges)
    assert off(found.poses, stands) < 0.01
    assert list(found.notes.values()) == [55]


@pytest.mark.parametrize("frames", [1, 7])
@pytest.mark.parametrize("where", [[3.0, 3.0, 0.5], [1e6, -1e6, 0.0]])
def test_a_glitch_is_interpolated_and_counted(drive, frames, where):
    stamps, poses, ranges = drive
    glitched = poses.copy()
    glitched[200 : 200 + frames] = where
    found = mended(stamps, glitched, ranges)
    assert off(found.poses, poses) < 0.02
    assert found.notes == {"a pose that no robot can have got to, interpolated": frames}


@pytest.mark.parametrize("every", [4, 10])
def test_poses_that_come_seldom_are_interpolated(drive, every):
    stamps, poses, ranges = drive
    held = poses[np.arange(600) // every * every]
    found = mended(stamps, held, ranges)
    # But behind the last, of which there is none to interpolate to.
    last = 600 - every
    assert off(found.poses[:last], poses[:last]) < 0.02
    (note,) = found.notes
    assert note.startswith(f"the odometry has a new pose {RATE_HZ / every:.3g} times a second, the sonars 10 scans")


def test_a_robot_that_stands_between_seldom_poses_stands(drive):
    stamps, poses, ranges = drive
    stood = np.concatenate([poses[:300], np.repeat(poses[299:300], 200, axis=0), poses[300:500]])
    stamps = np.arange(len(stood)) / RATE_HZ
    ranges = np.concatenate([ranges[:300], np.repeat(ranges[299:300], 200, axis=0), ranges[300:500]])
    found = mended(stamps, stood[np.arange(len(stood)) // 5 * 5], ranges)
    np.testing.assert_allclose(found.poses[310:480], found.poses[310:311].repeat(170, axis=0), atol=1e-9)
    assert off(found.poses[:-5], stood[:-5]) < 0.25


def test_a_minute_of_standing_is_no_odometry_that_comes_seldom(drive):
    stamps, poses, ranges = drive
    stood = np.concatenate([poses[:300], np.repeat(poses[299:300], 300, axis=0)])
    found = mended(stamps, stood, ranges)
    np.testing.assert_array_equal(found.poses, stood)
    assert found.notes == {}


def test_poses_in_other_units_are_not_mended(drive):
    stamps, poses, ranges = drive
    found = mended(stamps, poses * [1000, 1000, 1], ranges)
    assert found.impossible > 0.9


def test_one_scan_and_scans_without_time_are_taken(drive):
    stamps, poses, ranges = drive
    for part in (np.s_[:1], np.s_[:2]):
        np.testing.assert_array_equal(mended(stamps[part], poses[part], ranges[part]).poses, poses[part])
    np.testing.assert_array_equal(mended(0 * stamps, poses, ranges).poses, poses)
