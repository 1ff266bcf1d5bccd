import re
import resource
from collections.abc import Iterable
from dataclasses import replace
from math import inf, nan, pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bag_writers import (
    B21,
    FORMATS,
    START_S,
    Said,
    cloud,
    cloud2,
    drive,
    file_of,
    has_rosbag,
    header,
    in_order,
    mounted,
    odometry,
    posed,
    ranged,
    ranging,
    sample,
    seen_points,
    sonar_array,
    tf,
    time_of,
    transform,
    write,
    write_mcap,
    write_with_rosbag,
)
from echogrid.cli import main
from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.geometry import compose
from echogrid.logs import bag
from echogrid.logs.bag_file import BagFile
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from echogrid.mapping.build import build_map
from echogrid.metrics import score
from echogrid.models.table import sensor_model
from echogrid.robot import Robot
from echogrid.ros.messages import Choice, RangeSaid
from echogrid.simulation.drive import truth_of
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import parse_world

FRAMES = sample(30)
END_S = START_S + FRAMES[-1].stamp
DRIVE = drive(FRAMES)
P3DX = Robot.load("p3dx")
RING = [
    Frame(frame.stamp, frame.pose, P3DX.clean(np.where(np.arange(16) % 5 == 4, inf, frame.ranges[:16])))
    for frame in FRAMES
]
"""The drive as if a Pioneer had heard the first of the readings."""

with_rosbag = pytest.mark.skipif(not has_rosbag(), reason="Debian's rosbag is not here")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bags")


@pytest.fixture
def put(tmp_path):
    """Write a bag of ROS 1."""

    def bag_of(messages: Iterable[Said], form: str = "bag") -> Path:
        name = f"drive{len(list(tmp_path.iterdir()))}"
        return write(tmp_path / (f"{name}.bag" if form == "bag" else name), in_order(messages), form)

    return bag_of


def assert_same_frames(found: Iterable[Frame], expected: Iterable[Frame]) -> None:
    for one, other in zip(found, expected, strict=True):
        assert one.mounts is None
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-9)
        np.testing.assert_allclose(one.ranges, other.ranges, rtol=1e-6)
        assert one.stamp - START_S == pytest.approx(other.stamp, abs=1e-6)


def again(
    said: Said, stamp: float | None = None, frame: str | None = None, topic: str | None = None, **fields
) -> Said:
    """A message with some fields changed."""
    old = said.content["header"]
    at = old["stamp"]["sec"] + old["stamp"]["nanosec"] * 1e-9 if stamp is None else stamp
    content = dict(said.content) | {"header": header(at, old["frame_id"] if frame is None else frame)} | fields
    return said._replace(topic=topic or said.topic, content=content)


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


def rosbag_of(path: Path, messages: Iterable[Said] = DRIVE, **options: object) -> Path:
    write_with_rosbag(messages, {path: options})
    return path


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


@with_rosbag
def test_a_bag_without_its_index_says_how_to_mend_it(tmp_path, capsys):
    path = rosbag_of(tmp_path / "killed.bag", unindexed=True)
    assert "rosbag reindex" in refused(capsys, path)


@pytest.mark.parametrize("form", FORMATS)
def test_ranges_are_decoded_as_the_general_decoder_does(tmp_path, form):
    told = [ranging(START_S + n, "/s", "f" * n, 0.1 + n, B21, field_of_view=0.1 * n) for n in range(10)]
    told += [
        ranging(1.5, "/s", "Sonär", inf),
        ranging(2.0, "/s", "x", nan, max_range=-inf),
    ]
    for little in (True, False):
        path = write(tmp_path / f"{form}{little}.bag", in_order(told), form, little=little) if form == "bag" else None
        path = path or write(tmp_path / f"{form}{little}", in_order(told), form, little=little)
        with BagFile(path) as opened:
            found = [message.content for message in opened.messages({"/s"})]
        for one, said in zip(found, in_order(told), strict=True):
            assert isinstance(one, RangeSaid)
            content = said.content
            expected = [content[name] for name in ("field_of_view", "min_range", "max_range", "range")]
            assert one.frame == content["header"]["frame_id"]
            at = content["header"]["stamp"]
            assert one.stamp == at["sec"] + at["nanosec"] * 1e-9
            np.testing.assert_array_equal(np.array(one[2:], "f4"), np.array(expected, "f4"))


