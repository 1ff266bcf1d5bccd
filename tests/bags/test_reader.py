import re
from dataclasses import replace
from math import inf, nan, pi
from pathlib import Path

import numpy as np
import pytest

from bag_samples import DRIVE, FRAMES, LONG, SHIFT, again, assert_same_frames, rosbag_of, shifted, stated, with_rosbag
from bag_writers import (
    B21,
    START_S,
    Said,
    drive,
    file_of,
    mounted,
    posed,
    ranged,
    ranging,
    tf,
    time_of,
    transform,
    write,
    write_mcap,
)
from echogrid.geometry import compose
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from echogrid.mapping.build import build_map
from echogrid.mapping.registry import sensor_model
from echogrid.metrics import score
from echogrid.simulation.drive import truth_of
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import parse_world

WRITERS = {
    "rosbags bag": lambda path: write(path / "rosbags.bag", DRIVE, "bag"),
    "rosbags mcap": lambda path: write(path / "rosbags-mcap", DRIVE, "mcap"),
    "rosbags sqlite3": lambda path: write(path / "rosbags-sqlite3", DRIVE, "sqlite3"),
    "rosbags mcap, the file alone": lambda path: file_of(write(path / "alone", DRIVE, "mcap")),
    "rosbags sqlite3, big-endian": lambda path: write(path / "big", DRIVE, "sqlite3", little=False),
    "mcap-ros2-support": lambda path: write_mcap(path / "support.mcap", DRIVE),
    "rosbag": lambda path: rosbag_of(path / "rosbag.bag"),
    "rosbag, bz2": lambda path: rosbag_of(path / "bz2.bag", compression="bz2"),
    "rosbag, lz4, chunks": lambda path: rosbag_of(path / "lz4.bag", compression="lz4", chunk_threshold=20_000),
    "rosbag, chunks that overlap": lambda path: rosbag_of(path / "overlap.bag", mixed(DRIVE), chunk_threshold=30_000),
}
"""Who writes a bag of the drive, and how."""


def mixed(messages: list[Said]) -> list[Said]:
    """In an order in which what was recorded within 5 s is mixed up, poses last."""
    return sorted(messages, key=lambda said: (int((said.time - START_S) / 5), said.topic, said.time))


writers = pytest.mark.parametrize(
    "writer",
    [
        pytest.param(name, marks=[with_rosbag] if name.startswith("rosbag,") or name == "rosbag" else [])
        for name in WRITERS
    ],
)


@pytest.fixture(scope="module")
def written(folder):
    """The bag of a writer, written once."""
    paths: dict[str, Path] = {}

    def bag_of(writer: str) -> Path:
        if writer not in paths:
            paths[writer] = WRITERS[writer](folder)
        return paths[writer]

    return bag_of


@writers
def test_whoever_wrote_a_bag_its_frames_are_those_of_the_drive(written, writer):
    log = load_log(written(writer))
    assert_same_frames(log, FRAMES)
    assert log.notes == {}
    assert log.robot is not None
    np.testing.assert_allclose(log.robot.mounts, B21.mounts, atol=1e-9)
    assert log.robot.beam_width_rad == pytest.approx(B21.beam_width_rad)
    assert (log.robot.min_range_m, log.robot.max_range_m) == pytest.approx((B21.min_range_m, B21.max_range_m))


@pytest.fixture(scope="module")
def model():
    return sensor_model("set-network")


def log_odds(frames, robot, model):
    *_, grid = build_map(frames, robot, model, 0.06)
    return grid


@pytest.mark.parametrize(
    "writer", ["rosbags sqlite3", "mcap-ros2-support", pytest.param("rosbag", marks=with_rosbag)]
)
def test_a_bag_maps_to_the_grid_of_the_csv_log_of_the_same_drive(written, folder, model, writer):
    log = load_log(written(writer))
    csv = folder / f"{writer}.csv"
    write_csv(csv, FRAMES, 24)
    assert log.robot is not None
    found = log_odds(log, log.robot, model)
    expected = log_odds(load_log(csv, log.robot), log.robot, model)
    assert found.origin == expected.origin
    np.testing.assert_array_equal(found.observed, expected.observed)
    np.testing.assert_allclose(found.log_odds, expected.log_odds, atol=2e-3)
    assert np.ptp(found.log_odds) > 5


