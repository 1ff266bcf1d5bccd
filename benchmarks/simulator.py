"""Speed of the simulator: scans/s of a 24-sonar ring in a world of 30 walls with 3 bounces. Target: 2,000.

Also checks that the same seed gives the same readings.
"""

import time

import numpy as np

from echogrid import Robot, World
from echogrid.simulation.rooms import box
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import SMOOTH_M, polyline

SCANS, RUNS = 2048, 5


def world_of_30_walls() -> World:
    rng = np.random.default_rng(4)
    outline = polyline([[0, 0], [9, 0], [9, 4], [7, 4], [7, 7], [0, 7]], closed=True)
    boxes = [
        box(rng, x, y, 0.4, 1.0) for x, y in [(1.2, 1.2), (3.5, 5.5), (5.0, 1.5), (1.5, 5.5), (7.5, 2.5), (4, 3.3)]
    ]
    walls = np.concatenate([outline, *boxes])
    assert len(walls) == 30
    return World("bench", walls, np.full(30, SMOOTH_M), np.zeros((0, 3)))


def main() -> None:
    world, robot = world_of_30_walls(), Robot.load("b21")
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0], [9, 7], (50 * SCANS, 2))
    points = points[world.clearance(points) > 0.35][:SCANS]
    poses = np.column_stack([points, rng.uniform(-np.pi, np.pi, SCANS)])
    simulator = Simulator(world, robot)
    first = simulator.ranges(poses, np.random.default_rng(1))
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        again = simulator.ranges(poses, np.random.default_rng(1))
        times.append(time.perf_counter() - begin)
    same = "the same" if first.tobytes() == again.tobytes() else "DIFFERENT"
    print(f"simulator: {SCANS} scans x {robot.sonars} sonars, {len(world.walls)} walls, 3 bounces")
    print(f"  {SCANS / np.median(times):.0f} scans/s (median of {RUNS} runs; best {SCANS / min(times):.0f})")
    print(f"  readings for the same seed: {same}")


if __name__ == "__main__":
    main()
