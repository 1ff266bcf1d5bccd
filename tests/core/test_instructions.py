import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core_oracles import scores

CPU = Path("/proc/cpuinfo")
FLAGS = {
    "v3": "avx avx2 bmi1 bmi2 f16c fma abm movbe xsave",
    "v4": "avx512f avx512bw avx512cd avx512dq avx512vl",
}
X86 = platform.machine() in ("x86_64", "AMD64")


def here():
    """The levels that the system says this machine has."""
    if not X86:
        return ["neon" if platform.machine() in ("aarch64", "arm64") else "baseline"]
    flags = next((line.split() for line in CPU.read_text().splitlines() if line.startswith("flags")), [])
    levels = ["v2"]
    for level, wanted in FLAGS.items():
        if not set(wanted.split()) <= set(flags):
            break
        levels.append(level)
    return levels


NEEDS_CPUINFO = pytest.mark.skipif(X86 and not CPU.exists(), reason="no /proc/cpuinfo to compare with")


def run(instructions, code, *arguments):
    environment = os.environ | {"ECHOGRID_INSTRUCTIONS": instructions}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment, check=False)


@NEEDS_CPUINFO
def test_the_widest_instructions_of_the_machine_are_used():
    assert run("", "from echogrid import _core; print(_core.instructions())").stdout.strip() == here()[-1]


@NEEDS_CPUINFO
@pytest.mark.parametrize("level", here() if not X86 or CPU.exists() else [])
def test_all_instructions_compute_what_the_formula_says(level, tmp_path):
    code = """
import sys
import numpy as np
from echogrid import _core
rng = np.random.default_rng(1)
b = rng.uniform(-1, 1, (70, 50)).astype(np.float32)
points, a = rng.uniform(-1, 1, (333, 2)).astype(np.float32), rng.uniform(-1, 1, 333).astype(np.float32)
poses = rng.uniform(-1, 4, (99, 3))
found = _core.PoseScorer(b, (0.5, -0.5), 0.05).score(points, a, poses)
np.savez(sys.argv[1], name=_core.instructions(), found=found, b=b, points=points, a=a, poses=poses)
"""
    done = run(level, code, tmp_path / "found.npz")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "found.npz") as held:
        assert held["name"] == level
        expected = scores(held["b"], (0.5, -0.5), 0.05, held["points"], held["a"], held["poses"])
        np.testing.assert_allclose(held["found"], expected, atol=2e-4)


@pytest.mark.parametrize("wanted", ["v9", "neon" if X86 else "v2"])
def test_instructions_that_the_machine_lacks_are_refused(wanted):
    done = run(wanted, "from echogrid import _core; _core.instructions()")
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"echogrid.errors.UsageError: ECHOGRID_INSTRUCTIONS: found {wanted}, expected what this")
