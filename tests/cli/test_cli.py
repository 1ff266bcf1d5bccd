import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import yaml

from echogrid import __version__
from echogrid.cli import COMMANDS, main
from echogrid.frame import Frame
from echogrid.logs.formats import load_log
from echogrid.models.classical import Cone
from echogrid.models.em import ForwardModel
from echogrid.models.set_network import SetNetwork
from echogrid.models.table import MODELS, sensor_model
from echogrid.output.mapfile import read_truth
from echogrid.robot import Robot, robot_yaml
from echogrid.simulation.world import world_names

SOURCE = Path(__file__).parents[2] / "src"
DATA = SOURCE / "echogrid" / "data"
SAMPLE, TRUTH = DATA / "sample.csv", DATA / "sample.truth.npz"

MAP_FILES = {"map.pgm", "map.yaml", "map.png", "map.npz", "run.yaml"}
SCORES = ["found", "wiped", "free", "false", "auc", "nll", "brier", "ece", "surface_cells", "free_cells"]

ROBOT = """
name: duo
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.2, max_range_m: 4.0, beam_width_deg: 25}
mounts: [[0.1, 0, 0], [0, 0.1, 90]]
"""

LOG = """t,x,y,theta,r0,r1
0,0,0,0,1.0,inf
0.5,3,4,0,1.0,2.0
1.0,3,4,0,inf,2.0
2.0,3,5,0,,3.0
"""