def test_the_range_of_newer_distributions_is_read_too(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    path = write(tmp_path / "jazzy", drive(FRAMES[:5]), "sqlite3", store=store)
    assert_same_frames(load_log(path), FRAMES[:5])


def test_a_range_whose_fields_are_in_another_order_is_read_by_its_definition(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    other = get_typestore(Stores.EMPTY)
    other.register({name: store.fielddefs[name] for name in store.fielddefs if name != "sensor_msgs/msg/Range"})
    fields = "std_msgs/Header header\nfloat32 range\nfloat32 max_range\nfloat32 min_range\nfloat32 field_of_view"
    other.register(get_types_from_msg(fields, "sensor_msgs/msg/Range"))
    path = write(tmp_path / "other", drive(FRAMES[:5]), "mcap", store=other)
    assert_same_frames(load_log(path), FRAMES[:5])


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


def test_a_range_is_preferred_to_points_and_points_of_old_to_new(put):
    both = [*DRIVE, *(cloud(frame, B21) for frame in FRAMES), *(cloud2(frame, B21) for frame in FRAMES)]
    assert_same_frames(load_log(put(both)), FRAMES)
    points = [said for said in both if "Range" not in said.type]
    assert sum(frame.ranges.size for frame in load_log(put(points), B21)) == 24 * len(FRAMES)


SHIFT = np.array([1.0, -2.0, 0.5])


def shifted(frames: Iterable[Frame], by: np.ndarray) -> list[Frame]:
    return [replace(frame, pose=compose(by, frame.pose)) for frame in frames]


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


@pytest.mark.parametrize(("poses", "expected"), POSES.values(), ids=POSES)
def test_the_pose_is_told_from_tf_and_odometry(tmp_path, poses, expected):
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    said = in_order([mounted(), *poses, *ranged(FRAMES)])
    log = load_log(write(tmp_path / "drive.bag", said, "bag", store=store))
    assert_same_frames(log, expected)
    assert log.notes == {}


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


LONG = sample(60)
"""Twelve seconds: more than is surveyed."""


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


def test_the_frames_can_be_chosen(put):
    path = put([*DRIVE, *fixed("map", "odom", SHIFT), *fixed("base_link", "turret", (0.1, 0, pi / 2))])
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


def call(*args: object) -> int:
    try:
        main([str(arg) for arg in args])
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


def refused(capsys, path: Path, *args: object) -> str:
    """The line that the command says of a bag that it refuses."""
    capsys.readouterr()
    assert call("info", path, *args) == 2
    written = capsys.readouterr()
    line = written.err.removesuffix("\n")
    assert line.isprintable(), line
    assert len(line) < 600
    assert re.fullmatch(r"echogrid: .*: found .+, expected .+", line)
    assert line.startswith(f"echogrid: {path}")
    return line


def stated(capsys, path: Path, *args: object) -> tuple[str, str]:
    """What the command says of a bag that it takes: notes, and the rest."""
    capsys.readouterr()
    status = call("info", path, *args)
    written = capsys.readouterr()
    assert status == 0, written.err
    return written.err, written.out


def other_robot() -> list[Said]:
    mounts = [transform("r2/base_link", f"r2/sonar_{i}", mount, START_S) for i, mount in enumerate(B21.mounts)]
    ranges = (
        again(said, frame="r2/" + said.content["header"]["frame_id"], topic="/r2" + said.topic)
        for said in ranged(FRAMES)
    )
    return [tf(START_S, *mounts, topic="/tf_static"), *posed(FRAMES, "r2/odom", "r2/base_link"), *ranges]


def own_tf(robot: str, x: float) -> list[Said]:
    """The transforms of a robot that has its own topic of them, but no names of its own for its frames."""
    return [said._replace(topic=f"{robot}/tf") for said in posed(shifted(FRAMES, np.array([x, 0.0, 0.0])))]


POINTS = [*posed(RING), *(cloud(frame, P3DX) for frame in RING)]
TWO = [odometry(time_of(frame), frame.pose, topic=topic) for frame in FRAMES for topic in ("/odom", "/visual_odom")]
RANGES = list(ranged(FRAMES))

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
    "two clocks": (
        [mounted(), *posed(FRAMES), *(again(said, stamp=said.time - START_S + 5) for said in RANGES)],
        [],
        [f"last reading 10.8 s, poses 1600000000.0 to {END_S:.1f} s", "stamps of one clock"],
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


def test_where_topics_are_to_be_chosen_the_choice_helps(put, capsys):
    path = put([mounted(), *TWO, *RANGES])
    assert_same_frames(load_log(path, choice=Choice(("/odom",))), FRAMES)
    assert_same_frames(load_log(path, choice=Choice(("/odom", "/sonar/*"))), FRAMES)
    path = put([*DRIVE, *other_robot()])
    assert_same_frames(load_log(path, choice=Choice(("/r2/*",))), FRAMES)
    notes, _ = stated(capsys, path, "--base-frame", "r2/base_link")
    assert "sonar_* on /sonar/* (24 of them) left out: no transform to r2/base_link" in notes
    assert f"a sonar without a place, or that was not heard in the beginning ({24 * len(FRAMES)} times)" in notes


STATED = {
    "a sonar without a place": (
        [*DRIVE, *(ranging(time_of(f), "/left", "us_left", 1.0) for f in FRAMES)],
        ["us_left on /left left out: no transform to base_link", "without a place, or that was", "(30 times)"],
    ),
    "a sonar that says 0": (
        [said if said.topic != "/sonar/3" else again(said, range=0.0) for said in DRIVE],
        ["nothing but 0 m, which is no range, from sonar_3 on /sonar/3 in the beginning (26 times)"],
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
        ["a scan without a pose at its time (11 times)"],
    ),
    "no stamps of ranges": ([again(said, stamp=0) if "sonar" in said.topic else said for said in DRIVE], []),
}


@pytest.mark.parametrize(("messages", "told"), STATED.values(), ids=STATED)
def test_what_is_left_out_or_assumed_is_stated(put, capsys, messages, told):
    notes, said = stated(capsys, put(messages))
    assert [part for part in told if part not in notes] == [], notes
    assert len(notes.splitlines()) <= max(1, len(told))
    assert f"frames        {len(FRAMES) - 11 * ('without a pose' in notes)}" in said


def test_what_is_in_a_bag_is_told(put, capsys):
    _, said = stated(capsys, put(DRIVE))
    lines = said.splitlines()
    assert "/sonar/7                               30  sensor_msgs/msg/Range" in lines
    assert "/tf                                    30  tf2_msgs/msg/TFMessage" in lines
    row = next(line for line in lines if line.startswith("/sonar/7 sonar_7"))
    silent = np.mean([np.isinf(frame.ranges[7]) for frame in FRAMES])
    assert re.search(r" 5\.0 Hz +-?0\.\d\d +0\.\d\d m +67\.5 deg +25 deg  0\.26-5\.00 m", row), row
    assert row.endswith(f"{silent:6.1%}")


@pytest.mark.parametrize("name", ["drive.mcap", "drive", "drive.bag.gz", "drive.db3"])
def test_a_bag_with_the_ending_of_another_says_which_it_is(put, tmp_path, capsys, name):
    path = put(DRIVE[:50]).rename(tmp_path / name)
    assert "begins like .bag" in refused(capsys, path)


def test_an_mcap_with_channels_that_are_not_of_ros_is_not_called_damaged(tmp_path, capsys):
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("log", "jsonschema", b"{}")
        channel = writer.register_channel("/log", "json", schema)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    assert "channels of jsonschema in an MCAP, expected messages of ROS 2 alone" in refused(capsys, path)


def test_a_folder_without_its_metadata_says_which_file_to_take(put, capsys):
    path = put(DRIVE, "mcap")
    (path / "metadata.yaml").unlink()
    line = refused(capsys, path)
    assert "a folder without metadata.yaml" in line
    assert str(file_of(path)) in line
    assert_same_frames(load_log(file_of(path)), FRAMES)


def test_a_folder_whose_file_is_gone_is_refused(put, capsys):
    path = put(DRIVE, "sqlite3")
    file_of(path).unlink()
    assert "cut off or damaged" in refused(capsys, path)


def test_names_that_are_made_up_do_not_fill_the_screen(put, capsys):
    names = ["/" + "x" * 5_000, "/\x1b[31mred", "/a*1", "/a1*", "/a12", *(f"/n{'m' * n}" for n in range(40))]
    path = put([odometry(START_S, (0, 0, 0), topic=name) for name in names])
    assert "no topic of sonars among" in refused(capsys, path)


SHORT = [Frame(frame.stamp, frame.pose, frame.ranges[:3]) for frame in FRAMES[:8]]
TRIO = replace(B21, mounts=B21.mounts[:3])


@pytest.fixture(scope="module")
def small(folder):
    """The ending and the bytes of a short bag of a format."""
    out = {}
    for form in FORMATS:
        name = "small.bag" if form == "bag" else f"small-{form}"
        path = file_of(write(folder / name, drive(SHORT, robot=TRIO), form))
        out[form] = path.suffix, path.read_bytes()
    return lambda form: out[form]


def survives(path: Path) -> InputError | None:
    """Read all of a bag; its error if it has one."""
    found = None
    try:
        assert len(list(load_log(path))) <= 200
    except InputError as error:
        found = error
    assert found is None or (len(str(found)) < 600 and str(found).isprintable())
    return found


@pytest.mark.parametrize("form", FORMATS)
def test_a_bag_cut_off_anywhere_is_refused(small, tmp_path, form):
    suffix, whole = small(form)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole)
    assert survives(path) is None
    for length in [0, 1, 5, 8, 12, 13, 16, *np.linspace(17, len(whole) - 1, 40).astype(int).tolist()]:
        path.write_bytes(whole[:length])
        # Of a database the last page may hold nothing that is looked at.
        assert survives(path) is not None or (form == "sqlite3" and length > len(whole) - 4096), length


edits = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from(["flip", "set", "cut", "double", "long"]), st.integers(0, 255)),
    min_size=1,
    max_size=4,
)


