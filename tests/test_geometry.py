import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echogrid.geometry import compose, inverse, transform, wrap

metres = st.floats(-100, 100)
poses = st.tuples(metres, metres, st.floats(-10, 10)).map(np.array)
points = arrays(float, st.tuples(st.integers(0, 5), st.just(2)), elements=metres)
angles = st.floats(-50, 50)


def same_pose(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.allclose(a[:2], b[:2], atol=1e-9) and abs(wrap(a[2] - b[2])) < 1e-9)


@given(poses)
def test_a_pose_after_its_inverse_is_no_move(T_a_b):
    assert same_pose(compose(T_a_b, inverse(T_a_b)), np.zeros(3))
    assert same_pose(compose(inverse(T_a_b), T_a_b), np.zeros(3))


@given(poses)
def test_the_inverse_of_the_inverse_is_the_pose(T_a_b):
    assert same_pose(inverse(inverse(T_a_b)), T_a_b)


@given(poses, poses, poses)
def test_composition_is_associative(T_a_b, T_b_c, T_c_d):
    assert same_pose(compose(compose(T_a_b, T_b_c), T_c_d), compose(T_a_b, compose(T_b_c, T_c_d)))


@given(poses, poses)
def test_the_inverse_of_a_chain_is_the_chain_of_inverses_backwards(T_a_b, T_b_c):
    assert same_pose(inverse(compose(T_a_b, T_b_c)), compose(inverse(T_b_c), inverse(T_a_b)))


@given(poses, poses, points)
def test_a_chain_maps_points_as_its_links_do(T_a_b, T_b_c, p_c):
    np.testing.assert_allclose(
        transform(compose(T_a_b, T_b_c), p_c), transform(T_a_b, transform(T_b_c, p_c)), atol=1e-9
    )


@given(poses, points)
def test_the_inverse_undoes_a_transform(T_a_b, p_b):
    np.testing.assert_allclose(transform(inverse(T_a_b), transform(T_a_b, p_b)), p_b, atol=1e-9)


@given(poses, points)
def test_a_transform_keeps_distances_and_handedness(T_a_b, p_b):
    p_a = transform(T_a_b, p_b)
    np.testing.assert_allclose(
        np.linalg.norm(p_a[:, None] - p_a, axis=-1), np.linalg.norm(p_b[:, None] - p_b, axis=-1), atol=1e-9
    )
    sides_a, sides_b = p_a - T_a_b[:2], p_b
    np.testing.assert_allclose(
        np.outer(sides_a[:, 0], sides_a[:, 1]) - np.outer(sides_a[:, 1], sides_a[:, 0]),
        np.outer(sides_b[:, 0], sides_b[:, 1]) - np.outer(sides_b[:, 1], sides_b[:, 0]),
        atol=1e-7,
    )


def test_a_quarter_turn_to_the_left_takes_forward_to_left():
    T_world_robot = np.array([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(transform(T_world_robot, np.array([[3.0, 0.0], [0.0, 1.0]])), [[1, 5], [0, 2]])


@given(angles, st.integers(-5, 5))
def test_wrap_lands_in_the_half_open_turn_and_keeps_the_direction(angle, turns):
    wrapped = wrap(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.hypot(np.cos(wrapped) - np.cos(angle), np.sin(wrapped) - np.sin(angle)) < 1e-12
    assert abs(np.sin((wrap(angle + 2 * np.pi * turns) - wrapped) / 2)) < 1e-12


@given(arrays(float, 4, elements=angles))
def test_wrap_of_many_is_wrap_of_each(many):
    np.testing.assert_array_equal(wrap(many), [wrap(float(one)) for one in many])


def test_half_a_turn_wraps_to_minus_half_a_turn():
    assert wrap(np.pi) == -np.pi
    assert wrap(-np.pi) == -np.pi


@given(arrays(float, (3, 1, 3), elements=metres), arrays(float, (4, 3), elements=metres))
def test_poses_broadcast_over_leading_axes(left, right):
    whole = compose(left, right)
    assert whole.shape == (3, 4, 3)
    assert all(same_pose(whole[i, j], compose(left[i, 0], right[j])) for i in range(3) for j in range(4))
