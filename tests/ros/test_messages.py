import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bag_writers import B21, cloud, cloud2, odometry, ranging, sample, seen_points, sonar_array, tf, transform, types
from bag_writers import built as built_by
from echogrid.robot import MAX_SONARS
from echogrid.ros.messages import (
    Choice,
    RangeSaid,
    Sonar,
    points_of,
    put_odometry,
    put_transforms,
    ranges_of,
    seconds,
)
from echogrid.ros.transforms import Transforms

FRAME = sample(1)[0]


def built(said):
    """The message as rosbags decodes it."""
    return built_by(types(ros1=False), said.type, said.content)


def pose(transforms, target, source, stamp):
    found = transforms.pose(target, source, stamp)
    assert found is not None
    return found


def test_a_choice_without_topics_takes_all():
    assert Choice().takes("/sonar/3")


@pytest.mark.parametrize(
    ("topics", "taken"),
    [
        (("/sonar/*",), {"/sonar/1", "/sonar/12"}),
        (("/sonar/1",), {"/sonar/1"}),
        (("/sonar/?", "/odom"), {"/sonar/1", "/odom"}),
        (("/SONAR/*",), set()),
    ],
)
def test_a_choice_takes_topics_by_name_or_pattern(topics, taken):
    there = {"/sonar/1", "/sonar/12", "/odom", "/camera"}
    assert {name for name in there if Choice(topics).takes(name)} == taken


def test_sonars_are_sorted_as_people_count():
    names = ["/us/10", "/us/9", "/us/1", "/us/left", "/us/100", "/front", "/us/1/b"]
    ordered = sorted((Sonar(name, "f") for name in names), key=lambda sonar: sonar.order)
    assert [sonar.topic for sonar in ordered] == [
        "/front",
        "/us/1",
        "/us/1/b",
        "/us/9",
        "/us/10",
        "/us/100",
        "/us/left",
    ]
    frames = sorted((Sonar("/us", f"s{n}") for n in (11, 2, 1)), key=lambda sonar: sonar.order)
    assert [sonar.frame for sonar in frames] == ["s1", "s2", "s11"]


@given(st.lists(st.tuples(st.text(max_size=6), st.text(max_size=6)), max_size=6))
@settings(max_examples=50)
def test_sonars_of_any_names_can_be_sorted(names):
    sorted((Sonar(*each) for each in names), key=lambda sonar: sonar.order)


def test_stamps_are_seconds():
    assert seconds(SimpleNamespace(sec=1_600_000_000, nanosec=250_000_000)) == 1_600_000_000.25
    assert seconds(SimpleNamespace(sec=-1, nanosec=500_000_000)) == -0.5


def test_a_range_says_what_its_fields_say():
    said = RangeSaid.of(
        built(ranging(12.25, "/sonar", "left", 1.5, field_of_view=0.5, min_range=0.25, max_range=4.0))
    )
    assert said == RangeSaid(12.25, "left", 0.5, 0.25, 4.0, 1.5)


def test_odometry_is_a_pose_that_gives_way():
    transforms = Transforms()
    assert put_odometry(transforms, built(odometry(5.0, (1, 2, 0.5), ("/odom", "base_footprint")))) is None
    np.testing.assert_allclose(pose(transforms, "odom", "base_footprint", 5.0), [1, 2, 0.5])
    assert transforms.is_weak("base_footprint")


def test_odometry_without_frames_is_of_those_that_all_robots_have():
    transforms = Transforms()
    assert put_odometry(transforms, built(odometry(5.0, (1, 2, 0.5), ("", "")))) is None
    np.testing.assert_allclose(pose(transforms, "odom", "base_link", 5.0), [1, 2, 0.5])


def test_each_wrong_transform_of_a_message_is_told_and_the_others_are_taken():
    transforms = Transforms()
    wrong = transform("base_link", "b", (np.nan, 0, 0), 1.0)
    good = transform("base_link", "c", (1, 0, 0), 1.0)
    told = list(
        put_transforms(transforms, built(tf(1.0, wrong, good, transform("c", "c", (0, 0, 0), 1.0))), static=True)
    )
    assert told == ["a transform that is not finite", "a transform without two frames"]
    assert transforms.children() == ["c"]


@pytest.mark.parametrize(
    "said", [cloud(FRAME, B21), cloud2(FRAME, B21), cloud2(FRAME, B21, big=True)], ids=["old", "new", "big-endian"]
)
def test_points_are_those_that_were_put_in(said):
    np.testing.assert_allclose(np.array(points_of(built(said))), seen_points(FRAME, B21), atol=1e-6)


def changed(**fields):
    message = built(cloud2(FRAME, B21))
    for name, value in fields.items():
        setattr(message, name, value)
    return message


FIELDS = built(cloud2(FRAME, B21)).fields


@pytest.mark.parametrize(
    "message",
    [
        changed(width=0),
        changed(width=25),
        changed(width=MAX_SONARS + 1),
        changed(width=2**32 - 1, height=2**32 - 1),
        changed(height=0),
        changed(width=12, height=2),
        changed(point_step=0),
        changed(point_step=7),
        changed(point_step=2**32 - 1),
        changed(data=np.zeros(0, np.uint8)),
        changed(fields=[]),
        changed(fields=FIELDS[1:]),
        changed(fields=[SimpleNamespace(name=f.name, offset=f.offset, datatype=8) for f in FIELDS]),
        changed(fields=[SimpleNamespace(name=f.name, offset=2**32 - 2, datatype=7) for f in FIELDS]),
        SimpleNamespace(points=[]),
        SimpleNamespace(points=[SimpleNamespace(x=0, y=0)] * (MAX_SONARS + 1)),
    ],
)
def test_a_cloud_that_cannot_be_read_is_none(message):
    assert points_of(message) is None


@given(
    *[st.integers(0, 40) | st.integers(0, 2**32 - 1)] * 3,
    st.lists(st.tuples(st.sampled_from("xyzx"), st.integers(0, 50) | st.just(2**32 - 4)), max_size=4),
    st.binary(max_size=400),
    st.booleans(),
)
def test_no_cloud_raises(width, height, step, fields, data, big):
    message = SimpleNamespace(
        width=width,
        height=height,
        point_step=step,
        fields=[SimpleNamespace(name=name, offset=offset, datatype=7) for name, offset in fields],
        data=data,
        is_bigendian=big,
    )
    points = points_of(message)
    if points is not None:
        assert points.shape == (width, 2)
        (y,) = struct.unpack_from(">f" if big else "<f", data, (width - 1) * step + dict(fields)["y"])
        np.testing.assert_equal(points[-1, 1], np.float64(y))


def test_the_ranges_of_an_array_are_those_that_were_put_in():
    np.testing.assert_array_equal(ranges_of(built(sonar_array(FRAME))), FRAME.ranges)


@pytest.mark.parametrize("ranges", [[], [1.0] * (MAX_SONARS + 1), [[1.0, 2.0]]])
def test_what_is_no_array_of_ranges_is_none(ranges):
    assert ranges_of(SimpleNamespace(ranges=ranges)) is None
