"""Frames that a program hands over: what can be is mapped as it is meant, what cannot be leaves the map alone."""

from dataclasses import replace
from importlib import resources
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import inf, nan

from echogrid import EchogridError, Frame, Mapper, Robot, build_map, load_log
from echogrid.cli.arguments import check_map
from echogrid.errors import UsageError
from echogrid.mapping.intake import cleaned, fitting
from echogrid.models.classical.log_odds import Cone

pytestmark = pytest.mark.unchecked  # types are wrong on purpose, and a program checks none either

B21 = Robot.load("b21")
CELL_M = 0.1
SAMPLE = resources.files("echogrid") / "data" / "sample.csv"


def scan(stamp=0.0, x=0.0, seed=0):
    """A clean scan; about every fourth sonar hears no echo, one did not fire."""
    rng = np.random.default_rng(seed)
    ranges = np.where(rng.random(B21.sonars) < 0.25, inf, rng.uniform(0.5, 2.5, B21.sonars))
    ranges[7] = nan
    return Frame(stamp, np.array([x, 0.0, 0.1]), ranges)


def drive(count=6):
    return [scan(0.2 * i, 0.1 * i, seed=i) for i in range(count)]


def one_of(value, sonar=3, ranges=None):
    """Ranges of which one has a value."""
    changed = (scan(seed=9).ranges if ranges is None else ranges).copy()
    changed[sonar] = value
    return changed


def same(one, other):
    return one.origin == other.origin and all(
        np.array_equal(a, b) for a, b in ((one.log_odds, other.log_odds), (one.observed, other.observed))
    )


def mapped(frames, model="set-network", half_life=None):
    mapper = Mapper(B21, model, CELL_M, half_life)
    for frame in frames:
        mapper.add([frame])
    return mapper


@pytest.mark.parametrize("model", ["set-network", "network", "cone", "em"])
def test_no_echo_that_is_stored_as_the_maximum_range_draws_no_wall(model):
    clean = drive()
    for stored in (B21.max_range_m, float(np.float32(B21.max_range_m)) + 0.3):
        frames = [replace(f, ranges=np.where(np.isinf(f.ranges), stored, f.ranges)) for f in clean]
        for one, other in ((clean, frames), (map(low, clean), map(low, frames))):
            *_, right = build_map(list(one), B21, model, CELL_M)
            *_, grid = build_map(list(other), B21, model, CELL_M)
            assert same(grid, right)
            mapper = Mapper(B21, model, CELL_M)
            mapper.add(frames)


def test_of_a_robot_that_hears_farther_the_same_ranges_are_echoes():
    far, clean = replace(B21, max_range_m=9.0), drive()
    *_, walls = build_map([replace(f, ranges=np.minimum(f.ranges, 5.0)) for f in clean], far, "cone")
    *_, none = build_map(clean, far, "cone")
    assert walls.log_odds.max() > none.log_odds.max() or not same(walls, none)


def low(frame):
    """The same with a reading below the robot's minimum in the place of the one that did not fire."""
    return replace(frame, ranges=one_of(0.9 * B21.min_range_m, 7, frame.ranges))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_a_limit_in_single_precision_is_the_limit(kind):
    for limit in (0.7, 4.2, 5.0, 3.3):
        robot = replace(B21, min_range_m=0.1, max_range_m=limit)
        (frame,) = cleaned(list(fitting([replace(scan(), ranges=np.full(24, limit, kind))], robot)), robot)
        assert np.all(frame.ranges == inf)
        robot = replace(B21, min_range_m=limit, max_range_m=9.0)
        (frame,) = cleaned(list(fitting([replace(scan(), ranges=np.full(24, limit, kind))], robot)), robot)
        np.testing.assert_allclose(frame.ranges, limit, rtol=1e-6)


readings = st.floats(0, 100) | st.sampled_from([inf, nan, B21.min_range_m, B21.max_range_m, 5 - 1e-7, 0.26 - 1e-8])