@pytest.mark.parametrize("robot", [None, B21])
def test_many_frames_on_one_topic_are_as_many_sonars(put, robot):
    log = load_log(put(drive(FRAMES, topic="/ultrasound")), robot)
    assert_same_frames(log, FRAMES)


def test_with_a_robot_file_the_sonars_are_its_mounts_in_the_order_of_their_names(put):
    turned = replace(B21, mounts=B21.mounts + np.array([0.01, 0, 0.1]))
    bare = [*posed(FRAMES), *(again(said, frame="sonars") for said in ranged(FRAMES))]
    log = load_log(put(bare), turned)
    assert log.robot is turned
    assert_same_frames(log, FRAMES)


def test_poses_and_places_may_come_after_the_sonars(put):
    late = START_S + 8.0
    for said in (
        [mounted(), *posed(LONG[40:]), *ranged(LONG)],
        [mounted(time=late), *posed(LONG), *ranged(LONG)],
    ):
        log = load_log(put(said))
        found = list(log)
        assert_same_frames(found, LONG[-len(found) :])
        assert len(found) >= 20


def test_what_changed_after_the_beginning_is_told(put):
    turning = [
        tf(time_of(f), transform("base_link", "sonar_3", (0.1, 0, max(0.0, f.stamp - 7)), time_of(f))) for f in LONG
    ]
    map_late = [tf(time_of(f), transform("map", "odom", SHIFT, time_of(f))) for f in LONG[45:]]
    said = [*turning, *posed(LONG), *map_late, *ranged(LONG)]
    others = [transform("base_link", f"sonar_{i}", m, START_S) for i, m in enumerate(B21.mounts) if i != 3]
    log = load_log(put([tf(START_S, *others, topic="/tf_static"), *said]))
    assert len(list(log)) == len(LONG)
    assert any("mapped in odom; map came later, --fixed-frame map" in note for note in log.notes)
    assert any(note.startswith("sonar_3 moved on the robot") for note in log.notes)


def test_a_correction_that_comes_seldom_and_by_jumps_holds_until_the_next(put):
    """As of AMCL or of markers on the wall."""
    shifts = {0: np.zeros(3), 30: np.array([0.5, 0.0, 0.0])}
    seldom = [tf(time_of(LONG[i]), transform("map", "odom", by, time_of(LONG[i]))) for i, by in shifts.items()]
    log = load_log(put([mounted(), *posed(LONG), *seldom, *ranged(LONG)]))
    assert_same_frames(log, [*LONG[:30], *shifted(LONG[30:], shifts[30])])
    assert log.notes == {}


@pytest.mark.parametrize("every", [1, 2, 5, 10])
def test_a_correction_that_jumps_is_never_interpolated_and_told(put, every):
    shifts = {i: np.array([5.0 * (i >= 30), 0.0, 0.0]) for i in range(0, len(LONG), every)}
    jumping = [tf(time_of(LONG[i]), transform("map", "odom", by, time_of(LONG[i]))) for i, by in shifts.items()]
    log = load_log(put([mounted(), *posed(LONG), *jumping, *ranged(LONG)]))
    assert_same_frames(log, [*LONG[:30], *shifted(LONG[30:], shifts[30])])
    (note,) = log.notes
    assert re.match(r"the pose jumps by [45]\.\d\d m at ", note)


def test_the_signs_of_rep_117_are_read(put):
    values = [inf, -inf, nan, 0.0, 0.1, 5.0, 4.999, 6.0, B21.min_range_m]
    meant = [inf, nan, nan, nan, nan, inf, 4.999, inf, B21.min_range_m]
    said = [ranging(time_of(f), f"/s/{n}", f"sonar_{n}", value) for f in FRAMES[:3] for n, value in enumerate(values)]
    for frame in load_log(put([mounted(), *posed(FRAMES), *said])):
        np.testing.assert_allclose(frame.ranges, meant, rtol=1e-6)


def test_messages_that_come_late_twice_or_out_of_order_change_nothing_else(put):
    said = []
    for n, each in enumerate(DRIVE):
        if each.topic == "/tf":
            said.append(each._replace(time=each.time + 0.3))  # each scan waits for its pose
        elif n % 7 == 3:
            said += [each, each._replace(time=each.time + 0.05)]
        else:
            said.append(each._replace(time=each.time + 0.001 * (n % 40)))
    log = load_log(put(said))
    assert_same_frames(log, FRAMES)
    assert log.notes == {"a reading that came twice": sum("sonar" in said.topic for said in DRIVE[3::7])}


