from math import cos, sin

import numpy as np
import pytest
from hypothesis import given, settings

from echogrid.ros.rigid import compose, inverse, planar, slope
from rigid_samples import assert_same, matrix, rigids

few = settings(max_examples=40)


@given(rigids, rigids)
@few
def test_poses_are_chained_as_matrices_are(a, b):
    assert_same(compose(a, b), matrix(a) @ matrix(b))


@given(rigids)
@few
def test_a_pose_and_its_inverse_are_nothing(a):
    assert_same(compose(a, inverse(a)), np.eye(4))
    assert_same(inverse(a), np.linalg.inv(matrix(a)))


@given(rigids, rigids, rigids)
@few
def test_it_does_not_matter_which_two_of_three_poses_are_chained_first(a, b, c):
    assert_same(compose(compose(a, b), c), matrix(compose(a, compose(b, c))))


@given(rigids)
@few
def test_in_the_plane_a_pose_looks_where_its_x_axis_points(a):
    ahead = matrix(a)[:3, 0]
    x, y, bearing = planar(a)
    assert (x, y) == a.translation[:2]
    flat = np.hypot(*ahead[:2])
    np.testing.assert_allclose(flat * np.array([cos(bearing), sin(bearing)]), ahead[:2], atol=1e-9)
    assert slope(a) == pytest.approx(ahead[2], abs=1e-9)