@given(st.lists(st.lists(readings, min_size=24, max_size=24), min_size=1, max_size=4))
def test_what_is_clean_is_handed_on_as_it_is(rows):
    frames = [Frame(0.0, np.zeros(3), np.array(row)) for row in rows]
    once = cleaned(frames, B21)
    for before, after in zip(frames, once, strict=True):
        np.testing.assert_array_equal(after.ranges, [B21.clean_one(value) for value in before.ranges.tolist()])
    assert cleaned(once, B21) is once
    assert all(a is b for a, b in zip(fitting(once, B21), once, strict=True))


def test_no_frame_of_a_log_is_touched():
    log = list(load_log(str(SAMPLE), B21))
    assert cleaned(log, B21) is log
    assert all(a is b for a, b in zip(fitting(log, B21), log, strict=True))


GOOD = scan(0.6, 0.3, seed=9)
SHIFTED = np.where(np.arange(72) == 40, nan, 0.0).reshape(24, 3) + B21.mounts

BAD: dict[str, tuple[Any, str]] = {
    "too few readings": ({"ranges": GOOD.ranges[:23]}, "found 23 readings, expected 24 (robot b21)"),
    "no readings": ({"ranges": np.zeros(0)}, "found 0 readings"),
    "readings in rows": ({"ranges": np.ones((4, 6))}, "found ranges that is an array of shape (4, 6), expected one"),
    "ranges that are text": ({"ranges": ["1.0"] * 24}, "found ranges that is list ['1.0', "),
    "ranges of None": ({"ranges": [None] * 24}, "found ranges that is list [None, "),
    "no ranges": ({"ranges": None}, "found ranges that is None, expected one range a sonar"),
    "truth values": ({"ranges": np.ones(24, bool)}, "found ranges that is an array of bool"),
    "complex numbers": ({"ranges": np.ones(24, complex)}, "found ranges that is an array of complex128"),
    "uneven lists": ({"ranges": [[1.0]] * 23 + [2.0]}, "found ranges that is list"),
    "below zero": ({"ranges": one_of(-0.5)}, "found a range of -0.5 of sonar 3, expected metres from 0 to 100, inf"),
    "minus infinity": ({"ranges": one_of(-inf)}, "found a range of -inf of sonar 3"),
    "millimetres": ({"ranges": one_of(1204.0)}, "found a range of 1204 of sonar 3"),
    "millimetres in integers": ({"ranges": np.full(24, 1204)}, "found a range of 1204 of sonar 0"),
    "pose of nan": ({"pose": np.array([0.3, nan, 0.0])}, "found y = nan, expected metres within +-1e+07"),
    "pose of inf": ({"pose": np.array([inf, 0.0, 0.0])}, "found x = inf"),
    "heading of nan": ({"pose": np.array([0.0, 0.0, nan])}, "found theta = nan, expected radians"),
    "pose past everything": ({"pose": np.array([1e300, 0.0, 0.0])}, "found x = 1e+300"),
    "pose of two": ({"pose": np.zeros(2)}, "found a pose that is an array of shape (2,)"),
    "no pose": ({"pose": None}, "found a pose that is None, expected x, y, theta"),
    "pose that is text": ({"pose": "0 0 0"}, "found a pose that is str '0 0 0'"),
    "pose masked": ({"pose": np.ma.masked_invalid([nan, 0.0, 0.0])}, "found x = nan"),
    "mounts of another robot": ({"mounts": B21.mounts[:16]}, "found mounts that is an array of shape (16, 3)"),
    "mounts of nan": ({"mounts": SHIFTED}, "found mounts[13] = ["),
    "mounts that are text": ({"mounts": "front"}, "found mounts that is str 'front'"),
    "stamp of nan": ({"stamp": nan}, "found stamp = nan, expected a time in s within +-1e+11"),
    "stamp of inf": ({"stamp": inf}, "found stamp = inf"),
    "stamp in ns": ({"stamp": 1_700_000_000_000_000_000}, "found stamp = 1.7e+18"),
    "stamp that is text": ({"stamp": "now"}, "found stamp = 'now'"),
    "no stamp": ({"stamp": None}, "found stamp = nothing"),
}
NO_FRAMES: dict[str, tuple[Any, str]] = {
    "no frame": ((0.6, [0, 0, 0], [1.0] * 24), "found tuple (0.6, "),
    "nothing": (None, "found None, expected a Frame"),
    "text": ("frame", "found str 'frame', expected a Frame"),
}


