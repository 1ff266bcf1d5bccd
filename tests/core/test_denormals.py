"""Numbers too small to be normal take a hundred times as long: inside of the kernels they count as zero."""

import numpy as np
import pytest

from echogrid import _core
from echogrid.models.networks import set_core
from echogrid.models.networks.set_layers import initial

TINY = np.float32(1e-40)


def weights(**told):
    """Of a network that says nothing but what it is told."""
    return {name: np.zeros_like(value) for name, value in initial(np.random.default_rng(0), 4).items()} | told


def tables(**told):
    array = set_core.sonar_array(np.zeros((1, 3)), 3.0, 0.2, 0.4, False)
    network = set_core.network(weights(**told), None)
    return network.tables(array, np.ones((1, 1), np.float32), np.zeros((1, 4), np.float32))


def rings(value):
    """Tables where the log-odds of all points are 1e36 times a value."""
    return tables(b3=np.full(4, value, np.float32), wr=np.full((4, 8), 2.5e35, np.float32)).values()[0, 0, 10:]


def views(weight):
    """How many cells a scan of a weight speaks of."""
    layers, seen = [np.zeros((130, 130), np.float32) for _ in range(5)], np.zeros((130, 130), np.int32)
    corner, first = np.full((1, 2), -2.52, np.float32), np.zeros((1, 2), np.int32)
    told = tables(br=np.ones(8, np.float32))
    told.add(corner, np.zeros(1), first, np.full(1, weight, np.float32), 0.04, layers, seen)
    return np.sum(seen)


def observed(sum_):
    cells = [np.full((4, 4), value, np.float32) for value in (sum_, sum_, 0, 0, 1, 0)]
    log_odds, seen = np.zeros((4, 4), np.float32), np.zeros((4, 4), bool)
    network = set_core.network(weights(), None)
    network.read_out(cells, (0, 0), (2, 2), np.zeros(0, np.float32), 1.0, 0.0, -4.0, log_odds, seen, (0, 0))
    return np.sum(seen)


@pytest.mark.parametrize(
    "kernel", [lambda value: np.max(rings(value)), views, observed], ids=["scan", "sums", "cells"]
)
def test_they_count_as_zero_in_a_kernel(kernel):
    assert kernel(TINY) == kernel(0.0) == 0
    assert kernel(1e-36) > 0


def test_they_stay_what_they_are_outside():
    before = _core.threads()
    try:
        for threads in (1, 2):
            _core.set_threads(threads)
            views(1.0), observed(1.0), rings(1.0)
            assert float("1e-300") * 1e-10 == float("1e-310") != 0
            assert TINY * np.float32(1) == TINY != 0
    finally:
        _core.set_threads(before)
