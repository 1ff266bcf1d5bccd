from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import inf, nan

from echogrid.grid import Grid
from echogrid.live import live_map as module
from echogrid.live.live_map import FAR_STAMP, LEAPS, MAX_CELLS, Heard, Live, Settings
from echogrid.mapping.mapper import Mapper
from echogrid.models.set_network import SetNetwork
from echogrid.models.table import sensor_model
from echogrid.robot import MAX_SONARS
from echogrid.ros.messages import Choice
from echogrid.ros.scans import LATE, REPEATED

NETWORK = cast(SetNetwork, sensor_model("set-network"))
START_S = 1000.0
MOUNTS = [(0.2, 0.0, 0.0), (0.0, 0.2, np.pi / 2), (-0.2, 0.0, np.pi), (0.0, -0.2, -np.pi / 2)]


class Recorder(Mapper):
    """Stands for the mapper, which takes seconds to compile: keeps the frames."""

    def __init__(self, robot, network, resolution=None, half_life=None):
        self.robot, self.half_life, self.resolution = robot, half_life, resolution or 0.04
        self.frames, self.before = [], []
        self.cells = np.zeros((3, 4), dtype=np.float32)

    def equip(self, robot):
        self.robot, self.before, self.frames = robot, self.before + self.frames, []

    def prepare(self, batch, size=None):
        return lambda: cast(Any, None)

    def add(self, frames):
        self.frames += frames

    def grid(self):
        return Grid(self.cells, self.cells == 0, self.resolution, (0.0, 0.0))

    def around(self, x, y, side_m):
        cells = np.full((2, 2), -3, dtype=np.float32)
        return Grid(cells, cells < 0, self.resolution, (x - side_m / 2, y - side_m / 2))


@pytest.fixture
def recorded(monkeypatch):
    monkeypatch.setattr(module, "Mapper", Recorder)


def snapshot_of(live) -> Any:
    return live.snapshot()


