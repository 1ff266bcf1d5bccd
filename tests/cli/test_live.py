import os
import pickle
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from echogrid import Robot, World
from echogrid.frame import Frame
from echogrid.mapping.build import build_map
from echogrid.output.map_file import read_map
from echogrid.output.map_server_file import occupancy
from echogrid.robot import parse_robot
from echogrid.simulation.simulate import Simulator
from echogrid.yaml_keys import parse_yaml
from peers.fastdds import peer

pytest.importorskip("echogrid.live.dds", reason="found no cyclonedds")

needs_peer = pytest.mark.skipif(peer.missing() is not None, reason=f"Fast DDS peer: {peer.missing()}")


def sockets(network, pid):
    """Local address of each UDP socket of a process, and whether a TCP socket listens."""
    udp = [line.split()[3] for line in network.output("ss", "-uanpH").splitlines() if f"pid={pid}," in line]
    tcp = [line for line in network.output("ss", "-tlnpH").splitlines() if f"pid={pid}," in line]
    return udp, tcp


@pytest.fixture(scope="module")
def frames():
    world, robot = World.load("sample"), Robot.load("p3dx")
    poses = np.column_stack([np.linspace(0.9, 2.1, 80), np.full(80, 1.0), np.linspace(0, 0.5, 80)])
    return [
        Frame(peer.START_S + 0.1 * i, frame.pose, frame.ranges)
        for i, frame in enumerate(Simulator(world, robot).frames(poses, seed=2))
    ]


SILENT = range(45, 65)
"""Frames in which sonar 3 says nothing."""


STRANGE = [
    "tf 1003.0 odom base_link nan 0 0 0 0 0 1",
    "tf 1003.0 odom base_link 0 0 0 0 0 0 0",
    "tf 1003.0 base_link odom 0 0 0 0 0 0 1",
    "tf 5.0 odom base_link 9 9 0 0 0 0 1",
    "tf 1003.0 odom base_link 1e300 0 0 0 0 0 1",
    "static 0.0 sonar_0 base_link 0 0 0 0 0 0 1",
    "range sonar/s0 2000000000.0 sonar_0 0.4 0.1 5 1",
    "range sonar/s0 1003.0 " + "x" * 5000 + " 0.4 0.1 5 1",
    "range sonar/s0 1003.0 " + "x" * 300_000 + " 0.4 0.1 5 1",
    "range sonar/s0 1003.0 nobody nan -inf nan inf",
    *(f"range sonar/s0 1003.0 made_up_{i} 0.4 0.1 5 1" for i in range(600)),
    "text sonar/s0_text not-a-range",
]
"""What strangers send in between, which changes nothing."""

USERS_OWN = (
    '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces>'
    "</General></Domain></CycloneDDS>"
)

GARBAGE = """
import random, socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
r = random.Random(1)
for port in (7400 + 250 * 3, 7401 + 250 * 3, *range(7410 + 250 * 3, 7420 + 250 * 3)):
    for size in (0, 1, 20, 64, 500, 5000) * 20:
        s.sendto(r.choice([b"RTPS\\x02\\x01", b""]) + r.randbytes(size), ("127.0.0.1", port))
"""


