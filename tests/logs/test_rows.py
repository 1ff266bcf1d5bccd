from math import inf, nan

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from echogrid.logs.rows import Table

TABLE = Table(("t", "x", "theta", "r0", "r1"))
EDGES = [0.0, -0.0, 100.0, 100.1, -0.1, 1e7, 1e11, inf, -inf, nan]
VALUES = st.one_of(st.floats(-1e12, 1e12), st.sampled_from(EDGES))


@given(st.lists(VALUES, min_size=5, max_size=5))
def test_a_plain_row_is_a_right_one_of_finite_numbers(row):
    good, fault = TABLE.check(np.array([row]))
    assert TABLE.plain(row) == (good == 1 and fault is None and bool(np.isfinite(row).all()))