def header(stamp, frame):
    nanos = round(stamp * 1e9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=nanos // 10**9, nanosec=nanos % 10**9), frame_id=frame)


def range_of(stamp, frame, value, fov=0.4, low=0.15, high=5.0):
    return SimpleNamespace(
        header=header(stamp, frame), field_of_view=fov, min_range=low, max_range=high, range=value, radiation_type=0
    )


def xyz(x, y, z=0.0):
    return SimpleNamespace(x=x, y=y, z=z)


def turned(theta):
    return SimpleNamespace(x=0.0, y=0.0, z=np.sin(theta / 2), w=np.cos(theta / 2))


def transform(stamp, parent, child, x, y, theta):
    where = SimpleNamespace(translation=xyz(x, y), rotation=turned(theta))
    return SimpleNamespace(header=header(stamp, parent), child_frame_id=child, transform=where)


def tf(*transforms):
    return SimpleNamespace(transforms=list(transforms))


def odometry(stamp, x, y, theta, parent="odom", child="base_link"):
    pose = SimpleNamespace(pose=SimpleNamespace(position=xyz(x, y), orientation=turned(theta)))
    return SimpleNamespace(header=header(stamp, parent), child_frame_id=child, pose=pose)


class Drive:
    """A robot that sends its messages to Live, ten scans a second."""

    def __init__(self, live, mounts=MOUNTS):
        self.live, self.mounts, self.time = live, mounts, 0.0
        self.pictures, self.notices = [], []
        static = [transform(0, "base_link", f"sonar_{i}", *mount) for i, mount in enumerate(mounts)]
        self.take(Heard.STATIC, "/tf_static", tf(*static))

    def take(self, heard, topic, message):
        self.live.take(heard, topic, message, self.time)

    def pose(self, x=0.0, y=0.0, theta=0.0):
        self.take(Heard.TF, "/tf", tf(transform(START_S + self.time, "odom", "base_link", x, y, theta)))

    def ranges(self, values, stamp=None):
        for i, value in enumerate(values):
            if value is not None:
                self.take(Heard.RANGE, f"/s{i}", range_of(stamp or START_S + self.time, f"sonar_{i}", value))

    def step(self):
        self.pictures += self.live.step(self.time)
        self.notices += self.live.notices()
        self.time = round(self.time + 0.1, 6)

    def run(self, scans, values=(1.0, 2.0, inf, 0.5)):
        for _ in range(scans):
            self.pose(x=0.1 * self.time)
            self.ranges(values)
            self.step()

    @property
    def frames(self):
        return self.live._mapper.frames


@pytest.fixture
def live(recorded):
    return Live(NETWORK, Settings())


@pytest.fixture
def drive(live):
    return Drive(live)


def test_scans_reach_the_map_with_their_poses_and_none_is_lost_at_the_start(drive):
    drive.run(40)
    assert drive.notices[0].startswith("mapping in odom with 4 sonars of base_link: sonar_0, ")
    assert len(drive.frames) == drive.live.scans == 40
    assert drive.live.readings == 160
    for i, frame in enumerate(drive.frames):
        assert frame.stamp == pytest.approx(START_S + 0.1 * i)
        np.testing.assert_allclose(frame.pose, [0.01 * i, 0, 0], atol=1e-9)
        np.testing.assert_array_equal(frame.ranges, [1.0, 2.0, inf, 0.5])
    np.testing.assert_allclose(drive.live._mapper.robot.mounts, MOUNTS, atol=1e-12)
    assert not drive.live.refused


def test_the_array_has_the_order_of_the_names(recorded):
    live = Live(NETWORK, Settings())
    drive = Drive(live, [(0.1, 0.0, 0.1 * i) for i in range(12)])
    drive.run(30, [1.0] * 12)
    assert list(snapshot_of(live).settings["sonars"]) == [f"sonar_{i}" for i in range(12)]


def test_the_map_comes_once_a_second_if_it_changed_and_the_local_map_after_each_scan(drive):
    drive.run(71)
    maps = [picture for picture in drive.pictures if not picture.local]
    locals_ = [picture for picture in drive.pictures if picture.local]
    later = [picture.stamp for picture in maps if picture.stamp > START_S + 3]  # all that waited at first is mapped
    assert len(later) == 4
    np.testing.assert_allclose(np.diff(later), 1.0, atol=0.11)
    assert len([picture for picture in locals_ if picture.stamp > START_S + 3]) == 40
    assert locals_[-1].frame == "odom"
    assert locals_[-1].origin == pytest.approx((0.1 * 7 - 3, -3))
    np.testing.assert_array_equal(locals_[-1].cells, 0)
    before = len(drive.pictures)
    drive.time += 2
    drive.step()
    drive.time += 2
    drive.step()
    assert len(drive.pictures) - before <= 1  # the last change, and nothing for nothing


def test_a_silent_sonar_is_told_of_once_and_so_is_its_return(drive):
    drive.run(40)
    drive.run(50, (1.0, 2.0, None, 0.5))
    assert [n for n in drive.notices if n.startswith("silent")] == [
        "silent: sonar_2; what they look at is left as it is"
    ]
    assert "silent: sonar_2" in drive.live.status()
    drive.run(40)
    assert [n for n in drive.notices if n.startswith("back")] == ["back: sonar_2"]
    assert sum("silent" in n for n in drive.notices) == 1
    without = [frame for frame in drive.frames if np.isnan(frame.ranges[2])]
    assert len(without) == 50
    assert all(np.isfinite(frame.ranges[[0, 1, 3]]).all() for frame in without)


def test_silence_of_all_sonars_is_told(drive):
    drive.run(40)
    for _ in range(50):
        drive.pose(x=4.0)
        drive.step()
    assert sum(n.startswith("silent: sonar_0, sonar_1, sonar_2, sonar_3") for n in drive.notices) == 1


def test_late_and_repeated_readings_are_counted_and_not_mapped(drive):
    drive.run(40)
    stamp = START_S + drive.time - 0.1
    drive.ranges([9.0, None, None, None], stamp)
    drive.ranges([None, 9.0, None, None], stamp - 0.2)
    drive.run(10)
    assert len(drive.frames) == 50
    assert all(frame.ranges[0] == 1.0 and frame.ranges[1] == 2.0 for frame in drive.frames)
    assert drive.live.refused == {REPEATED: 1, LATE: 1}


def test_readings_of_one_scan_in_any_order_are_one_scan(drive):
    drive.run(40)
    drive.pose(x=0.1 * drive.time)
    for i in (3, 0, 2, 1):
        drive.take(Heard.RANGE, "/s", range_of(START_S + drive.time - 0.001 * i, f"sonar_{i}", 1.0))
    drive.step()
    assert len(drive.frames) == 41
    np.testing.assert_array_equal(drive.frames[-1].ranges, 1.0)


def test_a_scan_waits_for_its_pose_and_no_longer_than_it_must(drive):
    drive.run(40)
    drive.ranges([1.0] * 4)
    drive.step()
    assert len(drive.frames) == 40  # its pose may come
    for _ in range(3):
        drive.ranges([1.0] * 4)
        drive.step()
    assert len(drive.frames) > 40  # it did not: the robot is taken to go on
    np.testing.assert_allclose(drive.frames[40].pose, [0.4, 0, 0], atol=1e-9)


def test_one_stamp_of_another_clock_is_refused_and_many_are_a_clock_that_jumped(drive):
    drive.run(40)
    drive.take(Heard.RANGE, "/s", range_of(2e9, "sonar_0", 3.0))
    drive.take(Heard.TF, "/tf", tf(transform(1.0, "odom", "base_link", 50, 50, 0)))
    drive.run(10)
    assert drive.live.refused[FAR_STAMP] == 2
    assert len(drive.frames) == 50
    drive.live._clock.newest += 500.0  # from here on the robot's clock is 500 s behind, as when a simulation restarts
    drive.run(20)
    assert drive.live.refused["a clock that jumped"] == 1
    assert drive.live.refused[FAR_STAMP] == 2 + LEAPS - 1
    assert len(drive.frames) >= 50 + 20 - LEAPS // 5 - 2


def test_a_pose_far_off_does_not_make_the_map_grow(drive):
    drive.run(40)
    drive.pose(x=1e6)
    drive.ranges([1.0] * 4)
    drive.step()
    drive.run(5)
    assert drive.live.refused == {"a pose so far off that the map would become too large": 1}
    poses = np.array([frame.pose[:2] for frame in drive.frames])
    assert np.prod((np.ptp(poses, axis=0) + 8) / 0.04) < MAX_CELLS


def test_a_map_of_its_place_is_made_from_odometry_alone_and_from_its_first_topic(live):
    drive = Drive(live)
    for i in range(40):
        drive.take(Heard.ODOMETRY, "/odom", odometry(START_S + drive.time, 0.01 * i, 0.0, 0.0))
        drive.take(Heard.ODOMETRY, "/filtered", odometry(START_S + drive.time + 0.05, 30.0, 0.0, 0.0))
        drive.ranges([1.0] * 4)
        drive.step()
    np.testing.assert_allclose(
        [frame.pose for frame in drive.frames], [[0.01 * i, 0, 0] for i in range(40)], atol=1e-9
    )
    assert live.refused == {"odometry on a second topic": 40}


def test_map_is_preferred_and_the_user_chooses(recorded):
    for fixed, expected in ((None, "map"), ("odom", "odom")):
        live = Live(NETWORK, Settings(Choice(fixed=fixed)))
        drive = Drive(live)
        drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "map", "odom", 1.0, 2.0, 0.0)))
        drive.run(30)
        assert drive.pictures[-1].frame == expected
        np.testing.assert_allclose(drive.frames[0].pose, [1, 2, 0] if fixed is None else [0, 0, 0], atol=1e-9)


