from collections.abc import Iterable
from dataclasses import replace
from math import nan, pi

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bag_samples import (
    DRIVE,
    END_S,
    FRAMES,
    P3DX,
    RANGES,
    RING,
    SHIFT,
    TWO,
    again,
    assert_same_frames,
    other_robot,
    own_tf,
    refused,
    shifted,
    stated,
)
from bag_writers import (
    B21,
    START_S,
    Said,
    cloud,
    cloud2,
    header,
    in_order,
    mounted,
    odometry,
    posed,
    ranged,
    ranging,
    tf,
    time_of,
    transform,
    write,
)
from commands import call
from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.logs.formats import load_log
from echogrid.ros.messages import Choice


def jumped(frames: Iterable[Frame]) -> list[Said]:
    """Odometry that is quite elsewhere."""
    return [odometry(time_of(frame), frame.pose + 5.0) for frame in frames]


def fixed(parent: str, child: str, pose: Iterable[float], topic: str = "/tf") -> list[Said]:
    return [tf(time_of(frame), transform(parent, child, [*pose], time_of(frame)), topic=topic) for frame in FRAMES]


POSES = {
    "odometry alone": ([odometry(time_of(frame), frame.pose) for frame in FRAMES], FRAMES),
    "odometry without names of frames": ([odometry(time_of(f), f.pose, ("", "")) for f in FRAMES], FRAMES),
    "tf": (list(posed(FRAMES)), FRAMES),
    "names with a slash": (list(posed(FRAMES, "/odom", "/base_link")), FRAMES),
    "tf of the old type": ([said._replace(type="tf/msg/tfMessage") for said in posed(FRAMES)], FRAMES),
    "tf and odometry": ([*posed(FRAMES), *jumped(FRAMES)], FRAMES),
    "map above odom": ([*posed(FRAMES), *fixed("map", "odom", SHIFT)], shifted(FRAMES, SHIFT)),
    "map above odometry": (
        [*(odometry(time_of(frame), frame.pose) for frame in FRAMES), *fixed("map", "odom", SHIFT)],
        shifted(FRAMES, SHIFT),
    ),
    "map that stands": (
        [*posed(FRAMES), tf(START_S, transform("map", "odom", SHIFT, START_S), topic="/tf_static")],
        shifted(FRAMES, SHIFT),
    ),
    "map, tf and odometry": ([*posed(FRAMES), *jumped(FRAMES), *fixed("map", "odom", SHIFT)], shifted(FRAMES, SHIFT)),
    "base_footprint": (
        [*posed(FRAMES, child="base_footprint"), *fixed("base_footprint", "base_link", (0, 0, 0), "/tf_static")],
        FRAMES,
    ),
    "odometry of base_footprint": (
        [
            *(odometry(time_of(frame), frame.pose, ("odom", "base_footprint")) for frame in FRAMES),
            *fixed("base_footprint", "base_link", (0, 0, 0)),
        ],
        FRAMES,
    ),
}

POSES |= {
    "odom by another name": (list(posed(FRAMES, "robot1_odom")), FRAMES),
    "odometry of what hangs on base_footprint": (
        [
            *(odometry(time_of(frame), frame.pose) for frame in FRAMES),
            tf(START_S, transform("base_footprint", "base_link", np.zeros(3), START_S), topic="/tf_static"),
        ],
        FRAMES,
    ),
}

FOOT = tf(START_S, transform("base_footprint", "base_link", np.zeros(3), START_S), topic="/tf_static")
LEAF = tf(START_S, transform("base_link", "base_footprint", np.zeros(3), START_S), topic="/tf_static")
AHEAD = np.array([0.1, 0.0, 0.5])
"""Where a frame beside sits on the robot."""

