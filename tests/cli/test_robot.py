"""``echogrid robot`` and ``echogrid live --explore --drive`` beside a third program, faster than real time."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commands import assert_refused, put
from echogrid import Mapper, Robot, World, load_log, read_map, read_truth
from echogrid.metrics import score
from echogrid.planning.explore import Reachable
from echogrid.yaml_keys import parse_yaml
from peers.fastdds import peer

pytest.importorskip("echogrid.live.participant", reason="found no cyclonedds")
needs_namespace = pytest.mark.skipif(peer.without_namespace() is not None, reason=str(peer.without_namespace()))

SPEED = 5
OVERHEAR = Path(__file__).parents[1] / "peers" / "overhear.py"
START = np.array([1.2, 1.6])  # in whole cells of the map: half a cell more or less is 0.025 of the floor in a score
FLAT = """
name: flat
start: [1.2, 1.6]
walls:
  - {points: [[0, 0], [5.6, 0], [5.6, 3], [0, 3]], closed: true, roughness_mm: 2}
  - {points: [[2.7, 0], [2.7, 0.9], [2.9, 0.9], [2.9, 0]], roughness_mm: 2}
  - {points: [[2.7, 3], [2.7, 2.1], [2.9, 2.1], [2.9, 3]], roughness_mm: 2}
