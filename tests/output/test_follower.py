"""Few maps of a drive are picked, whatever its length."""

from itertools import pairwise

import numpy as np
import pytest

from echogrid.output.follower import MAP_PERIOD_S, MAX_MAP_CELLS, MAX_MAPS, Pace

START = 1_700_000_000.25


@pytest.mark.parametrize(("hours", "least"), [(0.1, 20), (1, 35), (10, 50), (1000, 55)])
def test_a_drive_of_any_length_has_a_bounded_number_of_maps_spread_over_it(hours, least):
    pace = Pace()
    pace.due(START, 0)
    stamps = START + np.arange(0, hours * 3600, max(0.5, hours / 10))
    taken = [stamp - START for stamp in stamps if pace.due(stamp, 1000)]
    assert least <= len(taken) < MAX_MAPS
    assert taken[0] == pytest.approx(MAP_PERIOD_S, abs=max(0.5, hours / 10))
    assert all(b - a >= MAP_PERIOD_S for a, b in pairwise(taken))
    assert taken[-1] >= 0.8 * min(hours, 15) * 3600


def test_large_maps_are_fewer():
    pace = Pace()
    assert sum(pace.due(stamp, MAX_MAP_CELLS // 3) for stamp in range(0, 10_000, 50)) == 3


def test_a_map_without_cells_is_none():
    pace = Pace()
    assert not any(pace.due(stamp, 0) for stamp in range(100))
    assert pace.due(100, 1)
