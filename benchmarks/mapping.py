"""Speed of interpretation and fusion of a long B21 log, start-up apart. Target: 20,000 scans/s on 2 cores.

The network and the cone map the same frames in one run; reading the CSV log is timed beside them.
"""

import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np

from echogrid import Log, Robot, World, build_map, load_log
from echogrid.drive import tour
from echogrid.log import Frame
from echogrid.models import sensor_model
from echogrid.readers.csv_log import write_csv
from echogrid.simulate import Simulator

SCANS, RUNS = 20_000, 5


def long_log(scans: int) -> Log:
    """The tour of the sample room driven again and again."""
    robot = Robot.load("b21")
    world = World.load("sample")
    frames = list(Simulator(world, robot).frames(tour(world, 0.36), seed=3))
    return Log.of(Frame(i * 0.2, frames[i % len(frames)].pose, frames[i % len(frames)].ranges) for i in range(scans))


def main() -> None:
    robot, log = Robot.load("b21"), long_log(SCANS)
    print(f"mapping: {SCANS} scans of {robot.sonars} sonars, cells of 0.12 m")
    for name in ("network", "cone"):
        model = sensor_model(name)
        times = []
        for _ in range(RUNS + 1):
            steps = build_map(log, robot, model)
            next(steps)  # start-up: compilation
            begin = time.perf_counter()
            done = sum(1 for _ in steps)
            times.append(time.perf_counter() - begin)
        scans = SCANS - SCANS // (done + 1)
        times = times[1:]
        print(
            f"  {name}: {scans / np.median(times):.0f} scans/s (median of {RUNS} runs; best {scans / min(times):.0f})"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.csv"
        write_csv(path, islice(log, SCANS), robot.sonars)
        begin = time.perf_counter()
        count = sum(1 for _ in load_log(path, robot))
        print(f"  reading the CSV log: {count / (time.perf_counter() - begin):.0f} scans/s")


if __name__ == "__main__":
    main()
