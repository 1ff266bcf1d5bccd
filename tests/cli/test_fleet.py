import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

pytest.importorskip("distributed", reason="found no dask.distributed")
pytest.importorskip("zarr", reason="found no zarr")

from benchmarks.fleet import one_process, tiles
from commands import MAP_FILES, assert_refused, everything
from echogrid.cli.fleet import _tell
from echogrid.extras import EXTRAS
from echogrid.fleet import engine
from echogrid.fleet.job import Outcome
from echogrid.fleet.store import Store
from echogrid.output.map_file import read_map
from fleet_samples import PIECES, ROBOT, filled, logs, shifted


@pytest.fixture(scope="module")
def scheduler():
    with engine.local(1) as (address, _):
        yield address


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working folder with logs."""
    monkeypatch.chdir(tmp_path)
    logs(tmp_path)
    return tmp_path


LOGS = [f"drive{k}.csv" for k in range(5)]


def test_logs_go_in_a_map_comes_out_and_what_was_done_is_not_done_again(here, run, scheduler):
    fleet = ["--robot", "b21", "--out", "store", "--scheduler", scheduler]
    status, out, _ = run("fleet", *LOGS[:3], *fleet)
    assert status == 0
    assert re.fullmatch(r"store: of 3 logs 3 added in \d+\.\d s; 3 logs with 450 scans count\n", out)
    status, out, _ = run("fleet", *LOGS, *fleet)
    assert status == 0
    assert "of 5 logs 2 added, 3 there already" in out
    status, out, err = run("tiles", "store", "--out", "house")
    assert (status, err) == (0, "")
    assert {path.name for path in (here / "house").iterdir()} == MAP_FILES
    ours, theirs = read_map(here / "house"), one_process([here / name for name in LOGS], ROBOT).observed_part()
    assert theirs is not None
    assert ours.origin == pytest.approx(theirs.origin)
    clipped = np.clip(theirs.log_odds, ours.log_odds.min(), ours.log_odds.max())
    np.testing.assert_allclose(ours.log_odds, clipped, atol=1e-3)
    record = yaml.safe_load((here / "house" / "run.yaml").read_text())
    assert sorted(record["logs"]) == LOGS
    assert yaml.safe_load(record["robot"])["name"] == "b21"


def test_a_log_that_cannot_be_read_is_told_and_the_rest_goes_on(here, run, scheduler):
    (here / "bad.csv").write_text("garbage\n")
    (here / "same.csv").write_bytes((here / LOGS[0]).read_bytes())
    status, out, err = run(
        "fleet", "gone.csv", "bad.csv", LOGS[0], "same.csv", "--robot", "b21", "--out", "store",
        "--scheduler", scheduler,
    )  # fmt: skip
    assert status == 2
    assert "of 4 logs 1 added, 1 there already, 2 refused" in out or "of 4 logs 2 added, 2 refused" in out
    lines = [line for line in err.splitlines() if not line.startswith("dashboard")]
    assert lines == [
        f"echogrid: {here}/bad.csv:1: found 'garbage', expected a CARMEN log (# ..., ODOM ..., SONAR ...) or a "
        "CSV log (t,x,y,theta,r0,...) or a bag of ROS",
        f"echogrid: {here}/gone.csv: found no such file, expected a log",
        f"note: same.csv: the same log as {LOGS[0]}: it counts once",
    ]
    assert len(Store(here / "store").records()) == 1


def test_logs_are_taken_out_by_content_or_by_name(here, run):
    store = filled(here / "store", [here / name for name in LOGS[:3]])
    (here / LOGS[0]).rename(here / "renamed.csv")
    (here / LOGS[1]).unlink()
    assert "drive4.csv: found a log that is not in it" in assert_refused(
        run, here, "fleet", "renamed.csv", "drive4.csv", "--out", "store", "--remove"
    )
    status, out, _ = run("fleet", "renamed.csv", LOGS[1], "--out", "store", "--remove")
    assert (status, out) == (0, "store: 2 logs taken out; 1 log count\n")
    assert tiles(store) == tiles(filled(here / "other", [here / LOGS[2]]))


def test_logs_of_one_name_whose_files_are_gone_are_taken_out_by_their_hashes(here, run):
    for day, name in (("monday", LOGS[0]), ("tuesday", LOGS[1])):
        (here / day).mkdir()
        (here / name).rename(here / day / "drive.csv")
    store = filled(here / "store", [here / day / "drive.csv" for day in ("monday", "tuesday")])
    for day in ("monday", "tuesday"):
        (here / day / "drive.csv").unlink()
    line = assert_refused(run, here, "fleet", "drive.csv", "--out", "store", "--remove")
    hashes = re.findall(r"\b[0-9a-f]{12}\b", line)
    assert sorted(hashes) == sorted(record.log[:12] for record in store.records())
    status, out, _ = run("fleet", hashes[0], "--out", "store", "--remove")
    assert (status, out) == (0, "store: 1 log taken out; 1 log count\n")
    assert [record.log[:12] for record in store.records()] == hashes[1:]


def test_a_log_that_held_something_else_before_is_told(here, run, scheduler):
    fleet = ["fleet", LOGS[0], "--robot", "b21", "--out", "store", "--scheduler", scheduler]
    run(*fleet)
    (earlier,) = Store(here / "store").records()
    (here / LOGS[0]).write_bytes((here / LOGS[1]).read_bytes())
    status, _, err = run(*fleet)
    assert status == 0
    assert f"which counts still; if it is to go: --remove {earlier.log[:12]}" in err


@pytest.mark.parametrize(("factor", "column", "told"), [(180 / np.pi, 3, "it has to be in radians"),
                                                        (1000.0, slice(1, 3), "faster than 10 m/s"),
                                                        (0.001, slice(4, None), "below min_range")])  # fmt: skip
def test_a_log_whose_numbers_are_not_what_it_says_is_refused(here, run, scheduler, factor, column, told):
    head, *rows = (here / LOGS[0]).read_text().splitlines()
    values = np.array([[float(value) for value in row.split(",")] for row in rows])
    values[:, column] *= factor
    (here / "odd.csv").write_text("\n".join([head, *(",".join(f"{v:.6f}" for v in row) for row in values), ""]))
    status, _, err = run("fleet", LOGS[1], "odd.csv", "--robot", "b21", "--out", "store", "--scheduler", scheduler)
    assert status == 2
    assert told in err
    assert "it was not mapped" in err
    assert [record.name for record in Store(here / "store").records()] == [LOGS[1]]


def test_a_part_is_asked_for_in_metres(here, run):
    filled(here / "store", [here / LOGS[0]])
    status, out, err = run("tiles", "store", "--region=-1,0,2,1.6", "--out", "part")
    assert (status, err) == (0, "")
    assert "map of 3.0 x 1.6 m" in out
    part = read_map(here / "part")
    assert (part.origin, part.resolution) == (pytest.approx((-1.0, 0.0)), 0.04)
    status, out, _ = run("tiles", "store", "--region=-1,0,2,1.6", "--out", "part", "--resolution", "0.1")
    assert read_map(here / "part").shape == (16, 30)


def test_two_stores_are_compared(here, run):
    for day, names in (("monday", LOGS[:2]), ("tuesday", LOGS[2:4])):
        filled(here / day, [here / name for name in names])
    status, out, _ = run("changes", "monday", "tuesday", "--out", "diff")
    assert status == 0
    assert re.search(r"\d+ areas became occupied, \d+ free, of \d+\.\d m2 that both saw", out)
    assert {path.name for path in (here / "diff").iterdir()} == {"changes.csv", "changes.png"}


@pytest.mark.parametrize(
    "args",
    [
        ["fleet", "--out", "store"],
        ["fleet", "drive0.csv", "--out", "store", "--poses", "nowhere"],
        ["fleet", "drive0.csv", "drive1.csv", "--out", "store", "--poses", "drive0.csv"],
        ["fleet", "drive0.csv", "--out", "store", "--poses", "drive0.csv", "--localise", "map"],
        ["fleet", "drive0.csv", "--out", "store", "--start", "0,0,0"],
        ["fleet", "drive0.csv", "--out", "store", "--localise", "nowhere"],
        ["fleet", "drive0.csv", "--out", "store", "--localise", "store"],
        ["fleet", "drive0.csv", "--out", "store", "--workers", "0"],
        ["fleet", "drive0.csv", "--out", "store", "--robot", "nobody"],
        ["fleet", "drive0.csv", "--out", "drive1.csv"],
        ["fleet", "drive0.csv", "--out", "."],
        ["fleet", "drive0.csv", "--out", "store", "--remove"],
        ["tiles", "nowhere"],
        ["tiles", "full", "--region", "1,2,3"],
        ["tiles", "full", "--region", "1,2,0,3"],
        ["tiles", "full", "--region", "100,100,101,101"],
        ["tiles", "full", "--region", "1e300,0,2e300,1"],
        ["tiles", "full", "--resolution", "0"],
        ["changes", "full", "nowhere"],
    ],
    ids=lambda args: " ".join(args[:1] + args[-2:]),
)
def test_what_cannot_be_is_refused_and_nothing_is_written(here, run, args):
    filled(here / "full", [here / LOGS[0]])
    assert_refused(run, here, *args)


def test_without_the_extra_the_line_says_which(here):
    hide = f"import sys; sys.modules |= dict.fromkeys({[*EXTRAS['fleet'].values()]!r})\n"
    before = everything(here)
    for command in (["fleet", "drive0.csv", "--out", "store"], ["tiles", "store"], ["changes", "a", "b"]):
        code = f"{hide}from echogrid.cli import main; main({command!r})"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        expected = f"echogrid: {command[0]}: found no dask.distributed, expected it: pip install 'echogrid[fleet]'\n"
        assert (done.returncode, done.stdout, done.stderr) == (2, "", expected)
    assert everything(here) == before


def test_many_logs_that_fail_alike_are_told_in_one_line(tmp_path, capsys):
    outcomes = [Outcome(f"{k}.csv", "refused", where=f"{k}.csv", reason="found x, expected y") for k in range(4)]
    noted = [Outcome(f"n{k}.csv", "added", hash=str(k), notes=(f"doubt {k}", "the same")) for k in range(30)]
    _tell(outcomes + noted, tmp_path)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "echogrid: 0.csv and 3 logs more: found x, expected y"
    assert "note: n0.csv and 29 logs more: the same" in lines
    assert lines[-1] == f"note: 21 notes more are in {tmp_path}/logs, under notes"
    assert len(lines) == 12


@pytest.mark.slow
def test_a_command_that_is_stopped_or_killed_goes_on_and_every_log_counts_once(here):
    """Stopped and killed at any time; what it leaves is what it would have been."""
    pieces = [shifted(PIECES[k % 5], 0.01 * k, 0.0) for k in range(40)]
    (here / "logs").mkdir()
    paths = logs(here / "logs", pieces)
    calm = tiles(filled(here / "calm", paths))
    code = "from echogrid.cli import main\nif __name__ == '__main__': main()"
    command = [sys.executable, "-c", code, "fleet", *map(str, paths), "--robot", "b21", "--out", "store"]
    rng, stops, left = np.random.default_rng(0), 0, []
    while not left or left[-1] < len(paths):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
            if stops < 8:
                time.sleep(rng.uniform(2, 6))
                process.send_signal(signal.SIGKILL if stops % 2 else signal.SIGINT)
            assert process.stderr is not None
            err = process.stderr.read()
        stops += 1
        assert "Traceback" not in err
        left.append(len(Store(here / "store").records()) if (here / "store" / "store.json").exists() else 0)
    assert left == sorted(left)
    assert stops >= 5
    store = Store(here / "store")
    assert tiles(store) == calm
    assert {path.stem for path in (store.path / "sums").glob("[!.]*")} == {record.sums for record in store.records()}
