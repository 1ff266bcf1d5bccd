"""Poses in space for tests, and the matrices that say what they mean."""

from math import pi

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from echogrid.ros.rigid import Rigid

numbers = st.floats(-50.0, 50.0).map(lambda value: round(value, 6))
unit = st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)
rigids = st.builds(
    lambda t, q: Rigid(tuple(t), tuple((np.array(q) / np.linalg.norm(q)).tolist())), st.tuples(*[numbers] * 3), unit
)
angles = st.floats(-pi, pi)


def matrix(rigid):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat(rigid.rotation).as_matrix()
    out[:3, 3] = rigid.translation
    return out


def yawed(yaw, pitch=0.0, roll=0.0):
    return tuple(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat().tolist())


def assert_same(found, expected, atol=1e-9):
    np.testing.assert_allclose(matrix(found), expected, atol=atol)
