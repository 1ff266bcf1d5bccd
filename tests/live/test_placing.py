"""``Live`` finds the robot: with the map that it makes, and in one that is known. No network in between."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from echogrid.geometry import compose, inverse
from echogrid.grid import Grid, logit
from echogrid.live.hearing import Heard
from echogrid.live.live_map import Picture, Settings
from echogrid.live.placing import Correction, RobotPose
from echogrid.live.session import Live
from echogrid.position.contradictions import Compared
from echogrid.robot import parse_robot
from live_drive import MOUNTS, NETWORK, START_S, Drive, header, tf, transform, turned, xyz

CELL = 0.05
ROBOT = parse_robot(
    "name: four\nfootprint_radius_m: 0.1\n"
    "sonar: {transducer: polaroid-600, min_range_m: 0.05, max_range_m: 5.0, beam_width_deg: 23}\n"
    "mounts: [[0.2, 0, 0], [0, 0.2, 90], [-0.2, 0, 180], [0, -0.2, -90]]\n",
    "four.yaml",
)


def room() -> Grid:
    """6 x 4 m with a closet, from the origin on."""
    rim = 4
    taken = np.ones((80 + 2 * rim, 120 + 2 * rim), dtype=bool)
    taken[rim:-rim, rim:-rim] = False
    taken[rim : rim + 20, rim + 50 : rim + 70] = True
    log_odds = np.where(taken, logit(0.95), logit(0.05)).astype(np.float32)
    return Grid(log_odds, np.ones_like(taken), CELL, (-rim * CELL, -rim * CELL))


def heard_at(pose) -> list[float]:
    """What narrow beams hear in the room: steps of a millimetre along the axis."""
    grid, way = room(), np.arange(0, 5.0, 0.001)
    found = []
    for x, y, axis in compose(np.asarray(pose, dtype=float)[None], ROBOT.mounts):
        cells = grid.index_of(np.stack([x + way * np.cos(axis), y + way * np.sin(axis)], axis=1))
        wall = grid.log_odds[tuple(np.clip(cells, 0, np.array(grid.shape) - 1).T)] > 0
        found.append(float(way[np.argmax(wall)]) if wall.any() else np.inf)
    return found


def way() -> np.ndarray:
    """Along three walls and back, at half a metre a second."""
    x = np.concatenate([np.linspace(0.6, 5.2, 93), np.full(30, 5.2), np.linspace(5.2, 0.6, 93)])
    y = np.concatenate([np.full(93, 3.0), np.linspace(3.0, 1.6, 30), np.linspace(1.6, 3.0, 93)])
    theta = np.concatenate([np.zeros(93), np.full(30, -np.pi / 2), np.full(93, np.pi - 0.3)])
    return np.column_stack([x, y, theta])


WAY = way()


class Robot(Drive):
    """Drives along WAY; its odometry begins at 0."""

    def __init__(self, live, origin=WAY[0]):
        super().__init__(live, MOUNTS)
        self.origin = origin
        self.after = 0.0
        """How far its clock is off, s."""

    def go(self, poses, odometry=None):
        odometry = compose(inverse(self.origin), poses) if odometry is None else odometry
        for pose, told in zip(poses, odometry, strict=True):
            stamp = START_S + self.time + self.after
            self.take(Heard.TF, "/tf", tf(transform(stamp, "odom", "base_link", *told)))
            self.ranges(heard_at(pose), stamp)
            self.step()
            placing = self.live._map.placing if self.live._map else None
            for beside in (
                getattr(placing, "_beside", None),
                getattr(getattr(placing, "_finder", None), "_beside", None),
            ):
                if beside is not None:
                    beside.wait()
        self.step()

    def say(self, pose, frame="map", variance=(0.04, 0.04, 0.03), stamp=0.0):
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = variance
        where = SimpleNamespace(position=xyz(*pose[:2]), orientation=turned(pose[2]))
        message = SimpleNamespace(
            header=header(stamp, frame), pose=SimpleNamespace(pose=where, covariance=covariance)
        )
        self.take(Heard.INITIAL, "/initialpose", message)

    def sent(self, kind):
        return [each for each in self.pictures if isinstance(each, kind)]


def slam(**settings):
    return Robot(Live(NETWORK, Settings(slam=True, **settings)))


def known(start=WAY[0]):
    return Robot(Live(NETWORK, Settings(known=room(), start=start, half_life=30.0)))


def test_the_map_lies_in_map_and_odom_is_told_in_it():
    robot = slam(map_frame="plan", tolerance=0.5)
    robot.go(WAY[:60])
    told = robot.sent(Correction)
    assert {(each.parent, each.child) for each in told} == {("plan", "odom")}
    assert told[-1].stamp == pytest.approx(START_S + 5.9 + 0.5)
    assert np.abs([each.pose for each in told]).max() < 0.1  # its odometry is right
    assert {each.frame for each in robot.sent(Picture)} == {"plan"}
    assert "mapping in plan, with odometry in odom, with 4 sonars of base_link" in robot.notices[0]
    assert not robot.sent(RobotPose)


def test_odometry_that_starts_anew_is_told_and_the_drive_goes_on():
    robot = slam()
    robot.go(WAY[:70])
    before = robot.sent(Correction)[-1].pose
    robot.go(WAY[70:93], compose(inverse(WAY[70]), WAY[70:93]))
    after = robot.sent(Correction)[-1].pose
    np.testing.assert_allclose(before, 0, atol=0.1)
    np.testing.assert_allclose(after, [3.5, 0, 0], atol=0.2)
    assert sum("the odometry jumps or starts anew: the drive goes on" in said for said in robot.notices) == 1


def test_what_contradicts_itself_is_told_once(monkeypatch):
    robot = slam()
    robot.go(WAY[:40])
    placing = robot.live._map.placing
    graph = placing._finder.graph
    many = graph._replace(poses=WAY[:90:3], together=Compared(*np.full((3, 30), 10)))
    assert not list(placing.notices())
    monkeypatch.setattr(type(placing._finder), "graph", property(lambda _: many))
    (told,) = placing.notices()
    assert "walls were seen where at other times there was free floor: walls are double there" in told
    assert not list(placing.notices())


def test_a_drive_that_is_played_again_makes_a_new_map():
    robot = slam()
    robot.go(WAY[:90])
    first = robot.live.snapshot()
    robot.after = -robot.time - 100.0
    robot.go(WAY[:60])
    assert any("time goes back" in said and "a new map begins" in said for said in robot.notices)
    again = robot.live.snapshot()
    assert again.path[:, 0].max() < first.path[:, 0].max() - 1.0
    assert again.grid.observed.sum() < first.grid.observed.sum()


def test_a_clock_that_is_set_changes_no_place():
    robot = slam()
    robot.go(WAY[:50])
    robot.after = 7200.0
    robot.go(WAY[50:93])
    assert not any("jumps" in said or "goes back" in said for said in robot.notices)
    assert robot.sent(Correction)[-1].stamp > START_S + 7200
    assert np.abs(robot.sent(Correction)[-1].pose).max() < 0.1


def test_who_tells_odom_in_map_as_well_is_told_to_stop():
    robot = slam()
    robot.go(WAY[:40])
    robot.take(Heard.TF, "/tf", tf(transform(START_S + robot.time, "map", "odom", 1.0, 0.0, 0.0)))
    robot.go(WAY[40:60])
    assert robot.notices.count("odom is told in map by another program as well: stop it") == 1
    assert np.abs(robot.sent(Correction)[-1].pose).max() < 0.1


def test_a_pose_in_map_itself_is_no_odometry():
    robot = slam()
    for _ in range(40):
        stamp = START_S + robot.time
        robot.take(Heard.TF, "/tf", tf(transform(stamp, "map", "base_link", 0.0, 0.0, 0.0)))
        robot.ranges(heard_at(WAY[0]), stamp)
        robot.step()
    assert robot.notices == ["base_link is told in map itself, not in a frame of odometry: stop who tells that"]
    assert not robot.live.scans


def test_in_a_known_map_the_robot_is_where_it_began_and_drives_on():
    robot = known()
    robot.go(WAY[:93])
    whole = [each for each in robot.sent(Picture) if not each.local]
    assert [each.frame for each in whole] == ["map"]
    assert whole[0].cells.shape == room().shape
    last, told = robot.sent(RobotPose)[-1], robot.sent(Correction)[-1]
    np.testing.assert_allclose(last.pose, WAY[92], atol=0.2)
    np.testing.assert_allclose(told.pose, WAY[0], atol=0.3)
    assert told.stamp == pytest.approx(last.stamp + 1.0)
    assert np.sqrt(last.covariance[0, 0]) < 0.2
    snapshot = robot.live.snapshot()
    np.testing.assert_array_equal(snapshot.grid.log_odds, room().log_odds)
    assert np.hypot(*(np.array(snapshot.settings["place"])[:2] - WAY[92, :2])) < 0.2


def test_while_the_place_is_not_known_no_transform_is_told_and_an_initial_pose_makes_it_known():
    robot = known(None)
    robot.go(WAY[:30])
    assert not robot.sent(Correction)
    assert np.sqrt(robot.sent(RobotPose)[-1].covariance[0, 0]) > 0.5
    robot.say(WAY[29], stamp=START_S + robot.time - 0.2)
    robot.go(WAY[30:60])
    assert any(said.startswith("initial pose: 2.05, 3.00 m, 0 degrees") for said in robot.notices)
    np.testing.assert_allclose(robot.sent(RobotPose)[-1].pose, WAY[59], atol=0.2)
    assert len(robot.sent(Correction)) > 10  # how many depends on the clock


@pytest.mark.parametrize(
    ("pose", "frame", "variance", "words"),
    [
        ((1.0, 1.0, 0.0), "odom", (0.1, 0.1, 0.1), "initial pose not taken: it is in odom, expected map"),
        (
            (90.0, 1.0, 0.0),
            "map",
            (0.1, 0.1, 0.1),
            "initial pose not taken: start: found 89.95, 1 m, outside of",
        ),
        ((np.nan, 1.0, 0.0), "map", (0.1, 0.1, 0.1), None),
        ((1.0, 1.0, 0.0), "map", (-1.0, 0.1, 0.1), None),
        ((1.0, 1.0, 0.0), "x" * 5000, (0.1, 0.1, 0.1), None),
    ],
)
def test_an_initial_pose_that_cannot_be_changes_nothing(pose, frame, variance, words):
    robot = known()
    robot.go(WAY[:30])
    robot.say(pose, frame, variance)
    robot.go(WAY[30:50])
    np.testing.assert_allclose(robot.sent(RobotPose)[-1].pose, WAY[49], atol=0.2)
    said = [notice for notice in robot.notices if "initial pose" in notice]
    assert said[-1].startswith(words) if words else not said
    assert words or sum(robot.live.refused.values()) == 1


def test_a_flood_of_initial_poses_costs_no_more_than_one_a_step():
    robot = known()
    robot.go(WAY[:30])
    for _ in range(5000):
        robot.say(WAY[30])
    robot.go(WAY[30:50])
    assert sum("initial pose: " in said for said in robot.notices) == 1


def test_a_drive_that_is_played_again_in_a_known_map_begins_where_it_began():
    robot = known()
    robot.go(WAY[:93])
    robot.after = -robot.time - 100.0
    robot.go(WAY[:50])
    assert any("the drive begins again where it began" in said for said in robot.notices)
    np.testing.assert_allclose(robot.sent(RobotPose)[-1].pose, WAY[49], atol=0.2)


def test_a_sonar_that_joins_in_is_used_from_then_on():
    robot = known()
    few, robot.mounts = robot.mounts, robot.mounts
    extra = replace(ROBOT, mounts=np.vstack([ROBOT.mounts, [0.15, 0.15, np.pi / 4]]))
    robot.go(WAY[:30])
    robot.take(Heard.STATIC, "/tf_static", tf(transform(0, "base_link", "sonar_4", *extra.mounts[4])))
    for k in range(30, 93):
        robot.ranges([None] * 4 + [1.5], START_S + robot.time)
        robot.go(WAY[k : k + 1])
    assert any(said == "new: sonar_4" for said in robot.notices)
    assert len(few) == 4
    np.testing.assert_allclose(robot.sent(RobotPose)[-1].pose, WAY[92], atol=0.3)