def told(text):
    assert "\n" not in text
    assert len(text) < 250
    assert ", expected " in text
    return text


@pytest.mark.parametrize("kind", [*BAD, *NO_FRAMES])
def test_a_frame_that_cannot_be_leaves_the_map_to_go_on_as_before(kind):
    bad, found = (BAD | NO_FRAMES)[kind]
    bad = replace(GOOD, **bad) if kind in BAD else bad
    first, rest = drive()[:3], drive()[3:]
    mapper, control = mapped(first, half_life=20.0), mapped(first, half_life=20.0)
    with pytest.raises(UsageError) as raised:
        mapper.add([*rest, bad])
    where = "map: frame of stamp 0.6 s: " if found.startswith("found a range") else "map: frame 3"
    assert told(str(raised.value)).startswith(where)
    assert found in str(raised.value)
    assert same(mapper.grid(), control.grid())
    for each in (mapper, control):
        each.add(rest)
    assert same(mapper.grid(), control.grid())
    with pytest.raises(UsageError) as raised:
        list(build_map([*first, bad], B21, "cone", CELL_M))
    assert found in told(str(raised.value))


def test_a_pose_that_is_far_off_leaves_the_map_to_go_on_as_before():
    first, rest = drive()[:3], drive()[3:]
    for model in ("set-network", "network", "cone"):
        mapper, control = mapped(first, model), mapped(first, model)
        with pytest.raises(UsageError, match=r"^map: found a drive that spans 9\.0000\de\+06 x "):
            mapper.add([*rest, replace(GOOD, pose=np.array([9e6, 9e6, 0.0]))])
        assert same(mapper.grid(), control.grid())
        for each in (mapper, control):
            each.add(rest)
        assert same(mapper.grid(), control.grid())


@pytest.mark.parametrize("model", ["set-network", "network", "cone", "em"])
def test_room_that_was_found_is_there(model):
    """What is checked before the first scan is taken holds for all of them, wherever their sonars looked from."""
    away = B21.mounts + np.array([3.0, -2.0, 0.3])
    mapper = Mapper(B21, model, CELL_M)
    checked, reserved = [], []
    for calls, name in ((checked, "check_room"), (reserved, "reserve")):
        method = getattr(mapper._grown, name)

        def noted(low, high, calls=calls, method=method):
            calls.append((low, high))
            return method(low, high)

        setattr(mapper._grown, name, noted)
    mapper.add([scan(0.0, 0.0), scan(0.1, 1.7), replace(scan(0.2, -4.1), mounts=away)])
    ((low, high),) = checked
    assert np.all(low <= np.min([first for first, _ in reserved], axis=0))
    assert np.all(high >= np.max([last for _, last in reserved], axis=0))


