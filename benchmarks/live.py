"""echogrid live, a robot on Fast DDS playing to it over loopback: latency, start, and memory over an hour.

    python -m benchmarks.live [latency | start | hour]

``latency``: a minute in real time, from the last range of a scan sent to the local map received, on one core and on
two; and the floor, the same of a program that answers each scan at once with a map that it has ready. ``start``: from
the start of the process, with a robot that drives, to the first local map received. ``hour``: 36,000 scans eight
times faster than real time, memory each ten minutes of the drive.

Targets with 24 sonars at 10 Hz: a median of 2 ms, 1 s to the first map, 120 MB after ten minutes, and memory that is
flat. Needs Debian's fastddsgen and libfastrtps-dev, and the right to make a network namespace (as the tests do).
"""

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from echogrid import Robot, World
from echogrid.frame import Frame
from echogrid.live.dds import Network
from echogrid.live.live_map import Picture
from echogrid.ros.messages import Choice
from echogrid.simulation.drive import tour
from echogrid.simulation.simulate import Simulator

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from peers.fastdds import peer  # ty: ignore[import-not-found]

RATE_HZ = 10.0
LATENCY_S, START_S, RESIDENT_MB = 0.002, 1.0, 120.0
"""Targets."""
START_UP_S = 5.0
"""Time at first that counts for nothing: the array is waited for, caches are cold."""
TEN_MINUTES_S = 600.0


def drive(scans: int) -> Iterator[Frame]:
    """The tour of the sample room driven again and again."""
    robot, world = Robot.load("b21"), World.load("sample")
    frames = list(Simulator(world, robot).frames(tour(world, 0.36), seed=3))
    there_and_back = frames + frames[::-1]
    for i, frame in enumerate(islice(cycle(there_and_back), scans)):
        yield Frame(peer.START_S + i / RATE_HZ, frame.pose, frame.ranges)


def resident_mb(pid: int) -> float:
    """Memory of a process, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


LIVE = (str(Path(sys.executable).with_name("echogrid")), "live", "--out")
ECHO = (sys.executable, "-m", "benchmarks.live", "echo")


@contextmanager
def played(scans: int, speed: float, listeners: int = 1) -> Generator[tuple[peer.Namespace, Path, subprocess.Popen]]:
    """A robot on core 1 that plays a drive to so many listeners: its network, a folder, and the robot."""
    program = peer.build()
    with tempfile.TemporaryDirectory() as folder, peer.namespace() as network:
        script = Path(folder) / "drive.txt"
        with open(script, "w") as file:
            file.writelines(line + "\n" for line in peer.opening(Robot.load("b21").mounts, listeners))
            for i, frame in enumerate(drive(scans)):
                lines = [f"at {i / RATE_HZ / speed:.4f}", *peer.frame_lines(frame.stamp, frame.pose, frame.ranges)]
                file.writelines(line + "\n" for line in lines)
            file.write(f"at {scans / RATE_HZ / speed + 3}\n")
        with open(script) as file:
            yield network, Path(folder), network.start("taskset", "-c", 1, program, 0, stdin=file, stdout=-1)


def play(scans: int, speed: float, cores: str = "0", words: Sequence[str] = LIVE) -> Iterator[tuple[peer.Heard, int]]:
    """Play a drive to a program on some cores; gives each map that comes back, and the program's number."""
    with played(scans, speed) as (network, folder, robot):
        live = network.start("taskset", "-c", cores, *words, folder, stdout=subprocess.DEVNULL)
        assert robot.stdout is not None
        for line in robot.stdout:
            yield from ((one, live.pid) for one in peer.heard(line))
        robot.wait()
        live.terminate()
        status = live.wait(60)
        assert status in (0, -15), f"{words[1]} ended with {status}"


def echo() -> None:
    """Answer each scan of 24 ranges at once, with a map that is ready."""
    network = Network(0, "lo", Choice(), "/map", "/local_map")
    cells, heard = np.full((150, 150), -1, dtype=np.int8), Counter[float]()
    due = 0.0
    while True:
        network.wait(0.05)
        if time.monotonic() >= due:
            network.discover()
            due = time.monotonic() + 0.5
        for _, _, message, _ in network.take():
            if hasattr(message, "range"):
                stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
                heard[stamp] += 1
                if heard[stamp] == 24:
                    del heard[stamp]
                    network.send(Picture(cells, 0.04, (0.0, 0.0), stamp, "odom", local=True))


def latency(seconds: float = 60.0) -> None:
    print(f"live: 24 sonars at {RATE_HZ:g} Hz for {seconds:g} s, last range sent to local map received")
    expected = (seconds - START_UP_S) * RATE_HZ
    for name, cores, words in (
        ("echogrid on one core", "0", LIVE),
        ("echogrid on two cores", "0,1", LIVE),
        ("floor: an answer at once", "0", ECHO),
    ):
        delays = [
            one.delay_s
            for one, _ in play(round(seconds * RATE_HZ), 1.0, cores, words)
            if one.kind == "local" and one.stamp > peer.START_S + START_UP_S
        ]
        low, median, high, worst = np.quantile(delays, [0.05, 0.5, 0.99, 1.0])
        print(
            f"  {name:25s} median {median * 1e3:.1f} ms ({median / LATENCY_S:.2f} of the target), "
            f"5 % {low * 1e3:.1f} ms, 99 % {high * 1e3:.1f} ms, worst {worst * 1e3:.0f} ms; "
            f"local maps for {len(delays) / expected:.1%} of the scans",
            flush=True,
        )


def start(times: int = 5) -> None:
    print(f"live: start of the process to the first local map received, a robot at {RATE_HZ:g} Hz driving already")
    took = []
    for _ in range(times):
        with played(100, 1.0, listeners=0) as (network, folder, robot):
            assert robot.stdout is not None
            time.sleep(2.0)
            begin = time.perf_counter()
            live = network.start("taskset", "-c", 0, *LIVE, folder, stdout=subprocess.DEVNULL)
            next(line for line in robot.stdout if line.startswith("local"))
            took.append(time.perf_counter() - begin)
            live.terminate()
            live.wait(60)
    print(f"  best {min(took):.2f} s, median {np.median(took):.2f} s; best / target: {min(took) / START_S:.2f}")


def hour(scans: int = 36_000, speed: float = 8.0) -> None:
    print(f"live: {scans} scans of 24 sonars, {speed:g} times faster than they were taken, echogrid on one core")
    due, begin, memory, newest, count = peer.START_S + 60.0, time.perf_counter(), [], 0.0, 0
    for one, pid in play(scans, speed):
        newest, count = one.stamp, count + (one.kind == "local")
        if newest >= due:
            memory.append(resident_mb(pid))
            minutes, real = (newest - peer.START_S) / 60, (time.perf_counter() - begin) / 60
            print(f"  minute {minutes:4.0f} of the drive, {real:4.1f} real: {memory[-1]:.0f} MB", flush=True)
            due = peer.START_S + TEN_MINUTES_S * len(memory)
    print(f"  memory after ten minutes / target: {memory[1] / RESIDENT_MB:.2f}")
    print(f"  memory at the end / after ten minutes: {memory[-1] / memory[1]:.3f}; {count} local maps")
    print(f"  newest scan in the last map / last scan: {(newest - peer.START_S) / ((scans - 1) / RATE_HZ):.4f}")


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else "latency"
    {"latency": latency, "start": start, "hour": hour, "echo": echo}[what]()
