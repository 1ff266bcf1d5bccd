"""An export on the processors that it is for: what it takes there, and that it says there what it says here."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from echogrid.microcontroller.source import source_of, write
from echogrid.robot import Robot
from export_samples import WARNINGS, in_a_room, network, packed, told, walk

COMPILER = shutil.which("arm-none-eabi-gcc")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="found no arm-none-eabi-gcc (make peers installs it)")

CORES = {
    "cortex-m4": ["-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-mthumb"],
    "cortex-m7": ["-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb"],
}
DRIVE = Path(__file__).with_name("drive.c")


@pytest.fixture(scope="module")
def source():
    return source_of(network(), Robot.load("p3dx"), 6.0, 0.1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, source):
    folder = tmp_path_factory.mktemp("firmware")
    write(folder, source)
    return folder


@pytest.fixture(scope="module")
def drive():
    rng = np.random.default_rng(7)
    robot = Robot.load("p3dx")
    return packed(in_a_room(rng, robot, walk(rng, 40), in_turn=True))


def built(folder, core, level):
    made = folder / f"{core}{level}.o"
    flags = [*CORES[core], level, "-ffunction-sections", "-fstack-usage"]
    told([COMPILER, *WARNINGS, *flags, "-c", folder / "echogrid.c", "-o", made])
    return made


@pytest.mark.parametrize("level", ["-Os", "-O2"])
@pytest.mark.parametrize("core", CORES)
def test_it_needs_no_library_and_takes_what_is_said(folder, source, core, level):
    made = built(folder, core, level)
    needed = re.findall(r"^ +U (\w+)$", told(["arm-none-eabi-nm", made]), re.MULTILINE)
    assert set(needed) <= {"memcpy", "memmove", "memset"}  # which every compiler asks for
    text, data, bss = map(int, told(["arm-none-eabi-size", made]).splitlines()[1].split()[:3])
    assert (data, bss) == (0, 0)  # nothing is kept but in the caller's struct
    assert source.table_bytes < text
    if level == "-Os":
        assert abs(text - source.table_bytes - source.code_bytes) < 0.1 * source.code_bytes
    listed = told(["arm-none-eabi-nm", "--print-size", made])
    tables = sum(int(size, 16) for size in re.findall(r"^\w+ (\w+) r ", listed, re.MULTILINE))
    assert 0 <= tables - source.table_bytes < 16
    frames = dict(re.findall(r":(\w+)[.\w]*\t(\d+)", made.with_suffix(".su").read_text()))
    deepest = sum(sorted(map(int, frames.values()))[-3:])
    assert 0.6 * source.stack_bytes < deepest <= source.stack_bytes


@pytest.mark.skipif(shutil.which("qemu-arm") is None, reason="found no qemu-arm (make peers installs it)")
@pytest.mark.parametrize(("core", "level"), [("cortex-m4", "-Os"), ("cortex-m7", "-O2")])
def test_it_says_there_what_it_says_here_to_the_bit(folder, drive, core, level):
    there, here = folder / f"{core}{level}.elf", folder / "here"
    files = [folder / "echogrid.c", DRIVE]
    told([COMPILER, *WARNINGS, *CORES[core], level, "-I", folder, "-nostartfiles", *files, "-o", there])
    told([shutil.which("gcc"), "-std=gnu11", "-ffp-contract=off", "-O2", "-I", folder, *files, "-o", here])
    ran = [
        subprocess.run(command, input=drive, capture_output=True, timeout=100)
        for command in (["qemu-arm", "-cpu", "max", there], [here])
    ]
    assert [done.returncode for done in ran] == [0, 0]
    assert len(ran[0].stdout) == 8 + 60 * 60
    assert len(set(ran[0].stdout[8:])) > 50
    assert ran[0].stdout == ran[1].stdout
