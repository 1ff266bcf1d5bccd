import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.geometry import compose, inverse, wrap
from echogrid.position import graph


def loop_of(rng, nodes=12, noise=0.0):
    """A walk, and edges that measure it: each step, and every fourth node from the first of its four."""
    step = np.column_stack(
        [rng.uniform(0.2, 1.0, nodes - 1), rng.normal(0, 0.1, nodes - 1), rng.normal(0, 0.5, nodes - 1)]
    )
    poses = [np.zeros(3)]
    for each in step:
        poses.append(compose(poses[-1], each))
    poses = np.array(poses)
    first = np.concatenate([np.arange(nodes - 1), np.arange(0, nodes - 4, 4)])
    second = np.concatenate([np.arange(1, nodes), np.arange(4, nodes, 4)[: len(np.arange(0, nodes - 4, 4))]])
    measured = compose(inverse(poses[first]), poses[second])
    measured = compose(measured, noise * rng.normal(size=measured.shape))
    root = rng.normal(size=(len(first), 3, 3))
    information = root @ root.swapaxes(1, 2) + np.eye(3)
    return poses, graph.Edges(first, second, measured, information, np.full(len(first), np.inf))


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_derivatives_are_those_by_finite_differences(seed):
    rng = np.random.default_rng(seed)
    poses, edges = loop_of(rng, 5, 0.1)
    told = graph.residuals(poses, edges)
    small = 1e-6
    for node in range(len(poses)):
        for k in range(3):
            moved = poses.copy()
            moved[node, k] += small
            change = (graph.residuals(moved, edges).off - told.off) / small
            expected = np.where((edges.first == node)[:, None], told.by_first[:, :, k], 0) + np.where(
                (edges.second == node)[:, None], told.by_second[:, :, k], 0
            )
            np.testing.assert_allclose(change, expected, atol=1e-4)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_what_agrees_is_found_from_anywhere_near(seed):
    rng = np.random.default_rng(seed)
    poses, edges = loop_of(rng)
    start = poses + rng.normal(0, 0.2, poses.shape)
    start[0] = poses[0]
    found = graph.solve(start, edges, np.zeros(0), np.zeros(0), rounds=50)
    np.testing.assert_allclose(found.poses[:, :2], poses[:, :2], atol=1e-4)
    np.testing.assert_allclose(wrap(found.poses[:, 2] - poses[:, 2]), 0, atol=1e-4)


def test_at_the_solution_no_small_step_agrees_better():
    rng = np.random.default_rng(3)
    poses, edges = loop_of(rng, noise=0.1)
    found = graph.solve(poses, edges, np.zeros(0), np.zeros(0), rounds=50, tolerance=1e-9)

    def cost(at):
        off = graph.residuals(at, edges).off
        return np.einsum("ni,nij,nj->", off, edges.information, off)

    least = cost(found.poses)
    for _ in range(50):
        step = rng.normal(0, 1e-3, poses.shape)
        step[0] = 0
        assert cost(found.poses + step) > least


def test_an_outlier_with_a_kernel_hardly_moves_what_else_is_known():
    rng = np.random.default_rng(4)
    poses, edges = loop_of(rng)
    wrong = graph.Edges(
        np.array([0]), np.array([11]), np.array([[30.0, -20.0, 1.0]]), 100 * np.eye(3)[None], np.array([3.0])
    )
    information = edges.information * 100
    held = graph.solve(
        poses, graph.joined([edges._replace(information=information), wrong]), np.zeros(0), np.zeros(0)
    )
    believed = graph.joined([edges._replace(information=information), wrong._replace(width=np.array([np.inf]))])
    moved = graph.solve(poses, believed, np.zeros(0), np.zeros(0))
    assert np.abs(held.poses - poses).max() < 0.02
    assert np.abs(moved.poses - poses).max() > 1


def test_a_constant_error_of_odometry_is_found_with_the_poses():
    rng = np.random.default_rng(5)
    poses, edges = loop_of(rng)
    odometry = edges.first + 1 == edges.second
    by = np.zeros((len(edges.first), 3, 1))
    by[odometry, 2, 0] = 1.0
    measured = edges.measured.copy()
    measured[odometry, 2] -= 0.05
    loose = np.where(odometry, 1.0, 100.0)[:, None, None] * np.eye(3)
    found = graph.solve(
        poses, edges._replace(measured=measured, by=by, information=loose), np.zeros(1), np.full(1, 10.0)
    )
    assert found.parameters[0] == pytest.approx(0.05, abs=0.01)


def back_and_forth(rng, scale, pieces=400):
    """A straight way to and fro, by odometry whose lengths are to be multiplied, and loops to its first pass."""
    x = np.abs((np.arange(pieces) * 0.5 + 10) % 20 - 10)
    poses = np.column_stack([x, np.zeros((pieces, 2))])
    at = np.arange(pieces - 1)
    spread = np.array([0.03, 0.03, 0.01])
    step = (poses[1:] - poses[:-1]) / [scale, 1, 1] + spread * rng.normal(size=(pieces - 1, 3))
    later = np.arange(40, pieces)
    loops = poses[later] - poses[later % 40] + 0.02 * rng.normal(size=(len(later), 3))
    by, none = np.zeros((pieces - 1, 3, 1)), np.full(pieces - 1, np.inf)
    by[:, :2, 0] = step[:, :2]
    odometry = graph.Edges(at, at + 1, step, np.tile(np.diag(spread**-2), (pieces - 1, 1, 1)), none, by)
    tied = graph.Edges(
        later % 40, later, loops, np.tile(np.eye(3) / 0.02**2, (len(later), 1, 1)), np.full(len(later), np.inf)
    )
    return poses, odometry, tied


