"""Clocks that are not one, stamps that are none, and those with which all is well."""

from collections.abc import Callable, Iterable
from math import floor
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bag_samples import DRIVE, END_S, FRAMES, LONG, again, refused, stated
from bag_writers import START_S, Said, drive, header, mounted, odometry, posed, ranged, tf, time_of, transform
from echogrid.bags.bag_file import Message
from echogrid.bags.clocks import Clocks, judged
from echogrid.logs.formats import load_log
from echogrid.ros.messages import ODOMETRY, RANGE

SECOND = 10**9


def stamped(said: Said, sec: float, nanosec: float = 0) -> Said:
    content = dict(said.content)
    content["header"] = content["header"] | {"stamp": {"sec": int(sec), "nanosec": int(nanosec)}}
    return said._replace(content=content)


def sonars(change: Callable[[Said], Said], said: Iterable[Said] = DRIVE) -> list[Said]:
    return [change(each) if each.type == RANGE else each for each in said]


def late(said: Said, most: float) -> Said:
    """Recorded as much later as the network took."""
    rng = np.random.default_rng(int(said.time * 1e4) + len(said.topic))
    return said._replace(time=said.time + rng.uniform(0, most))


def assert_close(log, frames, atol: float = 0.02) -> None:
    found = list(log)
    assert len(found) == len(frames)
    for one, other in zip(found, frames, strict=True):
        np.testing.assert_allclose(one.pose, other.pose, atol=atol)
        np.testing.assert_allclose(one.ranges, other.ranges, rtol=1e-6)


@pytest.mark.parametrize("off", [-12.0, -2.0, 0.7, 1.0, 3600.0, 5 - START_S])
def test_sonars_with_a_clock_of_their_own_are_brought_to_that_of_the_poses_and_told(put, off):
    log = load_log(put(sonars(lambda said: again(said, stamp=said.time + off))))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert "/sonar/* (24 of them)" in note
    assert "two clocks" in note
    assert ("behind" if off < 0 else "ahead of") in note


def test_the_note_names_those_alone_whose_clock_it_is_and_the_distance(put):
    odd = [f"/sonar/{number}" for number in range(1, 24, 2)]
    said = sonars(lambda said: again(said, stamp=said.time - START_S + 9 - 3 * (said.topic in odd)))
    said = [again(each, stamp=each.time - 2.5) if each.topic in odd else each for each in sonars(lambda s: s)]
    log = load_log(put(said))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert "(12 of them) lie 2.5 s behind" in note


def test_poses_with_a_clock_of_their_own_are_met_by_the_sonars(put):
    places = [again(odometry(time_of(f), f.pose), stamp=time_of(f) + 40) for f in FRAMES]
    log = load_log(put([mounted(), *places, *ranged(FRAMES)]))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert "40.0 s behind those of the poses on /odom, which lie 40.0 s ahead of the time of recording" in note


BROKEN = {
    "whole seconds": lambda said: stamped(said, said.time),
    "microseconds for nanosec": lambda said: stamped(said, said.time, said.time % 1 * 1e6),
    "milliseconds for nanosec": lambda said: stamped(said, said.time, said.time % 1 * 1e3),
    "nanosec past a second": lambda said: stamped(said, said.time, floor(said.time * SECOND) % 2**32),
    "one stamp for all": lambda said: stamped(said, START_S, 7),
    "whole seconds of another clock": lambda said: stamped(said, said.time - 90_000),
}


@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN)
def test_stamps_that_are_none_give_way_to_the_time_of_recording(put, change):
    log = load_log(put(sonars(change)))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert note.startswith("stamps on /sonar/* (24 of them) are no times (")
    assert "time of recording" in note


@pytest.mark.parametrize("change", BROKEN.values(), ids=BROKEN)
def test_so_do_those_of_odometry(put, change):
    places = [change(odometry(time_of(frame), frame.pose)) for frame in FRAMES]
    if change is BROKEN["whole seconds of another clock"]:
        places = [BROKEN["whole seconds"](each) for each in places]
    log = load_log(put([mounted(), *places, *ranged(FRAMES)]))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert note.startswith("stamps on /odom are no times (")


def test_readings_without_stamps_meet_poses_of_a_simulated_clock(put):
    said = sonars(lambda said: again(said, stamp=0))
    said = [again_tf(each, -START_S + 5) if each.topic == "/tf" else each for each in said]
    log = load_log(put(said))
    assert_close(log, FRAMES, 1e-3)
    (note,) = log.notes
    assert "no stamps on /sonar/*" in note


def again_tf(said: Said, off: float, rate: float = 1.0) -> Said:
    moved = []
    for each in said.content["transforms"]:
        at = each["header"]["stamp"]["sec"] + each["header"]["stamp"]["nanosec"] * 1e-9
        at = START_S + (at - START_S) * rate + off
        moved.append(each | {"header": each["header"] | {"stamp": {"sec": int(at), "nanosec": int(at % 1 * 1e9)}}})
    return said._replace(content={"transforms": moved})


