"""A help in whole sentences, with examples; completion by tab; the README as it is printed."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import venv
from itertools import pairwise
from pathlib import Path

import pytest

from bag_writers import drive, sample, write
from commands import LOG, ROBOT, SOURCE, put
from echogrid.cli.commands import COMMANDS
from echogrid.cli.helping import EXAMPLES
from echogrid.mapping.registry import MODELS
from echogrid.robot import preset_names
from echogrid.simulation.world import world_names

README = SOURCE.parent / "README.md"


def paragraphs(text):
    """The texts of a help's options, as wide as they come."""
    return re.findall(r"│ +(.*?) +│", text)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_default_is_none_and_no_sentence_is_broken(run, monkeypatch, command):
    monkeypatch.setenv("COLUMNS", "1000")
    text = run(command, "--help")[1]
    assert "default: None" not in text
    assert "(default: )" not in text
    assert "echogrid[" not in text
    options = [re.split(r" {2,}", line)[-1] for line in paragraphs(text)]
    options = [text for text in options if not text.startswith(("─", "-")) and not text.startswith("show this help")]
    assert len(options) > 1
    assert [line for line in options if not re.search(r"(?:[.)]|\(required\))$", line)] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_end_the_help_and_parse(run, command):
    text = run(command, "--help")[1]
    shown = text.partition("\nexamples:\n")[2]
    assert [line.strip() for line in shown.splitlines()] == EXAMPLES[command].strip().splitlines()
    commands = [shlex.split(line, comments=True)[1:] for line in EXAMPLES[command].strip().splitlines()]
    assert commands[-1 if command == "score" else 0][0] == command
    assert [words for words in commands if run(*words, "--help")[0]] == []


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("command", [None, *COMMANDS])
def test_no_line_of_a_help_is_wider_than_the_terminal_or_breaks_a_sentence(run, monkeypatch, width, command):
    monkeypatch.setenv("COLUMNS", str(width))
    text = run(*([command] if command else []), "--help")[1].partition("examples:")[0]
    # The names of all commands are one word.
    assert [line for line in text.splitlines() if len(line) > width and not line.startswith("{map,")] == []
    outside = re.sub(r"^[│╭╰].*\n", "", text, flags=re.MULTILINE).rstrip()
    for paragraph in outside.split("\n\n"):
        lines = paragraph.splitlines()
        for line, following in pairwise(lines):  # broken only where the next word has no room
            assert len(line) + 1 + len(following.split()[0]) > width
        assert len(lines) == 0 or lines[0].startswith("usage: ") or lines[-1].endswith(".")


def test_the_help_of_all_ends_with_where_to_begin(run):
    assert [run(*args)[1].partition("\nexamples:\n")[2] for args in (["--help"], ["-h"])] == [
        "".join(f"  {line}\n" for line in EXAMPLES[""].strip().splitlines())
    ] * 2


def completed(shell_script, *words, folder):
    """What bash offers for the last of some words."""
    code = f"""
source {shell_script}
COMP_WORDS=({" ".join(f"'{word}'" for word in words)}); COMP_CWORD={len(words) - 1}
_echogrid; echo "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(["bash", "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="found no bash")
def test_tab_completes_commands_options_presets_models_and_worlds(run, tmp_path):
    status, out, err = run("--tyro-print-completion", "bash")
    assert (status, err) == (0, "")
    script = put(tmp_path / "script", out)

    def offered(*words):
        return completed(script, "echogrid", *words, folder=tmp_path)

    assert offered("") == list(COMMANDS)
    assert offered("s") == [name for name in COMMANDS if name.startswith("s")]
    assert offered("map", "--robot", "") == list(preset_names())
    assert offered("map", "drive.csv", "--robot", "n") == [name for name in preset_names() if name.startswith("n")]
    assert set(offered("map", "--interpreter", "")) == set(MODELS)
    assert offered("map", "--pgm", "") == ["trinary", "scale", "raw"]
    assert offered("simulate", "") == list(world_names())
    assert offered("map", "") == offered("map", "--robot", "my-r") == []  # files, which the shell itself completes
    for command in COMMANDS:
        text = run(command, "--help")[1]
        there = set(re.findall(r"(?<![\w-])--[a-z][\w.-]*", text.partition("examples:")[0]))
        assert there - {"--rerun"} <= set(offered(command, "--"))


def test_a_shell_that_is_not_known_is_one_line(run):
    status, _, err = run("--tyro-print-completion", "dash")
    assert (status, err) == (2, "echogrid: --tyro-print-completion: found dash, expected bash or zsh\n")


def as_made(folder: Path) -> None:
    """A folder as make setup leaves it, with what the README's commands take."""
    venv.EnvBuilder(symlinks=True, with_pip=False).create(folder / ".venv")
    command = f"#!/bin/sh\nexec {sys.executable} -c 'from echogrid.cli import main; main()' \"$@\"\n"
    put(folder / ".venv" / "bin" / "echogrid", command).chmod(0o755)
    write(folder / "drive.bag", drive(sample(30)), "bag")
    put(folder / "drive.csv", LOG)
    put(folder / "my-robot.yaml", ROBOT)
    shutil.copy(SOURCE / "echogrid" / "weights" / "set.npz", folder / "mine.npz")


def test_the_commands_of_the_readme_run_as_printed(tmp_path):
    as_made(tmp_path)
    lines = re.findall(r"^ {4}((?:\. \.venv/bin/activate|echogrid)\b.*)", README.read_text(), re.MULTILINE)
    assert lines[0].startswith(". .venv/bin/activate")
    long = [line for line in lines if line.startswith(("echogrid live", "echogrid train"))]
    assert len(lines) - len(long) >= 8
    script = "set -e\n" + "\n".join(line for line in lines if line not in long)
    done = subprocess.run(
        ["sh", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "scan" / "scan.png").exists()


def test_make_says_what_takes_long_before_it_does(tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(SOURCE.parent / name, tmp_path)

    # These tests may themselves be run by make, which tells those below it how to talk.
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS"))}

    def planned(*targets):
        command = ["make", f"PYTHON={sys.executable}", *targets]
        return subprocess.run(command, cwd=tmp_path, env=alone, capture_output=True, text=True, check=True).stdout

    for target in ("map", "test"):
        lines = planned("-n", target).splitlines()
        told = [number for number, line in enumerate(lines) if line.startswith('echo "make: ')]
        venv_made = next(number for number, line in enumerate(lines) if "-m venv" in line)
        assert told[0] == venv_made - 1
        assert told[-1] == len(lines) - 2  # what the target itself does is the last line
    assert "--quiet" not in planned("-n", "setup")
    assert re.search(r"^make test .*\d+ minutes", planned(), re.MULTILINE)
    there = set(re.findall(r"^make (\w+)", planned(), re.MULTILINE))
    assert set(re.findall(r"^ {4}make (\w+)", README.read_text(), re.MULTILINE)) <= there
