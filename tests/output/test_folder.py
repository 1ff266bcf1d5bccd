"""What is ours by name in the folder of a map."""

import pytest

from echogrid.errors import UsageError
from echogrid.output.folder import ALWAYS, ASKED_FOR, check_folder, drop_stale


@pytest.mark.parametrize("written", [(), ("map.html",), ("map.mcap", "map.rrd"), ASKED_FOR])
def test_what_was_not_written_with_the_map_is_removed_and_nothing_else(tmp_path, written):
    others = {*ALWAYS, "map.htm", "mine.html", "map.html.bak"}
    for name in {*others, *ASKED_FOR}:
        (tmp_path / name).touch()
    assert drop_stale(tmp_path, written) == [name for name in ASKED_FOR if name not in written]
    assert {path.name for path in tmp_path.iterdir()} == others | set(written)
    assert drop_stale(tmp_path, written) == []


def test_the_log_that_was_mapped_stays(tmp_path):
    (tmp_path / "map.mcap").touch()
    (tmp_path / "map.rrd").touch()
    assert drop_stale(tmp_path, (), str(tmp_path / "." / "map.mcap")) == ["map.rrd"]
    assert [path.name for path in tmp_path.iterdir()] == ["map.mcap"]


def test_a_folder_of_such_a_name_stays(tmp_path):
    (tmp_path / "map.html").mkdir()
    assert drop_stale(tmp_path) == []
    assert (tmp_path / "map.html").is_dir()


@pytest.mark.parametrize("name", [*ALWAYS, *ASKED_FOR])
def test_a_place_that_is_taken_is_found_where_it_matters(tmp_path, name):
    check_folder(tmp_path, ASKED_FOR)
    (tmp_path / name).mkdir()
    with pytest.raises(UsageError, match=f"{name}: found a folder, expected a file that can be written"):
        check_folder(tmp_path, ASKED_FOR)
    if name in ASKED_FOR:
        check_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name]