POSES |= {
    "tf_static of base_footprint, then odometry of base_link": (
        [FOOT._replace(time=START_S - 1), *(odometry(time_of(f), f.pose) for f in FRAMES)],
        FRAMES,
    ),
    "odometry of what hangs below the robot": (
        [
            LEAF._replace(time=START_S - 1),
            *(odometry(time_of(f), f.pose, ("odom", "base_footprint")) for f in FRAMES),
        ],
        FRAMES,
    ),
    "odometry of what hangs beside the robot": (
        [
            tf(START_S - 1, transform("base_link", "wheels", AHEAD, START_S), topic="/tf_static"),
            *(odometry(time_of(f), compose(f.pose, AHEAD), ("odom", "wheels")) for f in FRAMES),
        ],
        FRAMES,
    ),
    "the same under a map": (
        [
            LEAF._replace(time=START_S - 1),
            *(odometry(time_of(f), f.pose, ("odom", "base_footprint")) for f in FRAMES),
            *fixed("map", "odom", SHIFT),
        ],
        shifted(FRAMES, SHIFT),
    ),
}


@pytest.mark.parametrize(("poses", "expected"), POSES.values(), ids=POSES)
def test_the_pose_is_told_from_tf_and_odometry(tmp_path, poses, expected):
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    said = in_order([mounted(), *poses, *ranged(FRAMES)])
    log = load_log(write(tmp_path / "drive.bag", said, "bag", store=store))
    assert_same_frames(log, expected)
    assert log.notes == {}


@pytest.mark.parametrize("first", [FOOT, LEAF], ids=["above", "below"])
def test_tf_static_may_come_after_odometry_of_a_frame_that_hangs_on_the_robots(put, first):
    child = first.content["transforms"][0]["child_frame_id"]
    places = [odometry(time_of(f), f.pose, ("odom", child)) for f in FRAMES]
    log = load_log(put([first._replace(time=START_S + 1), mounted(time=START_S + 2), *places, *ranged(FRAMES)]))
    assert_same_frames(log, FRAMES)
    assert log.notes == {}


def test_two_topics_of_odometry_of_frames_that_hang_on_one_another_are_not_mixed(put, capsys):
    places = [odometry(time_of(f), f.pose) for f in FRAMES]
    other = [odometry(time_of(f), f.pose + 5, ("odom", "camera"), "/visual_odom") for f in FRAMES]
    eye = tf(START_S - 1, transform("base_link", "camera", AHEAD, START_S), topic="/tf_static")
    assert_same_frames(load_log(put([mounted(), eye, *places, *other, *ranged(FRAMES)])), FRAMES)
    line = refused(capsys, put([mounted(), FOOT._replace(time=START_S - 1), eye, *places, *other, *ranged(FRAMES)]))
    assert "the pose of base_footprint in 2 topics, expected --topics with one of /odom, /visual_odom" in line


def test_two_parents_in_turn_are_named(put):
    second = [tf(time_of(f) + 0.1, transform("world", "base_link", f.pose, time_of(f) + 0.1)) for f in FRAMES]
    log = load_log(put([*DRIVE, *second]))
    with pytest.raises(InputError, match=r"base_link is told in two frames in turn, (odom and world|world and odom)"):
        list(log)
    rare = [said for number, said in enumerate(second) if number in {10, 12}]
    log = load_log(put([*DRIVE, *rare]))
    assert len(list(log)) > 20
    assert any("base_link is told in two frames in turn" in note for note in log.notes)


def test_a_frame_that_gets_another_parent_once_has_not_two_in_turn(put):
    log = load_log(
        put([*posed(FRAMES[:3], "world"), *[said for said in DRIVE if said.topic != "/tf"], *posed(FRAMES[3:])])
    )
    assert len(list(log)) >= 25
    assert not any("in turn" in note for note in log.notes)


def test_the_frames_can_be_chosen(put):
    path = put([*DRIVE, *fixed("map", "odom", SHIFT), *fixed("base_link", "turret", (0.1, 0, pi / 2))])
    assert_same_frames(load_log(path, choice=Choice(odometry=True)), FRAMES)
    assert_same_frames(load_log(path, choice=Choice(fixed="map", odometry=True)), shifted(FRAMES, SHIFT))
    assert_same_frames(load_log(path, choice=Choice(fixed="/odom")), FRAMES)
    log = load_log(path, choice=Choice(fixed="odom", base="turret"))
    assert_same_frames(log, [replace(f, pose=compose(f.pose, np.array([0.1, 0, pi / 2]))) for f in FRAMES])
    assert log.robot is not None
    x, y = B21.mounts[0, :2]
    np.testing.assert_allclose(log.robot.mounts[0, :2], [y, 0.1 - x], atol=1e-9)


