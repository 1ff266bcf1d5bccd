"""Logs are mapped, and maps scored."""

import json
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml

from commands import LOG, MAP_FILES, ROBOT, SAMPLE, SCORES, TRUTH, arrays, call, put, scores
from echogrid import __version__
from echogrid.frame import Frame
from echogrid.logs.formats import load_log
from echogrid.mapping.registry import sensor_model
from echogrid.metrics import Truth
from echogrid.models.classical.forward_model import ForwardModel
from echogrid.models.classical.log_odds import Cone
from echogrid.models.networks.set_network import SetNetwork
from echogrid.output.map_file import read_truth, write_truth
from echogrid.robot import Robot


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    """The map of the shipped sample, as made without a log."""
    folder = tmp_path_factory.mktemp("sample") / "out"
    assert call("map", "--out", folder) == 0
    return folder


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


def test_the_sample_maps_well(run, sample):
    found = scores(run, sample)
    assert found["auc"] > 0.95
    assert found["wiped"] < 0.1
    free, surface, _ = np.bincount(read_truth(TRUTH).cells.ravel())
    assert (found["surface_cells"], found["free_cells"]) == (surface, free)


@pytest.mark.parametrize("name", ["map.npz", "map.yaml"])
def test_score_takes_the_files_of_a_map_as_well(run, sample, name):
    assert scores(run, sample / name)["auc"] == pytest.approx(scores(run, sample)["auc"], abs=0.05)


@pytest.mark.parametrize("shift", [(100.0, 0.0), (0.0, -30.0)])
def test_a_truth_of_another_place_is_one_line_and_nothing_is_printed(run, sample, tmp_path, shift):
    truth = read_truth(TRUTH)
    origin = truth.origin[0] + shift[0], truth.origin[1] + shift[1]
    write_truth(tmp_path / "far.npz", Truth(truth.cells, truth.resolution, origin))
    status, out, err = run("score", sample, tmp_path / "far.npz")
    assert (status, out) == (2, "")
    found = r"echogrid: \S+far\.npz: found a truth of another place, x .* m, expected one of the place of .*\n"
    assert re.fullmatch(found, err)


def test_a_truth_that_the_map_hardly_covers_is_told(run, sample, tmp_path):
    truth = read_truth(TRUTH)
    wide = np.zeros(10 * np.array(truth.cells.shape), np.int8)
    write_truth(tmp_path / "wide.npz", Truth(wide, truth.resolution, truth.origin))
    status, out, err = run("score", sample, tmp_path / "wide.npz")
    assert (status, len(out.splitlines())) == (0, len(SCORES))
    assert re.fullmatch(r"note: the map speaks of [01]\.\d% of the truth's cells alone: is it .*\n", err)


def test_the_summary_names_the_files_and_the_size_that_the_page_and_the_picture_have(run, tmp_path):
    status, out, _ = run("map", "--view", "--out", tmp_path / "out")
    assert status == 0
    (width, height), (facts,) = (
        re.findall(r"map of (\S+) x (\S+) m in \S+/out/map.png, map.html; \S+/map.yaml is for Nav2's", out)[0],
        re.findall(r'id="facts">(.*?)</script>', (tmp_path / "out" / "map.html").read_text(), re.DOTALL),
    )
    assert [f"{metres:.1f}" for metres in json.loads(facts)["size"]] == [width, height]
    observed = np.argwhere(arrays(tmp_path / "out")["observed"])
    rows, cols = np.ptp(observed, axis=0) + 1
    assert (width, height) == (f"{cols * 0.04:.1f}", f"{rows * 0.04:.1f}")


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


@pytest.mark.parametrize(("frames", "reading"), [(1, "1.0"), (1, "inf")])
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
