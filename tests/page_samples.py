"""A drive and its map for the tests of the page."""

import numpy as np

from echogrid.frame import Frame
from echogrid.grid import P_MAX, P_MIN, Grid
from echogrid.output.recording import Recording
from echogrid.robot import Robot, Transducer

ROBOT = Robot(
    "</script ><b>duo", 0.2, Transducer("t", 5e4, 0.02), 0.2, 4.0, 0.5, np.array([[0.1, 0, 0], [0, 0.1, 1.5]])
)
P_STEP = (P_MAX - P_MIN) / 254


def a_grid(rows=60, cols=90, resolution=0.1, origin=(-2.0, 3.0), seed=0):
    rng = np.random.default_rng(seed)
    observed = np.zeros((rows, cols), bool)
    observed[5:-7, 3:-4] = True
    observed[20:25, 30:34] = False
    log_odds = np.where(observed, rng.normal(0, 2, (rows, cols)), 0).astype(np.float32)
    views = np.where(observed, rng.integers(1, 70_000, (rows, cols)), 0).astype(np.int32)
    return Grid(log_odds, observed, resolution, origin, views)


def a_frame(k, mounts=None):
    return Frame(
        100 + 0.25 * k, np.array([0.1 * k, 4 + 0.02 * k, 6.3 * k]), np.array([1 + k / 1000, np.inf]), mounts=mounts
    )


def a_recording(frames=40, grid=None):
    """A drive that was mapped by tens, the map growing to the right, without reading ahead."""
    grid = grid or a_grid()
    recording = Recording(ROBOT)
    for k in range(frames):
        recording.add(a_frame(k))
        if k % 10 == 9:
            recording.keep(part_of(grid, 20 + 2 * k))
    return recording


def part_of(grid, cols):
    """The grid with nothing right of a column, cut there."""
    return Grid(grid.log_odds[:, :cols], grid.observed[:, :cols], grid.resolution, grid.origin)