def test_mounts_that_are_told_again_and_again_are_mounts(put):
    mounts = mounted().content["transforms"]
    moving = [
        tf(at, *({**each, "header": header(at + 0.5, "base_link")} for each in mounts))
        for at in np.arange(START_S, END_S, 0.1)
    ]
    assert_same_frames(load_log(put([*moving, *posed(FRAMES), *ranged(FRAMES)])), FRAMES)


def test_a_sonar_that_looks_down_a_little_looks_where_its_axis_points(put):
    log = load_log(put([mounted(pitch=0.4), *posed(FRAMES), *ranged(FRAMES)]))
    assert_same_frames(log, FRAMES)
    assert log.robot is not None
    np.testing.assert_allclose(log.robot.mounts, B21.mounts, atol=1e-9)


POINTS = [*posed(RING), *(cloud(frame, P3DX) for frame in RING)]

BAD = {
    "no poses": ([mounted(), *RANGES], [], ["no pose of base_link", "/tf_static", "nav_msgs/Odometry"]),
    "neither poses nor tf": (RANGES, [], ["neither tf nor odometry", "nav_msgs/Odometry"]),
    "two robots": (
        [*DRIVE, *other_robot()],
        [],
        ["2 robots: base_link (sonar_* on /sonar/* (24 of them)); r2/base_link", "--topics or --base-frame"],
    ),
    "no frame of any sonar": (
        [*posed(FRAMES), *RANGES],
        [],
        ["from the robot (base_link)", "sonar_* (24", "--robot"],
    ),
    "frames without names": (
        [*DRIVE[:2], *(again(said, frame="") for said in RANGES), *posed(FRAMES)],
        [],
        ["without a name", "tf, or --robot"],
    ),
    "all in one frame": (
        [mounted(), *posed(FRAMES), *(again(said, frame="sonar_0") for said in RANGES)],
        [],
        ["in one frame, sonar_0", "a frame for each sonar, or --robot"],
    ),
    "all in the robot's frame": (
        [*posed(FRAMES), *(again(said, frame="base_link") for said in RANGES)],
        [],
        ["in one frame, base_link", "--robot"],
    ),
    "nothing but 0": (
        [mounted(), *posed(FRAMES), *(again(said, range=0.0) for said in RANGES)],
        [],
        ["no valid reading of any sonar", "+inf where there is no echo"],
    ),
    "a clock that jumps back": (
        [
            mounted(),
            *posed(FRAMES),
            *(again(said, stamp=said.time - 30 * (said.time > START_S + 3)) for said in RANGES),
        ],
        [],
        ["/sonar/0: found a clock that jumps back by more than 1 s at 1599999973.200 s", "cut the bag"],
    ),
    "two robots with topics of tf of their own": (
        [*own_tf("/r1", 0.0), *own_tf("/r2", 50.0), *RANGES],
        [],
        ["transforms of 2 robots (/r1/tf, /r2/tf)", "sonars of one, by --topics"],
    ),
    "empty": ([], [], ["a bag without messages", "sensor_msgs/msg/Range"]),
    "no sonars": (TWO, [], ["no topic of sonars among /odom (nav_msgs/msg/Odometry), /visual_odom", "msg/Range"]),
    "points alone": (
        POINTS,
        [],
        ["16 sonars in /RosAria/sonar", "does not say where", "(presets with 16: nomad200, p3dx)"],
    ),
    "points of another robot": (POINTS, ["--robot", "b21"], ["of 16 sonars, where robot b21 has 24 (30 times)"]),
    "points that may be a lidar's": (
        [*posed(RING), *(cloud2(frame, P3DX, topic="/velodyne") for frame in RING)],
        [],
        ["may not be sonars", "--topics with one of /velodyne"],
    ),
    "two topics of points": (
        [*POINTS, *(cloud(frame, P3DX, topic="/rear") for frame in RING)],
        [],
        ["2 topics of sensor_msgs/msg/PointCloud", "--topics with one of /RosAria/sonar", "/rear"],
    ),
    "two topics of odometry": (
        [mounted(), *TWO, *RANGES],
        [],
        ["2 topics", "--topics with one of /odom, /visual_odom"],
    ),
    "topics that are not there": (DRIVE, ["--topics", "/nope/*"], ["fits /nope/*", "one of /sonar/* (sensor_msgs"]),
    "one of the topics not there": (DRIVE, ["--topics", "/sonar/*", "/us"], ["fits /us", "/sonar/*"]),
    "a base that is not there": (
        DRIVE,
        ["--base-frame", "base"],
        ["no frame base", "--base-frame with one of base_link"],
    ),
    "a fixed frame that is not there": (
        DRIVE,
        ["--fixed-frame", "map"],
        ["no frame map", "--fixed-frame with one of"],
    ),
    "a fixed frame on the robot": (
        DRIVE,
        ["--fixed-frame", "sonar_1"],
        ["sonar_1 to map in, which moves with base_link"],
    ),
    "the robot as fixed frame": (
        DRIVE,
        ["--fixed-frame", "base_link"],
        ["base_link to map in", "--fixed-frame with odom"],
    ),
    "a frame that stands as base": (DRIVE, ["--base-frame", "odom"], ["no pose of odom", "nav_msgs/Odometry"]),
    "another robot": (DRIVE, ["--robot", "p3dx"], ["found 24 sonars (sonar_* on /sonar/*", "16, as robot p3dx has"]),
    "sonars that look up": (
        [mounted(pitch=-1.2), *posed(FRAMES), *RANGES],
        [],
        ["sonar_*", "points up or down", "--robot"],
    ),
    "a robot beside its base": (
        [mounted(), odometry(START_S, (0, 0, 0), ("odom", "base_footprint")), *RANGES],
        [],
        ["no pose of base_link", "base_footprint"],
    ),
}


