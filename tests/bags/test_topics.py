import numpy as np
import pytest

from bag_samples import DRIVE, FRAMES, RANGES, TWO, assert_same_frames, other_robot, own_tf, refused, shifted, stated
from bag_writers import B21, START_S, cloud, cloud2, mounted, odometry, ranged
from echogrid.logs.formats import load_log
from echogrid.ros.messages import Choice


def test_a_range_is_preferred_to_points_and_points_of_old_to_new(put):
    both = [*DRIVE, *(cloud(frame, B21) for frame in FRAMES), *(cloud2(frame, B21) for frame in FRAMES)]
    assert_same_frames(load_log(put(both)), FRAMES)
    points = [said for said in both if "Range" not in said.type]
    assert sum(frame.ranges.size for frame in load_log(put(points), B21)) == 24 * len(FRAMES)


@pytest.mark.parametrize("number", [1, 2])
def test_each_robot_has_its_own_transforms(put, number):
    """As ROS 2's navigation has it: namespaced topics of tf, in which frames go by the same names."""
    said = [
        *own_tf("/r1", 0.0),
        *own_tf("/r2", 50.0),
        *ranged(FRAMES, "/r1/sonar/{}"),
        *ranged(FRAMES, "/r2/sonar/{}"),
    ]
    said += [mounted()._replace(topic=f"/r{i}/tf_static") for i in (1, 2)]
    expected = shifted(FRAMES, np.array([50.0 * (number - 1), 0.0, 0.0]))
    assert_same_frames(load_log(put(said), choice=Choice((f"/r{number}/*",))), expected)


def test_where_topics_are_to_be_chosen_the_choice_helps(put, capsys):
    path = put([mounted(), *TWO, *RANGES])
    assert_same_frames(load_log(path, choice=Choice(("/odom",))), FRAMES)
    assert_same_frames(load_log(path, choice=Choice(("/odom", "/sonar/*"))), FRAMES)
    path = put([*DRIVE, *other_robot()])
    assert_same_frames(load_log(path, choice=Choice(("/r2/*",))), FRAMES)
    notes, _ = stated(capsys, path, "--base-frame", "r2/base_link")
    assert "sonar_* on /sonar/* (24 of them) left out: no transform to r2/base_link" in notes
    assert f"a sonar without a place, or that was not heard in the beginning ({24 * len(FRAMES)} times)" in notes


def test_names_that_are_made_up_do_not_fill_the_screen(put, capsys):
    names = ["/" + "x" * 5_000, "/\x1b[31mred", "/a*1", "/a1*", "/a12", *(f"/n{'m' * n}" for n in range(40))]
    path = put([odometry(START_S, (0, 0, 0), topic=name) for name in names])
    assert "no topic of sonars among" in refused(capsys, path)
