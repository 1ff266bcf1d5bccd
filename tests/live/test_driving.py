"""A robot that is driven by its live map: it goes where all is known to be free, and stands where it is in doubt."""

from types import SimpleNamespace

import numpy as np
import pytest

from echogrid.geometry import compose, wrap
from echogrid.grid import Grid
from echogrid.live import live_map
from echogrid.live.driving import REST, Drives, Goal, Velocity
from echogrid.live.hearing import Heard
from echogrid.live.live_map import Settings
from echogrid.live.session import Live
from live_drive import MOUNTS, NETWORK, START_S, Drive, Recorder, xyz

STEP_S = 0.1


class Plan(Recorder):
    """A mapper that knows a room of 6 x 4 m round the start, but for what lies right of ``known_m``."""

    known_m = 1.5

    def grid(self):
        cells = np.full((100, 150), -4.0, np.float32)
        cells[:3] = cells[-3:] = 6.0
        cells[:, :3] = cells[:, -3:] = 6.0
        observed = np.ones(cells.shape, bool)
        observed[:, round((self.known_m + 3) / 0.04) :] = False
        return Grid(cells, observed, 0.04, (-3.0, -2.0))

    def around(self, x, y, side_m):
        whole = self.grid()
        cells = round(side_m / 0.04)
        corner = np.floor((np.array([y, x]) - whole.origin[::-1]) / 0.04).astype(int) - cells // 2
        return whole.part(corner, (cells, cells))


class Robot(Drive):
    """It does what it is told, unless it is stuck."""

    def __init__(self, live):
        super().__init__(live)
        self.pose_, self.stuck, self.velocity = np.zeros(3), False, Velocity(0.0, 0.0)
        self.goals, self.velocities, self.farthest = [], [], 0.0
        self.wall_x = np.inf
        """A wall across the room that the map lacks, m; whoever looks at it hears it."""

    def heard(self, mount):
        x, _, theta = compose(self.pose_, np.array(mount))
        off = (self.wall_x - x) / np.cos(theta) if np.cos(theta) > 0.7 else np.inf
        return off if 0 < off < 4.0 else np.inf

    def go(self, seconds, ranges=True, odometry=True, silent=()):
        for _ in range(round(seconds / STEP_S)):
            if odometry:
                self.pose(*self.pose_)
            if ranges:
                self.ranges([None if i in silent else self.heard(mount) for i, mount in enumerate(MOUNTS)])
            before = len(self.pictures)
            self.step()
            for sent in self.pictures[before:]:
                if isinstance(sent, Velocity):
                    self.velocity = sent
                    self.velocities.append(sent)
                elif isinstance(sent, Goal):
                    self.goals.append(sent)
            if not self.stuck:
                x, y, theta = self.pose_
                speed, turn = self.velocity
                self.pose_ = np.array([
                    x + speed * STEP_S * np.cos(theta), y + speed * STEP_S * np.sin(theta),
                    float(wrap(theta + turn * STEP_S)),
                ])  # fmt: skip
            self.farthest = max(self.farthest, self.pose_[0])
        return self

    def walk(self, place):
        """Be driven by somebody else to near a place."""
        while (off := np.linalg.norm(place[:2] - self.pose_[:2])) > 0.25:
            self.pose_[:2] += 0.02 * (place[:2] - self.pose_[:2]) / off
            self.go(STEP_S)
        return self

    def said(self, text):
        return sum(text in notice for notice in self.notices)


@pytest.fixture
def driven(monkeypatch):
    monkeypatch.setattr(live_map, "Mapper", Plan)
    monkeypatch.setattr(Plan, "known_m", 1.5)
    return Robot(Live(NETWORK, Settings(), Drives(0.25, itself=True)))


@pytest.fixture
def sent(monkeypatch):
    monkeypatch.setattr(live_map, "Mapper", Plan)
    monkeypatch.setattr(Plan, "known_m", 1.5)
    return Robot(Live(NETWORK, Settings(), Drives(0.25)))


def stands(robot, seconds=1.0, **how):
    """Whether a robot that was driving stands."""
    robot.go(seconds, **how)
    return robot.velocity == (0.0, 0.0)


def underway(robot):
    for _ in range(200):
        robot.go(STEP_S)
        if robot.velocity.speed > 0.2:
            return robot
    pytest.fail("it never drove")