ROOM = """
name: box
walls:
  - {points: [[0, 0], [4, 0], [4, 3], [0, 3]], closed: true, roughness_mm: 2}
cylinders:
  - {centre: [2.0, 1.5], radius_m: 0.15}
"""


def test_sonars_that_fire_one_after_another_map_best_from_their_own_places(put, model):
    scans, period = 80, 0.6
    stamps = np.arange(scans)[:, None] * period + np.arange(24) * period / 24

    def pose(at):
        turn = 2 * pi / 20 * at
        heading = np.arctan2(0.8 * np.cos(turn), -1.1 * np.sin(turn)) + 0.9 * np.sin(2 * at)
        return np.stack([2 + 1.1 * np.cos(turn), 1.5 + 0.8 * np.sin(turn), heading], axis=-1)

    one = replace(B21, mounts=np.zeros((1, 3)))
    world = parse_world(ROOM, "box")
    eyes = compose(pose(stamps), B21.mounts[None]).reshape(-1, 3)
    ranges = B21.clean(Simulator(world, one).ranges(eyes, np.random.default_rng(1))).reshape(scans, 24)
    heard = [
        ranging(START_S + stamps[n, i], f"/sonar/{i}", f"sonar_{i}", value)
        for (n, i), value in np.ndenumerate(ranges)
    ]
    times = START_S + np.arange(0, scans * period, 0.05)
    places = [tf(at, transform("odom", "base_link", pose(at - START_S), at)) for at in times]
    log = load_log(put([mounted(), *heard, *places]))
    frames = list(log)
    assert log.robot is not None
    assert len(frames) == scans
    for frame, expected in zip(frames, ranges, strict=True):
        np.testing.assert_allclose(frame.ranges, expected, rtol=1e-6)
    for frame, fired in list(zip(frames, stamps, strict=True))[::9]:
        assert frame.mounts is not None
        place = compose(frame.pose, frame.mounts)
        np.testing.assert_allclose(place[:, :2], compose(pose(fired), B21.mounts)[:, :2], atol=2e-3)
    truth = truth_of(world, np.array([frame.pose for frame in frames]))
    own = score(log_odds(frames, log.robot, model), truth)
    together = score(log_odds([replace(frame, mounts=None) for frame in frames], log.robot, model), truth)
    assert own.found > 0.98
    assert own.wiped == 0 < together.wiped
    assert own.found > together.found + 0.05
    assert own.nll < together.nll / 2


def test_what_is_in_a_bag_is_told(put, capsys):
    _, said = stated(capsys, put(DRIVE))
    lines = said.splitlines()
    assert "/sonar/7                               30  sensor_msgs/msg/Range" in lines
    assert "/tf                                    30  tf2_msgs/msg/TFMessage" in lines
    row = next(line for line in lines if line.startswith("/sonar/7 sonar_7"))
    silent = np.mean([np.isinf(frame.ranges[7]) for frame in FRAMES])
    assert re.search(r" 5\.0 Hz +-?0\.\d\d +0\.\d\d m +67\.5 deg +25 deg  0\.26-5\.00 m", row), row
    assert row.endswith(f"{silent:6.1%}    0.0%")


@pytest.mark.parametrize("nothing", [0.0, -1.0])
def test_no_echo_that_is_said_as_0_is_told(put, capsys, nothing):
    def said(share):
        rng = np.random.default_rng(0)
        for each in ranged(FRAMES):
            lost = rng.random() < share
            yield again(each, range=nothing) if lost else each

    noted, out = stated(capsys, put([mounted(), *posed(FRAMES), *said(0.4)]))
    assert re.fullmatch(r"note: \d\d% of the readings on /sonar/\* \(2\d of them\) are 0 m or less, .*\+inf\n", noted)
    row = next(line for line in out.splitlines() if line.startswith("/sonar/7 sonar_7"))
    assert 20 < float(row.split()[-1].rstrip("%")) < 60
    assert stated(capsys, put([mounted(), *posed(FRAMES), *said(0.05)]))[0] == ""