@pytest.fixture(scope="module")
def session(frames, tmp_path_factory):
    """What came of a drive; played once, though several processes may run these tests."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "live-session"
    folder.mkdir(exist_ok=True)
    with peer.locked(folder / "lock"):
        done = folder / "done"
        if not done.exists():
            with peer.namespace() as network:
                done.write_bytes(pickle.dumps(play_drive(network, peer.build(), frames, folder)))
        return pickle.loads(done.read_bytes())


def play_drive(network, robot_program, frames, folder):
    """A drive played by Fast DDS to two processes of echogrid live; one is stopped in the end, the other killed."""
    mounts = Robot.load("p3dx").mounts
    lines = peer.opening(mounts, listeners=2)
    speed = 4.0
    for i, frame in enumerate(frames):
        lines.append(f"at {0.1 * i / speed}")
        scan = peer.frame_lines(frame.stamp, frame.pose, frame.ranges)
        lines += [line for line in scan if i not in SILENT or "sonar_3 " not in line]
        lines += [scan[5]] if i == 70 else []  # once more
        lines += STRANGE if i == 30 else []
    lines.append(f"at {0.1 * len(frames) / speed + 160}")  # it is ended before
    (folder / "drive.txt").write_text("\n".join(lines) + "\n")
    echogrid = Path(sys.executable).with_name("echogrid")
    environment = os.environ | {"ROS_DOMAIN_ID": "3"}
    environment.pop("CYCLONEDDS_URI", None)
    common = (echogrid, "live", "--save-every", "1", "--resolution", "0.08")
    options = {"env": environment, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    stopped = network.start(*common, "--out", folder / "stopped", **options)
    killed = network.start(*common, "--out", folder / "killed", "--map-topic", "/b", "--local-map-topic", "/c",
                   **(options | {"env": environment | {"CYCLONEDDS_URI": USERS_OWN}}))  # fmt: skip
    with open(folder / "drive.txt") as drive, open(folder / "heard.txt", "w") as heard:
        robot = network.start(robot_program, 3, stdin=drive, stdout=heard)

    def last_map():
        maps = [each for each in peer.heard((folder / "heard.txt").read_text()) if each.kind == "map"]
        return maps[-1].stamp if maps else 0.0

    deadline = time.monotonic() + 150
    while last_map() < frames[-1].stamp or not (folder / "killed" / "run.yaml").exists():
        assert time.monotonic() < deadline, stopped.poll()
        time.sleep(0.2)
    ports = sockets(network, stopped.pid)
    network.output(sys.executable, "-c", GARBAGE)
    late = network.start(robot_program, 3, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    said_late, _ = late.communicate("at 0\nat 3\n", timeout=30)
    killed.send_signal(signal.SIGKILL)
    _, killed_errors = killed.communicate()
    stopped.send_signal(signal.SIGINT)
    out, errors = stopped.communicate(timeout=60)
    robot.kill()
    robot.wait()
    heard = peer.heard((folder / "heard.txt").read_text())
    return {
        "folder": folder,
        "heard": heard,
        "late": peer.heard(said_late),
        "ports": ports,
        "status": stopped.returncode,
        "out": out,
        "errors": errors,
        "killed_errors": killed_errors,
    }


def offline(frames, folder):
    """The map of the same frames as echogrid map makes it."""
    robot = parse_robot(parse_yaml((folder / "run.yaml").read_text(), "run.yaml")["robot"], "robot")
    quiet = [
        replace(frame, ranges=np.where((i in SILENT) & (np.arange(len(frame.ranges)) == 3), np.nan, frame.ranges))
        for i, frame in enumerate(frames)
    ]
    *_, grid = build_map(quiet, robot, resolution=0.08)
    return grid


@needs_peer
def test_the_map_that_the_robot_hears_is_the_map_of_its_log(session, frames):
    last = [each for each in session["heard"] if each.kind == "map"][-1]
    grid = offline(frames, session["folder"] / "stopped")
    expected = occupancy(grid)
    assert last.frame == "odom"
    assert last.resolution == pytest.approx(0.08)
    assert last.origin == pytest.approx(grid.origin)
    assert last.cells.shape == expected.shape
    assert np.sum(last.cells != expected) <= 0.002 * np.sum(expected >= 0)
    assert np.sum(expected == 100) > 50


@needs_peer
def test_the_local_map_is_the_part_of_the_map_round_the_robot(session, frames):
    last = [each for each in session["heard"] if each.kind == "local"][-1]
    whole = [each for each in session["heard"] if each.kind == "map"][-1]
    assert last.stamp == whole.stamp == pytest.approx(frames[-1].stamp)
    assert last.cells.shape == (75, 75)
    row, col = np.rint((np.array(last.origin) - whole.origin) / 0.08).astype(int)[::-1]
    for local_row in range(75):
        for local_col in range(75):
            r, c = row + local_row, col + local_col
            inside = 0 <= r < whole.cells.shape[0] and 0 <= c < whole.cells.shape[1]
            assert last.cells[local_row, local_col] == (whole.cells[r, c] if inside else -1)


@needs_peer
def test_who_comes_late_gets_the_last_map(session):
    assert [each.stamp for each in session["late"] if each.kind == "map"] == [session["heard"][-1].stamp]


@needs_peer
def test_only_loopback_is_listened_on(session):
    udp, tcp = session["ports"]
    assert len(udp) >= 3
    assert all(address.split(":")[0].endswith("%lo") for address in udp)
    assert not tcp


@needs_peer
def test_a_stop_saves_the_map_and_is_no_error(session, frames):
    assert session["status"] == 0
    assert session["out"].startswith("80 scans, ")
    saved = read_map(session["folder"] / "stopped")
    assert np.mean(saved.observed != offline(frames, session["folder"] / "stopped").observed) < 0.002


@needs_peer
def test_what_happened_is_said_once_in_lines(session):
    lines = session["errors"].splitlines()
    assert all(line.startswith("live: ") for line in lines)
    assert lines[0] == "live: domain 3, interface lo; /map, /local_map"
    assert sum("mapping in odom with 16 sonars of base_link" in line for line in lines) == 1
    assert "Traceback" not in session["errors"]


@needs_peer
def test_the_users_own_configuration_of_dds_is_kept_to(session):
    assert session["killed_errors"].splitlines()[0] == "live: domain 3, network as CYCLONEDDS_URI says; /b, /c"


@needs_peer
def test_what_strangers_sent_is_counted(session):
    refused = parse_yaml((session["folder"] / "stopped" / "run.yaml").read_text(), "run.yaml")["refused"]
    for reason in (
        "a transform that is not finite",
        "a rotation that is no unit quaternion",
        "a transform that closes a circle",
        "a stamp far from those of the others",
        "a name of a frame that cannot be",
        "a reading that came twice",
    ):
        assert refused[reason] >= 1
    assert refused["a reading of a sonar that is new, or whose place is not known"] >= 400


@needs_peer
def test_a_kill_leaves_the_last_save_whole(session):
    folder = session["folder"] / "killed"
    assert {"map.npz", "map.pgm", "map.yaml", "map.png", "run.yaml"} <= {path.name for path in folder.iterdir()}
    assert read_map(folder).observed.any()
    assert read_map(folder / "map.yaml").shape == read_map(folder).shape


@pytest.mark.parametrize(
    ("arguments", "environment", "message"),
    [
        (["--domain", "233"], {}, "--domain: found 233, expected 0 to 232"),
        ([], {"ROS_DOMAIN_ID": "x"}, "ROS_DOMAIN_ID: found x, expected 0 to 232"),
        (["--local-side", "nan"], {}, "--local-side: found nan, expected 1 to 40 m"),
        (["--save-every", "0"], {}, "--save-every: found 0, expected 1 to 86400 s"),
        (["--half-life", "0"], {}, "--half-life: found 0, expected 0.1 to 1e+07 s"),
        (["--interpreter", "cone"], {}, "--interpreter: found cone, expected set-network or a file of its weights"),
        (["--interface", "wlan77"], {}, "live: found no interface 'wlan77', expected any or one of "),
        (["--map-topic", "map"], {}, "live: found the topic 'map', expected a name such as /sonar/front"),
    ],
)
def test_a_wrong_option_is_one_line(tmp_path, monkeypatch, capsys, arguments, environment, message):
    from echogrid.cli import main

    for name in ("ROS_DOMAIN_ID", "CYCLONEDDS_URI"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit) as ended:
        main(["live", "--out", str(tmp_path / "out"), *arguments])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"echogrid: {message}")
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_without_cyclonedds_it_is_said_what_to_install(tmp_path, monkeypatch, capsys):
    from echogrid.cli import main

    monkeypatch.delitem(sys.modules, "echogrid.live.dds", raising=False)
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    monkeypatch.setitem(sys.modules, "cyclonedds.builtin", None)
    with pytest.raises(SystemExit):
        main(["live", "--out", str(tmp_path / "out")])
    assert capsys.readouterr().err == (
        "echogrid: live: found no cyclonedds, expected it: pip install 'echogrid[ros2]'\n"
    )