@pytest.mark.parametrize(("messages", "args", "told"), BAD.values(), ids=BAD)
def test_a_bag_that_cannot_be_mapped_says_what_is_wrong_in_one_line(put, capsys, messages, args, told):
    line = refused(capsys, put(messages), *args)
    assert [part for part in told if part not in line] == [], line


def test_a_bag_that_turns_out_to_be_bad_leaves_no_map(put, tmp_path, capsys):
    path = put(BAD["nothing but 0"][0])
    assert call("map", path, "--out", tmp_path / "out", "--resolution", "0.06") == 2
    assert "no valid reading" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


STATED = {
    "a sonar without a place": (
        [*DRIVE, *(ranging(time_of(f), "/left", "us_left", 1.0) for f in FRAMES)],
        ["us_left on /left left out: no transform to base_link", "without a place, or that was", "(30 times)"],
    ),
    "a sonar that says 0": (
        [said if said.topic != "/sonar/3" else again(said, range=0.0) for said in DRIVE],
        ["nothing but 0 m or less, which is no range, from sonar_3 on /sonar/3 in the beginning (26 times)"],
    ),
    "a beam of 0": (
        [again(said, field_of_view=0.0) if "sonar" in said.topic else said for said in DRIVE],
        ["field_of_view 0 of sonar_0 on /sonar/0 and 23 more: no beam width, 25 degrees taken"],
    ),
    "one beam of 0": (
        [again(said, field_of_view=0.0) if said.topic == "/sonar/3" else said for said in DRIVE],
        ["field_of_view 0 of sonar_3 on /sonar/3: no beam width, 25 degrees taken"],
    ),
    "transforms that are none": (
        [*DRIVE, *(tf(time_of(f), transform("base_link", "arm", (nan, 0, 0), time_of(f))) for f in FRAMES)],
        ["a transform that is not finite (30 times)"],
    ),
    "readings before the first pose": (
        [said for said in DRIVE if said.topic != "/tf" or said.time > START_S + 2],
        ["a scan without a pose at its time (9 times)"],  # and two shortly before it
    ),
    "no stamps of ranges": ([again(said, stamp=0) if "sonar" in said.topic else said for said in DRIVE], []),
}


@pytest.mark.parametrize(("messages", "told"), STATED.values(), ids=STATED)
def test_what_is_left_out_or_assumed_is_stated(put, capsys, messages, told):
    notes, said = stated(capsys, put(messages))
    assert [part for part in told if part not in notes] == [], notes
    assert len(notes.splitlines()) <= max(1, len(told))
    assert f"frames        {len(FRAMES) - 11 * ('without a pose' in notes)}" in said
