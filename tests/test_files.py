"""A file is replaced whole or not at all."""

import os

import pytest

from echogrid.errors import UsageError
from echogrid.files import replacing


def everything_in(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_replacing_swaps_the_file_when_the_block_ends_and_not_before(tmp_path):
    target = tmp_path / "a.csv"
    target.write_text("old")
    with replacing(target) as new:
        assert (new.parent, new.suffix) == (tmp_path, ".csv")
        new.write_text("new")
        assert target.read_text() == "old"
    assert everything_in(tmp_path) == {"a.csv": b"new"}


def test_replacing_leaves_the_old_file_when_the_block_raises(tmp_path):
    target = tmp_path / "a.csv"
    target.write_text("old")

    def fail_half_way():
        with replacing(target) as new:
            new.write_text("ne")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert everything_in(tmp_path) == {"a.csv": b"old"}


def test_replacing_follows_a_link_and_gives_the_rights_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with replacing(tmp_path / "link") as new:
        new.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"
    assert (tmp_path / "target").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("place_", ["", "none/a.csv", "pipe", "file/a.csv", "n" * 300])
def test_replacing_refuses_what_is_not_a_place_for_a_file(tmp_path, place_):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    with pytest.raises(UsageError), replacing(tmp_path / place_):
        pytest.fail("the block must not run")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "pipe"]
    assert (tmp_path / "pipe").is_fifo()
