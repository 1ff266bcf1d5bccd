import random
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from echogrid.ros import transforms
from echogrid.ros.rigid import IDENTITY
from echogrid.ros.transforms import Transforms
from rigid_samples import angles, assert_same, matrix, numbers, rigids, yawed

FLAT = (0.0, 0.0, 0.0, 1.0)
few = settings(max_examples=40)


def turned_by(one, other):
    return float(np.arccos(np.clip((np.trace(one.as_matrix().T @ other.as_matrix()) - 1) / 2, -1, 1)))


def rigid(transforms, target, source, stamp, reach=0.0):
    found = transforms.rigid(target, source, stamp, reach)
    assert found is not None
    return found


def pose(transforms, target, source, stamp, reach=0.0):
    found = transforms.pose(target, source, stamp, reach)
    assert found is not None
    return found


def heard(*samples, **kind):
    """``b`` in ``a`` at some times: (stamp, x, yaw)."""
    found = Transforms()
    for stamp, x, yaw in samples:
        assert found.put("a", "b", stamp, (x, 2 * x, 0.0), yawed(yaw), **kind) is None
    return found


@example(3.0, -3.0, 0.5, 0.0, 0.0)
@example(-2.0, 2.0, 0.25, 0.0, 1.0)
@given(angles, angles, st.floats(0.0, 1.0), numbers, numbers)
@few
def test_between_two_samples_the_heading_turns_evenly_on_the_shorter_way(yaw0, yaw1, share, x0, x1):
    turns = Rotation.from_quat([yawed(yaw0), yawed(yaw1)])
    if turned_by(turns[0], turns[1]) > pi - 1e-3:
        return  # either way round is the shorter
    found = heard((10.0, x0, yaw0), (11.0, x1, yaw1)).rigid("a", "b", 10.0 + share)
    expected = np.eye(4)
    expected[:3, :3] = Slerp([0.0, 1.0], turns)(10.0 + share - 10.0).as_matrix()
    x = x0 + (10.0 + share - 10.0) * (x1 - x0)
    expected[:2, 3] = x, 2 * x
    assert_same(found, expected, atol=1e-6)


@given(angles, angles, st.floats(0.0, 1.0), st.tuples(*[st.floats(-0.1, 0.1)] * 4))
@few
def test_a_robot_that_leans_a_little_is_interpolated_nearly_as_on_the_sphere(yaw0, yaw1, share, lean):
    turns = [yawed(yaw0, *lean[:2]), yawed(yaw1, *lean[2:])]
    if abs((yaw1 - yaw0 + pi) % (2 * pi) - pi) > 1.5:
        return
    found = Transforms()
    for stamp, turn in enumerate(turns):
        found.put("a", "b", float(stamp), (0, 0, 0), turn)
    expected = Slerp([0.0, 1.0], Rotation.from_quat(turns))(share)
    apart = turned_by(expected, Rotation.from_quat(rigid(found, "a", "b", share).rotation))
    assert apart < 0.06  # the lean itself is up to 0.2


@given(st.lists(st.tuples(st.integers(0, 40), numbers, angles), min_size=1, max_size=12, unique_by=lambda s: s[0]))
@few
def test_in_which_order_samples_come_does_not_matter(samples):
    samples = [(0.25 * stamp, x, yaw) for stamp, x, yaw in samples]
    mixed = random.Random(1).sample(samples, len(samples)) + samples[:2]
    one, other = heard(*sorted(samples)), heard(*mixed)
    for stamp in np.arange(-1.0, 11.0, 0.3):
        assert one.rigid("a", "b", stamp, 0.5) == other.rigid("a", "b", stamp, 0.5)


def test_a_sample_that_comes_again_replaces_the_one_before():
    found = heard((1.0, 5.0, 0.0), (2.0, 7.0, 0.0), (1.0, 6.0, 0.0))
    assert pose(found, "a", "b", 1.0)[0] == 6.0
    assert pose(found, "a", "b", 1.5)[0] == pytest.approx(6.5)


