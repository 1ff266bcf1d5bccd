import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from core_oracles import scores
from echogrid import _core
from kernel_samples import sampled

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


SAMPLES = Path(__file__).parents[1] / "kernel_samples.py"
ELSEWHERE = os.environ.get("ECHOGRID_SAMPLES")
"""Of another machine, where `make arm` has them."""


def assert_alike(found, expected):
    """But for cells on a rim, where the last bit decides."""
    assert len(expected) > 30
    for name, values in expected.items():
        if name != "instructions":
            off = np.abs(found[name].astype(float) - values)
            assert np.mean(off > 1e-3) < 5e-4, name
            assert np.std(values) > 0.01 or name.endswith("until"), name


@NEEDS_CPUINFO
@pytest.mark.parametrize("level", here()[:-1] if not X86 or CPU.exists() else [])
def test_the_networks_say_the_same_by_all_instructions(level, tmp_path):
    environment = os.environ | {"ECHOGRID_INSTRUCTIONS": level}
    subprocess.run([sys.executable, SAMPLES, tmp_path / "found.npz"], check=True, timeout=120, env=environment)
    with np.load(tmp_path / "found.npz") as found:
        assert found["instructions"] == level
        assert_alike(found, sampled())


# In QEMU the sanitizers' map of the memory would fill it.
SANITIZED = "libasan" in os.environ.get("LD_PRELOAD", "")
OLDER = pytest.mark.skipif(
    SANITIZED or not (X86 and shutil.which("qemu-x86_64")),
    reason="needs qemu-x86_64 (make peers installs it), and a core without sanitizers",
)


def run_on(cpu, *arguments):
    """Run Python on an older processor: an instruction that it lacks ends the process."""
    # OpenBLAS does not look what there is.
    environment = os.environ | {"OPENBLAS_CORETYPE": "Nehalem", "ECHOGRID_INSTRUCTIONS": ""}
    command = ["qemu-x86_64", "-cpu", cpu, sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120, env=environment)


@OLDER
@pytest.mark.parametrize(("cpu", "level"), [("Nehalem", "v2"), ("Haswell,-avx2", "v2"), ("Haswell", "v3")])
def test_an_older_processor_gets_the_instructions_that_it_has(cpu, level):
    assert run_on(cpu, "-c", "from echogrid import _core; print(_core.instructions())").stdout.strip() == level


@OLDER
def test_an_older_processor_says_the_same(tmp_path):
    done = run_on("Nehalem", SAMPLES, tmp_path / "found.npz")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "found.npz") as found:
        assert_alike(found, sampled())


@OLDER
def test_a_processor_that_is_too_old_is_told_so():
    last = run_on("Conroe", "-c", "from echogrid import _core; _core.instructions()").stderr.splitlines()[-1]
    assert last.endswith("echogrid: found a processor without SSE 4.2, expected x86-64-v2 or newer")


@pytest.mark.skipif(ELSEWHERE is None, reason="make arm compares with another machine")
def test_the_networks_say_what_they_say_on_another_machine():
    with np.load(str(ELSEWHERE)) as expected:
        assert expected["instructions"] != _core.instructions()
        assert_alike(sampled(), dict(expected))


@pytest.mark.parametrize("wanted", ["v9", "neon" if X86 else "v2"])
def test_instructions_that_the_machine_lacks_are_refused(wanted):
    done = run(wanted, "from echogrid import _core; _core.instructions()")
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"echogrid.errors.UsageError: ECHOGRID_INSTRUCTIONS: found {wanted}, expected what this")
