"""echogrid live on one core, a robot on Fast DDS playing to it over loopback: latency, and memory over an hour.

    python -m benchmarks.live [latency | hour]

``latency``: two minutes in real time, from the last range of a scan sent to the local map received. ``hour``: 36,000
scans eight times faster than real time, memory each ten minutes of the drive.

Targets with 24 sonars at 10 Hz: a median under 20 ms, and memory that is flat. Needs Debian's fastddsgen and
libfastrtps-dev, and the right to make a network namespace (as the tests do).
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from echogrid import Robot, World
from echogrid.frame import Frame
from echogrid.simulation.drive import tour
from echogrid.simulation.simulate import Simulator

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from peers.fastdds import peer  # ty: ignore[import-not-found]

RATE_HZ, TARGET_S = 10.0, 0.020
START_UP_S = 15.0
"""Time at first that counts for nothing: the network is compiled."""
TEN_MINUTES_S = 600.0


def drive(scans: int) -> Iterator[Frame]:
    """The tour of the sample room driven again and again."""
    robot, world = Robot.load("b21"), World.load("sample")
    frames = list(Simulator(world, robot).frames(tour(world, 0.36), seed=3))
    there_and_back = frames + frames[::-1]
    for i, frame in enumerate(islice(cycle(there_and_back), scans)):
        yield Frame(peer.START_S + i / RATE_HZ, frame.pose, frame.ranges)


def resident_mib(pid: int) -> float:
    """Memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def play(scans: int, speed: float) -> Iterator[tuple[peer.Heard, int]]:
    """Play a drive to echogrid live on core 0; gives each map that comes back, and the process's number."""
    program = peer.build()
    echogrid = Path(sys.executable).with_name("echogrid")
    with tempfile.TemporaryDirectory() as folder, peer.namespace() as network:
        words = ("taskset", "-c", "0", echogrid, "live", "--out", folder)
        live = subprocess.Popen(network.command(*words), stdout=subprocess.DEVNULL)
        script = Path(folder) / "drive.txt"
        with open(script, "w") as file:
            file.writelines(line + "\n" for line in peer.opening(Robot.load("b21").mounts))
            for i, frame in enumerate(drive(scans)):
                lines = [f"at {i / RATE_HZ / speed:.4f}", *peer.frame_lines(frame.stamp, frame.pose, frame.ranges)]
                file.writelines(line + "\n" for line in lines)
            file.write(f"at {scans / RATE_HZ / speed + 3}\n")
        with open(script) as file:
            command = network.command("taskset", "-c", "1", program, 0)
            robot = subprocess.Popen(command, stdin=file, stdout=subprocess.PIPE, text=True)
        assert robot.stdout is not None
        for line in robot.stdout:
            yield from ((one, live.pid) for one in peer.heard(line))
        robot.wait()
        live.terminate()
        status = live.wait(60)
        assert status == 0, f"echogrid live ended with {status}"


def latency(seconds: float = 120.0) -> None:
    delays = [
        one.delay_s
        for one, _ in play(round(seconds * RATE_HZ), 1.0)
        if one.kind == "local" and one.stamp > peer.START_S + START_UP_S
    ]
    expected = (seconds - START_UP_S) * RATE_HZ
    median, high, worst = np.quantile(delays, [0.5, 0.99, 1.0]) * 1e3
    print(f"live: 24 sonars at {RATE_HZ:g} Hz for {seconds:g} s, echogrid on one core")
    print(
        f"  last range sent to local map received: median {median:.1f} ms, 99 % {high:.1f} ms, worst {worst:.0f} ms"
    )
    print(
        f"  median / target: {median / 1e3 / TARGET_S:.2f}; local maps for {len(delays) / expected:.1%} of the scans"
    )


def hour(scans: int = 36_000, speed: float = 8.0) -> None:
    print(f"live: {scans} scans of 24 sonars, {speed:g} times faster than they were taken, echogrid on one core")
    due, begin, memory, newest, count = peer.START_S + 60.0, time.perf_counter(), [], 0.0, 0
    for one, pid in play(scans, speed):
        newest, count = one.stamp, count + (one.kind == "local")
        if newest >= due:
            memory.append(resident_mib(pid))
            minutes, real = (newest - peer.START_S) / 60, (time.perf_counter() - begin) / 60
            print(f"  minute {minutes:4.0f} of the drive, {real:4.1f} real: {memory[-1]:.0f} MiB", flush=True)
            due = peer.START_S + TEN_MINUTES_S * len(memory)
    print(f"  memory at the end / after ten minutes: {memory[-1] / memory[1]:.3f}; {count} local maps")
    print(f"  newest scan in the last map / last scan: {(newest - peer.START_S) / ((scans - 1) / RATE_HZ):.4f}")


if __name__ == "__main__":
    {"latency": latency, "hour": hour}[sys.argv[1] if len(sys.argv) > 1 else "latency"]()
