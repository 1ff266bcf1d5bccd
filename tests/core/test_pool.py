import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from echogrid import _core
from echogrid.errors import UsageError

ROOT = Path(__file__).parents[2]
X86 = platform.machine() in ("x86_64", "AMD64")
LINUX = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads as Linux does")

SCORE = """
import os
import numpy as np
from echogrid import _core
rng = np.random.default_rng(1)
points, a = rng.uniform(-1, 1, (300, 2)).astype(np.float32), rng.uniform(-1, 1, 300).astype(np.float32)
scorer = _core.PoseScorer(rng.uniform(-1, 1, (50, 50)).astype(np.float32), (0.0, 0.0), 0.05)
poses = rng.uniform(0, 2, (2000, 3))
score = lambda: scorer.score(points, a, poses).tobytes()
tasks = lambda: len(os.listdir("/proc/self/task"))
"""


def said(code):
    """What a fresh Python prints."""
    # Libraries of numpy start threads too.
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", "-c", SCORE + code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=alone, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_at_first_there_are_as_many_as_the_process_may_use():
    code = "import echogrid._core as c; print(c.threads())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    expected = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    assert int(done.stdout) == min(expected, 256)


@LINUX
def test_threads_start_with_the_first_run_and_stay():
    code = """
_core.set_threads(3)
print(tasks())
for _ in range(4):
    score()
    print(tasks())
"""
    first, *rest = map(int, said(code))
    assert rest == [first + 2] * 4


@LINUX
def test_fewer_threads_leave_no_others_behind():
    code = """
before = tasks()
_core.set_threads(4)
score()
_core.set_threads(1)
score()
print(tasks() - before)
_core.set_threads(2)
print(_core.threads())
"""
    assert said(code) == ["0", "2"]


@LINUX
def test_a_forked_child_has_threads_of_its_own():
    code = """
_core.set_threads(3)
expected = score()
child = os.fork()
if child == 0:
    alone = tasks()
    right = _core.threads() == 3 and score() == expected and tasks() == alone + 2
    os._exit(0 if right else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), score() == expected)
"""
    assert said(code) == ["0", "True"]


@pytest.mark.skipif(not (shutil.which("c++") and X86), reason="needs c++ and what ThreadSanitizer runs on")
@pytest.mark.parametrize("flags", [["-O2"], ["-O1", "-g", "-fsanitize=thread"]], ids=["fast", "watched"])
def test_each_part_of_a_run_is_done_once_and_before_it_ends(flags, tmp_path):
    sources = ROOT / "core" / "pool.cpp", Path(__file__).with_name("pool.cpp")
    command = ["c++", "-std=c++20", "-pthread", *flags, "-I", ROOT / "core", *sources, "-o", tmp_path / "pool"]
    subprocess.run(command, check=True, capture_output=True)
    alone = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}  # not two sanitizers
    done = subprocess.run([tmp_path / "pool"], capture_output=True, text=True, timeout=100, check=False, env=alone)
    if "unexpected memory mapping" in done.stderr:
        pytest.skip("ThreadSanitizer does not run on this machine")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("count", [0, -1, 257, 10**12])
def test_a_number_that_nobody_can_mean_is_refused(count):
    before = _core.threads()
    with pytest.raises(UsageError, match=f"^threads: found {count}, expected 1 to 256$"):
        _core.set_threads(count)
    assert _core.threads() == before
