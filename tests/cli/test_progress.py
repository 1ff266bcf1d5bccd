"""Progress shows how much there is to do, in each kind of log."""

import gzip
import re
import sys
from functools import partial

import pytest
from tqdm import tqdm

from bag_writers import drive, sample, write
from commands import SAMPLE, put
from echogrid.cli import arguments
from echogrid.logs.formats import load_log
from log_samples import messages, odom, sonar

SCANS = 70


def a_log(kind, folder):
    """A log of some kind: its file, and what is counted in it and how many there are."""
    lines = SAMPLE.read_text().splitlines(keepends=True)[: SCANS + 1]
    if kind == "csv":
        lines.insert(40, "# a comment\n")
        return put(folder / "drive.csv", "".join(["# mine\n", *lines])), SCANS
    if kind == "csv.gz":
        file = folder / "drive.csv.gz"
        file.write_bytes(gzip.compress("".join(lines).encode()))
        return file, SCANS
    if kind == "carmen":
        pairs = ((odom(k / 20, 0, 0, 10 + k / 10), sonar(10 + k / 10)) for k in range(SCANS))
        return put(folder / "drive.log", messages(*(line for pair in pairs for line in pair))), SCANS
    said = drive(sample(SCANS))
    return write(folder / f"drive.{kind}", said, kind), len(said)


@pytest.mark.parametrize("kind", ["csv", "csv.gz", "carmen", "bag", "mcap", "sqlite3"])
def test_a_terminal_sees_the_whole_and_how_far_it_is(run, tmp_path, monkeypatch, kind):
    log, total = a_log(kind, tmp_path)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(arguments, "tqdm", partial(tqdm, mininterval=0, miniters=1))
    status, _, err = run("map", log, "--out", tmp_path / "out")
    assert status == 0, err
    unit = "scan" if total == SCANS else "message"
    seen = [(int(done), int(of)) for done, of in re.findall(rf"mapping:.*? (\d+)/(\d+) \[.*?{unit}", err)]
    assert {of for _, of in seen} == {total}
    counts = [done for done, _ in seen]
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert 0.9 * total <= counts[-1] <= total


def test_a_log_that_is_gone_through_again_begins_again(tmp_path):
    log = load_log(a_log("mcap", tmp_path)[0])
    progress = log.progress
    assert progress is not None
    for _ in range(2):
        frames = iter(log)
        next(frames)
        assert 0 < (progress.done or 0) < progress.total()
        assert len(list(frames)) > 1
        assert progress.done == progress.total()


def test_where_there_is_no_terminal_nothing_is_shown(run, tmp_path):
    assert run("map", a_log("csv", tmp_path)[0], "--robot", "b21", "--out", tmp_path / "out")[2] == ""