def test_numbers_of_other_kinds_are_taken_for_what_they_say():
    frames = drive()
    right = mapped(frames).grid()
    for frame in frames:
        frame.ranges[:] = np.float32(frame.ranges)
    single = mapped(frames).grid()
    unfired = [np.isnan(f.ranges) for f in frames]
    masked = [
        replace(f, ranges=np.ma.masked_array(np.where(no, 1.0, f.ranges), no))
        for f, no in zip(frames, unfired, strict=True)
    ]
    lists = [Frame(float(f.stamp), f.pose.tolist(), f.ranges.tolist()) for f in frames]
    for other in (masked, lists, [replace(f, ranges=f.ranges.astype(np.float32)) for f in frames]):
        assert same(mapped(other).grid(), single)
        *_, built = build_map(other, B21, "set-network", CELL_M)
        # Cells at the very edge of a view may fall to either side, and those round them are read with them.
        assert np.mean(~np.isclose(built.log_odds, single.log_odds, atol=2e-3)) < 1e-2
        np.testing.assert_allclose(built.log_odds, single.log_odds, atol=0.05)
    np.testing.assert_allclose(single.log_odds, right.log_odds, atol=2e-3)
    pose, ranges = cast(Any, [0, 0, 0]), cast(Any, [2] * 24)
    whole = Frame(0, pose, ranges)
    assert same(mapped([whole]).grid(), mapped([Frame(0.0, np.zeros(3), np.full(24, 2.0))]).grid())


def test_where_nothing_fades_stamps_may_stand_in_any_order():
    frames = drive()
    back = [replace(frame, stamp=100.0 - 7 * i) for i, frame in enumerate(frames)]
    assert same(mapped(back).grid(), mapped(frames).grid())


def test_where_evidence_fades_a_clock_that_jumps_back_is_refused():
    mapper, control = (mapped([scan(1000.0)], half_life=5.0) for _ in range(2))
    with pytest.raises(
        UsageError, match=r"^map: frame 1 \(stamp 0.4 s\): found a clock that jumps back, from 1000.2 s"
    ):
        mapper.add([scan(1000.2), scan(0.4)])
    for late in (999.4, 1000.3):  # what is late by less than a second is no jump
        for each in (mapper, control):
            each.add([scan(late, 0.2, seed=1)])
    assert same(mapper.grid(), control.grid())
    with pytest.raises(UsageError, match="found a clock that jumps back"):
        list(build_map([scan(1000.0), scan(0.0)], B21, "set-network", CELL_M, half_life=5.0))


def test_scans_for_em_after_its_map_was_made_are_refused_and_do_not_replace_it():
    mapper = Mapper(B21, "em", CELL_M)
    mapper.add(drive())
    before = mapper.grid().log_odds.copy()
    with pytest.raises(UsageError, match=r"^map: found more scans for em after its map was made, expected all scans"):
        mapper.add([GOOD])
    np.testing.assert_array_equal(mapper.grid().log_odds, before)


def test_no_scans_are_no_change():
    mapper = mapped(drive())
    before = mapper.grid().log_odds.copy()
    mapper.add([])
    np.testing.assert_array_equal(mapper.grid().log_odds, before)


@pytest.mark.parametrize("frames", [None, 7, GOOD])
def test_what_are_no_frames_at_all_are_refused(frames):
    for taking in (Mapper(B21, "cone").add, lambda given: list(build_map(given, B21, "cone"))):
        with pytest.raises(UsageError, match=r"^map: found .*, expected frames, in a list or a log$"):
            taking(frames)


CHOICES = [
    *(("resolution", value) for value in (0, -0.1, 0.004, 10.1, nan, inf, "fine", True, [0.1])),
    *(("half_life", value) for value in (0, -5, 0.05, 2e7, nan, inf, "long")),
]


@pytest.mark.parametrize(("name", "value"), CHOICES)
def test_a_choice_out_of_range_is_refused_at_once_as_the_command_refuses_it(name, value):
    messages = []
    for chosen in (
        lambda: Mapper(B21, "set-network", **{name: value}),
        lambda: build_map([], B21, "set-network", **{name: value}),
        lambda: check_map(**{"resolution": None, "half_life": None} | {name: value}),
    ):
        with pytest.raises(UsageError) as raised:
            chosen()
        messages.append(told(str(raised.value)))
    assert messages[0] == messages[1]
    assert messages[2] == f"--{messages[0].replace('_', '-', 1)}"
    assert messages[0].startswith(f"{name}: found ")