@pytest.mark.unchecked
def test_it_looks_round_goes_where_the_map_ends_and_no_farther(driven):
    driven.go(4.0)
    assert driven.velocity.turn > 0.2
    assert not any(velocity.speed for velocity in driven.velocities)
    driven.go(60.0)
    assert 1.1 < driven.farthest < 1.5 - 0.25 + 0.05
    assert driven.said("poses in odom") == 1
    assert driven.goals == []  # whoever takes them would drive as well


@pytest.mark.unchecked
def test_it_stops_before_what_it_hears_though_the_map_says_that_it_is_free(driven):
    driven.wall_x = 0.8
    driven.go(60.0)
    assert driven.farthest < 0.8 - 0.25
    driven.wall_x = np.inf  # carried away
    driven.go(60.0)
    assert driven.farthest > 1.1


def test_when_it_is_done_it_stands_where_it_began_and_leaves_the_commands_to_others(driven, monkeypatch):
    underway(driven)
    monkeypatch.setattr(Plan, "known_m", 3.0)
    driven.go(60.0)
    assert np.hypot(*driven.pose_[:2]) < 0.1
    assert driven.said("explored: nothing that can be reached is unknown; the robot stands 0.0") == 1
    assert driven.velocities[-REST:] == [(0.0, 0.0)] * REST
    before = len(driven.velocities)
    driven.go(5.0)
    assert len(driven.velocities) == before
    assert driven.live.snapshot().settings["explored"].startswith("explored: ")


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"ranges": False}, "no range came"),
        ({"odometry": False}, "no odometry came"),
        ({"ranges": False, "odometry": False}, "no range came"),
        ({"silent": (2,)}, "sonar_2: silent"),
    ],
)
def test_it_stands_while_what_it_drives_by_is_silent_and_goes_on_afterwards(driven, how, text):
    underway(driven)
    assert not stands(driven, 0.2, **how)
    assert stands(driven, 8.0, **how)
    there = driven.pose_.copy()
    driven.go(2.0, **how)
    np.testing.assert_array_equal(driven.pose_, there)
    assert driven.said(f"the robot stands: {text}") == 1
    driven.go(8.0)
    assert driven.said("the robot goes on") == 1
    assert driven.said("the robot stands") == 1
    assert np.linalg.norm(driven.pose_ - there) > 0.1


def test_it_stands_while_two_robots_tell_where_they_are(driven):
    underway(driven)
    for _ in range(10):
        driven.pose(*driven.pose_, source="one")
        driven.pose(*driven.pose_, after=0.02, source="other")
        driven.go(STEP_S)
    assert driven.velocity == (0.0, 0.0)
    assert driven.said("the robot stands: two programs at once tell base_link on /tf") == 1
    driven.go(4.0)
    assert driven.said("the robot goes on") == 1
    assert driven.said("two programs at once tell base_link on /tf: stop one") == 1
    assert any("stop one" in note for note in driven.live.snapshot().settings["notes"])


def command(speed, turn=0.0):
    return SimpleNamespace(linear=xyz(speed, 0.0), angular=xyz(0.0, 0.0, turn))


def test_it_leaves_the_robot_to_another_program_that_drives_it(driven):
    underway(driven)
    for _ in range(10):
        driven.take(Heard.COMMAND, "/cmd_vel", command(0.3))
        before = len(driven.velocities)
        driven.go(STEP_S)
    assert len(driven.velocities) == before
    assert driven.said("the robot stands: another program drives it as well: stop one of the two") == 1
    driven.go(5.0)
    assert driven.said("the robot goes on") == 1
    assert driven.velocity != (0.0, 0.0)


@pytest.mark.parametrize("message", [command(0.0), SimpleNamespace(linear=None), SimpleNamespace()])
def test_who_only_says_stop_or_nothing_disturbs_nobody(driven, message):
    underway(driven)
    driven.take(Heard.COMMAND, "/cmd_vel", message)
    driven.go(1.0)
    assert driven.said("the robot stands") == 0


def test_it_stands_while_the_robots_clock_does(driven):
    underway(driven)
    stamp = START_S + driven.time - STEP_S
    for _ in range(30):
        driven.ranges([1.0] * len(MOUNTS), stamp)
        driven.step()
    assert [sent for sent in driven.pictures if isinstance(sent, Velocity)][-1] == (0.0, 0.0)
    assert driven.said("the robot stands: the robot's clock stands") == 1


