"""The command as a whole: what stops it from outside, its help, and the examples of the documents."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
import pytest

from commands import GOOD, MAP, SAMPLE, SIMULATE, SOURCE, arrays, everything, put, rows, scores
from echogrid import __version__
from echogrid.cli.commands import COMMANDS
from echogrid.frame import Frame
from echogrid.grid import sigmoid
from echogrid.mapping.registry import MODELS
from echogrid.robot import parse_robot
from echogrid.simulation.world import world_names
from echogrid.yaml_keys import parse_yaml


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
    # The log says where the sonars are, but not how large the robot is.
    said, file = (parse_robot(parse_yaml((tmp_path / out / "run.yaml").read_text(), out)["robot"], out)
                  for out in ("out-as-the-log-says", "out"))  # fmt: skip
    np.testing.assert_allclose(said.mounts, file.mounts, atol=1e-6)
    assert said.footprint_radius_m <= file.footprint_radius_m
    assert np.mean(np.abs(sigmoid(csv["log_odds"]) - sigmoid(own["log_odds"])) > 0.3) < 0.02
