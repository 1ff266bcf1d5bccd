from pathlib import Path

import pytest

from commands import LOG, MAP_FILES, ROBOT, WORLD, Run, call, put


@pytest.fixture
def run(capsys) -> Run:
    """Run a command in this process: its exit status, and what it wrote to stdout and stderr."""

    def command(*args: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = call(*args)
        written = capsys.readouterr()
        return status, written.out, written.err

    return command


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