@pytest.mark.parametrize("jump", [(1.0, 0.0, 0.0), (0.0, 0.0, 2.0)])
def test_a_pose_that_jumps_stops_it_for_good(driven, jump):
    underway(driven)
    driven.pose_ += jump
    assert stands(driven, 0.5)
    assert stands(driven, 20.0)
    assert driven.said("its place is in doubt: start echogrid live again") == 1


def test_a_base_that_was_restarted_in_its_place_stops_it_for_good(driven):
    underway(driven)
    for _ in range(200):
        if np.hypot(*driven.pose_[:2]) > 0.3:
            break
        driven.go(STEP_S)
    driven.go(5.0, ranges=False, odometry=False)
    driven.pose_ = np.zeros(3)
    assert stands(driven, 0.5)
    assert stands(driven, 20.0)
    assert driven.said("its place is in doubt: start echogrid live again") == 1


def test_a_robot_that_has_no_room_where_it_stands_is_not_done(sent, monkeypatch):
    """Told what to do about it, and begun again where it is moved to."""
    around = np.full((100, 150), -4.0, np.float32)
    around[42:58, 67:83] = 6.0
    monkeypatch.setattr(Plan, "grid", lambda _: Grid(around, np.ones(around.shape, bool), 0.04, (-3.0, -2.0)))
    sent.go(3.0)
    assert sent.said("cannot explore from here: by the map there is no room for a disc of 0.25 m") == 1
    assert sent.said("explored: ") == 0
    assert sent.live.snapshot().settings["explored"].startswith("cannot explore: ")
    around[42:58, 67:83] = -4.0
    sent.go(3.0)
    assert sent.said("explored: ") == 0
    sent.pose_[:2] += (0.5, 0.2)
    sent.go(1.0)
    assert sent.said("explored: ") + len(sent.goals) >= 1


def test_the_radius_that_is_told_is_saved_with_the_map(sent):
    sent.go(1.0)
    assert "footprint_radius_m: 0.25" in sent.live.snapshot().settings["robot"]


def test_another_drive_ends_that_and_is_told_of(driven):
    underway(driven)
    driven.pose_ += np.array([1.0, 0.0, 0.0])
    assert stands(driven, 0.5)
    driven.live._driving._map = None  # as when the odometry begins anew
    driven.go(0.5)
    assert driven.said("another drive begins: it is explored from here on") == 1
    assert not stands(driven, 20.0)


def test_what_comes_into_the_way_stops_it(driven, monkeypatch):
    underway(driven)
    monkeypatch.setattr(Plan, "known_m", float(driven.pose_[0]) + 0.3)
    assert stands(driven, 0.2)


def test_a_robot_that_is_stuck_backs_off(driven):
    underway(driven)
    driven.go(0.5)
    driven.stuck = True
    driven.go(2.5)
    assert driven.velocity.speed < 0
    assert driven.said("the robot is stuck at") == 1


def test_a_robot_that_does_not_obey_is_told_of_once(driven):
    driven.stuck = True
    driven.go(20.0)
    assert driven.said("does not move as it is told") == 1
    assert driven.said("stuck") == 0


def test_its_end_is_a_stop(driven):
    underway(driven)
    assert set(driven.live.ended()) == {Velocity(0.0, 0.0)}


def test_goals_are_sent_once_and_home_in_the_end(sent, monkeypatch):
    sent.go(3.0)
    (goal,) = sent.goals
    assert goal.frame == "odom"
    assert goal.stamp == pytest.approx(START_S, abs=4)
    assert 0.8 < goal.pose[0] < 1.3
    assert sent.velocities == []
    sent.walk(goal.pose)
    assert len(sent.goals) == 1
    monkeypatch.setattr(Plan, "known_m", 3.0)
    sent.go(3.0)
    np.testing.assert_allclose(sent.goals[-1].pose[:2], 0, atol=0.1)
    sent.walk(sent.goals[-1].pose).go(2.0)
    assert sent.said("explored: ") == 1


def test_a_goal_that_is_not_reached_is_told_again_and_then_given_up(sent):
    sent.go(40.0)
    first = sent.goals[0].pose[:2]
    again = [goal for goal in sent.goals if np.linalg.norm(goal.pose[:2] - first) < 0.2]
    others = [goal for goal in sent.goals if np.linalg.norm(goal.pose[:2] - first) > 0.2]
    assert 2 <= len(again) <= 4
    assert others
