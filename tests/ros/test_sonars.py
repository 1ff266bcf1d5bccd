from math import inf, isnan, nan, radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.robot import Robot
from echogrid.ros import sonars as array
from echogrid.ros.sonars import base_of, beam_width, fixed_of, mount, reading, robot_of
from echogrid.ros.transforms import Transforms

B21 = Robot.load("b21")
FLAT = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("range_m", "low", "high", "meant"),
    [
        (1.0, 0.2, 4.0, 1.0),
        (inf, 0.2, 4.0, inf),
        (4.0, 0.2, 4.0, inf),
        (4.1, 0.2, 4.0, inf),
        (3.999, 0.2, 4.0, 3.999),
        (-inf, 0.2, 4.0, nan),
        (nan, 0.2, 4.0, nan),
        (0.19, 0.2, 4.0, nan),
        (0.2, 0.2, 4.0, 0.2),
        (0.0, 0.0, 4.0, nan),
        (-1.0, -2.0, 4.0, nan),
        (3.0, 0.0, 0.0, 3.0),
        (3.0, nan, nan, 3.0),
        (3.0, -inf, -1.0, 3.0),
        (3.0, inf, inf, 3.0),
        (1e6, 0.0, 0.0, inf),
        (inf, 0.0, inf, inf),
    ],
)
def test_a_reading_means_what_rep_117_says(range_m, low, high, meant):
    np.testing.assert_equal(reading(range_m, low, high), meant)


@given(*[st.floats()] * 3)
def test_whatever_a_message_says_a_reading_is_a_range_no_echo_or_nothing(range_m, low, high):
    meant = reading(range_m, low, high)
    assert isnan(meant) or meant == inf or 0 < meant <= array.MAX_RANGE_M
    if 0 < meant < inf:
        assert meant == range_m


@pytest.mark.parametrize("field_of_view", [0.0, nan, inf, -0.5, 4.0, 25.0])
def test_what_is_no_beam_width_is_none(field_of_view):
    assert beam_width(field_of_view) is None
    assert beam_width(radians(25)) == radians(25)


@given(st.lists(st.tuples(st.floats(), st.floats()), min_size=1, max_size=6))
@settings(max_examples=60)
def test_whatever_limits_sonars_tell_their_robot_is_one_that_can_be(limits):
    found = robot_of("x", B21.mounts[: len(limits)], [], limits)
    assert 0 <= found.min_range_m < found.max_range_m <= array.MAX_RANGE_M
    assert found.sonars == len(limits)


def test_sonars_that_differ_in_their_maximum_range_keep_their_own():
    mixed = robot_of("x", B21.mounts[:4], [], [(0.1, 4.0), (0.1, 0.9), (0.1, nan), (0.1, 0.5)])
    np.testing.assert_array_equal(mixed.max_ranges_m, [4.0, 0.9, 4.0, 0.5])
    alike = robot_of("x", B21.mounts[:2], [], [(0.1, 4.0), (0.2, 4.0)])
    assert alike.own_max_ranges_m is None


def tree(*edges):
    found = Transforms()
    for parent, child in edges:
        found.put(parent, child, 0.0, (0.1, 0, 0), FLAT)
    return found


@pytest.mark.parametrize(
    ("edges", "base", "fixed"),
    [
        ([("odom", "base_link"), ("base_link", "sonar")], "base_link", "odom"),
        ([("map", "odom"), ("odom", "base_link"), ("base_link", "sonar")], "base_link", "map"),
        (
            [("map", "odom"), ("odom", "base_footprint"), ("base_footprint", "base_link"), ("base_link", "sonar")],
            "base_footprint",
            "map",
        ),
        ([("world", "map"), ("map", "base_link"), ("base_link", "ring"), ("ring", "sonar")], "base_link", "map"),
        ([("r1/map", "r1/odom"), ("r1/odom", "r1/base"), ("r1/base", "sonar")], "r1/base", "r1/map"),
        ([("base_link", "sonar")], "base_link", None),
        ([], "sonar", None),
    ],
)
def test_the_robot_is_what_moves_below_the_frames_that_stand_still(edges, base, fixed):
    transforms = tree(*edges)
    assert base_of(transforms, "sonar") == base
    assert fixed_of(transforms, base) == fixed


def test_a_mount_is_where_the_sonar_sits_however_it_is_tilted():
    transforms = Transforms()
    yaw, pitch = 1.0, 0.5
    half = [np.cos(yaw / 2), np.sin(yaw / 2), np.cos(pitch / 2), np.sin(pitch / 2)]
    tilted = (-half[1] * half[3], half[0] * half[3], half[1] * half[2], half[0] * half[2])
    transforms.put("base", "sonar", 0.0, (0.2, 0.1, 0.5), tilted, static=True)
    np.testing.assert_allclose(np.array(mount(transforms, "base", "sonar", 5.0)), [0.2, 0.1, 1.0], atol=1e-9)
    np.testing.assert_allclose(np.array(mount(transforms, "base", "/base", 5.0)), [0, 0, 0])
    assert mount(transforms, "base", "nobody", 5.0) is None


@pytest.mark.parametrize(
    ("pitch", "x", "said"), [(1.4, 0.1, "up or down"), (-1.4, 0.1, "up or down"), (0.0, 11.0, "10 m")]
)
def test_what_is_no_mount_in_the_plane_is_told(pitch, x, said):
    transforms = Transforms()
    transforms.put("base", "sonar", 0.0, (x, 0, 0), (0.0, np.sin(pitch / 2), 0.0, np.cos(pitch / 2)), static=True)
    assert said in str(mount(transforms, "base", "sonar", 0.0))
