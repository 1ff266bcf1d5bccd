"""What the objects of a session in Python show themselves as: one line, whatever they hold."""

import numpy as np
import pytest

from commands import SAMPLE, TRUTH
from echogrid import Grid, Robot, World, build_map, load_log, read_truth, sensor_model

B21 = Robot.load("b21")
LOG = load_log(SAMPLE, B21)


def grid():
    *_, built = build_map(list(LOG)[:3], B21, "cone")
    return built


SHOWN = {
    "robot": (lambda: B21, "Robot('b21', 24 sonars of 0.26 to 5 m, beam 25 deg)"),
    "log": (lambda: LOG, "sample.csv', 24 sonars, robot 'b21')"),
    "log without robot": (lambda: load_log(SAMPLE), "24 sonars, robot None)"),
    "frame": (
        lambda: next(iter(LOG)),
        "Frame(stamp=0.0, pose=[1.147, 1.157, -2.475], ranges: 24, 9 echoes from 0.862 to",
    ),
    "grid": (grid, "cells of 0.12 m from ("),
    "no grid": (lambda: Grid(np.zeros((0, 0)), np.zeros((0, 0), bool), 0.1, (0.0, 0.0)), "Grid(0 x 0 cells of 0.1 m"),
    "truth": (
        lambda: read_truth(TRUTH),
        "Truth(64 x 85 cells of 0.1 m from (-1.1, -0.6) m: 292 surface, 2837 free, 2311",
    ),
    "set network": (lambda: sensor_model("set-network"), "SetNetwork('set-network', 16586 weights)"),
    "network": (lambda: sensor_model("network"), "Network('network', 1377 weights)"),
    "world": (lambda: World.load("sample"), "World('sample', "),
}


@pytest.mark.parametrize("kind", SHOWN)
def test_it_shows_itself_in_one_line(kind):
    make, expected = SHOWN[kind]
    shown = repr(make())
    assert expected in shown
    assert "\n" not in shown
    assert len(shown) < 200


def test_a_grid_shows_how_much_of_it_was_observed():
    observed = np.arange(12).reshape(3, 4) < 3
    grid = Grid(np.zeros((3, 4), np.float32), observed, 0.25, (-1.0, 2.5))
    assert repr(grid) == "Grid(3 x 4 cells of 0.25 m from (-1, 2.5) m, 25% observed)"