def test_outside_its_samples_a_frame_is_known_only_as_far_as_one_reaches():
    found = heard((10.0, 1.0, 0.0), (11.0, 3.0, 0.0))
    assert found.pose("a", "b", 9.9) is None
    assert found.pose("a", "b", 11.1) is None
    assert found.pose("a", "b", 9.9, reach=0.05) is None
    assert pose(found, "a", "b", 9.9, reach=0.2)[0] == 1.0  # as it was then
    assert found.pose("a", "b", 11.1, reach=0.05) is None
    assert pose(found, "a", "b", 11.1, reach=0.2)[0] == pytest.approx(3.2)  # as it went on
    assert found.known("a", "b") == found.known("b", "a") == (10.0, 11.0)


def test_a_single_sample_holds_as_far_as_one_reaches():
    found = heard((10.0, 1.0, 0.5))
    assert pose(found, "a", "b", 10.0)[2] == pytest.approx(0.5)
    assert found.pose("a", "b", 13.0) is None
    np.testing.assert_allclose(pose(found, "a", "b", 13.0, reach=5.0), [1.0, 2.0, 0.5])


@pytest.mark.parametrize(("x", "yaw", "gap"), [(0.31, 0.0, 2.1), (0.0, 0.36, 2.1)])
def test_over_a_long_gap_in_which_a_frame_moved_nothing_is_made_up(x, yaw, gap):
    found = heard((0.0, 0.0, 0.0), (gap, x, yaw), (gap + 0.1, x, yaw))
    assert found.rigid("a", "b", gap / 2) is None
    assert found.rigid("a", "b", gap) is not None
    assert found.rigid("a", "b", 0.0) is not None
    assert heard((0.0, 0.0, 0.0), (1.9, x, yaw)).rigid("a", "b", 1.0) is not None
    assert heard((0.0, 0.0, 0.0), (gap, x / 4, yaw / 2)).rigid("a", "b", 1.0) is not None


def test_after_a_jump_a_frame_does_not_go_on_with_it():
    found = heard((0.0, 0.0, 0.0), (10.0, 50.0, 0.0))
    assert pose(found, "a", "b", 11.0, reach=2.0)[0] == 50.0


@given(st.floats(0.01, 5.0), st.floats(0.0, 0.999), st.floats(0.15, 50.0), st.floats(-3.0, 3.0))
@few
def test_a_correction_that_jumps_holds_until_the_next_and_the_drift_of_one_is_interpolated(gap, share, x, yaw):
    """Of odom in map; how soon the next comes is nothing to it."""

    def corrected(by, turn):
        found = Transforms()
        for stamp, to, at in ((0.0, 0.0, 0.0), (gap, by, turn), (gap + 10.0, by, turn)):
            assert found.put("map", "odom", stamp, (to, 2 * to, 0.0), yawed(at)) is None
        return found

    for found, way in ((corrected(x, yaw), x), (corrected(0.0, 0.4), 0.0)):
        np.testing.assert_array_equal(pose(found, "map", "odom", share * gap), np.zeros(3))
        assert pose(found, "map", "odom", gap)[0] == pytest.approx(way)
    drifting = pose(corrected(0.1, 0.3), "map", "odom", share * gap)
    np.testing.assert_allclose(drifting, share * np.array([0.1, 0.2, 0.3]), atol=1e-9)


def test_what_is_static_holds_at_all_times_and_the_last_word_counts():
    found = heard((10.0, 1.0, 0.0), (5.0, 2.0, 0.0), static=True)
    assert {pose(found, "a", "b", stamp)[0] for stamp in (-1e9, 0.0, 5.0, 10.0, 1e9)} == {2.0}
    assert found.known("a", "b") == (-inf, inf)
    assert not found.moves("a", "b")


