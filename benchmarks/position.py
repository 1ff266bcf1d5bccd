"""How long localising and SLAM take: ``python -m benchmarks.position``.

2,000 particles moved, weighed by a scan of 24 sonars and drawn anew, beside the same look-ups done by a plain gather
of numpy; then the sample, tracked in its own map, beside the time that its drive took. Then a ring of corridors
driven four times by a robot with 24 sonars: offline, and live, with what a scan waits and what a search for loops
costs in the thread beside it.
"""

import time
from contextlib import closing
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np

from echogrid import Localiser, Log, Robot, build_map, load_log, slam
from echogrid.position.beams import Beams
from echogrid.position.drive import Drive
from echogrid.position.motion import Drift
from echogrid.position.online import OnlineSlam
from echogrid.position.particles import Particles
from experiments.studies.position.cases import Case
from experiments.studies.position.simulated import make

PARTICLES, TIMES = 2000, 100


def main() -> None:
    """Print the times and their ratios."""
    robot = Robot.load("b21")
    log = list(load_log(str(resources.files("echogrid") / "data" / "sample.csv"), robot))
    *_, grid = build_map(load_log(str(resources.files("echogrid") / "data" / "sample.csv"), robot), robot)
    rng = np.random.default_rng(0)
    beams, drift = Beams(grid, robot), Drift()
    ranges = np.where(np.isnan(log[50].ranges), np.inf, log[50].ranges)
    particles = Particles(log[50].pose + rng.normal(0, 0.1, (PARTICLES, 3)), np.zeros(PARTICLES))
    table, at = rng.random(1_000_000), rng.integers(1_000_000, size=(PARTICLES, robot.sonars))

    def update() -> None:
        particles.propagate(np.array([0.01, 0.0, 0.0]), 0.01, 0.0, drift, rng)
        particles.reweight(0.2 * beams.log_likelihood(particles.poses, ranges, robot.mounts))
        particles.resample(PARTICLES, PARTICLES, rng)

    took, gather = _median(update), _median(lambda: table[at].sum(axis=1))
    print(
        f"update of {PARTICLES} particles, {robot.sonars} sonars  {1e3 * took:.2f} ms, {took / gather:.1f} x a gather"
    )
    localiser = Localiser(grid, robot, log[0].pose)
    each = []
    for frame in log:
        begin = time.perf_counter()
        localiser.add(frame)
        each.append(time.perf_counter() - begin)
    span = log[-1].stamp - log[0].stamp
    tail = f"median {1e3 * np.median(each):.2f} ms, longest {1e3 * max(each):.0f} ms a scan"
    print(f"the sample, tracked  {span / sum(each):.0f} x as fast as it was driven, {tail}")
    _slam()


def _slam() -> None:
    with TemporaryDirectory() as folder:
        make(Path(folder), "ring-mixed-b21-1")
        case = Case(Path(folder) / "ring-mixed-b21-1")
        frames = list(case.log("twice"))
        robot = case.robot
    span = frames[-1].stamp - frames[0].stamp
    begin, cpu = time.perf_counter(), time.process_time()
    slam(Log.of(frames), robot)
    took, worked = time.perf_counter() - begin, time.process_time() - cpu
    print(f"{case.name}, offline  {span / took:.0f} x as fast as it was driven, {span / worked:.0f} x by CPU time")
    scans, loops = [], []
    close = Drive._close_loops

    def timed(self: Drive, k: int) -> None:
        begin = time.perf_counter()
        close(self, k)
        loops.append(time.perf_counter() - begin)

    with patch.object(Drive, "_close_loops", timed), closing(OnlineSlam(robot)) as finder:
        for frame in frames:
            begin = time.perf_counter()
            finder.add(frame)
            scans.append(time.perf_counter() - begin)
            finder.wait()
    print(
        f"{case.name}, live  median {1e3 * np.median(scans):.2f} ms a scan, longest {1e3 * max(scans):.1f} ms; loops "
        f"beside it median {1e3 * np.median(loops):.0f} ms, 99 % {1e3 * np.quantile(loops, 0.99):.0f} ms, longest "
        f"{1e3 * max(loops):.0f} ms a search"
    )


def _median(what) -> float:
    times = []
    for _ in range(TIMES):
        begin = time.perf_counter()
        what()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


if __name__ == "__main__":
    main()
