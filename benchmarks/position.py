"""How long localising takes: ``python -m benchmarks.position``.

2,000 particles moved, weighed by a scan of 24 sonars and drawn anew, beside the same look-ups done by a plain gather
of numpy; then the sample, tracked in its own map, beside the time that its drive took.
"""

import time
from importlib import resources

import numpy as np

from echogrid import Localiser, Robot, build_map, load_log
from echogrid.position.beams import Beams
from echogrid.position.motion import Drift
from echogrid.position.particles import Particles

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


def _median(what) -> float:
    times = []
    for _ in range(TIMES):
        begin = time.perf_counter()
        what()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


if __name__ == "__main__":
    main()