def test_the_scale_of_odometry_is_no_smaller_for_all_its_errors():
    """Loops back to a place say nothing of the scale: what is found is 0, not what makes errors less."""
    found = {"unit": [], "m": []}
    for seed in range(10):
        poses, odometry, tied = back_and_forth(np.random.default_rng(seed), 1.0)
        for name, unit in (("unit", np.zeros(len(odometry.first), dtype=int)), ("m", None)):
            edges = graph.joined([odometry._replace(unit=unit), tied])
            told = graph.solve(poses, edges, np.zeros(1), np.full(1, 0.02), rounds=50)
            found[name].append(told.parameters[0])
    assert abs(np.mean(found["unit"])) < 0.003
    assert np.mean(found["m"]) < -0.02


@pytest.mark.parametrize("scale", [0.97, 1.05])
def test_the_scale_of_odometry_is_found_where_places_far_apart_are_known(scale):
    poses, odometry, _ = back_and_forth(np.random.default_rng(1), scale)
    known = np.arange(5, len(poses), 5)
    exact, none = np.tile(np.eye(3) / 0.05**2, (len(known), 1, 1)), np.full(len(known), np.inf)
    far = graph.Edges(np.zeros(len(known), dtype=int), known, poses[known] - poses[0], exact, none)
    edges = graph.joined([odometry._replace(unit=np.zeros(len(odometry.first), dtype=int)), far])
    told = graph.solve(poses, edges, np.zeros(1), np.full(1, 0.1), rounds=50)
    assert told.parameters[0] == pytest.approx(scale - 1, abs=0.006)


def test_derivatives_hold_in_units_that_are_found():
    poses, odometry, tied = back_and_forth(np.random.default_rng(2), 0.9, 60)
    edges = graph.joined([odometry._replace(unit=np.zeros(59, dtype=int)), tied])
    told = graph.solve(poses, edges, np.zeros(1), np.full(1, 0.1), rounds=100, tolerance=1e-10)

    def cost(at, scale):
        assert edges.by is not None
        off = graph.residuals(at, edges, edges.measured + edges.by[..., 0] * scale).off
        off[edges.unit == 0, :2] /= 1 + scale
        return graph.chi2(off, edges.information).sum() + (scale / 0.1) ** 2

    least, rng = cost(told.poses, told.parameters[0]), np.random.default_rng(3)
    for _ in range(50):
        step = rng.normal(0, 1e-4, poses.shape)
        step[0] = 0
        assert cost(told.poses + step, told.parameters[0] + rng.normal(0, 1e-4)) > least
    for change in (-1e-4, 1e-4):  # all larger or smaller, as what is found must not prefer
        larger = told.poses * [1 + change, 1 + change, 1]
        assert cost(larger, (1 + told.parameters[0]) * (1 + change) - 1) > least


def test_covariances_are_those_of_the_dense_inverse():
    rng = np.random.default_rng(6)
    poses, edges = loop_of(rng, 6)
    found = graph.solve(poses, edges, np.zeros(0), np.zeros(0))
    told = graph.residuals(found.poses, edges)
    dense = np.zeros((18, 18))
    for n, (i, j) in enumerate(zip(edges.first, edges.second, strict=True)):
        by = np.zeros((3, 18))
        by[:, 3 * i : 3 * i + 3], by[:, 3 * j : 3 * j + 3] = told.by_first[n], told.by_second[n]
        dense += by.T @ edges.information[n] @ by
    expected = np.linalg.inv(dense[3:, 3:])
    got = found.covariance([2, 5])
    np.testing.assert_allclose(got[0, 0], expected[3:6, 3:6], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(got[0, 1], expected[3:6, 12:15], rtol=1e-4, atol=1e-7)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10_000))
def test_poses_and_covariances_are_those_that_gtsam_finds(seed):
    rng = np.random.default_rng(seed)
    poses, edges = loop_of(rng, 30, noise=0.01)
    start = poses + rng.normal(0, 0.05, poses.shape)
    start[0] = poses[0]
    known, first_guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
    known.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*poses[0]), gtsam.noiseModel.Isotropic.Precision(3, 1e9)))
    for i, j, measured, information in zip(*edges[:4], strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information)
        known.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*measured), noise))
    for i, pose in enumerate(start):
        first_guess.insert(i, gtsam.Pose2(*pose))
    theirs = gtsam.LevenbergMarquardtOptimizer(known, first_guess).optimize()
    at = [theirs.atPose2(i) for i in range(len(poses))]
    expected = np.array([(pose.x(), pose.y(), pose.theta()) for pose in at])
    found = graph.solve(start, edges, np.zeros(0), np.zeros(0), rounds=50, tolerance=1e-8)
    off, wrong = found.poses - expected, found.poses - poses
    off[:, 2], wrong[:, 2] = wrap(off[:, 2]), wrap(wrong[:, 2])
    # its residuals are logarithms of poses, which differ from ours by squares of what is small
    assert np.abs(off).max() < 0.02 * np.abs(wrong).max()
    turned = np.eye(3)
    turned[:2, :2] = at[20].rotation().matrix()
    told = turned @ gtsam.Marginals(known, theirs).marginalCovariance(20) @ turned.T  # from its own frame
    np.testing.assert_allclose(found.covariance([20])[0, 0], told, rtol=0.02, atol=0.02 * told.max())
