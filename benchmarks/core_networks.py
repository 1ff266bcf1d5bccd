"""The networks in the compiled core against the same in JAX, as ratios in one run; of benchmarks.core.

Each side has a process of its own, and they take turns. CPU time, the
least of several runs, for other work on the machine lengthens it least; the wall's beside it. For the floor the peak
of the processor and the stream of its memory are measured with numpy on one thread.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROUNDS, SCANS, ALONE = 5, 1536, 60
REACH_M, CELL_M, LAYERS = 2.5, 0.04, 6
UNITS, TOKENS, BEARINGS, RINGS = 24, 6, 64, 51


def floor_flop() -> float:
    """Floating-point operations of a scan at 4 cm: its encoder, its profiles, and a cell's look-up and sums."""
    h = UNITS
    token = 20 * h + h * h + 4 * h + 10 * h + 19 * RINGS + 130
    bearing = TOKENS * token + 4 * h * h + 9 * h + 30 * RINGS
    cells = np.pi * (REACH_M / CELL_M) ** 2
    return float(2 * BEARINGS * bearing + 70 * cells)


def floor_bytes() -> float:
    """Bytes of the map's layers that a scan reads and writes."""
    return float(np.pi * (REACH_M / CELL_M) ** 2 * LAYERS * 4 * 2)


def machine() -> dict[str, float]:
    """Operations and bytes a second of one thread, as numpy gets them."""
    a, b = (np.random.default_rng(i).random((768, 768), dtype=np.float32) for i in (0, 1))
    long = np.zeros(1 << 24, np.float32)
    flop = min(timed(lambda: a @ b)[0] for _ in range(9))
    moved = min(timed(lambda: np.add(long, 1.0, out=long))[0] for _ in range(5))
    return {"flop": 2 * 768**3 / flop, "bytes": 2 * long.nbytes / moved}


def timed(work) -> tuple[float, float]:
    """CPU time of the process, and time, s."""
    cpu, wall = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - cpu, time.perf_counter() - wall


def serve(source: Path) -> None:
    """Measure what is asked for, line by line; in the process of one side, with the package that lies in source."""
    # An editable install finds its own package before any path does.
    sys.meta_path[:] = [each for each in sys.meta_path if "ScikitBuild" not in type(each).__name__]
    sys.path.insert(0, str(source))
    import echogrid

    assert Path(str(echogrid.__file__)).is_relative_to(source), f"found {echogrid.__file__}"
    from echogrid import Robot, build_map, load_log
    from echogrid.mapping.mapper import Mapper

    robot = Robot.load("b21")
    sample = list(load_log(str(Path(str(sys.modules["echogrid"].__file__)).parent / "data" / "sample.csv")))
    frames = [sample[i % len(sample)] for i in range(SCANS)]

    def bulk(model, cell):
        for grid in build_map(frames, robot, model, cell):
            last = grid
        return last

    driven = Mapper(robot)
    driven.add(sample)
    driven.grid()

    def alone(read):
        for frame in sample[:ALONE]:
            driven.add([frame])
            if read:
                driven.grid()

    # Where evidence fades, each read-out is of all cells.
    mapper = Mapper(robot, half_life=1e6)
    mapper.add(sample)
    whole = mapper.grid().shape
    rows = {
        "set-network, bulk": (lambda: bulk("set-network", 0.04), SCANS),
        "set-network, bulk, told in 12 cm": (lambda: bulk("set-network", 0.12), SCANS),
        "network, bulk, 12 cm": (lambda: bulk("network", 0.12), SCANS),
        "set-network, scan alone": (lambda: alone(False), ALONE),
        "set-network, scan alone and read out": (lambda: alone(True), ALONE),
        f"read-out of {whole[0]} x {whole[1]} cells": (mapper.grid, 1),
    }
    print(json.dumps(list(rows)), flush=True)
    for line in sys.stdin:
        if line.strip() == "machine":
            print(json.dumps(machine()), flush=True)
            continue
        work, count = rows[line.strip()]
        cpu, wall = timed(work)
        print(json.dumps([cpu / count, wall / count]), flush=True)


class Side:
    """A process that measures one of the two."""

    def __init__(self, root: Path):
        env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-W", "ignore", __file__, str(root / "src")]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env)
        self.rows = self._heard()

    def ask(self, row: str) -> Any:
        """CPU time and time of a row, s each, or what the machine does in a second."""
        assert self._process.stdin
        self._process.stdin.write(row + "\n")
        self._process.stdin.flush()
        return self._heard()

    def _heard(self) -> Any:
        assert self._process.stdout
        return json.loads(self._process.stdout.readline())


def compare(root: str, rounds: int = ROUNDS) -> None:
    """Print the table of the networks against those of the worktree."""
    from echogrid import _core

    core, old = (Side(Path(root).resolve()) for root in (Path(__file__).parents[1], root))
    print(f"networks: instructions {_core.instructions()}; us of CPU (of the clock)")
    least = {}
    for row, of_old in zip(core.rows, old.rows, strict=True):
        found = {"core": [], "jax": []}
        for _ in range(rounds + 1):
            found["core"].append(core.ask(row))
            found["jax"].append(old.ask(of_old))
        # The first run compiles.
        (cpu, wall), (cpu_old, wall_old) = (np.min(found[side][1:], axis=0) * 1e6 for side in ("core", "jax"))
        least[row] = cpu
        print(
            f"  {row}: core {cpu:.1f} ({wall:.1f}), JAX {cpu_old:.1f} ({wall_old:.1f}): "
            f"{cpu_old / cpu:.1f} x ({wall_old / wall:.1f} x)",
            flush=True,
        )
    speed = core.ask("machine")
    floor = max(floor_flop() / speed["flop"], floor_bytes() / speed["bytes"]) * 1e6
    print(
        f"  floor: {floor_flop() / 1e6:.2f} MFLOP at {speed['flop'] / 1e9:.0f} GFLOP/s, "
        f"{floor_bytes() / 1e3:.0f} KB at {speed['bytes'] / 1e9:.1f} GB/s: {floor:.1f} us a scan, "
        f"{floor / least['set-network, bulk']:.0%} of what is taken"
    )


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
