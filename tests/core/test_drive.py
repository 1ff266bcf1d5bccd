"""What is remembered of a drive, by the core and by numpy; its laws are tested beside models.networks.memory."""

from dataclasses import replace
from itertools import pairwise
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, wrap
from echogrid.models.networks import memory
from echogrid.models.networks.memory import Memory, Recent


def drawn(seed, scans, sonars):
    """Mounts, of which one may be missing, poses, ranges and stamps."""
    rng = np.random.default_rng(seed)
    mounts = np.column_stack([rng.uniform(-0.3, 0.3, (sonars, 2)), rng.uniform(-3, 3, sonars)])
    ranges = rng.uniform(0.1, 6, (scans, sonars))
    ranges[rng.random(ranges.shape) < 0.2] = inf
    ranges[rng.random(ranges.shape) < 0.4] = nan
    mounts[rng.random(sonars) < 0.1] = nan
    ranges[:, np.isnan(mounts[:, 2])] = nan
    poses = np.cumsum(rng.normal(0, [0.05, 0.05, 0.2], (scans, 3)), axis=0) + np.array([5, -5, 3])
    return mounts, poses, ranges, np.cumsum(rng.uniform(-0.1, 0.4, scans))


def remembered(mounts, poses, ranges, stamps, new, half_life):
    """Weights and traits of scans, one reading and one pair of sonars after the other."""
    looks, sums, counts, weights, traits = {}, np.zeros(4), np.zeros(4), [], []
    there = max(1, np.sum(~np.isnan(mounts[:, 2])))
    for pose, scan, stamp, part in zip(poses, ranges, stamps, new, strict=True):
        turn = np.mod(pose[2], 2 * np.pi)
        place = *np.floor(pose[:2] / memory.PLACE_M).astype(int), int(turn // memory.TURN_RAD)
        count, time = looks.get(place, (0.0, stamp))
        faded = 1.0 if half_life is None else 2 ** min((time - stamp) / half_life, 0.0)
        looks[place] = part * np.sum(~np.isnan(scan)) / there + count * faded, stamp
        weights.append(part / max(looks[place][0], 1.0))
        fired = scan[~np.isnan(scan)]
        total = np.array([np.sum(np.isinf(fired)), 0, 0, np.sum(np.minimum(fired, memory.FAR_M)) / memory.FAR_M])
        count = np.array([len(fired), 0.0, 0.0, len(fired)])
        for i in range(len(scan)):
            for j in range(i):
                near = np.exp(-((wrap(mounts[i, 2] - mounts[j, 2]) / memory.NEIGHBOUR_RAD) ** 2))
                if np.isnan(scan[i]) or np.isnan(scan[j]) or near <= 0.01:
                    continue
                apart = abs(min(scan[i], memory.FAR_M) - min(scan[j], memory.FAR_M))
                total[2] += near * min(apart, 1.0)
                count[2] += near
                if np.isfinite(scan[i]) and np.isfinite(scan[j]):
                    total[1] += near * max(1 - apart / memory.SAME_M, 0.0)
                    count[1] += near
        sums, counts = memory.FADE * sums + total, memory.FADE * counts + count
        traits.append((sums + 0.5 * memory.PRIOR) / (counts + memory.PRIOR))
    return np.array(weights), np.array(traits)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 9999), st.integers(1, 12), st.sampled_from([None, 0.5, 60.0]))
def test_the_core_remembers_as_numpy_does(seed, sonars, half_life):
    mounts, poses, ranges, stamps = drawn(seed, 25, sonars)
    new = np.random.default_rng(seed).uniform(0.1, 1, 25)
    recalled = Memory(mounts, half_life).take(poses, ranges, stamps, new)
    weights, traits = remembered(mounts, poses, ranges, stamps, new, half_life)
    np.testing.assert_allclose(recalled.weight, weights, rtol=1e-6)
    np.testing.assert_allclose(recalled.traits, traits, atol=1e-6)


NUMBERS = {"PLACE_M": 0.3, "TURN_RAD": 0.7, "FAR_M": 2.0, "SAME_M": 0.5, "FADE": 0.5, "PRIOR": 0.7}


@pytest.mark.parametrize("name", NUMBERS)
def test_what_is_remembered_goes_by_the_numbers_of_memory(name, monkeypatch):
    mounts, poses, ranges, stamps = drawn(1, 25, 12)
    before = Memory(mounts).take(poses, ranges)
    monkeypatch.setattr(memory, name, NUMBERS[name])
    after = Memory(mounts).take(poses, ranges)
    weights, traits = remembered(mounts, poses, ranges, stamps, np.ones(25), None)
    np.testing.assert_allclose(after.weight, weights, rtol=1e-6)
    np.testing.assert_allclose(after.traits, traits, atol=1e-6)
    assert max(np.max(np.abs(a - b)) for a, b in zip(before, after, strict=True)) > 0.01


@pytest.mark.parametrize("name", ["RECENT_M", "RECENT_RAD", "RECENT_S", "RECENT_FRAMES"])
def test_what_is_recent_goes_by_the_numbers_of_memory(name, monkeypatch):
    mounts, poses, ranges, stamps = drawn(2, 40, 12)
    frames = [Frame(*each) for each in zip(stamps, poses, ranges, strict=True)]
    _, before = Recent(mounts).completed(frames)
    monkeypatch.setattr(memory, name, 1 if name == "RECENT_FRAMES" else 0.1)
    _, after = Recent(mounts).completed(frames)
    np.testing.assert_array_equal(after, [share for _, share in completed(mounts, frames)])
    assert np.any(after != before)


