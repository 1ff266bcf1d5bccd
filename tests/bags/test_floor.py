"""Rangers that hear the floor, and those that look ahead though they are pitched; one sonar on two topics."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bag_samples import DRIVE, FRAMES, again, assert_same_frames, refused, stated
from bag_writers import B21, START_S, Said, posed, ranged, ranging, tf, time_of, transform, write
from echogrid.errors import InputError
from echogrid.logs.formats import load_log
from echogrid.ros.messages import RANGE, Choice


def cliffs(pitch: float, height: float, factor: float = 1.0, base: str = "base_link") -> list[Said]:
    """Two rangers in front that are pitched down and read the floor, times a factor."""
    far = factor * height / np.sin(pitch)
    sides = (0.3, -0.3)
    places = [transform(base, f"cliff_{i}", (0.2, s, s), START_S, z=height, pitch=pitch) for i, s in enumerate(sides)]
    noise = np.random.default_rng(1)
    heard = [
        ranging(time_of(f), f"/cliff/{i}", f"cliff_{i}", far + noise.normal(0, 0.004), min_range=0.02)
        for f in FRAMES
        for i in range(2)
    ]
    return [tf(START_S, *places, topic="/tf_static"), *heard]


@given(pitch=st.floats(0.44, 0.75), height=st.floats(0.08, 0.6))
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_rangers_that_hear_the_floor_are_left_out_and_told(tmp_path_factory, pitch, height):
    path = write(tmp_path_factory.mktemp("floor") / "drive.bag", [*DRIVE, *cliffs(pitch, height)], "bag")
    log = load_log(path)
    ranges = [frame.ranges for frame in log]
    assert {len(each) for each in ranges} == {24}
    (note,) = log.notes
    assert note.startswith("cliff_0 on /cliff/0, cliff_1 on /cliff/1 pitched down by")
    assert f"at a height of {height:.2f} m" in note
    assert "floor: left out" in note


def test_the_height_is_that_above_base_footprint(put):
    foot = tf(START_S, transform("base_footprint", "base_link", np.zeros(3), START_S, z=0.1), topic="/tf_static")
    said = [each for each in DRIVE if each.topic != "/tf"]
    floor = [again_range(each, 0.3 / np.sin(0.6)) for each in cliffs(0.6, 0.2)]
    log = load_log(put([foot, *said, *posed(FRAMES, child="base_footprint"), *floor]))
    list(log)
    assert [note for note in log.notes if "at a height of 0.30 m" in note]


def again_range(said: Said, value: float) -> Said:
    return again(said, range=value) if said.type == RANGE else said


def test_where_all_hear_the_floor_the_bag_is_refused(put, capsys):
    line = refused(capsys, put([*posed(FRAMES), *cliffs(0.6, 0.12)]))
    assert "pitched down by 34 degrees at a height of 0.12 m" in line
    assert "expected rangers that look ahead" in line


def half_heard(pitch: float, height: float) -> list[Said]:
    """Rangers that hear the floor in every second reading, and nothing in the others."""
    tree, *heard = cliffs(pitch, height)
    return [tree, *(again_range(each, inf) if i // 2 % 2 else each for i, each in enumerate(heard))]


def test_info_says_which_rangers_hear_the_floor(put, capsys):
    _, said = stated(capsys, put([*DRIVE, *cliffs(0.6, 0.2)]))
    rows = [line for line in said.splitlines() if line.startswith("/cliff/") and "deg" in line]
    assert len(rows) == 2
    assert all("one that hears the floor" in row for row in rows)


LEVEL = {
    "too few readings": cliffs(0.6, 0.2)[:19],
    "half of the readings alone": half_heard(0.6, 0.2),
    "level, and so near": cliffs(0.01, 0.2, 0.01),
    "pitched, and farther than the floor": cliffs(0.6, 0.3, 4.0),
    "pitched, and nearer than the floor": cliffs(0.6, 0.6, 0.5),
    "pitched a little": cliffs(0.2, 0.15),
}


@pytest.mark.parametrize("cliff", LEVEL.values(), ids=LEVEL)
def test_rangers_that_hear_something_else_stay(put, cliff):
    log = load_log(put([*DRIVE, *cliff]))
    assert {len(frame.ranges) for frame in log} == {26}
    assert log.notes == {}


def test_with_a_robot_file_it_is_the_users_to_say_what_they_see(put):
    both = replace(B21, mounts=np.vstack([[[0.2, 0.3, 0.3], [0.2, -0.3, -0.3]], B21.mounts]))
    log = load_log(put([*DRIVE, *cliffs(0.6, 0.3)]), both)
    assert {len(frame.ranges) for frame in log} == {26}


FILTERED = [
    *(again(each, topic=each.topic + "/raw") if each.type == RANGE else each for each in DRIVE),
    *(again(each, topic=each.topic + "/filtered") for each in ranged(FRAMES)),
]


def test_one_sonar_on_two_topics_names_the_option_that_chooses(put, capsys):
    line = refused(capsys, put(FILTERED))
    assert "--topics with one of /sonar/*/filtered (24 of them), /sonar/*/raw (24 of them)" in line
    assert "in one frame, sonar_0" in line
    single = [each for each in FILTERED if each.type != RANGE or each.topic.startswith("/sonar/0/")]
    assert "--topics with one of /sonar/0/filtered, /sonar/0/raw" in refused(capsys, put(single))


def test_what_it_names_maps(put):
    path = put(FILTERED)
    with pytest.raises(InputError, match="in one frame"):
        load_log(path)
    for choice in ("/sonar/*/raw", "/sonar/*/filtered"):
        log = load_log(path, choice=Choice((choice,)))
        assert_same_frames(log, FRAMES)
        assert log.notes == {}