def test_what_is_missing_is_said(live):
    assert live.status() == "heard no sensor_msgs/Range yet"
    live.take(Heard.RANGE, "/s", range_of(START_S, "sonar_0", 1.0), 0.0)
    assert live.status() == "heard sonar_0, but no transform of them (/tf_static)"
    drive = Drive(live)
    assert "no pose of the robot" in live.status()
    drive.run(30)
    assert live.status() == "30 scans of 4 sonars in odom; not taken: 1 x " + REPEATED


def test_a_sonar_without_a_place_is_left_out_and_joins_when_it_has_one(live):
    drive = Drive(live, MOUNTS[:3])
    drive.mounts = MOUNTS
    drive.run(60)
    assert drive.live._mapper.robot.sonars == 3
    assert live.refused["a reading of a sonar that is new, or whose place is not known"] > 0
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(30)
    assert drive.notices[-1] == "new: sonar_3"
    assert drive.live._mapper.robot.sonars == 4
    np.testing.assert_array_equal(drive.frames[-1].ranges, [1.0, 2.0, inf, 0.5])


def test_a_frame_to_map_in_that_comes_late_is_told_of(drive):
    drive.run(40)
    drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "map", "odom", 5.0, 0.0, 0.0)))
    drive.run(40)
    assert drive.notices.count("there is map now; to map in it rather than in odom, start again") == 1
    assert len(drive.frames) == 80
    assert drive.pictures[-1].frame == "odom"


