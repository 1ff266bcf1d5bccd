"""Maps for the tests of what is written of a map."""

import numpy as np

from echogrid.grid import Grid

PATH = np.array([[0.1, 0.1, 0.0], [0.4, 0.3, 0.1]])
NO_PATH = np.zeros((0, 3))


def a_grid(rows=8, cols=11, resolution=0.12, origin=(-1.5, 2.25), seed=0):
    rng = np.random.default_rng(seed)
    observed = rng.random((rows, cols)) < 0.7
    log_odds = np.where(observed, rng.normal(0, 3, (rows, cols)), 0).astype(np.float32)
    return Grid(log_odds, observed, resolution, origin)


def one_wall(row, col, rows=20, cols=30, resolution=0.1, origin=(-1.0, 5.0)):
    """A grid that is free but for one occupied cell."""
    log_odds = np.full((rows, cols), -3, dtype=np.float32)
    log_odds[row, col] = 3
    return Grid(log_odds, np.ones((rows, cols), bool), resolution, origin)