"""
"""Two rooms, and a door in a wall that can be heard."""


class Run:
    """The processes of a drive, in a namespace and a folder."""

    def __init__(self, network, folder):
        self.network, self.folder = network, folder
        self.environment = {name: value for name, value in os.environ.items() if name != "CYCLONEDDS_URI"}
        put(folder / "flat.yaml", FLAT)

    def start(self, name, *words):
        program = "import sys; from echogrid.cli import main; main(sys.argv[1:])"
        errors = open(self.folder / f"{name}.err", "w")  # noqa: SIM115
        with errors:
            return self.network.start(
                sys.executable, "-c", program, *words, "--domain", 11,
                env=self.environment, stdout=subprocess.PIPE, stderr=errors,
            )  # fmt: skip

    def robot(self, name="robot", seed=1):
        log = self.folder / f"{name}.csv"
        words = "robot", self.folder / "flat.yaml", "--robot", "b21", "--speed", SPEED, "--seed", seed, "--out", log
        return self.start(name, *words)

    def live(self, name="live", *options):
        drives = "--explore", "--drive", "--radius", Robot.load("b21").footprint_radius_m
        return self.start(name, "live", "--slam", "--out", self.folder / name, *drives, *options)

    def overhear(self):
        listener = self.network.start(
            sys.executable, OVERHEAR, 11, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert listener.stdout.readline() == "ready\n"
        return listener

    def errors(self, name):
        return (self.folder / f"{name}.err").read_text()

    def until(self, name, pattern, seconds=240):
        deadline = time.monotonic() + seconds
        while not re.search(pattern, self.errors(name)):
            if time.monotonic() > deadline and "falls behind" in self.errors("robot"):
                pytest.skip("the machine is too busy to drive in real time")
            assert time.monotonic() < deadline, self.errors(name)
            time.sleep(0.1)


def ended(process, signal_=signal.SIGINT):
    process.send_signal(signal_)
    out, _ = process.communicate(timeout=60)
    return out


def kill(process):
    process.kill()
    process.communicate()


def poses(log):
    return np.array([frame.pose for frame in load_log(log, Robot.load("b21"))])


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    with peer.namespace() as network:
        run = Run(network, tmp_path_factory.mktemp("robot"))
        listener, robot, live = run.overhear(), run.robot(), run.live()
        run.until("live", "explored: ")
        time.sleep(1.0)
        outs = [ended(live), ended(robot)]
        heard = json.loads(listener.communicate("")[0])
        yield {"run": run, "heard": heard, "outs": outs, "statuses": [live.returncode, robot.returncode]}


@needs_namespace
def test_the_building_is_mapped_nothing_is_touched_and_the_robot_is_home(session):
    assert session["statuses"] == [0, 0]
    run, (_, drove) = session["run"], session["outs"]
    assert "b21 in flat: " in drove
    assert ", no collisions, " in drove
    driven = poses(run.folder / "robot.csv")
    np.testing.assert_allclose(driven[0], [*START, 0], atol=0.01)
    assert np.linalg.norm(driven[-1, :2] - START) < 0.3
    grid = read_map(run.folder / "live")
    reachable = Reachable.of(World.load(run.folder / "flat.yaml"), Robot.load("b21"), START)
    assert Reachable(reachable.points - START).seen(grid) > 0.95  # the map begins where the robot did


@needs_namespace
def test_the_map_is_about_that_of_the_log_with_its_true_poses(session):
    run = session["run"]
    grid = read_map(run.folder / "live")
    live = replace(grid, origin=tuple((grid.origin + START).tolist()))
    mapper = Mapper(Robot.load("b21"))
    mapper.add(load_log(run.folder / "robot.csv", Robot.load("b21")))
    truth = read_truth(run.folder / "robot.truth.npz")
    found, best = score(live, truth), score(mapper.grid(), truth)
    assert found.free > best.free - 0.05
    assert found.found > best.found - 0.2
    assert found.false < best.false + 0.02


@needs_namespace
def test_what_the_three_said_to_each_other(session):
    heard = {topic: [told for _, told in samples] for topic, samples in session["heard"].items()}
    speed, turn = np.array(heard["/cmd_vel"]).T
    assert np.min(speed) >= -0.1
    assert 0.2 < np.max(speed) <= 0.3
    assert np.max(np.abs(turn)) <= 0.9
    assert (speed[-1], turn[-1]) == (0.0, 0.0)
    assert heard["/goal_pose"] == []  # who takes goals would drive as well
    assert {frame for frame, _ in heard["/map"]} == {"map"}
    assert {tuple(each[3:]) for each in heard["/odom"]} == {("odom", "base_link")}
    assert heard["/tf_static"][0] == [["base_link", f"sonar_{number}"] for number in range(24)]
    came, clock = np.array(session["heard"]["/clock"]).T
    assert (np.diff(clock) > 0).all()
    assert (clock[-1] - clock[0]) / (came[-1] - came[0]) > SPEED / 2
    assert {frame for _, frame, _ in heard["/sonar/s3"]} == {"sonar_3"}


@needs_namespace
def test_it_is_said_loudly_that_the_robot_is_driven_and_nothing_else_is_doubtful(session):
    lines = session["run"].errors("live").splitlines()
    assert all(line.startswith("live: ") for line in lines)
    assert "DRIVES THE ROBOT ITSELF by /cmd_vel" in lines[1]
    assert sum("explored: nothing " in line for line in lines) >= 1  # is unknown, or new was seen for long
    assert not any("stuck" in line or "in doubt" in line for line in lines)
    told = parse_yaml((session["run"].folder / "live" / "run.yaml").read_text(), "run.yaml")
    assert told["explored"].startswith("explored: ")
    assert [line for line in session["run"].errors("robot").splitlines() if "falls behind" not in line] == [
        "robot: b21 in flat: domain 11, interface lo; hears /cmd_vel"
    ]


@needs_namespace
@pytest.mark.slow
def test_who_is_killed_on_the_way_and_started_again_does_no_harm(tmp_path):
    with peer.namespace() as network:
        run = Run(network, tmp_path)
        listener, robot, live = run.overhear(), run.robot(seed=2), run.live("first")
        run.until("first", "exploring: ")
        kill(live)
        time.sleep(1.0)  # 5 s of the robot's: it stands
        killed = time.monotonic()
        time.sleep(0.5)
        again = time.monotonic()
        live = run.live("second")
        run.until("second", "exploring: ")
        kill(robot)
        restarted = run.robot("anew", seed=3)
        run.until("second", "explored: |in doubt")
        outs = [ended(live), ended(restarted)]
        heard = json.loads(listener.communicate("")[0])
    stood = np.array([told[1:3] for came, told in heard["/odom"] if killed < came < again])
    assert len(stood) > 20
    np.testing.assert_allclose(stood, stood[:1].repeat(len(stood), 0), atol=1e-9)
    assert "no collisions" in outs[1]
    assert live.returncode == restarted.returncode == 0
    # Time went back, so that a new map began and was explored; or it stood. It is never silently wrong.
    assert re.search("time goes back|in doubt", run.errors("second"))
    assert "Traceback" not in run.errors("first") + run.errors("second") + run.errors("anew")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--speed", "0"], "--speed: found 0, expected 0.1 to 50"),
        (["--speed", "nan"], "--speed: found nan"),
        (["--slip", "-1"], "--slip: found -1"),
        (["--domain", "300"], "--domain: found 300, expected 0 to 232"),
        (["--interface", "wlan77"], "robot: found no interface 'wlan77'"),
        (["--cmd-vel-topic", "a b"], "robot: found the topic 'a b'"),
        (["--start", "1"], "--start: found 1, expected X,Y,DEG"),
        (["--start", "0.1,1,0"], "world box: start: found (0.10, 1.00) m, less than 0.36 m from a wall"),
        (["--seed", "-1"], "--seed: found -1"),
        (["--robot", "b22"], "robot: found b22"),
        (["--out", "folder"], "folder: found a folder"),
        (["WORLD", "nowhere"], "world: found nowhere"),
        (["WORLD", "hole.yaml"], "world hole: found a hole through which the robot gets out"),
    ],
)
def test_what_cannot_be_is_one_line(run, place, arguments, line):
    walls = "[[0, 0], [3, 0], [3, 2], [0, 2]]"
    put(place / "hole.yaml", f"name: hole\nstart: [1, 1]\nwalls: [{{points: {walls}, roughness_mm: 1}}]\n")
    given = dict(zip(arguments[::2], arguments[1::2], strict=True))
    options = {"--robot": "b21"} | {key: value for key, value in given.items() if key != "WORLD"}
    words = [word for pair in options.items() for word in pair]
    assert line in assert_refused(run, place, "robot", given.get("WORLD", "box.yaml"), *words)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--drive"], "--drive: found no --explore, expected both"),
        (["--explore", "--max-speed", "0.1"], "--max-speed: found no --drive, expected both"),
        (["--explore", "--cmd-vel-topic", "/v"], "--cmd-vel-topic: found no --drive, expected both"),
        (["--goal-topic", "/g"], "--goal-topic: found no --explore, expected both"),
        (
            ["--explore", "--drive", "--radius", "0.3", "--goal-topic", "/g"],
            "--goal-topic: found --drive, which sends no goals",
        ),
        (["--radius", "0.2"], "--radius: found no --explore, expected both"),
        (["--explore", "--drive"], "--drive: found no --radius, expected that of the robot's footprint"),
        (["--explore", "--radius", "nan"], "--radius: found nan, expected 0.02 to 2 m"),
        (
            ["--explore", "--drive", "--radius", "0.3", "--max-speed", "9"],
            "--max-speed: found 9, expected 0.05 to 1 m/s",
        ),
        (["--explore", "--map", "out"], "--explore, --map: found both"),
        (["--explore", "--goal-topic", "x"], "live: found the topic 'x'"),
        (["--explore", "--goal-topic", ""], "live: found the topic ''"),
        (["--explore", "--drive", "--radius", "0.3", "--cmd-vel-topic", ""], "live: found the topic ''"),
    ],
)
def test_what_cannot_be_explored_is_one_line(run, place, arguments, line):
    assert line in assert_refused(run, place, "live", "--out", "live", *arguments)
