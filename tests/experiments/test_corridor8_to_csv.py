import subprocess
import sys
from math import inf, pi
from pathlib import Path

import pytest

from echogrid.logs.contents import describe
from echogrid.logs.formats import load_log
from echogrid.robot import Robot
from log_samples import put

ROOT = Path(__file__).parents[2]
CORRIDOR8 = ROOT.parent / "shared" / "data" / "corridor8"


def corridor8(*arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "experiments.paper.corridor8_to_csv", *map(str, arguments)]
    return subprocess.run(command, check=False, capture_output=True, text=True, cwd=ROOT)


@pytest.mark.skipif(not CORRIDOR8.is_dir(), reason="the recorded run is not part of the repository")
def test_the_recorded_corridor_becomes_a_csv_log(tmp_path):
    path = tmp_path / "corridor8.csv"
    result = corridor8(CORRIDOR8, path)
    assert (result.returncode, result.stderr) == (0, "")
    log = load_log(path, Robot.load(ROOT / "experiments" / "common" / "corridor8.yaml"))
    info = describe(log)
    assert (info.frames, info.sonars, info.start_s) == (413, 8, 0.0)
    assert info.span_s == pytest.approx(92.8, abs=0.05)
    assert info.length_m == pytest.approx(25, abs=0.2)
    assert info.no_echo == pytest.approx(0.33, abs=0.01)
    assert info.no_echo_by_sonar[4] == pytest.approx(0.81, abs=0.01)
    first = next(iter(log))
    assert first.ranges.tolist() == [inf, inf, 2.32, 2.36, inf, inf, 2.16, 1.19]
    # The run turns right at the end of the first leg.
    assert min(frame.pose[2] for frame in log) < -pi / 4


def test_the_corridor_script_says_in_one_line_what_is_wrong(tmp_path):
    put(tmp_path, "0 1 1 1 1 1 1 1 1\n", "measurement.txt")
    put(tmp_path, "7 0 0 0\n", "poses.txt")
    for folder in (tmp_path, tmp_path / "absent"):
        result = corridor8(folder, tmp_path / "out.csv")
        assert result.returncode == 2
        assert len(result.stderr.splitlines()) == 1
        assert not (tmp_path / "out.csv").exists()