@pytest.mark.parametrize("form", FORMATS)
@given(edits=edits)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_bytes_a_bag_holds_nothing_but_one_line_comes_of_it(small, tmp_path, form, edits):
    suffix, whole = small(form)
    content = bytearray(whole)
    for share, kind, value in edits:
        at = int(share * (len(content) - 1))
        match kind:
            case "flip":
                content[at] ^= 1 << value % 8
            case "set":
                content[at] = value
            case "cut":
                del content[at : at + 1 + value]
            case "double":
                content[at:at] = content[at : at + value]
            case "long":
                content[at : at + 4] = b"\xff\xff\xff\x7f"
    path = tmp_path / f"any{suffix}"
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    survives(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB that it took at most"


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        ("tf2_msgs/msg/TFMessage", "std_msgs/Header[] transforms"),
        ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped transforms"),
        ("tf2_msgs/msg/TFMessage", "string[] transforms"),
        ("nav_msgs/msg/Odometry", "std_msgs/Header header\nint32 child_frame_id"),
        ("sensor_msgs/msg/Range", "std_msgs/Header header\nfloat32 range"),
        ("sensor_msgs/msg/Range", "std_msgs/Header header\nstring range\n" + "float32 {}\n" * 3),
    ],
)
def test_definitions_without_the_fields_that_are_read_are_refused(tmp_path, capsys, kind, wrong):
    wrong = wrong.format("field_of_view", "min_range", "max_range")
    store, whole = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_HUMBLE)
    store.register({name: whole.fielddefs[name] for name in whole.fielddefs if name != kind})
    store.register(get_types_from_msg(wrong, kind))
    said = [
        *(said for said in DRIVE if said.type != kind),
        *(odometry(time_of(frame), frame.pose) for frame in FRAMES if "Odometry" not in kind),
        *(Said("/any", time_of(frame), kind, {}) for frame in FRAMES),
    ]
    path = write(tmp_path / "drive", in_order(said), "mcap", store=store)
    assert f"found a definition of {kind} without" in refused(capsys, path)


@pytest.mark.parametrize(("content", "found"), [(b"", "an empty file"), (b"#ROSB", "does not begin like a bag")])
def test_a_file_that_is_none_is_refused_by_its_name(tmp_path, capsys, content, found):
    for suffix in (".bag", ".mcap", ".db3"):
        path = tmp_path / f"drive{suffix}"
        path.write_bytes(content)
        assert found in refused(capsys, path)


def test_what_is_no_bag_is_left_to_the_other_readers(tmp_path):
    assert not bag.recognises(Path(__file__))
    assert not bag.recognises(tmp_path)
    assert not bag.recognises(tmp_path / "absent.bag")
