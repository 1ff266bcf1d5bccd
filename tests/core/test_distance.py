"""The distance from marked cells, against scipy's and a search of all pairs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from echogrid import _core


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40), st.sampled_from([0.001, 0.02, 0.3, 0.99]))
def test_it_is_that_of_scipy(seed, rows, cols, share):
    marked = np.random.default_rng(seed).random((rows, cols)) < share
    found = _core.distance(marked)
    assert found.dtype == np.float32
    expected = ndimage.distance_transform_edt(~marked) if marked.any() else np.full((rows, cols), np.inf)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("shape", [(0, 0), (0, 7), (7, 0)])
def test_a_map_without_cells(shape):
    assert _core.distance(np.zeros(shape, bool)).shape == shape


def test_of_one_cell_it_is_the_distance_to_it():
    marked = np.zeros((300, 200), bool)
    marked[250, 20] = True
    row, col = np.indices(marked.shape)
    np.testing.assert_allclose(_core.distance(marked), np.hypot(row - 250, col - 20), rtol=1e-6)


def test_what_is_not_of_truth_values_is_refused():
    with pytest.raises(TypeError):
        _core.distance(np.zeros((3, 3)))