def simulated(said: Said, rate: float) -> Said:
    """Of a simulation that runs at another rate than the clock on the wall."""
    if said.topic == "/tf":
        return again_tf(said, 100 - START_S, rate)
    return again(said, stamp=100 + (said.time - START_S) * rate) if said.type == RANGE else said


ALL_WELL = {
    "as it should be": DRIVE,
    "late by up to 50 ms": [late(said, 0.05) for said in DRIVE],
    "all late by up to 0.4 s": [said._replace(time=said.time + 0.3) for said in DRIVE],
    "poses late": [said._replace(time=said.time + 0.35 * (said.topic == "/tf")) for said in DRIVE],
    "a simulated clock": [simulated(said, 1.0) for said in DRIVE],
    "a simulated clock that is slow": [simulated(said, 0.4) for said in DRIVE],
    "a simulated clock that is fast, sonars later": [
        simulated(said, 3.0) for said in drive(LONG) if said.type != RANGE or said.time > START_S + 4
    ],
    "sonars recorded in bursts": [
        said._replace(time=np.ceil(said.time)) if said.type == RANGE else said for said in DRIVE
    ],
    "a localiser that dates ahead": [
        *DRIVE,
        *(tf(time_of(f), transform("map", "odom", np.zeros(3), time_of(f) + 1)) for f in FRAMES),
    ],
    "the first messages from a queue": [
        said._replace(time=max(said.time, START_S + 1)) if said.type == RANGE else said for said in DRIVE
    ],
}


@pytest.mark.parametrize("messages", ALL_WELL.values(), ids=ALL_WELL)
def test_of_clocks_with_which_all_is_well_nothing_is_said(put, messages):
    log = load_log(put(messages))
    assert len(list(log)) >= len(FRAMES) - 6
    assert [note for note in log.notes if "pose at its time" not in note] == []


def test_messages_without_clocks_that_can_be_joined_are_refused(put, capsys):
    said = [
        mounted(),
        *ranged(FRAMES),
        *(again_tf(each, 100)._replace(time=each.time + 100) for each in posed(FRAMES)),
    ]
    line = refused(capsys, put(said))
    assert f"last reading {END_S:.1f} s, poses 1600000100.0" in line
    assert "stamps of one clock" in line


def test_info_tells_the_clocks_that_are_not_that_of_the_recording(put, capsys):
    _, said = stated(capsys, put(sonars(lambda said: again(said, stamp=said.time - 12))))
    assert "clocks        /sonar/* (24 of them): 12.0 s behind the time of recording" in said.splitlines()
    _, said = stated(capsys, put(DRIVE))
    assert "clocks        all stamps within 0.5 s of the time of recording" in said.splitlines()


@pytest.mark.parametrize("rate", [0.5, 1.0, 3.0])
def test_a_simulation_whose_time_begins_at_0_is_not_doubted(put, capsys, rate):
    def simulated(said):
        time = rate * (said.time - START_S)
        if "transforms" not in said.content:
            return again(said, stamp=time)
        moved = [dict(each, header=header(time, each["header"]["frame_id"])) for each in said.content["transforms"]]
        return said._replace(content={"transforms": moved})

    noted, said = stated(capsys, put(map(simulated, DRIVE)))
    assert noted == ""
    assert f"span          {rate * (END_S - START_S):.2f} s" in said
    assert f"frames        {len(FRAMES)}" in said
    row = next(line for line in said.splitlines() if line.startswith("/sonar/0 sonar_0"))
    assert float(row.split()[2]) == pytest.approx(5 / rate, rel=0.05)


@given(
    off=st.floats(-1e9, 1e9),
    own=st.floats(-1e9, 1e9),
    jitter=st.floats(0.0, 0.05),
    period=st.floats(0.02, 0.5),
    seed=st.integers(0, 99),
)
@settings(max_examples=60, deadline=None)
def test_whatever_clocks_there_are_they_are_told_apart_by_their_distance_alone(off, own, jitter, period, seed):
    rng, clocks = np.random.default_rng(seed), Clocks()
    for at in np.arange(0, max(6.0, 8 * period), period) + START_S:
        sec = floor(at + own)
        stamp = SimpleNamespace(sec=sec, nanosec=round((at + own - sec) * 1e9))
        moving = SimpleNamespace(header=SimpleNamespace(stamp=stamp), child_frame_id="base_link")
        heard = SimpleNamespace(stamp=at + own + off, frame="s")
        clocks.hear(Message("/odom", ODOMETRY, at + rng.uniform(0, jitter), moving))
        clocks.hear(Message("/s", RANGE, at + 0.01 + rng.uniform(0, jitter), heard))
    found = judged(clocks, [("/s", "s")], [("/odom", "base_link")], ())
    if abs(off) > 0.6:
        assert found.fixes["/s", "s"].of(1e9 + off, 0.0) == pytest.approx(1e9, abs=0.12)
        assert len(found.notes) == 1
    elif abs(off) < 0.4:
        assert found == ({}, frozenset(), {})
