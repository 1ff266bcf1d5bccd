"""What works where the extra ``train`` is not installed, and what is said where it does not."""

import os
import re
import subprocess
import sys

import pytest

from bag_samples import DRIVE
from bag_writers import write_mcap
from commands import MAP_FILES, SAMPLE, TRUTH, everything, put, told
from echogrid.extras import EXTRAS
from echogrid.mapping.registry import MODELS

HIDE = f"import sys; sys.modules |= dict.fromkeys({['jaxlib', *EXTRAS['train'].values()]!r})\n"
"""Code that makes Python say that there is no such module."""

WITHOUT = ["set-network", "network", "em"]
WITH = sorted(MODELS.keys() - WITHOUT)

LACKING = r": found no JAX, expected it: pip install 'echogrid\[train\]'"


def python(folder, code, *args):
    """A Python that has no JAX, run in a folder: its exit status and both streams."""
    command = [sys.executable, "-c", HIDE + code, *map(str, args)]
    alone = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run(command, cwd=folder, env=alone, capture_output=True, text=True, timeout=120, check=False)
    return done.returncode, done.stdout, done.stderr


def echogrid(folder, *args):
    return python(folder, "from echogrid.cli import main; main(sys.argv[1:])", *args)


@pytest.mark.parametrize(
    "args",
    [
        ["simulate", "lab", "--robot", "b21", "--out", "drive.csv"],
        ["scan", "lab", "--at", "1,0.8", "--out", "scan"],
        ["train", "--robot", "b21", "--drives", "1", "--epochs", "1", "--out", "mine.npz"],
    ],
    ids=lambda args: args[0],
)
def test_commands_that_need_it_say_so_before_anything_is_written(tmp_path, args):
    status, out, err = echogrid(tmp_path, *args)
    assert (status, out) == (2, "")
    assert re.fullmatch(f"echogrid: {args[0]}{LACKING}\n", err)
    assert everything(tmp_path) == {}


def test_so_does_training_without_optax(tmp_path):
    code = "del sys.modules['jax'], sys.modules['jaxlib']\nfrom echogrid.cli import main; main(sys.argv[1:])"
    status, _, err = python(tmp_path, code, "train", "--robot", "b21", "--out", "mine.npz")
    assert (status, err) == (2, "echogrid: train: found no optax, expected it: pip install 'echogrid[train]'\n")


def test_so_do_the_classical_models(tmp_path):
    """All but one, in one Python, for each start of it takes its time."""
    code = """
from echogrid.cli import main
for model in sys.argv[1:]:
    try:
        main(["map", "--interpreter", model])
    except SystemExit as ended:
        print(model, ended.code)
"""
    status, out, err = python(tmp_path, code, *WITH)
    assert (status, out.splitlines()) == (0, [f"{model} 2" for model in WITH])
    assert re.fullmatch(f"(echogrid: interpreter{LACKING}\n){{{len(WITH)}}}", err)
    assert everything(tmp_path) == {}


def test_so_does_the_library(tmp_path):
    code = """
import numpy as np
from echogrid import EchogridError, Robot, World, build_map
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.simulate import Simulator, rotary_scan
def train():
    import echogrid.training.gradient_descent
robot, world = Robot.load("b21"), World.load("lab")
for asked in (
    lambda: next(Simulator(world, robot).frames(np.zeros((1, 3)), 0)),
    lambda: rotary_scan(world, robot.transducer, 5.0, (1.0, 0.8), Physics()),
    lambda: build_map([], robot, model="cone"),
    train,
):
    try:
        asked()
    except EchogridError as error:
        assert isinstance(error, ImportError)
        print(error)
"""
    status, out, err = python(tmp_path, code)
    assert (status, err) == (0, "")
    wheres = ["simulate", "simulate", "interpreter", "train"]
    assert re.fullmatch("".join(f"{where}{LACKING}\n" for where in wheres), out)


@pytest.mark.parametrize("network", ["set-network", "network"])
def test_the_sample_is_mapped_in_full_and_scored(tmp_path, network):
    status, _, err = echogrid(tmp_path, "map", "--view", "--mcap", "--interpreter", network)
    assert (status, err) == (0, "")
    assert {path.name for path in (tmp_path / "out").iterdir()} == MAP_FILES | {"map.html", "map.mcap"}
    status, out, err = echogrid(tmp_path, "score", "out", TRUTH)
    assert (status, err) == (0, "")
    assert float(told(out)["found"]) > 0.9


def test_a_bag_is_mapped(tmp_path):
    write_mcap(tmp_path / "drive.mcap", DRIVE)
    status, _, err = echogrid(tmp_path, "map", "drive.mcap")
    assert (status, err) == (0, "")
    assert {path.name for path in (tmp_path / "out").iterdir()} == MAP_FILES


def test_em_maps(tmp_path):
    put(tmp_path / "short.csv", "".join(SAMPLE.read_text().splitlines(keepends=True)[:20]))
    assert echogrid(tmp_path, "map", "short.csv", "--robot", "b21", "--interpreter", "em")[0] == 0


def test_help_completion_info_live_and_scan_by_scan_are_as_ever(tmp_path):
    code = """
import numpy as np
from echogrid import Frame, Mapper, Robot
from echogrid.cli import commands, main
from echogrid.live import live_map, session
for args in (*([name, "--help"] for name in ("", *commands.COMMANDS)), ["--version"],
             ["--tyro-print-completion", "bash"], ["info", sys.argv[1]]):
    try:
        main([arg for arg in args if arg])
    except SystemExit as ended:
        assert ended.code in (0, None)
mapper = Mapper(Robot.load("p3dx"))
mapper.add([Frame(0.0, np.zeros(3), np.full(16, 1.5))])
assert mapper.around(0.0, 0.0, 4.0).observed.any()
"""
    status, out, err = python(tmp_path, code, SAMPLE)
    assert (status, err) == (0, "")
    assert "complete -o default -F _echogrid echogrid" in out
    assert told(out)["frames"].startswith("521")
