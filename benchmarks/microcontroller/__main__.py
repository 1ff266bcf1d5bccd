"""Flash, RAM and instructions a scan of exports (arm-none-eabi-gcc, qemu-arm), and the scores of their maps.

Instructions are counted by QEMU over the sample's drive, not cycles: a Cortex-M4 takes about 1.3 to 1.7 of these for
one, a Cortex-M7 0.7 to 1.
"""

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.grid import Grid
from echogrid.logs.formats import load_log
from echogrid.mapping.mapper import Mapper
from echogrid.metrics import Truth, score
from echogrid.microcontroller.source import Source, source_of, write
from echogrid.models.networks.set_network import SetNetwork
from echogrid.output.map_file import read_truth
from echogrid.robot import Robot

HERE = Path(__file__).parent
DRIVE = HERE.parents[1] / "tests" / "microcontroller" / "drive.c"
ARM = [
    "arm-none-eabi-gcc",
    "-mcpu=cortex-m4",
    "-mfpu=fpv4-sp-d16",
    "-mfloat-abi=hard",
    "-mthumb",
    "-nostartfiles",
    "-std=gnu11",
]
NETWORK = SetNetwork.load(str(resources.files("echogrid") / "weights" / "set.npz"))
SCORES = ["found", "wiped", "free", "false", "auc", "nll"]


def main() -> None:
    frames = list(load_log(str(resources.files("echogrid") / "data" / "sample.csv"), Robot.load("b21")))
    print("robot     sonars  window         flash: tables, code    RAM      million instructions a scan: -Os, -O2")
    for name, side, cell in [("b21", 6, 0.1), ("b21", 6, 0.06), ("p3dx", 6, 0.1)]:
        robot = Robot.load(name)
        source = source_of(NETWORK, robot, side, cell)
        own = [replace(frame, ranges=frame.ranges[: robot.sonars]) for frame in frames]
        some = [instructions(source, own, level) for level in ("-Os", "-O2")]
        silent = [with_silent(frame, k) for k, frame in enumerate(own)]
        print(
            f"{name:8} {robot.sonars:6}   {side} m / {cell:.2f} m   {source.table_bytes:8} {source.code_bytes:8}"
            f" {source.state_bytes:10}   {some[0]:6.1f} {some[1]:6.1f}"
            f"   half of the sonars silent: {instructions(source, silent, '-O2'):.1f}"
        )
    truth = read_truth(Path(str(resources.files("echogrid") / "data" / "sample.truth.npz")))
    print(f"\nthe sample mapped, 12 m wide     {'  '.join(f'{name:>6}' for name in SCORES)}")
    for cell in (0.04, 0.06, 0.08, 0.1, 0.12):
        show(f"exported, cells of {cell:.2f} m", exported(frames, cell), truth)
    show("mapper without surroundings", mapped(frames, replace(NETWORK, around=None)), truth)
    show("mapper as it is", mapped(frames, NETWORK), truth)


def with_silent(frame: Frame, number: int) -> Frame:
    return replace(frame, ranges=np.where(np.arange(len(frame.ranges)) % 2 == number % 2, np.nan, frame.ranges))


def packed(frames: Sequence[Frame]) -> bytes:
    kind = [("told", "<f4", len(frames[0].ranges) + 3), ("ms", "<u4")]
    rows = [(np.append(frame.ranges, frame.pose), round(1000 * frame.stamp)) for frame in frames]
    return np.array(rows, kind).tobytes()


def instructions(source: Source, frames: Sequence[Frame], level: str, begin: int = 20, scans: int = 20) -> float:
    """Millions a scan."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, source)
        plugin, program = folder / "count.so", folder / "drive"
        subprocess.run(["gcc", "-shared", "-fPIC", HERE / "count.c", "-o", plugin], check=True)
        subprocess.run([*ARM, level, "-I", folder, folder / "echogrid.c", DRIVE, "-o", program], check=True)
        counts = []
        for n in (begin, begin + scans):
            command = ["qemu-arm", "-cpu", "max", "-plugin", plugin, program]
            done = subprocess.run(command, input=packed(frames[:n]), capture_output=True, check=True)
            counts.append(int(done.stderr))
    return (counts[1] - counts[0]) / scans / 1e6


def exported(frames: Sequence[Frame], cell: float) -> Grid:
    """The map of an export that runs here."""
    source = source_of(NETWORK, Robot.load("b21"), 12, cell)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, source)
        program = folder / "drive"
        subprocess.run(["gcc", "-O2", "-I", folder, folder / "echogrid.c", DRIVE, "-o", program], check=True)
        told = subprocess.run([program], input=packed(frames), capture_output=True, check=True).stdout
    x, y = np.frombuffer(told[:8], "<f4").tolist()
    cells = np.frombuffer(told[8:], np.int8).reshape(source.side, source.side)
    known: ndarray = cells != -128
    return Grid(np.where(known, cells / 16, 0).astype(np.float32), known, cell, (x, y), p_min=NETWORK.p_min)


def mapped(frames: Sequence[Frame], network: SetNetwork) -> Grid:
    mapper = Mapper(Robot.load("b21"), network)
    mapper.add(frames)
    return mapper.grid()


def show(what: str, grid: Grid, truth: Truth) -> None:
    told = score(grid, truth)
    print(f"{what:32} {'  '.join(f'{getattr(told, name):6.3f}' for name in SCORES)}")


if __name__ == "__main__":
    main()
