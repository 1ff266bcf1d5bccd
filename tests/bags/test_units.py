"""Units and limits that cannot be m, and those with which all is well."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bag_samples import DRIVE, FRAMES, again, assert_same_frames, refused
from bag_writers import B21, Said, drive, write
from commands import call
from echogrid.errors import InputError
from echogrid.logs.formats import load_log
from echogrid.ros.messages import RANGE

NOT_M = "cm or mm for m?"


def changed(change: Callable[[Said], dict[str, Any]], said: list[Said] = DRIVE) -> list[Said]:
    return [again(each, **change(each)) if each.type == RANGE else each for each in said]


def times(factor: float, *names: str) -> Callable[[Said], dict[str, float]]:
    return lambda said: {name: said.content[name] * factor for name in names}


def on(number: int, change: Callable[[Said], dict[str, float]]) -> Callable[[Said], dict[str, float]]:
    return lambda said: change(said) if said.topic == f"/sonar/{number}" else {}


REFUSED = {
    "ranges in cm": (times(100, "range"), ["on /sonar/* (24 of them), whose limits are 0.26 to 5 m", NOT_M]),
    "ranges in mm": (times(1000, "range"), ["/sonar/* (24 of them)", NOT_M]),
    "ranges and limits in cm": (times(100, "range", "max_range", "min_range"), ["limits are 26 to 500 m", NOT_M]),
    "ranges and limits in mm": (times(1000, "range", "max_range", "min_range"), ["limits are 260 to 5000 m", NOT_M]),
    "ranges in mm without limits": (
        lambda said: {"range": said.content["range"] * 1000, "max_range": 0.0, "min_range": 0.0},
        ["/sonar/* (24 of them)", NOT_M],
    ),
    "the maximum set to the minimum": (
        lambda _: {"max_range": 0.2, "min_range": 0.2},
        ["max_range 0.2 m on /sonar/* (24 of them), not above min_range 0.2 m", "--robot with the true limits"],
    ),
    "limits swapped": (lambda _: {"max_range": 0.26, "min_range": 5.0}, ["max_range 0.26 m", "min_range 5 m"]),
    "the minimum in cm": (times(100, "min_range"), ["max_range 5 m", "min_range 26 m"]),
}


@pytest.mark.parametrize(("change", "told"), REFUSED.values(), ids=REFUSED)
def test_where_no_range_can_be_used_the_bag_is_refused_with_its_numbers(put, capsys, change, told):
    line = refused(capsys, put(changed(change)))
    assert [part for part in told if part not in line] == [], line


def test_a_bag_in_cm_leaves_no_map(put, tmp_path, capsys):
    assert call("map", put(changed(times(100, "range"))), "--out", tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()


LEFT_OUT = {
    "one in mm": (on(6, times(1000, "range")), f"on /sonar/6, whose limits are 0.26 to 5 m: {NOT_M}; left out"),
    "one whose limits are swapped": (
        on(6, lambda _: {"max_range": 0.26, "min_range": 5.0}),
        "max_range 0.26 m on /sonar/6, not above min_range 5 m, so that no range is valid; left out",
    ),
}


@pytest.mark.parametrize(("change", "told"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_a_sonar_that_cannot_be_used_is_left_out_and_told(put, change, told):
    log = load_log(put(changed(change)))
    others = np.arange(24) != 6
    assert_same_frames(log, [replace(frame, ranges=frame.ranges[others]) for frame in FRAMES])
    (note,) = log.notes
    assert told in note


@pytest.mark.parametrize(("factor", "name"), [(100, "cm"), (1000, "mm")])
def test_limits_of_another_unit_than_the_ranges_are_brought_to_it_and_told(put, factor, name):
    log = load_log(put(changed(times(factor, "max_range", "min_range"))))
    assert_same_frames(log, FRAMES)
    assert log.robot is not None
    assert (log.robot.min_range_m, log.robot.max_range_m) == pytest.approx((B21.min_range_m, B21.max_range_m))
    (note,) = log.notes
    assert f"taken for {name}, 0.26 to 5 m" in note
    assert "/sonar/* (24 of them)" in note


@pytest.mark.parametrize(
    "change",
    [times(100, "max_range", "min_range"), lambda _: {"max_range": 0.2, "min_range": 0.2}],
    ids=["limits in cm", "the maximum set to the minimum"],
)
def test_the_limits_of_a_robot_file_stand_in_for_those_that_cannot_be(put, change):
    log = load_log(put(changed(change)), B21)
    assert_same_frames(log, FRAMES)
    (note,) = log.notes
    assert "those of the robot file taken" in note


def test_ranges_that_mostly_lie_past_a_limit_too_small_are_told(put):
    log = load_log(put(changed(lambda _: {"max_range": 0.9})))
    assert len(list(log)) == len(FRAMES)
    (note,) = log.notes
    assert "most of them past the limits of 0.26 to 0.9 m" in note


def test_ranges_that_lie_below_the_limit_all_the_time_are_told(put):
    log = load_log(put(changed(on(3, lambda _: {"range": 0.05}))))
    assert len(list(log)) == len(FRAMES)
    (note,) = log.notes
    assert "ranges of about 0.05 m on /sonar/3 in the beginning, below the limits of 0.26 to 5 m" in note


def no_echo_as(value: float) -> list[Said]:
    return changed(lambda said: {"range": value} if np.isinf(said.content["range"]) else {})


ALL_WELL = {
    "as it should be": DRIVE,
    "no echo is the maximum": no_echo_as(B21.max_range_m),
    "no echo is a little more": no_echo_as(B21.max_range_m * 1.01),
    "no echo is a code": no_echo_as(65.535),
    "no echo is a large code": no_echo_as(8190.0),
    "no limits": changed(lambda _: {"min_range": 0.0, "max_range": 0.0}),
    "limits that are the largest float": changed(lambda _: {"max_range": 3.4e38}),
    "some too near": changed(lambda said: {"range": 0.1} if int(said.time * 10) % 3 == 0 else {}),
}


@pytest.mark.parametrize("messages", ALL_WELL.values(), ids=ALL_WELL)
def test_of_units_with_which_all_is_well_nothing_is_said(put, messages):
    log = load_log(put(messages))
    assert len(list(log)) == len(FRAMES)
    assert log.notes == {}


@given(
    factor=st.sampled_from([10.0, 100.0, 1000.0]),
    limits=st.booleans(),
    stands=st.booleans(),
    fewer=st.integers(1, 24),
)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_the_unit_no_map_is_made_of_it_in_silence(tmp_path_factory, factor, limits, stands, fewer):
    names = ("range", "max_range", "min_range") if limits else ("range",)
    few = [replace(frame, ranges=np.minimum(frame.ranges[:fewer], 4.99)) for frame in FRAMES]
    if stands:
        few = [replace(frame, ranges=few[0].ranges) for frame in few]
    said = changed(times(factor, *names), drive(few, robot=replace(B21, mounts=B21.mounts[:fewer])))
    path = write(tmp_path_factory.mktemp("unit") / "drive.bag", said, "bag")
    if factor == 10 or (stands and fewer < 2):  # what may be another sonar's, or a code, is for the judge of all logs
        return
    with pytest.raises(InputError, match=re.escape(NOT_M)):
        list(load_log(path))