@st.composite
def trees(draw):
    """Frames f0, f1, ...: the parent of each, whether it is static, and its poses at 0 and 1 s."""
    count = draw(st.integers(2, 8))
    return [
        (draw(st.integers(0, child - 1)), draw(st.booleans()), draw(rigids), draw(rigids))
        for child in range(1, count)
    ]


@given(trees(), st.data())
@few
def test_any_frame_is_found_in_any_other_through_the_tree(tree, data):
    found = Transforms()
    to_root = [np.eye(4)]
    stamp = float(data.draw(st.integers(0, 1)))
    for child, (parent, static, first, second) in enumerate(tree, start=1):
        for at, pose in ((0.0, first),) if static else ((0.0, first), (1.0, second)):
            found.put(f"f{parent}", f"f{child}", at, *pose, static=static)
        to_root.append(to_root[parent] @ matrix(second if stamp and not static else first))
    for target, source in data.draw(st.lists(st.tuples(*[st.integers(0, len(tree))] * 2), min_size=4, max_size=4)):
        expected = np.linalg.inv(to_root[target]) @ to_root[source]
        assert_same(rigid(found, f"f{target}", f"f{source}", stamp), expected, atol=1e-6)
        still = all(tree[k - 1][1] for k in path(tree, target) ^ path(tree, source))
        assert found.moves(f"f{target}", f"f{source}") is not still


def path(tree, frame):
    frames = set()
    while frame:
        frames.add(frame)
        frame = tree[frame - 1][0]
    return frames


@given(st.lists(st.tuples(*[st.integers(0, 6)] * 2), max_size=40))
@few
def test_no_circle_can_be_told(edges):
    found, parents = Transforms(), {}
    for parent, child in edges:
        refused = found.put(f"f{parent}", f"f{child}", 0.0, (0, 0, 0), FLAT)
        above, circle = parent, parent == child
        while above in parents and not circle:
            above = parents[above]
            circle = above == child
        assert (refused is not None) is circle
        if not circle:
            parents[child] = parent
    for frame in range(7):
        line = found.line(f"f{frame}")
        assert len(line) == len(set(line))
        assert line == [f"f{frame}"] if frame not in parents else line[1] == f"f{parents[frame]}"


def test_frames_that_nothing_joins_do_not_know_each_other():
    found = heard((0.0, 1.0, 0.0))
    found.put("c", "d", 0.0, (0, 0, 0), FLAT)
    assert found.rigid("a", "d", 0.0) is None
    assert found.known("a", "d") is None
    assert found.rigid("a", "nobody", 0.0) is None
    assert found.moves("a", "d")
    assert found.rigid("a", "a", 0.0) == IDENTITY


def test_a_frame_that_gets_another_parent_forgets_the_one_before():
    found = Transforms()
    found.put("odom", "base_link", 0.0, (1, 0, 0), FLAT)
    found.put("odom", "base_footprint", 1.0, (2, 0, 0), FLAT)
    assert found.put("base_footprint", "base_link", 1.0, (0, 0, 0.1), FLAT) is None
    assert found.line("base_link") == ["base_link", "base_footprint", "odom"]
    assert pose(found, "odom", "base_link", 1.0)[0] == 2.0
    assert found.rigid("odom", "base_link", 0.0) is None


def test_a_leading_slash_counts_for_nothing():
    found = Transforms()
    found.put("/odom", "/base_link", 0.0, (1, 2, 0), FLAT)
    np.testing.assert_allclose(pose(found, "odom", "base_link", 0.0), [1, 2, 0])
    assert "base_link" in found
    assert "odom" in found
    assert "map" not in found
    assert found.line("/base_link") == ["base_link", "odom"]


def test_odometry_gives_way_to_tf_whichever_comes_first():
    for order in ((True, False), (False, True)):
        found = Transforms()
        for weak in order:
            assert found.put("odom", "base_link", 0.0, (5.0 if weak else 7.0, 0, 0), FLAT, weak=weak) is None
        assert pose(found, "odom", "base_link", 0.0)[0] == 7.0
        assert not found.is_weak("base_link")


