"""What a killed run leaves goes with the next; what a live run holds stays."""

import subprocess
import sys

import pytest

from echogrid.files import check_writable, replacing
from echogrid.temporary import beside, sweep

HOLD = """
import sys, time
from pathlib import Path
from echogrid.temporary import beside
with beside(Path(sys.argv[1]), folder=sys.argv[2] == "folder") as held:
    if held.is_dir():
        (held / "content").write_text("mine")
    print(held.name, flush=True)
    time.sleep(60)
"""


def holder(target, kind):
    """Another run that holds a temporary file or folder for a target, and the name of that."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, target, kind], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline().strip()


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_live_run_holds_stays_and_what_it_left_when_killed_goes(tmp_path, kind):
    target = tmp_path / "map.mcap"
    process, name = holder(target, kind)
    try:
        sweep(target)
        with replacing(target) as new:
            assert {path.name for path in tmp_path.iterdir()} == {name, new.name}
            new.write_text("new")
        assert {path.name for path in tmp_path.iterdir()} == {name, "map.mcap"}
    finally:
        process.kill()
        process.communicate()
    assert (tmp_path / name).exists()
    check_writable(target)
    assert {path.name for path in tmp_path.iterdir()} == {"map.mcap"}


@pytest.mark.parametrize(
    "name",
    [".map.0123456.mcap", ".map.01234567.rrd", ".map.01234567.mcap.txt", "map.01234567.mcap", ".map.x1234567.mcap"],
)
def test_files_of_others_stay(tmp_path, name):
    (tmp_path / name).write_text("theirs")
    (tmp_path / ".map.01234567.mcap").write_text("left")
    sweep(tmp_path / "map.mcap")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_link_by_such_a_name_is_not_followed(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").write_text("mine")
    (tmp_path / ".map.01234567.mcap").symlink_to(tmp_path / "precious")
    sweep(tmp_path / "map.mcap")
    assert (tmp_path / "precious" / "file").read_text() == "mine"


def test_a_folder_goes_with_all_in_it_when_the_block_raises(tmp_path):
    def fail_half_way():
        with beside(tmp_path / "map.mcap", folder=True) as folder:
            (folder / "bag").mkdir()
            (folder / "bag" / "file").touch()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert list(tmp_path.iterdir()) == []
