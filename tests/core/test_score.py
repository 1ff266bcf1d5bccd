import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core_oracles import scores
from echogrid import _core
from echogrid.errors import UsageError

NO_POINTS = np.zeros((0, 2), np.float32)


def a_map(seed, rows=40, cols=31):
    """Half of it unknown."""
    rng = np.random.default_rng(seed)
    b = rng.uniform(-1, 1, (rows, cols)) * (rng.random((rows, cols)) < 0.5)
    return b.astype(np.float32)


def a_view(seed, points=300, reach=2.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-reach, reach, (points, 2)).astype(np.float32), rng.uniform(-1, 1, points).astype(np.float32)


@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(0, 50), st.integers(0, 50)),
    points=st.integers(0, 200),
    resolution=st.sampled_from([0.04, 0.05, 0.12, 1.0]),
    origin=st.tuples(*[st.floats(-1000, 1000)] * 2),
)
def test_scores_are_the_sums_of_the_formula(seed, shape, points, resolution, origin):
    b, (p, a) = a_map(seed, *shape), a_view(seed, points, 10 * resolution)
    rng = np.random.default_rng(seed)
    span = (np.array(shape[::-1]) + 60) * resolution
    poses = np.column_stack([origin + rng.uniform(-0.5, 1, (20, 2)) * span, rng.uniform(-10, 10, 20)])
    found = _core.PoseScorer(b, origin, resolution).score(p, a, poses)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, scores(b, origin, resolution, p, a, poses), rtol=1e-5, atol=2e-3)


def test_a_point_in_the_middle_of_a_cell_has_the_value_of_the_cell():
    b = a_map(1)
    scorer = _core.PoseScorer(b, (-3.0, 2.0), 0.5)
    cells = [(0, 0), (0, 30), (39, 0), (39, 30), (17, 11)]
    poses = np.array([[-3 + (col + 0.5) * 0.5, 2 + (row + 0.5) * 0.5, 0.7] for row, col in cells])
    found = scorer.score(np.zeros((1, 2), np.float32), np.array([0.8], np.float32), poses)
    np.testing.assert_allclose(found, [math.log1p(0.8 * float(b[cell])) for cell in cells], atol=1e-6)


def test_what_lies_outside_or_is_unknown_counts_nothing():
    b = np.full((4, 5), 0.9, np.float32)
    p, a = a_view(3)
    scorer = _core.PoseScorer(b, (0.0, 0.0), 0.1)
    far = np.array([[2.9 + 0.5, 0, 0], [0, -3, 1], [1e7, 1e7, 1], [-1e300, 1e300, 2], [0, 1e18, 3.0]])
    assert np.array_equal(scorer.score(p, a, far), np.zeros(5))
    unknown = _core.PoseScorer(np.zeros((4, 5), np.float32), (0.0, 0.0), 0.1)
    assert np.array_equal(unknown.score(p, a, np.zeros((1, 3))), [0])
    assert np.array_equal(scorer.score(NO_POINTS, np.zeros(0, np.float32), np.zeros((1, 3))), [0])


def test_half_a_cell_outside_a_value_has_faded_to_half():
    scorer = _core.PoseScorer(np.array([[0.8]], np.float32), (0.0, 0.0), 1.0)
    poses = np.array([[0.5 + off, 0.5, 0] for off in (0, 0.25, 0.5, 1.0, 1.5)])
    found = scorer.score(np.zeros((1, 2), np.float32), np.ones(1, np.float32), poses)
    np.testing.assert_allclose(np.expm1(found), [0.8, 0.6, 0.4, 0, 0], atol=1e-6)


def test_a_map_far_from_the_origin_is_as_sharp():
    # A float32 of 100 km would be sharp to 8 mm.
    b, (p, a) = a_map(5), a_view(6)
    poses = np.random.default_rng(7).uniform(0, [1.5, 2, 6], (50, 3))
    near = _core.PoseScorer(b, (0.0, 0.0), 0.05).score(p, a, poses)
    far = _core.PoseScorer(b, (1e5, -1e5), 0.05).score(p, a, poses + np.array([1e5, -1e5, 0]))
    np.testing.assert_allclose(far, near, atol=1e-4)


