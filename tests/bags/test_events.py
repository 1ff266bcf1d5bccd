from math import pi

import numpy as np
import pytest

from bag_samples import FRAMES, P3DX, RANGES, RING, again, assert_same_frames
from bag_writers import (
    B21,
    START_S,
    cloud,
    cloud2,
    mounted,
    odometry,
    posed,
    seen_points,
    sonar_array,
    tf,
    time_of,
    transform,
)
from echogrid.logs.formats import load_log


@pytest.mark.parametrize(
    "said",
    [
        pytest.param(cloud, id="PointCloud"),
        pytest.param(cloud2, id="PointCloud2"),
        pytest.param(lambda frame, robot: cloud2(frame, robot, big=True), id="PointCloud2, big-endian"),
        pytest.param(lambda frame, _: sonar_array(frame), id="SonarArray"),
    ],
)
@pytest.mark.parametrize("form", ["bag", "mcap"])
def test_all_sonars_in_one_message_are_those_of_the_robot_file(put, said, form):
    poses = (odometry(time_of(frame), frame.pose, topic="/RosAria/pose") for frame in RING)
    log = load_log(put([*poses, *(said(frame, P3DX) for frame in RING)], form), P3DX)
    for found, expected in zip(log, RING, strict=True):
        np.testing.assert_allclose(found.ranges, expected.ranges, atol=2e-5)
        np.testing.assert_allclose(found.pose, expected.pose, atol=1e-9)


def test_what_lies_at_the_end_of_the_range_is_no_echo_though_points_are_of_single_precision(put):
    log = load_log(put([*posed(FRAMES), *(cloud(frame, B21) for frame in FRAMES)]), B21)
    for found, expected in zip(log, FRAMES, strict=True):
        np.testing.assert_array_equal(np.isinf(found.ranges), np.isinf(expected.ranges))


def test_points_in_a_frame_of_their_own_are_taken_to_the_robot(put):
    ring = transform("base_link", "ring", (0.2, -0.1, pi / 2), START_S)
    said = [tf(START_S, ring, topic="/tf_static"), *posed(RING)]
    for frame in RING:
        points = [{"x": float(y + 0.1), "y": float(0.2 - x)} for x, y in seen_points(frame, P3DX)]
        said.append(again(cloud(frame, P3DX), frame="ring", points=points))
    for found, expected in zip(load_log(put(said), P3DX), RING, strict=True):
        np.testing.assert_allclose(found.ranges, expected.ranges, atol=2e-5)


def test_odometry_that_says_no_time_is_of_when_it_was_recorded(put):
    """As rosserial sends it before its clock is set."""
    poses = [again(odometry(time_of(frame), frame.pose), stamp=0) for frame in FRAMES]
    found = list(load_log(put([mounted(), *poses, *RANGES])))
    for one, other in zip(found, FRAMES, strict=True):
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-5)


def test_a_reading_without_a_stamp_among_others_is_left_out_and_counted(put):
    first = again(RANGES[0], stamp=0.0)._replace(time=START_S - 1)
    log = load_log(put([mounted(time=START_S - 2), first, *posed(FRAMES), *RANGES]))
    assert_same_frames(log, FRAMES)
    assert list(log.notes.values()) == [1]
