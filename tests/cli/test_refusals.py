"""What is wrong is one line, and leaves everything as it was."""

import os
import re
import socket
import time

import numpy as np
import pytest

from commands import GOOD, LOG, MAP, ROBOT, SAMPLE, SIMULATE, TRUTH, WORLD, assert_refused, everything, put, rows
from log_samples import peak_of

BAD_LOGS: dict[str, tuple[str | bytes, str]] = {
    "cut in half": (LOG[: len(LOG) // 2], "drive.csv:3: found "),
    "a column less": (rows(GOOD, "1,0,0,0,1"), "drive.csv:3: found 5 columns"),
    "a column more": (rows(GOOD, "1,0,0,0,1,1,1"), "drive.csv:3: found 7 columns"),
    "text": (rows(GOOD, GOOD, "1,0,0,0,far,1"), "drive.csv:4: found r0 = 'far'"),
    "a decimal comma": (rows("0,0,0,0,1,5,1,0"), "drive.csv:2: found 8 columns"),
    "time backwards": (rows("1,0,0,0,1,1", "0.5,0,0,0,1,1"), "drive.csv:3: found time 0.5 after 1.0"),
    "nan pose": (rows(GOOD, "1,nan,0,0,1,1"), "drive.csv:3: found x = nan"),
    "inf pose": (rows(GOOD, "1,0,0,inf,1,1"), "drive.csv:3: found theta = inf"),
    "empty pose": (rows(GOOD, "1,0,,0,1,1"), "drive.csv:3: found y = nothing"),
    "pose 1e9": (rows(GOOD, "1,0,1e9,0,1,1"), "drive.csv:3: found y = 1000000000.0"),
    "range 1e9": (rows(GOOD, "1,0,0,0,1,1e9"), "drive.csv:3: found r1 = 1000000000.0"),
    "range below zero": (rows(GOOD, "1,0,0,0,-1,1"), "drive.csv:3: found r0 = -1.0"),
    "blank line": (rows(GOOD, "", "1,0,0,0,1,1"), "drive.csv:3: found a blank line"),
    "no rows": (rows(), "drive.csv: found a header and no rows"),
    "wrong header": ("t,x,y,theta,r1,r2\n" + GOOD, "drive.csv:1: found 'r2'"),
    "no header": (GOOD + "\n", "drive.csv:1: found '0,0,0,0,1,1'"),
    "empty": ("", "drive.csv: found an empty file"),
    "binary": (b"\x89PNG\r\n\x1a\n\0\0\0", "drive.csv:1: found "),
    "binary inside": (rows(GOOD).encode() + b"\xff\xfe\0", "drive.csv:3: found "),
    "another number of sonars": (
        "t,x,y,theta,r0\n0,0,0,0,1\n",
        "drive.csv: found 1 sonars, expected 2",
    ),
    "too many sonars": ("t,x,y,theta," + ",".join(f"r{i}" for i in range(1000)), "drive.csv:1: found 1000 sonars"),
    "carmen without odometry": ("SONAR 0.4 1 1.0 0 0 0 1 host 1\n", "drive.csv: found no ODOM line"),
}


@pytest.mark.parametrize("command", ["map", "info"])
@pytest.mark.parametrize("kind", BAD_LOGS)
def test_a_wrong_log_is_one_line_that_names_the_place(run, place, kind, command):
    content, found = BAD_LOGS[kind]
    put(place / "drive.csv", content)
    out = ["--out", "out"] if command == "map" else []
    err = assert_refused(run, place, command, "drive.csv", "--robot", "duo.yaml", *out)
    assert err.startswith(f"echogrid: {found}")


def test_a_row_that_is_wrong_after_hundreds_of_good_ones_leaves_no_map(run, place):
    put(place / "drive.csv", SAMPLE.read_bytes()[:70_000])
    err = assert_refused(run, place, "map", "drive.csv", "--out", "out")
    assert re.match(r"echogrid: drive\.csv:\d{3}: found \d+ columns, expected 28", err)
    assert_refused(run, place, "map", "drive.csv", "--out", "new/out")


def test_a_folder_that_cannot_be_made_is_found_before_the_mapping(run, place, monkeypatch):
    monkeypatch.setattr("echogrid.mapping.build.build_map", lambda *_: pytest.fail("mapped"))
    assert_refused(run, place, "map", "drive.csv", "--robot", "duo.yaml", "--out", "file")


def test_a_pose_that_jumps_away_is_one_line(run, place):
    put(place / "drive.csv", rows(GOOD, *["1,9e6,9e6,0,1,1"] * 21))
    err = assert_refused(run, place, "map", "drive.csv", "--robot", "duo.yaml", "--out", "out")
    assert "are the poses in mm or cm, or is one broken?" in err


BAD_ROBOTS = {
    "preset": ("b12", "robot: found b12, expected a file or one of b21, "),
    "missing": ("no/such.yaml", "robot: found no/such.yaml, expected a file or one of b21, "),
    "folder": ("folder", "folder: found "),
    "text": ("file", "file: found "),
    "log": ("drive.csv", "drive.csv: found "),
    "world": ("box.yaml", "box.yaml: walls: found an unknown key"),
    "binary": ("binary", "binary: found "),
    "key": ("key.yaml", "key.yaml: mounts: found "),
    "long": ("x" * 300, "robot: found x"),
}

ROBOT_COMMANDS = {
    "map": ["map", "drive.csv", "--out", "out"],
    "info": ["info", "drive.csv"],
    "simulate": ["simulate", "box.yaml", "--out", "old.csv"],
    "train": ["train", "--drives", 1, "--epochs", 1, "--out", "old.npz"],
}


@pytest.mark.parametrize("command", ROBOT_COMMANDS)
@pytest.mark.parametrize("kind", BAD_ROBOTS)
def test_a_wrong_robot_is_one_line(run, place, kind, command):
    put(place / "binary", b"\x89PNG\xff\0")
    put(place / "key.yaml", ROBOT.replace("[[0.1, 0, 0], [0, 0.1, 90]]", "none"))
    robot, found = BAD_ROBOTS[kind]
    err = assert_refused(run, place, *ROBOT_COMMANDS[command], "--robot", robot)
    assert err.startswith(f"echogrid: {found}")


SCAN = ["scan", "box.yaml", "--at", "1,1", "--out", "out"]
TRAIN = ["train", "--robot", "duo.yaml", "--drives", "1", "--epochs", "1", "--out", "old.npz"]

BAD_CALLS: list[tuple[list[str], str]] = [
    (["map", "missing.csv", "--out", "out"], "missing.csv: found No such file"),
    (["map", "folder", "--out", "out"], "folder: found a directory"),
    (["map", "drive.csv", "--out", "out"], "drive.csv: found 2 sonars, expected --robot"),
    (["map", "drive.csv", "--robot", "p3dx", "--out", "out"], "drive.csv: found 2 sonars, expected 16"),
    ([*MAP, "--out", "file"], "file: found a file, expected a folder"),
    ([*MAP, "--out", "file/below"], "file/below: found "),
    ([*MAP, "--out", "x" * 300], "x"),
    ([*MAP, "--resolution", "0"], "--resolution: found 0"),
    ([*MAP, "--resolution", "-1"], "--resolution: found -1"),
    ([*MAP, "--resolution", "nan"], "--resolution: found nan"),
    ([*MAP, "--resolution", "1000"], "--resolution: found 1000"),
    ([*MAP, "--interpreter", "netwrok"], "interpreter: found netwrok, expected set-network, network, cone, "),
    ([*MAP, "--interpreter", "missing.npz"], "interpreter: found missing.npz"),
    ([*MAP, "--interpreter", "x" * 300], "x"),
    ([*MAP, "--interpreter", "drive.csv"], "drive.csv: found "),
    ([*MAP, "--interpreter", "folder"], "folder: found "),
    ([*MAP, "--interpreter", str(TRUTH)], f"{TRUTH}: found "),
    (["info", "missing.csv"], "missing.csv: found No such file"),
    (["info", "folder"], "folder: found a directory"),
    (["info", "/dev/null"], "/dev/null: found a pipe or a device"),
    (["info", "x" * 300], "x"),
    (["simulate", "mars", *SIMULATE[2:]], "world: found mars, expected a file or one of corridor, "),
    (["simulate", "folder", *SIMULATE[2:]], "folder: found "),
    (["simulate", "duo.yaml", *SIMULATE[2:]], "duo.yaml: footprint_radius_m: found an unknown key"),
    ([*SIMULATE, "--drive", "missing.txt"], "missing.txt: found no such file"),
    ([*SIMULATE, "--drive", "folder"], "folder: found a folder"),
    ([*SIMULATE, "--drive", "drive.csv"], "drive.csv:1: found "),
    ([*SIMULATE, "--drive", "one.txt"], "one.txt: found "),
    ([*SIMULATE, "--drive", "nan.txt"], "nan.txt:2: found '1,nan'"),
    ([*SIMULATE, "--seed", "-1"], "--seed: found -1"),
    ([*SIMULATE, "--physics.beam", "laser"], "--physics.beam: found laser, expected bessel, "),
    ([*SIMULATE, "--physics.lost", "2"], "--physics.lost: found 2, expected 0 to 1"),
    ([*SIMULATE, "--physics.cross-talk", "-0.5"], "--physics.cross-talk: found -0.5"),
    ([*SIMULATE, "--physics.level-db", "nan"], "--physics.level-db: found nan"),
    ([*SIMULATE, "--physics.edge-db", "1e300"], "--physics.edge-db: found 1e+300"),
    ([*SIMULATE, "--physics.temperature-c", "-300"], "--physics.temperature-c: found -300"),
    ([*SIMULATE, "--physics.humidity-percent", "-5"], "--physics.humidity-percent: found -5"),
    ([*SIMULATE, "--physics.facet-slope-deg", "0"], "--physics.facet-slope-deg: found 0"),
    ([*SIMULATE, "--out", "folder"], "folder: found a folder, expected a file"),
    ([*SIMULATE, "--out", "."], ".: found a folder, expected a file"),
    ([*SIMULATE, "--out", "/dev/null"], "/dev/null: found something that is not a plain file"),
    ([*SIMULATE, "--out", "no/such/drive.csv"], "no/such/drive.csv: found No such file"),
    ([*SIMULATE, "--out", "file/drive.csv"], "file/drive.csv: found "),
    ([*SIMULATE, "--out", "place.csv"], "place.truth.npz: found a folder"),
    (["scan", "mars", *SCAN[2:]], "world: found mars"),
    ([*SCAN, "--at", "1"], "--at: found '1', expected X,Y in metres"),
    ([*SCAN, "--at", "1 1"], "--at: found '1 1'"),
    ([*SCAN, "--at", "1,1,1"], "--at: found '1,1,1'"),
    ([*SCAN, "--at", "here"], "--at: found 'here'"),
    ([*SCAN, "--at", "1e,+"], "--at: found '1e,+'"),
    ([*SCAN, "--at", "nan,1"], "--at: found 'nan,1'"),
    ([*SCAN, "--at", "1e999,1"], "--at: found '1e999,1'"),
    ([*SCAN, "--at", "1e30,1"], "--at: found '1e30,1'"),
    ([*SCAN, "--transducer", "sr04"], "--transducer: found sr04, expected polaroid-600 or polaroid-7000"),
    ([*SCAN, "--physics.beam", "laser"], "--physics.beam: found laser"),
    ([*SCAN, "--max-range", "0"], "--max-range: found 0"),
    ([*SCAN, "--max-range", "nan"], "--max-range: found nan"),
    ([*SCAN, "--out", "file"], "file: found a file, expected a folder"),
    ([*TRAIN, "--drives", "0"], "--drives: found 0"),
    ([*TRAIN, "--epochs", "-1"], "--epochs: found -1"),
    ([*TRAIN, "--seed", "-1"], "--seed: found -1"),
    ([*TRAIN, "--out", "folder"], "folder: found a folder, expected a file"),
    ([*TRAIN, "--out", "."], ".: found a folder, expected a file"),
    ([*TRAIN, "--out", "no/such.npz"], "--out: found no folder no"),
    (["score", "missing", str(TRUTH)], "missing: found no such file"),
    (["score", "folder", str(TRUTH)], "folder: found a folder without map.npz"),
    (["score", "out", str(TRUTH)], "out/map.npz: found "),
    (["score", "drive.csv", str(TRUTH)], "drive.csv: found "),
    (["score", "out/map.yaml", str(TRUTH)], "out/map.yaml: found "),
    (["score", "cut.npz", str(TRUTH)], "cut.npz: found "),
    (["score", str(TRUTH), str(TRUTH)], f"{TRUTH}: found the arrays truth, "),
    (["score", "good.npz", "missing"], "missing: found no such file"),
    (["score", "good.npz", "out"], "out: found a folder"),
    (["score", "good.npz", "good.npz"], "good.npz: found "),
    (["score", "good.npz", "drive.csv"], "drive.csv: found "),
    (["score", "good.npz", "cut.npz"], "cut.npz: found "),
]


@pytest.mark.parametrize(("args", "found"), BAD_CALLS, ids=lambda v: " ".join(v)[:80] if isinstance(v, list) else "")
def test_a_wrong_argument_is_one_line(run, place, args, found):
    put(place / "one.txt", "1,1\n")
    put(place / "nan.txt", "1,1\n1,nan\n")
    (place / "place.truth.npz").mkdir()
    log_odds = np.full((2, 3), 0.5, dtype=np.float32)
    observed = np.ones((2, 3), dtype=bool)
    np.savez(place / "good.npz", log_odds=log_odds, observed=observed, resolution=0.1, origin=[0.0, 0.0])
    whole = (place / "good.npz").read_bytes()
    put(place / "cut.npz", whole[: len(whole) // 2])
    err = assert_refused(run, place, *args)
    assert err.startswith(f"echogrid: {found}")


BAD_WORLDS = {
    "not yaml": ("name: [", ":"),
    "unknown key": (WORLD + "ceiling: 3\n", ": ceiling: found an unknown key"),
    "no walls": ("name: void\n", ": walls: found no wall"),
    "no roughness": (WORLD.replace(", roughness_mm: 0.05", ""), ": walls[0].roughness_mm: found nothing"),
    "text": (WORLD.replace("0.05", "smooth"), ": walls[0].roughness_mm: found 'smooth'"),
    "one point": (WORLD.replace("[[0, 0], [3, 0], [3, 2], [0, 2]]", "[[0, 0]]"), ": walls[0].points: found "),
    "far": (WORLD.replace("[3, 2]", "[3, 2e9]"), ": walls[0].points[2]: found "),
    "binary": (b"\xff\xfe\0", ": found bytes that are not UTF-8 text"),
    "empty": ("", ": found nothing"),
}


@pytest.mark.parametrize("kind", BAD_WORLDS)
def test_a_wrong_world_is_one_line_that_names_the_key(run, place, kind):
    content, found = BAD_WORLDS[kind]
    put(place / "box.yaml", content)
    for command in (SIMULATE, SCAN):
        assert assert_refused(run, place, *command).startswith(f"echogrid: box.yaml{found}")


def test_a_room_too_narrow_for_the_robot_is_one_line(run, place):
    put(place / "box.yaml", WORLD.replace("[3, 2], [0, 2]", "[3, 0.3], [0, 0.3]"))
    err = assert_refused(run, place, "simulate", "box.yaml", "--robot", "duo.yaml", "--out", "old.csv")
    assert "no free space" in err


@pytest.mark.parametrize(
    "args", [[], ["mpa"], ["map", "a.csv", "b.csv"], ["map", "--walls"], ["map", "--resolution", "x"]]
)
def test_a_call_that_cannot_be_understood_is_explained_on_stderr(run, place, args):
    before = everything(place)
    status, out, err = run(*args)
    assert (status, out) == (2, "")
    assert "Traceback" not in err
    assert "--help" in err
    assert everything(place) == before


ANCHORS = "\n".join(
    ["a0: &a0 {k: 1}", *(f"a{n}: &a{n} {{<<: [{', '.join([f'*a{n - 1}'] * 9)}]}}" for n in range(1, 9))]
)

OPENING = {
    "map": ["map", "ODD", "--robot", "duo.yaml", "--out", "out"],
    "map --robot": ["map", "drive.csv", "--robot", "ODD", "--out", "out"],
    "map --interpreter": [*MAP, "--interpreter", "ODD"],
    "live --interpreter": ["live", "--interpreter", "ODD", "--out", "out"],
    "info": ["info", "ODD"],
    "info --robot": ["info", "drive.csv", "--robot", "ODD"],
    "simulate": ["simulate", "ODD", *SIMULATE[2:]],
    "simulate --robot": ["simulate", "box.yaml", "--robot", "ODD", "--out", "old.csv"],
    "simulate --drive": [*SIMULATE, "--drive", "ODD"],
    "scan": ["scan", "ODD", *SCAN[2:]],
    "train --robot": ["train", "--robot", "ODD", "--drives", "1", "--epochs", "1", "--out", "old.npz"],
    "score MAP": ["score", "ODD", str(TRUTH)],
    "score TRUTH": ["score", "ODD.npz", "ODD"],
}
"""Everything that opens a path of the user's."""

AT_ONCE_S = 20.0
"""Most of it is the import of JAX, in the first test."""


@pytest.mark.parametrize("name", ["pipe", "pipe.bag", "pipe.yaml", "/dev/zero", "socket"])
@pytest.mark.parametrize("args", OPENING.values(), ids=OPENING)
def test_a_pipe_and_a_device_are_refused_at_once(run, place, args, name):
    if name.startswith("pipe"):
        os.mkfifo(name)
    if name == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(name)
    np.savez("ODD.npz", log_odds=np.zeros((2, 3)), observed=np.ones((2, 3), bool), resolution=0.1, origin=[0.0, 0.0])
    before = sorted(path.name for path in place.iterdir())
    begin = time.monotonic()
    status, out, err = run(*(name if arg == "ODD" else arg for arg in args))
    assert time.monotonic() - begin < AT_ONCE_S
    assert (status, out) == (2, "")
    assert re.fullmatch(
        rf"echogrid: {name}: found (something that is not a plain file|a pipe or a device), .*\n", err
    )
    assert sorted(path.name for path in place.iterdir()) == before


@pytest.mark.parametrize("args", [OPENING["map --robot"], OPENING["simulate"], OPENING["score MAP"]], ids=str)
@pytest.mark.parametrize("bomb", [ANCHORS, ANCHORS.replace("<<", "k"), "1" * 500, "a: " + "1:" * 400_000 + "1"])
def test_yaml_that_becomes_far_more_than_it_is_is_refused_at_once(run, place, args, bomb):
    put(place / "bomb.yaml", bomb)
    begin = time.monotonic()
    err = assert_refused(run, place, *("bomb.yaml" if arg == "ODD" else arg for arg in args))
    assert time.monotonic() - begin < AT_ONCE_S
    assert err.startswith("echogrid: bomb.yaml: found ")
    assert "anchors that become" in err or "a number of more than" in err


def test_a_key_that_is_written_twice_is_refused_with_its_line(run, place):
    """YAML takes the last: half of the walls would be missing."""
    put(place / "box.yaml", WORLD + "walls:\n  - {points: [[1, 1], [2, 2]], roughness_mm: 1.0}\n")
    line = WORLD.count("\n") + 1
    assert f"box.yaml:{line}: found the key 'walls' twice, expected YAML" in assert_refused(run, place, *SIMULATE)


def npz_of(path, length, **arrays):
    """An archive with zeros besides; they become a thousandth when they are packed."""
    np.savez_compressed(path, zeros=np.zeros(length, dtype=np.uint8), **arrays)


@pytest.mark.parametrize(
    "args",
    [OPENING["map --interpreter"], OPENING["score MAP"], OPENING["score TRUTH"]],
    ids=["weights", "map", "truth"],
)
def test_an_archive_that_becomes_far_longer_is_refused_in_little_memory(run, place, args):
    log_odds, observed = np.zeros((2, 3)), np.ones((2, 3), bool)
    np.savez("ODD.npz", log_odds=log_odds, observed=observed, resolution=0.1, origin=[0.0, 0.0])
    npz_of(place / "bomb.npz", 400_000_000, log_odds=log_odds, observed=observed, resolution=0.1, origin=[0.0, 0.0])
    assert (place / "bomb.npz").stat().st_size < 1e6

    def refuse():
        err = assert_refused(run, place, *("bomb.npz" if arg == "ODD" else arg for arg in args))
        assert "bomb.npz: found an archive that becomes 4.0e+08 bytes when unpacked" in err

    assert peak_of(refuse) < 1e8


def test_weights_of_a_width_that_no_memory_holds_are_refused(run, place):
    np.savez_compressed(place / "wide.npz", format="echogrid-set-1", recipe="{}", b1=np.zeros(10**6, np.float32))
    assert peak_of(lambda: assert_refused(run, place, *MAP, "--interpreter", "wide.npz")) < 3e8


def test_anchors_that_say_what_they_mean_are_read(run, place):
    put(
        place / "box.yaml",
        WORLD.replace("closed: true", "closed: &yes true").replace("0.05", "&rough 0.05")
        + "".join(
            f"  - {{points: [[1, {y}], [1.2, {y}]], closed: *yes, roughness_mm: *rough}}\n" for y in (0.5, 0.8)
        ),
    )
    assert run(*SIMULATE)[0] == 0