WORLD = """
name: box
walls:
  - {points: [[0, 0], [3, 0], [3, 2], [0, 2]], closed: true, roughness_mm: 0.05}
"""


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys) -> Run:
    """Run a command in this process: its exit status, and what it wrote to stdout and stderr."""

    def command(*args: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = call(*args)
        written = capsys.readouterr()
        return status, written.out, written.err

    return command


def call(*args: object) -> int:
    try:
        main([str(arg) for arg in args])
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


def put(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def everything(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder and below, hidden files included; None stands for a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def assert_refused(run: Run, folder: Path, *args: object) -> str:
    """One line on stderr, exit status 2, and the folder as it was. Gives the line."""
    before = everything(folder)
    status, out, err = run(*args)
    assert status == 2
    assert out == ""
    assert re.fullmatch(r"echogrid: .+: found .+, expected .+\n", err), err
    assert everything(folder) == before
    return err


def told(text: str) -> dict[str, str]:
    """The lines of ``score`` and ``info`` as name and value."""
    return {line[:14].strip(): line[14:] for line in text.splitlines()}


def share(text: str, name: str) -> float:
    return float(told(text)[name].split("%")[0]) / 100


# ------------------------------------------------------------------ map and score


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    """The map of the shipped sample, as made without a log."""
    folder = tmp_path_factory.mktemp("sample") / "out"
    assert call("map", "--out", folder) == 0
    return folder


def arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "map.npz", allow_pickle=False) as data:
        return dict(data)


def test_map_writes_what_the_contract_names(sample):
    assert {path.name for path in sample.iterdir()} == MAP_FILES
    npz = arrays(sample)
    assert set(npz) == {"log_odds", "observed", "resolution", "origin"}
    assert (npz["log_odds"].dtype, npz["observed"].dtype) == (np.float32, bool)
    assert npz["log_odds"].shape == npz["observed"].shape
    assert npz["resolution"] == 0.04
    assert npz["origin"].shape == (2,)
    server = yaml.safe_load((sample / "map.yaml").read_text())
    assert (server["image"], server["mode"], server["resolution"]) == ("map.pgm", "trinary", 0.04)
    assert (sample / "map.png").read_bytes().startswith(b"\x89PNG\r\n")
    rows, cols = npz["log_odds"].shape
    assert (sample / "map.pgm").read_bytes().startswith(b"P5\n%d %d\n255\n" % (cols, rows))


def scores(run: Run, map_: Path, truth: Path = TRUTH) -> dict[str, float]:
    status, out, err = run("score", map_, truth)
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()] == SCORES
    return {name: float(value) for name, value in told(out).items()}


def test_the_sample_maps_well(run, sample):
    found = scores(run, sample)
    assert found["auc"] > 0.95
    assert found["wiped"] < 0.1
    free, surface, _ = np.bincount(read_truth(TRUTH).cells.ravel())
    assert (found["surface_cells"], found["free_cells"]) == (surface, free)


@pytest.mark.parametrize("name", ["map.npz", "map.yaml"])
def test_score_takes_the_files_of_a_map_as_well(run, sample, name):
    assert scores(run, sample / name)["auc"] == pytest.approx(scores(run, sample)["auc"], abs=0.05)


def test_the_scores_of_the_cone_are_worse(run, sample, tmp_path):
    status, out, err = run("map", "--interpreter", "cone", "--out", tmp_path / "cone")
    assert (status, err) == (0, "")
    assert "521 scans of b21" in out
    cone, network = scores(run, tmp_path / "cone"), scores(run, sample)
    assert cone["wiped"] > network["wiped"]
    assert cone["auc"] < network["auc"]


def test_a_finer_map_is_of_the_same_place(run, sample, tmp_path):
    assert run("map", "--resolution", 0.06, "--out", tmp_path)[0] == 0
    fine, coarse = arrays(tmp_path), arrays(sample)
    assert fine["resolution"] == 0.06
    sides = [np.array(npz["log_odds"].shape) * npz["resolution"] for npz in (fine, coarse)]
    assert sides[0] == pytest.approx(sides[1], abs=0.6)
    assert fine["origin"] == pytest.approx(coarse["origin"], abs=0.3)
    assert scores(run, tmp_path)["auc"] > 0.95


def test_refine_changes_the_map_where_it_was_observed(run, sample, tmp_path):
    assert run("map", "--refine", "--out", tmp_path)[0] == 0
    plain, refined = arrays(sample), arrays(tmp_path)
    changed = plain["log_odds"] != refined["log_odds"]
    assert changed.any()
    assert not changed[~plain["observed"]].any()
    np.testing.assert_array_equal(plain["observed"], refined["observed"])


def test_run_yaml_is_enough_to_repeat_the_run(run, sample, tmp_path):
    settings = yaml.safe_load((sample / "run.yaml").read_text())
    assert settings["echogrid_version"] == __version__
    assert settings["frames"] == 521
    robot = put(tmp_path / "robot.yaml", settings["robot"])
    again = ["--resolution", settings["resolution"], "--interpreter", settings["interpreter"]]
    again += ["--refine"] if settings["refine"] else []
    assert run("map", settings["log"], "--robot", robot, "--out", tmp_path / "again", *again)[0] == 0
    for name in ("map.npz", "map.pgm", "map.yaml"):
        assert (tmp_path / "again" / name).read_bytes() == (sample / name).read_bytes()


def test_run_yaml_holds_how_the_weights_were_trained(sample):
    settings = yaml.safe_load((sample / "run.yaml").read_text())
    network = sensor_model("set-network")
    assert isinstance(network, SetNetwork)
    assert settings["weights"] == network.recipe
    assert "parameters" not in settings


@pytest.mark.parametrize(("name", "kind"), [("cone", Cone), ("em", ForwardModel)])
def test_run_yaml_holds_every_number_of_a_model(run, tmp_path, name, kind):
    log = write_csv_log(tmp_path / "some.csv", some_frames(4))
    assert run("map", log, "--robot", "b21", "--interpreter", name, "--out", tmp_path / "out")[0] == 0
    settings = yaml.safe_load((tmp_path / "out" / "run.yaml").read_text())
    assert settings["parameters"].keys() == {item.name for item in fields(kind)}
    assert kind(**settings["parameters"]) == sensor_model(name)
    assert "weights" not in settings


def test_a_robot_that_nobody_named_is_said(run, tmp_path):
    log = write_csv_log(tmp_path / "some.csv", some_frames(4))
    status, out, err = run("map", log, "--out", tmp_path / "out")
    assert (status, err) == (0, "robot: b21, as none was named\n")
    assert out.startswith(f"{log}: 4 scans of b21 in ")
    assert run("map", log, "--robot", "b21", "--out", tmp_path / "out")[2] == ""


def some_frames(count: int) -> list[Frame]:
    """The first frames of the sample."""
    frames = iter(load_log(SAMPLE, Robot.load("b21")))
    return [next(frames) for _ in range(count)]


def write_csv_log(path: Path, frames: list[Frame]) -> Path:
    lines = ["t,x,y,theta," + ",".join(f"r{i}" for i in range(24))]
    lines += [",".join(str(float(v)) for v in [f.stamp, *f.pose, *f.ranges]) for f in frames]
    return put(path, "\n".join([*lines, ""]))


def test_a_drive_makes_the_same_map_as_csv_and_as_carmen(run, tmp_path):
    frames, robot = some_frames(100), Robot.load("b21")
    mounts = " ".join(f"{v:.9f}" for v in robot.mounts.ravel())
    lines = ["# CARMEN Logfile"]
    for f in frames:
        # A real module says no echo and not valid by readings past its limits.
        ranges = " ".join(f"{v:.4f}" for v in np.nan_to_num(f.ranges, nan=0.1, posinf=10.0))
        x, y, theta = f.pose
        lines.append(f"ODOM {x:.9f} {y:.9f} {theta:.9f} 0 0 0 {f.stamp} host {f.stamp}")
        lines.append(f"SONAR 0.43 24 {ranges} {mounts} {f.stamp} host {f.stamp}")
    carmen = put(tmp_path / "drive.log", "\n".join([*lines, ""]))
    csv = write_csv_log(tmp_path / "drive.csv", frames)
    for log, out in ((csv, "a"), (carmen, "b")):
        assert run("map", log, "--robot", "b21", "--out", tmp_path / out)[0] == 0
    a, b = arrays(tmp_path / "a"), arrays(tmp_path / "b")
    np.testing.assert_allclose(a["log_odds"], b["log_odds"], atol=1e-3)
    np.testing.assert_array_equal(a["observed"], b["observed"])
    np.testing.assert_array_equal(a["origin"], b["origin"])


@pytest.mark.parametrize(("frames", "reading"), [(1, "1.0"), (1, "inf"), (70, "nan"), (70, "")])
def test_a_drive_that_goes_nowhere_and_one_that_hears_nothing_make_a_map(run, tmp_path, frames, reading):
    rows = "".join(f"{i},0,0,0,{reading},{reading}\n" for i in range(frames))
    log = put(tmp_path / "still.csv", "t,x,y,theta,r0,r1\n" + rows)
    robot = put(tmp_path / "duo.yaml", ROBOT)
    status, out, err = run("map", log, "--robot", robot, "--out", tmp_path / "out")
    assert (status, err) == (0, "")
    assert f"{frames} scans of duo" in out
    npz = arrays(tmp_path / "out")
    assert np.isfinite(npz["log_odds"]).all()
    assert npz["observed"].any()  # the floor under the robot at least


def test_a_map_is_made_in_a_folder_with_an_odd_name_that_did_not_exist(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = put(tmp_path / "my drive ö.csv", LOG)
    put(tmp_path / "duo.yaml", ROBOT)
    assert run("map", log.name, "--robot", "duo.yaml", "--out", "a b/c/../c ü")[0] == 0
    assert {path.name for path in (tmp_path / "a b" / "c ü").iterdir()} == MAP_FILES


# ------------------------------------------------------------------ simulate and scan


def simulate(run: Run, out: Path, *args: object, world: object = "lab", robot: object = "b21") -> str:
    """A short simulated drive; what ``info`` says of it."""
    drive = put(out.with_suffix(".txt"), "1,1\n2,1  # a stop\n\n2,2\n")
    status, text, err = run("simulate", world, "--robot", robot, "--drive", drive, "--out", out, *args)
    assert (status, err) == (0, "")
    assert f"in {out}, truth in {out.with_suffix('.truth.npz')}" in text
    return run("info", out)[1]


def test_simulate_writes_a_log_and_its_truth(run, tmp_path):
    info = told(simulate(run, tmp_path / "drive.csv"))
    assert {path.name for path in tmp_path.iterdir()} == {"drive.csv", "drive.truth.npz", "drive.txt"}
    assert info["sonars"] == "24"
    assert info["drive"] == "2.00 m within x 1.00 .. 2.00, y 1.00 .. 2.00 m"
    truth = read_truth(tmp_path / "drive.truth.npz")
    assert set(np.unique(truth.cells)) == {0, 1, 2}
    assert run("map", tmp_path / "drive.csv", "--out", tmp_path / "map")[0] == 0
    assert scores(run, tmp_path / "map", tmp_path / "drive.truth.npz")["auc"] > 0.8


def test_the_drive_follows_its_waypoints(run, tmp_path):
    simulate(run, tmp_path / "drive.csv")
    poses = np.array([frame.pose for frame in load_log(tmp_path / "drive.csv")])
    np.testing.assert_allclose(poses[[0, -1]], [[1, 1, 0], [2, 2, np.pi / 2]], atol=1e-6)
    assert np.min(np.linalg.norm(poses[:, :2] - [2, 1], axis=1)) < 1e-6
    assert np.all((np.abs(poses[:, 1] - 1) < 1e-6) | (np.abs(poses[:, 0] - 2) < 1e-6))
    assert np.max(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)) < 0.06


def test_a_tour_drives_through_all_of_a_room(run, tmp_path):
    out = tmp_path / "tour.csv"
    assert run("simulate", put(tmp_path / "box.yaml", WORLD), "--robot", "p3dx", "--out", out)[0] == 0
    poses = np.array([frame.pose for frame in load_log(out, Robot.load("p3dx"))])
    assert np.all(poses[:, :2] > 0.28)
    assert np.all(poses[:, :2] < [3 - 0.28, 2 - 0.28])
    assert np.ptp(poses[:, 0]) > 1


def test_a_seed_repeats_a_drive_and_another_does_not(run, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        simulate(run, tmp_path / f"{name}.csv", "--seed", seed)
    a, b, c = ((tmp_path / f"{name}.csv").read_bytes() for name in "abc")
    assert a == b
    assert a != c
    truths = {(tmp_path / f"{name}.truth.npz").read_bytes() for name in "abc"}
    assert len(truths) == 1


def test_rough_walls_are_heard_where_smooth_ones_are_not(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD.replace("[3, 2], [0, 2]", "[3, 3], [0, 3]"))
    smooth = share(simulate(run, tmp_path / "smooth.csv", "--walls", "smooth", world=world), "no echo")
    rough = share(simulate(run, tmp_path / "rough.csv", "--walls", "rough", world=world), "no echo")
    assert rough < smooth - 0.1
    simulate(run, tmp_path / "as-given.csv", world=world)  # smooth
    assert (tmp_path / "as-given.csv").read_bytes() == (tmp_path / "smooth.csv").read_bytes()


def test_the_switches_of_the_ranging_module_do_what_they_say(run, tmp_path):
    plain = simulate(run, tmp_path / "plain.csv")
    assert share(plain, "stale") < 0.02
    stale = simulate(run, tmp_path / "stale.csv", "--physics.stale", 0.5)
    assert share(stale, "stale") == pytest.approx(0.5, abs=0.1)
    assert told(simulate(run, tmp_path / "lost.csv", "--physics.lost", 1))["no echo"] == "100.0%"
    assert told(simulate(run, tmp_path / "lost.csv", "--physics.lost", 1))["ranges"] == "none"
    heard = share(simulate(run, tmp_path / "loud.csv", "--physics.level-db", 60), "no echo")
    assert heard < share(plain, "no echo") - 0.1


def test_a_scan_is_a_reading_a_degree(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD.replace("0.05", "2.0"))
    status, out, err = run("scan", world, "--at", "1.25,0.75", "--out", tmp_path / "scan")
    assert (status, err) == (0, "")
    assert out.startswith("box: 360 bearings, 100% with an echo")
    assert {path.name for path in (tmp_path / "scan").iterdir()} == {"scan.csv", "scan.png"}
    assert (tmp_path / "scan" / "scan.png").read_bytes().startswith(b"\x89PNG\r\n")
    lines = (tmp_path / "scan" / "scan.csv").read_text().splitlines()
    assert lines[0] == "bearing_deg,range_m,region"
    degrees, ranges, region = zip(*(line.split(",") for line in lines[1:]), strict=True)
    np.testing.assert_array_equal([float(d) for d in degrees], np.arange(360))
    # Square to the four walls the reading is the distance, late by a weak echo's walk error at the most.
    square = np.array(ranges, dtype=float)[[0, 90, 180, 270]]
    np.testing.assert_allclose(square, [1.75, 1.25, 1.25, 0.75], atol=0.03)
    # A rough wall is flat about its normal and nowhere else; regions are numbered as they follow one another.
    assert [region[i] for i in (45, 90, 180, 270)] == ["", "1", "2", "3"]
    assert region[359] == region[0] == "4"
    assert set(region) == {"", "1", "2", "3", "4"}


def test_a_scan_marks_the_regions_of_constant_depth_of_smooth_walls_and_corners(run, tmp_path):
    world = put(tmp_path / "box.yaml", WORLD)
    assert run("scan", world, "--at", "1.3,0.8", "--out", tmp_path)[0] == 0
    rows = [line.split(",") for line in (tmp_path / "scan.csv").read_text().splitlines()[1:]]
    # Walls and corners in turn; the corners' bearings rounded to a degree.
    targets = {0: 1.7, 35: 2.0809, 90: 1.2, 137: 1.7692, 180: 1.3, 212: 1.5264, 270: 0.8, 335: 1.8788}
    for bearing, distance in targets.items():
        assert float(rows[bearing][1]) == pytest.approx(distance, abs=0.01)
    assert [rows[bearing][2] for bearing in targets] == ["8", "1", "2", "3", "4", "5", "6", "7"]


def test_a_scan_may_be_left_of_and_below_the_origin(run, tmp_path):
    box = WORLD.replace("[[0, 0], [3, 0], [3, 2], [0, 2]]", "[[-3, -2], [0, -2], [0, 0], [-3, 0]]")
    world = put(tmp_path / "box.yaml", box)
    assert run("scan", world, "--at", "-2,-1.5", "--walls", "rough", "--out", tmp_path)[0] == 0
    assert (tmp_path / "scan.csv").read_text().count("inf") < 36


# ------------------------------------------------------------------ train


def test_weights_are_trained_and_map_a_log(run, tmp_path):
    weights = tmp_path / "mine.npz"
    status, out, err = run("train", "--robot", "p3dx", "--drives", 16, "--epochs", 1, "--seed", 5, "--out", weights)
    assert (status, err) == (0, "")
    assert out.startswith(f"{weights}: trained for p3dx in ")
    assert everything(tmp_path).keys() == {"mine.npz"}
    log = put(tmp_path / "drive.csv", LOG)
    robot = put(tmp_path / "duo.yaml", ROBOT)
    assert run("map", log, "--robot", robot, "--interpreter", weights, "--out", tmp_path / "out")[0] == 0
    settings = yaml.safe_load((tmp_path / "out" / "run.yaml").read_text())
    assert settings["weights"]["robot"] == robot_yaml(Robot.load("p3dx"))
    assert (settings["weights"]["drives"], settings["weights"]["seed"]) == (16, 5)


# ------------------------------------------------------------------ info


def test_info_counts_as_one_does_by_hand(run, tmp_path):
    log = put(tmp_path / "tiny.csv", LOG)
    status, out, err = run("info", log)
    assert (status, err) == (0, "")
    assert told(out) == {
        "log": str(log),
        "frames": "4",
        "sonars": "2",
        "span": "2.00 s, 1.5 Hz",
        "drive": "6.00 m within x 0.00 .. 3.00, y 0.00 .. 5.00 m",
        "no echo": "25.0%",
        "not fired": "12.5%",
        "stale": "50.0% of the finite readings repeat the one before",
        "ranges": "1.000 .. 3.000 m, median 2.00 m",
        "no echo of": "r0 25% r1 25%",
    }


def test_info_takes_the_limits_of_a_robot(run, tmp_path):
    robot = put(tmp_path / "duo.yaml", ROBOT.replace("max_range_m: 4.0", "max_range_m: 2.5"))
    out = told(run("info", put(tmp_path / "tiny.csv", LOG), "--robot", robot)[1])
    assert out["no echo"] == "37.5%"
    assert out["ranges"] == "1.000 .. 2.000 m, median 1.50 m"


@pytest.mark.parametrize(("reading", "no_echo", "not_fired"), [("inf", "100.0%", "0.0%"), ("nan", "0.0%", "100.0%")])
def test_info_of_a_log_without_a_range(run, tmp_path, reading, no_echo, not_fired):
    out = told(run("info", put(tmp_path / "one.csv", f"t,x,y,theta,r0\n7,0,0,0,{reading}\n"))[1])
    assert (out["no echo"], out["not fired"], out["ranges"]) == (no_echo, not_fired, "none")
    assert out["span"] == "0.00 s"


# ------------------------------------------------------------------ what is wrong is one line


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A working folder with inputs that are right and with the outputs of earlier runs."""
    monkeypatch.chdir(tmp_path)
    put(tmp_path / "drive.csv", LOG)
    put(tmp_path / "duo.yaml", ROBOT)
    put(tmp_path / "box.yaml", WORLD)
    put(tmp_path / "way.txt", "1,1\n2,1\n")
    put(tmp_path / "file", "mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "out").mkdir()
    for name in MAP_FILES | {"scan.csv", "scan.png"}:
        put(tmp_path / "out" / name, f"an old {name}")
    for name in ("old.csv", "old.truth.npz", "old.npz"):
        put(tmp_path / name, f"an old {name}")
    return tmp_path


def rows(*rows: str) -> str:
    return "\n".join(["t,x,y,theta,r0,r1", *rows, ""])


GOOD = "0,0,0,0,1,1"

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
    "wrong header": ("t,x,y,theta,r1,r2\n" + GOOD, "drive.csv:1: found 'r1'"),
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
    put(place / "drive.csv", rows(GOOD, "1,9e6,9e6,0,1,1"))
    err = assert_refused(run, place, "map", "drive.csv", "--robot", "duo.yaml", "--out", "out")
    assert "broken pose" in err


BAD_ROBOTS = {
    "preset": ("b12", "robot: found b12, expected a file or one of b21, "),
    "missing": ("no/such.yaml", "robot: found no/such.yaml, expected a file or one of b21, "),
    "folder": ("folder", "folder: found "),
    "text": ("file", "file: found "),
    "log": ("drive.csv", "drive.csv: found "),
    "world": ("box.yaml", "box.yaml: walls: found an unknown key"),
    "binary": ("binary", "binary: found "),
    "key": ("key.yaml", "key.yaml: mounts: found "),
    "long": ("x" * 300, "x"),
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


MAP = ["map", "drive.csv", "--robot", "duo.yaml", "--out", "out"]
SIMULATE = ["simulate", "box.yaml", "--robot", "duo.yaml", "--drive", "way.txt", "--out", "old.csv"]
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
    ([*SIMULATE, "--drive", "missing.txt"], "missing.txt: found No such file"),
    ([*SIMULATE, "--drive", "folder"], "folder: found Is a directory"),
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


# ------------------------------------------------------------------ what stops a command from outside


def interrupted(items: list, error: BaseException) -> Iterator:
    yield from items
    raise error


def interrupted_in_numpy() -> ValueError:
    """What NumPy makes of a Ctrl-C that comes while it asks an array for its numbers."""
    error = ValueError("setting an array element with a sequence.")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (KeyboardInterrupt(), 130, "echogrid: stopped\n"),
        (interrupted_in_numpy(), 130, "echogrid: stopped\n"),
        (MemoryError(), 2, "echogrid: memory: found too little, expected more for a job of this size\n"),
        (OSError(28, "No space left on device"), 2, None),
    ],
)
def test_a_run_that_is_stopped_leaves_everything_as_it_was(run, place, monkeypatch, error, status, line):
    frames = [Frame(0.1 * i, np.zeros(3), np.ones(2)) for i in range(5)]
    monkeypatch.setattr("echogrid.mapping.build.build_map", lambda *_: interrupted([], error))
    monkeypatch.setattr("echogrid.simulation.simulate.Simulator.frames", lambda *_: interrupted(frames, error))
    before = everything(place)
    for command in (MAP, [*MAP, "--out", "new/out"], SIMULATE):
        found, out, err = run(*command)
        assert (found, out) == (status, "")
        assert err == line if line else re.fullmatch(r"echogrid: .*: found No space left on device, .*\n", err)
        assert everything(place) == before


def test_a_truth_that_cannot_be_worked_out_leaves_no_log(run, place, monkeypatch):
    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("echogrid.simulation.drive.truth_of", fail)
    before = everything(place)
    assert run(*SIMULATE)[0] == 2
    assert everything(place) == before


def process(*args: object, stdout: int | IO[str] = subprocess.PIPE) -> subprocess.CompletedProcess[str]:
    """The installed command in a process of its own."""
    command = [str(Path(sys.executable).with_name("echogrid")), *map(str, args)]
    # With its usual buffer, which Python empties as it ends.
    env = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    return subprocess.run(command, env=env, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=60, check=False)


def test_the_installed_command_refuses_a_wrong_log_in_one_line(place):
    put(place / "drive.csv", rows(GOOD, "1,0,0,0,1"))
    before = everything(place)
    done = process(*MAP)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "echogrid: drive.csv:3: found 5 columns, expected 6, as the header has\n"
    assert everything(place) == before


def test_output_that_nobody_reads_is_no_error():
    read, write = os.pipe()
    os.close(read)
    done = process("info", SAMPLE, stdout=write)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_output_that_finds_a_full_disk_is_one_line():
    with open("/dev/full", "w") as full:
        done = process("--help", stdout=full)
    assert done.returncode == 2
    assert done.stderr == "echogrid: output: found No space left on device, expected a file that can be used\n"


# ------------------------------------------------------------------ help


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_help(run, command):
    status, out, err = run(command, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: echogrid {command} ")
    assert "None}" not in out


def test_help_names_every_command_and_version_the_version(run):
    assert all(f"• {command}" in run("--help")[1] for command in COMMANDS)
    assert run("--version") == (0, f"echogrid {__version__}\n", "")


def words(text: str) -> set[str]:
    """The names in a help, which may be broken over lines within a frame."""
    return set(re.findall(r"[\w-]+", re.sub(r"[\s│]", "", text)))


def test_help_names_every_model_and_world(run):
    assert set(MODELS) <= words(run("map", "--help")[1])
    for command in ("simulate", "scan"):
        assert set(world_names()) <= words(run(command, "--help")[1])


def test_help_and_info_do_not_pay_for_jax():
    code = f"""
import sys
from echogrid.cli import main
for args in (["--help"], ["map", "--help"], ["info", {str(SAMPLE)!r}]):
    try:
        main(args)
    except SystemExit:
        pass
print({{"jax", "matplotlib"}} & sys.modules.keys(), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert "521" in done.stdout
    assert done.stderr == "set()\n"


# ------------------------------------------------------------------ what the documents show


def test_the_examples_of_the_formats_work(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (SOURCE.parent / "docs" / "formats.md").read_text()
    blocks = re.findall(r"^```(\w+) ?(\S*)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    for _, name, content in blocks:
        if name:
            put(tmp_path / name, content)
    shown = {kind: [content for k, _, content in blocks if k == kind] for kind in ("sh", "python")}
    for line in "".join(shown["sh"]).splitlines():
        status, _, err = run(*line.split()[1:])
        assert (status, err) == (0, ""), line
    for code in shown["python"]:
        exec(compile(code, "docs/formats.md", "exec"), {})
    assert scores(run, tmp_path / "out", tmp_path / "mine.npz")["surface_cells"] == 136
    csv, carmen, own = (arrays(tmp_path / out) for out in ("out", "out-carmen", "out-as-the-log-says"))
    np.testing.assert_allclose(csv["log_odds"], carmen["log_odds"], atol=1e-3)
    np.testing.assert_allclose(csv["log_odds"], own["log_odds"], atol=1e-3)
