"""What a run leaves when it is told to end from outside."""

import signal
import subprocess
import sys

import pytest

from commands import MAP, MAP_FILES, assert_refused, everything

IMPORTING = """
import os, signal, sys
from echogrid.cli import main

class Finder:
    def find_spec(self, name, *_):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Finder())
main(["map", "--view", "--out", sys.argv[2]])
"""

COLLECTING = """
import gc, os, signal, sys
from echogrid.cli import main
from echogrid.output.page import Page

def collect(*_):
    if Page in map(type, gc.get_referrers(Page)) or sys.modules.get("echogrid.mapping.build"):
        gc.callbacks.remove(collect)
        os.kill(os.getpid(), signal.SIGINT)

gc.callbacks.append(collect)
main(["map", "--view", "--out", sys.argv[2]])
"""

MAPPING = """
import os, sys, time
from echogrid.cli import main
from echogrid.output.page import Page
from echogrid.output.mcap_file import Recorder

def end(self, grid):
    os.kill(os.getpid(), int(sys.argv[1]))
    time.sleep(5)

Page.keep = end
main(["map", "--view", "--mcap", "--out", sys.argv[2]])
"""


def ended(code, *args):
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("module", ["numpy", "tyro", "echogrid.cli.maps", "echogrid._core", "matplotlib"])
def test_ctrl_c_during_an_import_is_one_line(tmp_path, module):
    done = ended(IMPORTING, module, tmp_path / "out")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "echogrid: stopped\n")
    assert everything(tmp_path) == {}


def test_ctrl_c_while_python_collects_garbage_is_not_lost(tmp_path):
    done = ended(COLLECTING, "", tmp_path / "out")
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "echogrid: stopped\n")
    assert everything(tmp_path) == {}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_leaves_everything_as_it_was(tmp_path, number):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "map.html").write_text("old")
    before = everything(tmp_path)
    done = ended(MAPPING, int(number), tmp_path / "out")
    assert (done.returncode, done.stderr) == (128 + number, "echogrid: stopped\n")
    assert everything(tmp_path) == before


def test_a_signal_that_is_to_be_ignored_is_ignored(tmp_path):
    ignoring = f"import signal; signal.signal({int(signal.SIGHUP)}, signal.SIG_IGN)"
    done = ended(ignoring + MAPPING.replace("sleep(5)", "sleep(0)"), int(signal.SIGHUP), tmp_path / "out")
    assert (done.returncode, done.stderr) == (0, "")


def test_what_a_killed_run_left_goes_with_the_next(run, tmp_path):
    assert ended(MAPPING, int(signal.SIGKILL), tmp_path).returncode == -signal.SIGKILL
    left = {path.name for path in tmp_path.iterdir()}
    assert {name.rpartition(".")[2] for name in left} == {"html", "mcap"}
    assert run("map", "--out", tmp_path)[0] == 0
    assert {path.name for path in tmp_path.iterdir()} == MAP_FILES


@pytest.mark.parametrize("name", ["map.png", "run.yaml", "map.html", "map.mcap"])
def test_a_folder_that_cannot_be_written_is_found_before_the_mapping(run, place, monkeypatch, name):
    def build_map(*_: object) -> None:
        pytest.fail("it was mapped")

    monkeypatch.setattr("echogrid.mapping.build.build_map", build_map)
    (place / "new" / name).mkdir(parents=True)
    err = assert_refused(run, place, *MAP, "--out", "new", "--view", "--mcap")
    assert err.startswith(f"echogrid: new/{name}: found a folder")


def test_what_shows_an_older_map_goes_with_it(run, place):
    for name in ("map.html", "map.mcap", "map.rrd", "mine.html"):
        (place / "out" / name).write_text("old")
    status, _, err = run(*MAP, "--mcap")
    assert (status, err) == (0, "note: removed map.html, map.rrd of an older map from out\n")
    assert {path.name for path in (place / "out").iterdir()} >= MAP_FILES | {"map.mcap", "mine.html"}
    assert not (place / "out" / "map.html").exists()
    recording = (place / "out" / "map.mcap").read_bytes()
    status, _, err = run("map", "out/map.mcap", "--out", "out")
    assert (status, err) == (0, "")
    assert (place / "out" / "map.mcap").read_bytes() == recording


def test_a_run_that_fails_removes_nothing(run, place):
    (place / "out" / "map.html").write_text("old")
    (place / "drive.csv").write_text("t,x,y,theta,r0,r1\n0,0,0,0,1\n")
    assert_refused(run, place, *MAP)