def test_a_place_that_moves_is_not_made_static_by_an_old_word():
    found = heard((0.0, 1.0, 0.0), (1.0, 2.0, 0.0))
    assert found.put("a", "b", 0.0, (9, 9, 9), FLAT, static=True) is None
    assert pose(found, "a", "b", 0.5)[0] == 1.5


def test_what_does_not_move_is_kept_in_the_copy():
    found = heard((0.0, 1.0, 0.0))
    found.put("b", "sonar", 0.0, (0.2, 0, 0), FLAT, static=True)
    still = found.still()
    assert still.children() == ["sonar"]
    still.put("a", "b", 0.0, (9, 9, 9), FLAT)
    assert pose(found, "a", "b", 0.0)[0] == 1.0


@pytest.mark.parametrize(
    ("parent", "child", "translation", "rotation", "reason"),
    [
        ("a", "b", (nan, 0, 0), FLAT, "not finite"),
        ("a", "b", (0, inf, 0), FLAT, "not finite"),
        ("a", "b", (0, 0, 1e8), FLAT, "not finite"),
        ("a", "b", (0, 0, 0), (0, 0, nan, 1), "not finite"),
        ("a", "b", (0, 0, 0), (0, 0, 0, 0), "unit quaternion"),
        ("a", "b", (0, 0, 0), (0, 0, 0, 3), "unit quaternion"),
        ("", "b", (0, 0, 0), FLAT, "two frames"),
        ("a", "/", (0, 0, 0), FLAT, "two frames"),
        ("a", "/a", (0, 0, 0), FLAT, "two frames"),
    ],
)
def test_what_is_no_transform_is_refused_and_does_no_harm(parent, child, translation, rotation, reason):
    found = heard((0.0, 1.0, 0.0))
    assert reason in found.put(parent, child, 0.0, translation, rotation)
    assert pose(found, "a", "b", 0.0)[0] == 1.0
    assert found.children() == ["b"]


def test_a_quaternion_that_is_nearly_one_is_made_one():
    found = Transforms()
    found.put("a", "b", 0.0, (0, 0, 0), (0, 0, 0.72, 0.72))
    assert pose(found, "a", "b", 0.0)[2] == pytest.approx(pi / 2)


def test_made_up_frames_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(transforms, "MAX_FRAMES", 50)
    found = Transforms()
    refused = [found.put("a", f"f{k}", 0.0, (0, 0, 0), FLAT) for k in range(60)]
    assert refused[:50] == [None] * 50
    assert refused[50:] == ["a transform of frame number 51"] * 10
    assert found.put("a", "f7", 1.0, (1, 0, 0), FLAT) is None


def test_an_edge_keeps_a_bounded_past(monkeypatch):
    monkeypatch.setattr(transforms, "MAX_SAMPLES", 2_000)
    found = Transforms()
    for k in range(6_000):
        found.put("a", "b", 0.1 * k, (float(k), 0, 0), FLAT)  # a minute of it is 600 samples
    held = found._edges["b"].stamps
    assert len(held) == len(found._edges["b"].poses) < 600 + 2 * 512
    for k in range(5_400, 6_000):
        assert pose(found, "a", "b", 0.1 * k)[0] == k
    for k in range(6_000):
        found.put("a", "b", 1_000 + 0.001 * k, (float(k), 0, 0), FLAT)
    assert len(found._edges["b"].stamps) <= 2_000


def test_a_long_line_of_frames_ends():
    found = Transforms()
    for k in range(200):
        found.put(f"f{k}", f"f{k + 1}", 0.0, (1, 0, 0), FLAT, static=True)
    found.put("f200", "f0", 0.0, (1, 0, 0), FLAT, static=True)
    assert len(found.line("f200")) <= 64
    assert rigid(found, "f0", "f50", 0.0).translation[0] == 50.0