def test_who_is_sure_of_the_opposite_scores_what_float32_can_tell_from_never():
    scorer = _core.PoseScorer(np.ones((9, 9), np.float32), (-4.5, -4.5), 1.0)
    for points in (1, 4, 64, 1000):
        found = scorer.score(np.zeros((points, 2), np.float32), -np.ones(points, np.float32), np.zeros((1, 3)))
        np.testing.assert_allclose(found, [-24 * math.log(2) * points], rtol=1e-6)
        agreed = scorer.score(np.zeros((points, 2), np.float32), np.ones(points, np.float32), np.zeros((1, 3)))
        np.testing.assert_allclose(agreed, [math.log(2) * points], rtol=1e-6)


def test_the_true_pose_scores_best():
    b = a_map(8, 60, 60)
    row, col = np.nonzero(b)
    p = np.column_stack([col, row]) * 0.1 + 0.05 - 3.0
    poses = np.array([[x, y, h] for h in (-0.05, 0, 0.05) for x in (2.9, 3.0, 3.1) for y in (2.9, 3.0, 3.1)])
    found = _core.PoseScorer(b, (0.0, 0.0), 0.1).score(p.astype(np.float32), b[row, col], poses)
    assert np.array_equal(poses[np.argmax(found)], [3, 3, 0])


@pytest.fixture
def threads():
    before = _core.threads()
    yield _core.set_threads
    _core.set_threads(before)


def test_the_number_of_threads_changes_no_bit(threads):
    b, (p, a) = a_map(9), a_view(10)
    poses = np.random.default_rng(11).uniform(-1, 3, (1001, 3))
    scorer, found = _core.PoseScorer(b, (0.0, 0.0), 0.05), []
    for count in (1, 2, 3, 7):
        threads(count)
        found += [scorer.score(p, a, poses).tobytes() for _ in range(5)]
    assert len(set(found)) == 1


def test_programs_that_score_from_threads_of_their_own_get_the_same(threads):
    b, (p, a) = a_map(12), a_view(13)
    poses = np.random.default_rng(14).uniform(-1, 3, (400, 3))
    scorer, found = _core.PoseScorer(b, (0.0, 0.0), 0.05), []
    expected = scorer.score(p, a, poses).tobytes()
    threads(2)

    def work():
        found.extend(scorer.score(p, a, poses).tobytes() for _ in range(20))

    workers = [threading.Thread(target=work) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert set(found) == {expected}
    assert len(found) == 80


B, P, A, POSES = np.zeros((2, 2), np.float32), np.zeros((3, 2), np.float32), np.zeros(3, np.float32), np.zeros((1, 3))


@pytest.mark.parametrize(
    ("told", "map_", "view"),
    [
        ("b: found 1.5, expected 2 p - 1 in -1 to 1", {"b": B + np.float32(1.5)}, {}),
        ("b: found nan, expected 2 p - 1 in -1 to 1", {"b": B + np.float32("nan")}, {}),
        ("resolution: found 0, expected m > 0", {"resolution": 0.0}, {}),
        ("resolution: found nan, expected m > 0", {"resolution": math.nan}, {}),
        ("origin: found (0, inf), expected m", {"origin": (0.0, math.inf)}, {}),
        ("points: found 3 x 3, expected n x 2", {}, {"points": np.zeros((3, 3), np.float32)}),
        (
            "points[1]: found nan, expected m, at most 2^16 cells away",
            {},
            {"points": P + np.array([[0, math.nan, 0]]).T},
        ),
        ("points[0]: found 1e+30, expected m, at most 2^16 cells away", {}, {"points": P + 1e30}),
        ("a: found 2 values for 3 points, expected one each", {}, {"a": A[:2]}),
        ("a: found -2, expected 2 p - 1 in -1 to 1", {}, {"a": A - 2}),
        ("poses: found 1 x 2, expected n x 3", {}, {"poses": POSES[:, :2]}),
        ("poses[0]: found inf, expected m, m, rad", {}, {"poses": POSES + np.inf}),
    ],
)
def test_what_cannot_be_scored_is_refused(told, map_, view):
    given_map = {"b": B, "origin": (0.0, 0.0), "resolution": 0.1} | map_
    given_view = {"points": P, "a": A, "poses": POSES} | view
    given_view["points"] = given_view["points"].astype(np.float32)
    with pytest.raises(UsageError) as raised:
        _core.PoseScorer(**given_map).score(**given_view)
    assert str(raised.value) == told