def test_a_frame_that_is_put_in_between_later_is_followed(drive):
    drive.run(40)
    for _ in range(40):
        stamp = START_S + drive.time
        drive.take(Heard.TF, "/tf", tf(transform(stamp, "base_footprint", "base_link", 0.0, 0.0, 0.0)))
        drive.take(Heard.TF, "/tf", tf(transform(stamp, "odom", "base_footprint", 0.5, 0.0, 0.0)))
        drive.ranges([1.0] * 4)
        drive.step()
    assert len(drive.frames) >= 65
    np.testing.assert_allclose(drive.frames[-1].pose, [0.5, 0, 0], atol=1e-9)


def test_scans_that_wait_are_mapped_before_a_sonar_joins(live):
    drive = Drive(live, MOUNTS[:3])
    drive.mounts = MOUNTS
    drive.run(40)
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    for _ in range(60):  # so many at once that they have to wait
        for _ in range(30):
            drive.pose()
            drive.ranges((1.0, 2.0, inf, 0.5))
            drive.time = round(drive.time + 0.02, 6)
        drive.step()
    before = drive.live._mapper.before
    assert all(len(frame.ranges) == 3 for frame in before)
    assert all(len(frame.ranges) == 4 for frame in drive.frames)
    assert len(before) + len(drive.frames) == live.scans


def test_the_map_is_kept_when_a_sonar_joins():
    live: Any = Live(NETWORK, Settings(resolution=0.12))
    drive = Drive(live, MOUNTS[:3])
    drive.run(40)
    before = snapshot_of(live).grid
    drive.mounts = MOUNTS
    drive.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_3", *MOUNTS[3])))
    drive.run(40)
    after = snapshot_of(live).grid
    assert live._mapper.robot.sonars == 4
    assert after.observed.sum() >= before.observed.sum()
    assert after.views.max() > before.views.max()


def test_a_snapshot_does_not_change(live):
    drive = Drive(live)
    assert live.snapshot() is None
    drive.run(30)
    snapshot = live.snapshot()
    assert not np.shares_memory(snapshot.grid.log_odds, live._mapper.grid().log_odds)
    assert snapshot.settings["frames"] == 30
    assert snapshot.path.shape[1] == 2