def test_choices_in_range_are_taken():
    for resolution in (0.005, 10, cast(float, np.float32(0.25)), None):
        Mapper(B21, "cone", resolution)
    for half_life in (0.1, 1e7, 5):
        Mapper(B21, "set-network", half_life=half_life)


ROBOTS: dict[str, tuple[Any, str]] = {
    "a name": ("b21", "robot: found str 'b21', expected a Robot, as of Robot.load"),
    "nothing": (None, "robot: found None, expected a Robot"),
    "mounts of nan": ({"mounts": SHIFTED}, "robot b21: found mounts "),
    "mounts of two": ({"mounts": B21.mounts[:, :2]}, "robot b21: found mounts "),
    "no mounts": ({"mounts": np.zeros((0, 3))}, "robot b21: found mounts "),
    "limits": ({"min_range_m": 6.0}, "robot b21: found ranges from 6.0 to 5.0 m, expected a minimum below"),
    "own limits of two": ({"own_max_ranges_m": np.array([5.0, 1.0])}, "robot b21: found own maximum ranges "),
    "own limits above": ({"own_max_ranges_m": np.full(24, 6.0)}, "robot b21: found own maximum ranges "),
    "limit of nan": ({"max_range_m": nan}, "robot b21: found ranges from 0.26 to nan m"),
}


@pytest.mark.parametrize("kind", ROBOTS)
def test_a_robot_that_cannot_be_is_refused_at_once(kind):
    robot, found = ROBOTS[kind]
    robot = replace(B21, **robot) if isinstance(robot, dict) else robot
    mapper = Mapper(B21, "cone")
    for taking in (lambda: Mapper(robot, "cone"), lambda: build_map([], robot), lambda: mapper.equip(robot)):
        with pytest.raises(UsageError) as raised:
            taking()
        assert told(str(raised.value)).startswith(found)
    assert mapper.robot is B21


@pytest.mark.parametrize("model", ["conee", Cone, None, 7])
def test_what_is_no_model_is_refused(model):
    with pytest.raises(UsageError, match=r"^interpreter: found .*, expected "):
        Mapper(B21, model)


@pytest.mark.parametrize(
    "asked", [(nan, 0, 1), (0, inf, 1), (0, 0, nan), (0, 0, 0), (0, 0, -1), (0, 0, 1e9), ("a", 0, 1)]
)
def test_a_square_that_cannot_be_is_refused(asked):
    mapper = mapped(drive(), "cone")
    assert mapper.around(0, 0, 1).shape == (10, 10)
    with pytest.raises(UsageError, match=r"^around: (x|y|side_m): found .*, expected "):
        mapper.around(*asked)


anything = (
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4) | st.complex_numbers(),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=6,
    )
    | st.floats(-3, 3).map(lambda value: np.full(3, value))
    | st.floats(0, 9).map(lambda value: np.full(24, value))
)


@settings(max_examples=200, deadline=None)
@given(stamp=anything, pose=anything, ranges=anything, mounts=anything)
def test_whatever_a_frame_holds_is_taken_or_refused_in_one_line(stamp, pose, ranges, mounts):
    for each in (
        Frame(stamp, np.zeros(3), GOOD.ranges),
        Frame(0.0, pose, GOOD.ranges),
        Frame(0.0, np.zeros(3), ranges),
        Frame(0.0, np.zeros(3), GOOD.ranges, mounts=mounts),
        Frame(stamp, pose, ranges, mounts=mounts),
    ):
        assert "\n" not in repr(each)
        try:
            (frame,) = cleaned(list(fitting([each], B21)), B21)
        except EchogridError as error:
            told(str(error))
        else:
            assert np.isfinite([frame.stamp, *frame.pose]).all()
            assert (frame.pose.dtype, frame.ranges.dtype) == (float, float)
            np.testing.assert_array_equal(B21.clean(frame.ranges), frame.ranges)
