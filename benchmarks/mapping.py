"""Speed of interpretation and fusion of a long B21 log, start-up apart.

Targets on 2 cores: 10,000 scans/s for the set network and less than 5 ms for one scan alone, 20,000 scans/s for the
paper's network.

The networks and the cone map the same frames in one run; reading the CSV log is timed beside them.
"""

import tempfile
import time
from itertools import islice
from pathlib import Path

import numpy as np

from echogrid import Log, Robot, World, build_map, load_log
from echogrid.frame import Frame
from echogrid.logs.csv_log import write_csv
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import sensor_model
from echogrid.models.networks.set_network import SetNetwork
from echogrid.simulation.drive import tour
from echogrid.simulation.simulate import Simulator

SCANS, RUNS = 20_000, 5


def long_log(scans: int) -> Log:
    """The tour of the sample room driven again and again."""
    robot = Robot.load("b21")
    world = World.load("sample")
    frames = list(Simulator(world, robot).frames(tour(world, 0.36), seed=3))
    return Log.of(Frame(i * 0.2, frames[i % len(frames)].pose, frames[i % len(frames)].ranges) for i in range(scans))


def latency(robot: Robot, frames: list[Frame]) -> None:
    """Time from a scan to its place in the map, one scan after the other in a running process."""
    network = sensor_model("set-network")
    assert isinstance(network, SetNetwork)
    mapper, spans = Mapper(robot, network), []
    for frame in frames:
        begin = time.perf_counter()
        mapper.add([frame])
        spans.append((time.perf_counter() - begin) * 1e3)
    print(f"  one scan alone: {np.median(spans[20:]):.2f} ms (median; 95 %: {np.quantile(spans[20:], 0.95):.2f})")


def main() -> None:
    robot, log = Robot.load("b21"), long_log(SCANS)
    print(f"mapping: {SCANS} scans of {robot.sonars} sonars")
    for name, cell in (
        ("set-network", 0.04),
        ("set-network", 0.06),
        ("set-network", 0.12),
        ("network", 0.12),
        ("cone", 0.12),
    ):
        model = sensor_model(name)
        times = []
        for _ in range(RUNS + 1):
            steps = build_map(log, robot, model, cell)
            next(steps)  # start-up: compilation
            begin = time.perf_counter()
            done = sum(1 for _ in steps)
            times.append(time.perf_counter() - begin)
        scans = SCANS - SCANS // (done + 1)
        times = times[1:]
        print(
            f"  {name}, cells of {cell} m: {scans / np.median(times):.0f} scans/s (median of {RUNS} runs; "
            f"best {scans / min(times):.0f})"
        )
    latency(robot, list(islice(log, 300)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.csv"
        write_csv(path, islice(log, SCANS), robot.sonars)
        begin = time.perf_counter()
        count = sum(1 for _ in load_log(path, robot))
        print(f"  reading the CSV log: {count / (time.perf_counter() - begin):.0f} scans/s")


if __name__ == "__main__":
    main()