@pytest.mark.parametrize(
    ("heard", "message", "reason"),
    [
        (Heard.RANGE, range_of(START_S, "", 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(START_S, "x" * 1000, 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(START_S, "a\nb", 1.0), "a name of a frame that cannot be"),
        (Heard.RANGE, range_of(-5.0, "a", 1.0), "a stamp that cannot be"),
        (Heard.RANGE, range_of(0.0, "a", 1.0), "a reading without a stamp before any transform"),
        (Heard.RANGE, SimpleNamespace(), "a message that is no sensor_msgs/Range"),
        (Heard.TF, SimpleNamespace(transforms=[None]), "a message that is no tf2_msgs/TFMessage on /tf"),
        (Heard.TF, tf(transform(START_S, "odom", "b", nan, 0, 0)), "a transform that is not finite"),
        (Heard.TF, tf(transform(START_S, "b", "b", 0, 0, 0)), "a transform without two frames"),
        (
            Heard.STATIC,
            tf(transform(0, "a", "b", 0, 0, 0), transform(0, "b", "c", 0, 0, 0), transform(0, "c", "a", 0, 0, 0)),
            "a transform that closes a circle",
        ),
        (Heard.ODOMETRY, odometry(START_S, inf, 0, 0), "a transform that is not finite"),
    ],
)
def test_what_cannot_be_is_counted_by_its_reason(live, heard, message, reason):
    live.take(heard, "/t", message, 0.0)
    assert live.refused == {reason: 1}


def test_a_rotation_of_zero_is_refused(live):
    message = transform(START_S, "odom", "base_link", 0, 0, 0)
    message.transform.rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    live.take(Heard.TF, "/tf", tf(message), 0.0)
    assert live.refused == {"a rotation that is no unit quaternion": 1}


def test_thousands_of_frames_leave_memory_bounded_and_the_robot_heard(drive):
    drive.run(40)
    for i in range(5000):
        drive.take(Heard.RANGE, "/evil", range_of(START_S + drive.time, f"evil_{i}", 1.0))
        drive.take(Heard.TF, "/tf", tf(transform(START_S + drive.time, "odom", f"evil_{i}", 0, 0, 0)))
    drive.run(10)
    assert len(drive.frames) == 50
    assert len(drive.live._sonars) <= MAX_SONARS
    assert len(drive.live._transforms.children()) < 10
    assert sum(drive.live.refused.values()) == 5000


def test_what_waits_for_a_pose_is_bounded(live, monkeypatch):
    monkeypatch.setattr(module, "MAX_MOVES", 100)
    for i in range(1000):
        live.take(Heard.TF, "/tf", tf(transform(START_S + 1e-3 * i, "odom", "arm", 0, 0, 0)), 0.0)
        live.take(Heard.RANGE, "/s", range_of(START_S + 1e-3 * i, "sonar", 1.0), 0.0)
    assert len(live._transforms._edges["arm"].stamps) <= 101
    assert live._waiting.maxlen == module.MAX_WAITING


numbers = st.one_of(st.floats(width=32), st.floats(-3, 3), st.just(0.0))
stamps = st.builds(
    lambda sec, nanosec: SimpleNamespace(sec=sec, nanosec=nanosec),
    st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(1000, 1010)),
    st.one_of(st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1)),
)
names = st.one_of(st.sampled_from(["odom", "map", "base_link", "sonar_0", "sonar_1", "", "/", "/odom"]), st.text())
headers = st.builds(lambda stamp, name: SimpleNamespace(stamp=stamp, frame_id=name), stamps, names)
vectors = st.builds(xyz, numbers, numbers, numbers)
rotations = st.one_of(
    st.builds(turned, st.floats(-3, 3)),
    st.builds(lambda x, y, z, w: SimpleNamespace(x=x, y=y, z=z, w=w), numbers, numbers, numbers, numbers),
)
transforms = st.builds(
    lambda header, child, place, turn: SimpleNamespace(
        header=header, child_frame_id=child, transform=SimpleNamespace(translation=place, rotation=turn)
    ),
    headers,
    names,
    vectors,
    rotations,
)
junk = st.one_of(st.none(), st.integers(), st.text(), st.lists(st.none()), st.builds(SimpleNamespace))
messages = st.one_of(
    st.tuples(
        st.just(Heard.RANGE),
        st.builds(
            lambda header, fov, low, high, value: SimpleNamespace(
                header=header, field_of_view=fov, min_range=low, max_range=high, range=value
            ),
            headers,
            numbers,
            numbers,
            numbers,
            numbers,
        ),
    ),
    st.tuples(st.sampled_from([Heard.TF, Heard.STATIC]), st.builds(tf, transforms, transforms)),
    st.tuples(
        st.just(Heard.ODOMETRY),
        st.builds(
            lambda header, child, place, turn: SimpleNamespace(
                header=header,
                child_frame_id=child,
                pose=SimpleNamespace(pose=SimpleNamespace(position=place, orientation=turn)),
            ),
            headers,
            names,
            vectors,
            rotations,
        ),
    ),
    st.tuples(st.sampled_from(list(Heard)), junk),
)


@settings(max_examples=150, deadline=None)
@given(st.booleans(), st.lists(messages, max_size=60))
def test_strangers_do_no_harm(mapping, strange):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "Mapper", Recorder)
        drive = Drive(Live(NETWORK, Settings()))
        if mapping:
            drive.run(25)
        for i, (heard, message) in enumerate(strange):
            drive.take(heard, "/strange", message)
            if i % 5 == 4:
                drive.run(1)
        drive.run(25)
        drive.live.finish()
        assert drive.live.status()
        assert all(reason.isprintable() for reason in drive.live.refused)
        mapper = drive.live._mapper
        if mapper is not None:
            for frame in mapper.frames:
                assert np.isfinite(frame.pose).all()
                assert not np.any(frame.ranges <= 0)
