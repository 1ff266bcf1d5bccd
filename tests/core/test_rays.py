"""What is added along rays, against numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid import _core
from echogrid.errors import UsageError


@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(1, 4))
def test_each_point_adds_to_its_cell_and_those_outside_to_none(seed, fans, rays):
    rng = np.random.default_rng(seed)
    at, angles = rng.uniform(-2, 4, (fans, 2)), rng.uniform(-4, 4, (fans, rays))
    first, counts = rng.uniform(0, 2, fans), rng.integers(-1, 9, fans)
    cells, corner, cell, step = np.zeros((12, 17)), (-0.7, 0.3), 0.11, 0.13
    _core.add_rays(at, angles, first, step, counts, 0.5, corner, cell, cells)
    expected = np.zeros_like(cells)
    for i in range(fans):
        radius = first[i] + step * np.arange(max(counts[i], 0))
        for angle in angles[i]:
            cols, rows = (
                np.floor((at[i, k] + radius * turned(angle) - corner[k]) / cell).astype(int)
                for k, turned in enumerate((np.cos, np.sin))
            )
            held = (cols >= 0) & (rows >= 0) & (cols < 17) & (rows < 12)
            np.add.at(expected, (rows[held], cols[held]), 0.5)
    np.testing.assert_array_equal(cells, expected)


def test_part_of_a_map_is_written_to_in_place():
    whole = np.zeros((20, 30))
    part = whole[5:9, 10:14]
    one = np.zeros(1)
    _core.add_rays(np.array([[0.5, 2.5]]), one[:, None], one, 1.0, np.array([9]), 2.0, (0.0, 0.0), 1.0, part)
    expected = np.zeros_like(whole)
    expected[7, 10:14] = 2
    np.testing.assert_array_equal(whole, expected)


@pytest.mark.parametrize("cell", [0.0, -1.0, np.nan, np.inf])
def test_a_cell_that_is_none_is_refused(cell):
    with pytest.raises(UsageError, match=r"cell: found .*, expected m > 0"):
        _core.add_rays(np.zeros((1, 2)), np.zeros((1, 1)), np.zeros(1), 1.0, np.ones(1, int), 1.0, (0.0, 0.0), cell,
                       np.zeros((2, 2)))  # fmt: skip


def test_arrays_of_other_shapes_are_refused():
    with pytest.raises(UsageError, match=r"first: found 2, expected 3"):
        _core.add_rays(np.zeros((3, 2)), np.zeros((3, 1)), np.zeros(2), 1.0, np.ones(3, int), 1.0, (0.0, 0.0), 1.0,
                       np.zeros((2, 2)))  # fmt: skip