def completed(mounts, frames):
    """Frames, each sonar of which has the last that it heard near by, if it is silent."""
    for i, frame in enumerate(frames):
        ranges, looked = frame.ranges.copy(), (mounts if frame.mounts is None else frame.mounts).copy()
        for sonar in np.flatnonzero(np.isnan(ranges) & ~np.isnan(mounts[:, 2])):
            for before in reversed(frames[max(0, i - memory.RECENT_FRAMES) : i]):
                moved = compose(inverse(frame.pose), before.pose)
                near = np.hypot(*moved[:2]) <= memory.RECENT_M and abs(moved[2]) <= memory.RECENT_RAD
                if near and frame.stamp - before.stamp <= memory.RECENT_S and not np.isnan(before.ranges[sonar]):
                    own = mounts if before.mounts is None else before.mounts
                    ranges[sonar], looked[sonar] = before.ranges[sonar], compose(moved, own[sonar])
                    break
        filled = np.sum(np.isnan(frame.ranges)) - np.sum(np.isnan(ranges))
        fired = np.sum(~np.isnan(frame.ranges))
        whole = replace(frame, ranges=ranges, mounts=looked) if filled else frame
        yield whole, fired / (fired + filled) if filled else 1.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 9999), st.integers(1, 12), st.booleans())
def test_the_core_completes_scans_as_numpy_does(seed, sonars, moved):
    mounts, poses, ranges, stamps = drawn(seed, 40, sonars)
    own = mounts + np.random.default_rng(seed).normal(0, 0.05, (40, sonars, 3)) if moved else [None] * 40
    frames = [Frame(*each[:3], mounts=each[3]) for each in zip(stamps, poses, ranges, own, strict=True)]
    found, new = Recent(mounts).completed(frames)
    for mine, its, (expected, share) in zip(found, new, completed(mounts, frames), strict=True):
        np.testing.assert_array_equal(mine.ranges, expected.ranges)
        assert its == share
        assert (mine.mounts is None) == (expected.mounts is None)
        if mine.mounts is not None:
            np.testing.assert_allclose(mine.mounts, expected.mounts, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 9999),
    st.integers(1, 6),
    st.booleans(),
    st.sampled_from([0.02, 0.3, 2.0]),
    st.sampled_from([0.04, 0.5]),
)
def test_the_floor_is_marked_that_discs_along_the_way_cover(seed, poses, came, radius, cell):
    rng = np.random.default_rng(seed)
    way = np.cumsum(rng.normal(0, 0.3, (poses, 2)), axis=0)
    step, gap, begin, shape = 0.08, 0.6, rng.integers(-20, 0, 2), rng.integers(0, 60, 2)
    layer = rng.random((shape[0], shape[1] + 3)).astype(np.float32)
    held, stood = layer.copy(), layer[:, : shape[1]]
    points = [] if came else [way[0]]
    for a, b in pairwise(way):
        far = float(np.linalg.norm(np.subtract(b, a)))
        count = int(np.ceil(far / step)) if far <= gap else 1
        points += [a + (b - a) * (k + 1) / count for k in range(count)]
    row, col = (first + np.arange(int(n)) for n, first in zip(shape, begin, strict=True))
    y, x = np.meshgrid((row + 0.5) * cell, (col + 0.5) * cell, indexing="ij")
    off = np.min([np.hypot(x - px, y - py) for px, py in points] or [np.full(shape, inf)], axis=0)
    found = _core.stand(way, came, radius, cell, step, gap, 0.7, stood, tuple(begin.tolist()))
    sure = abs(off - radius) > 1e-9
    expected = np.where(off < radius, np.maximum(held[:, : shape[1]], np.float32(0.7)), held[:, : shape[1]])
    np.testing.assert_array_equal(stood[sure], expected[sure])
    np.testing.assert_array_equal(layer[:, shape[1] :], held[:, shape[1] :])
    at = np.argwhere(off < radius)
    if sure.all() and len(at):
        assert found == (*(at.min(axis=0) + begin), *(at.max(axis=0) + begin + 1))
    elif sure.all():
        assert found is None


def core_memory(pairs=((0, 1),), near=(1.0,), place=0.1, fade=0.9):
    given_ = np.array(pairs, np.int32), np.array(near), 2
    return _core.Memory(*given_, place=place, turn=0.2, far=4.0, same=0.1, fade=fade, prior=0.01)


@pytest.mark.parametrize(
    ("call", "found"),
    [
        (lambda: core_memory([[0, -1]]), "negative sonar"),
        (lambda: core_memory([[0, 0]], [1, 1]), "1 x 2"),
        (lambda: Memory(np.zeros((2, 3))).take(np.zeros((1, 3)), np.zeros((1, 1))), "1 sonars"),
        (lambda: Memory(np.zeros((2, 3))).take(np.array([[inf, 0, 0]]), np.zeros((1, 2))), "inf"),
        (lambda: Memory(np.zeros((2, 3)), -1.0), "-1"),
        (lambda: core_memory(place=0.0), "0"),
        (lambda: core_memory(fade=nan), "nan"),
        (lambda: _core.Recent(np.zeros((2, 3)), 1, 1, 1, 0), "0"),
        (lambda: _core.Recent(np.zeros((2, 3)), 1, 1, 1, 9).complete(0.0, np.zeros(3), np.zeros(3)), "3"),
        (lambda: _core.stand(np.full((1, 2), nan), False, 1, 0.1, 0.1, 1, 1, np.zeros((9, 9), "f4"), (0, 0)), "nan"),
        (lambda: _core.stand(np.zeros((1, 2)), False, 0, 0.1, 0.1, 1, 1, np.zeros((9, 9), "f4"), (0, 0)), "0 m"),
    ],
)
def test_what_cannot_be_is_refused(call, found):
    with pytest.raises(UsageError, match=f"found .*{found}.*expected"):
        call()
