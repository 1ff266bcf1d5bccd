import numpy as np
import pytest
from numpy import inf

from echogrid.errors import InputError
from echogrid.live.hearing import SECOND_TOPIC, SECONDS, Heard
from echogrid.live.telling import Telling
from live_drive import START_S, range_of, tf, transform

TRUTH = np.array([1.0, 2.0, 3.0, 0.5])


def play(
    drive, seconds=20, value=lambda v: v, limits=(0.15, 5.0), topic="/s{}", frame="sonar_{}", pose=lambda t: 0.1 * t
):
    """A drive whose sonars say otherwise what they hear; what was told beside that it maps."""
    low, high = limits
    for step in range(round(seconds * 10)):
        drive.pose(x=pose(drive.time))
        for i, truth in enumerate(TRUTH):
            said = value(truth + 0.001 * (step % 50))
            message = range_of(START_S + drive.time, frame.format(i), said, low=low, high=high)
            drive.take(Heard.RANGE, topic.format(i), message)
        drive.step()
    drive.live.finish()
    drive.notices += drive.live.notices()
    return [notice for notice in drive.notices if not notice.startswith("mapping in")]


@pytest.mark.parametrize("limits", [(0.15, 5.0), (0.0, 0.0), (0.02, inf), (0.02, 3e38), (0.0, 100.0)])
def test_a_faultless_drive_is_told_nothing_of(drive, limits):
    assert play(drive, limits=limits) == []
    assert drive.live.snapshot().settings["notes"] == {}


def test_no_echo_sent_as_the_maximum_in_an_open_place_is_no_unit(drive):
    said = play(drive, value=lambda v: 5.0 if v > 0.6 else v)
    assert said == []


@pytest.mark.parametrize(
    ("value", "limits", "words"),
    [
        (
            lambda v: 100 * v,
            (0.15, 5.0),
            ["no sonar ever heard an echo, all"],
        ),
        (lambda v: inf, (0.15, 5.0), ["no sonar ever heard an echo"]),
        (lambda v: v, (0.2, 0.2), ["min_range 0.2 and max_range 0.2 m", "no sonar ever heard an echo"]),
        (lambda v: 100 * v, (15.0, 500.0), ["min_range 15 and max_range 500 m"]),
        (lambda v: v / 100, (0.15, 5.0), ["below min_range 0.15 m"]),
    ],
)
def test_units_and_limits_are_told_once(drive, value, limits, words):
    said = play(drive, 40, value, limits)
    assert len(said) == len(words)
    for word in words:
        assert sum(word in one for one in said) == 1
        assert any(word in one for one in drive.live.snapshot().settings["notes"])


def test_a_drive_without_a_valid_reading_is_an_error(drive):
    play(drive, value=lambda v: 0.0)
    with pytest.raises(InputError, match=r"^live: found no valid reading of any sonar"):
        drive.live.refuse_nothing()


def test_several_topics_in_one_frame_are_told_and_not_mapped(drive):
    (said,) = play(drive, frame="ultrasound")
    assert said.startswith("4 topics in one frame, ultrasound (/s* (4 of them)): left out; ")
    assert "--topics" in said
    assert drive.live.snapshot() is None
    assert drive.live.status().startswith("heard ultrasound, but no sonar that has a frame of its own")


def test_one_topic_of_several_frames_is_told_nothing_of(drive):
    assert play(drive, topic="/sonar") == []
    assert drive.mapper.robot.sonars == 4


def test_a_second_topic_in_the_frame_of_a_sonar_that_maps_is_told_and_refused(drive):
    drive.run(40)
    for _ in range(40):
        drive.take(Heard.RANGE, "/filtered", range_of(START_S + drive.time - 0.05, "sonar_1", 4.0))
        drive.run(1)
    (said,) = [notice for notice in drive.notices if "one frame" in notice]
    assert "only /s1 is mapped" in said
    assert drive.live.refused == {SECOND_TOPIC: 40}
    assert all(frame.ranges[1] == 2.0 for frame in drive.frames)


def test_a_few_readings_of_a_stranger_put_no_sonar_out(drive):
    for _ in range(SECONDS - 1):
        drive.ranges([1.0] * 4)
        drive.take(Heard.RANGE, "/stranger", range_of(START_S + drive.time, "sonar_0", 4.0))
    drive.run(40)
    assert drive.mapper.robot.sonars == 4


def test_a_pose_that_jumps_is_told_once_and_one_that_drives_is_not(drive):
    said = play(drive, pose=lambda t: 0.1 * t + 8.0 * (t > 5) + 8.0 * (t > 9) + 9.0 * (t > 18))
    assert len(said) == 1
    assert said[0].startswith("the pose jumps by 8.01 m at 1005")
    assert said[0].endswith("start echogrid live anew")


@pytest.mark.parametrize("jump", [5.0, 0.0])
def test_a_correction_that_jumps_is_told_and_one_that_creeps_is_not(drive, jump):
    def corrected(t):
        if round(10 * t) % 15 == 0:  # such as a localiser sends it
            by = 0.01 * t + jump * (t > 10)
            drive.take(Heard.TF, "/tf", tf(transform(START_S + t, "map", "odom", by, 0.0, 0.0)))
        return 0.1 * t

    said = play(drive, pose=corrected)
    assert [notice.split(" at")[0] for notice in said] == ["the pose jumps by 5.03 m"] * bool(jump)


def test_no_echo_sent_as_a_value_of_its_own_is_told_with_what_helps(drive):
    (said,) = play(drive, value=lambda v: 4.0 if v > 0.6 else v)
    assert said.startswith("the longest range, 4 m, comes ")
    assert said.endswith("let its driver send max_range 4, or +inf")


def test_a_frame_in_two_parents_in_turn_is_told_once_and_one_that_changes_its_parent_is_not(drive):
    drive.run(40)
    drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "map", "odom", 0, 0, 0)))
    drive.run(20)
    assert not [notice for notice in drive.notices if "in turn" in notice]
    for i in range(60):
        parent = ("odom", "map")[i % 2]
        drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, parent, "base_link", 0, 0, 0)))
        drive.ranges([1.0] * 4)
        drive.step()
    (said,) = [notice for notice in drive.notices if "in turn" in notice]
    assert said.startswith("base_link is told in two frames in turn, map and odom, ")


def test_a_doubt_is_told_when_it_no_longer_grows():
    telling = Telling()
    assert [telling.told([("a", text)]) for text in ("one", "two", "two", "two", "three")] == [
        [],
        [],
        ["two"],
        [],
        [],
    ]
    assert telling.told([("b", "x")], now=True) == ["x"]
