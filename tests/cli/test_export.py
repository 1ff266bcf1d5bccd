"""The command that writes C for a microcontroller, and what it refuses."""

import re
import shutil
import subprocess

import pytest

from commands import ROBOT, assert_refused, everything, put
from echogrid.microcontroller.source import FILES


def test_the_files_are_written_and_what_they_take_is_said(run, place):
    status, out, err = run("export", "--c", "firmware/c", "--robot", "duo.yaml", "--side", 3, "--cell", 0.12)
    assert (status, err) == (0, "")
    head, flash, ram, _ = out.splitlines()
    assert head == "firmware/c/echogrid.c: 3 x 3 m in 25 x 25 cells round duo (2 sonars)"
    assert re.fullmatch(r"flash: \d+ bytes of tables, about \d+ of code", flash)
    assert re.fullmatch(r"RAM: \d+ bytes, sizeof\(struct echogrid\), and about \d+ of stack", ram)
    assert set(everything(place / "firmware" / "c")) == set(FILES)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="found no gcc")
@pytest.mark.parametrize("folder", [".", "firmware", "mine & 'yours'"])
def test_the_command_that_is_printed_draws_a_map(run, place, folder):
    _, out, _ = run("export", "--c", folder, "--robot", "p3dx", "--side", 5)
    command = out.splitlines()[-1].removeprefix("try it here: ")
    done = subprocess.run(["sh", "-c", command], cwd=place, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    drawn = done.stdout.splitlines()
    assert [len(row) for row in drawn] == [50] * 50
    for across in (drawn[25], "".join(row[25] for row in drawn)):  # free floor up to the walls at 1.5 m and a bit
        assert re.fullmatch(r" +#{1,3} ?\.{30,38} ?#{1,3} +", across)


def test_an_export_replaces_an_earlier_one_and_nothing_else(run, place):
    run("export", "--c", "folder", "--robot", "duo.yaml")
    put(place / "folder" / "mine.c", "mine")
    before = everything(place / "folder")
    assert run("export", "--c", "folder", "--robot", "duo.yaml", "--cell", 0.2)[0] == 0
    after = everything(place / "folder")
    assert set(after) == set(before)
    assert [name for name in FILES if after[name] == before[name]] == []
    assert after["mine.c"] == b"mine"


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_no_export_made_is_not_replaced(run, place, name):
    put(place / "folder" / name, "mine")
    found = f"echogrid: folder/{name}: found a file that no export has made, expected none, or one to replace\n"
    assert assert_refused(run, place, "export", "--c", "folder") == found


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--c", "file"], "file: found a file, expected a folder that can be written"),
        (["--robot", "r2d2"], "robot: found r2d2, expected a file or one of b21, "),
        (["--robot", "many.yaml"], "robot duo: found 70 sonars, expected at most 64"),
        (["--interpreter", "cone"], "--interpreter: found cone, expected set-network or weights of a set network"),
        (["--interpreter", "network"], "--interpreter: found network, expected set-network or weights of"),
        (["--interpreter", "old.npz"], "old.npz: found "),
        (["--cell", "0"], "--cell: found 0, expected 0.02 to 0.5 m"),
        (["--cell", "inf"], "--cell: found inf, expected 0.02 to 0.5 m"),
        (["--side", "-3"], "--side: found -3, expected 1 to 50 m"),
        (["--side", "50", "--cell", "0.02"], "--side: found 2500 cells of 0.02 m, expected 8 to 500"),
    ],
)
def test_what_makes_no_map_is_refused(run, place, arguments, line):
    put(place / "many.yaml", ROBOT.replace("mounts: [", "mounts: [" + "[0, 0, 0], " * 68))
    given = arguments if "--c" in arguments else ["--c", "firmware", *arguments]
    assert assert_refused(run, place, "export", *given).startswith(f"echogrid: {line}")
