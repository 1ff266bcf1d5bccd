from math import inf, isnan, nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.errors import InputError
from echogrid.frame import Frame, Log
from echogrid.logs.contents import describe


def log_of(ranges: list[list[float]], poses: list[tuple[float, float, float]] | None = None) -> Log:
    poses = poses or [(0.0, 0.0, 0.0)] * len(ranges)
    pairs = zip(ranges, poses, strict=True)
    return Log.of([Frame(2.0 + i, np.array(pose), np.array(row)) for i, (row, pose) in enumerate(pairs)], "drive")


def test_a_small_log_is_described_as_counted_by_hand():
    poses = [(0.0, 0.0, 0.0), (3.0, 4.0, 1.0), (3.0, 2.0, 0.0)]
    info = describe(log_of([[1.0, inf], [1.0, inf], [2.5, nan]], poses))
    assert (info.name, info.frames, info.sonars) == ("drive", 3, 2)
    assert (info.start_s, info.end_s, info.span_s) == (2.0, 4.0, 2.0)
    assert info.length_m == 7.0
    assert info.box_m == (0.0, 0.0, 3.0, 4.0)
    assert info.no_echo == pytest.approx(2 / 6)
    assert info.not_fired == pytest.approx(1 / 6)
    assert info.no_echo_by_sonar == pytest.approx((0, 2 / 3))
    assert (info.nearest_m, info.median_m, info.farthest_m) == (1.0, 1.0, 2.5)
    # Of the later finite readings, 1.0 and 2.5, one repeats; the repeated no echo does not count.
    assert info.stale == 0.5


def test_the_median_is_rounded_to_the_nearest_centimetre():
    assert describe(log_of([[1.239]])).median_m == 1.24
    assert describe(log_of([[1.0, 1.5]])).median_m == 1.25


def test_a_log_without_a_finite_reading_has_no_distances():
    info = describe(log_of([[inf, nan]]))
    assert isnan(info.nearest_m)
    assert isnan(info.median_m)
    assert isnan(info.farthest_m)
    assert info.stale == 0.0


def test_a_frozen_sonar_is_all_stale_and_a_changing_one_is_not():
    frozen = [[1.0]] * 700
    changing = [[1.0 + 0.001 * i] for i in range(700)]
    assert describe(log_of(frozen)).stale == 1.0
    assert describe(log_of(changing)).stale == 0.0


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize("frames", [2, 256, 257, 258, 513])
def test_nothing_is_lost_between_the_batches(frames, way):
    ranges = [[0.5 + 0.01 * i] for i in range(frames - 1)]
    poses = [(way * -i, way * i, 0.0) for i in range(frames)]
    info = describe(log_of([*ranges, ranges[-1]], poses))
    assert info.frames == frames
    assert info.stale == pytest.approx(1 / (frames - 1))
    far = frames - 1
    assert info.box_m == ((-far, 0, 0, far) if way == 1 else (0, -far, far, 0))
    assert info.length_m == pytest.approx((frames - 1) * 2**0.5)


def test_no_frames_are_an_input_error():
    with pytest.raises(InputError, match="drive: found no frames"):
        describe(Log.of([], "drive"))


def test_frames_of_one_log_have_one_number_of_readings():
    with pytest.raises(InputError, match="of 1 and of 2 readings"):
        Log.of([Frame(0.0, np.zeros(3), np.ones(n)) for n in (2, 1)])


readings = st.one_of(st.floats(0, 100), st.just(inf), st.just(nan), st.just(1.0))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.lists(readings, min_size=3, max_size=3), min_size=1, max_size=40), st.integers(1, 20))
def test_the_tallies_agree_with_the_whole_array(rows, copies):
    ranges = np.array(rows * copies)
    poses = [(float(i % 11), float(-i % 5), 0.0) for i in range(len(ranges))]
    info = describe(log_of(ranges.tolist(), poses))
    finite = ranges[np.isfinite(ranges)]
    xy = np.array(poses)[:, :2]
    assert info.no_echo == pytest.approx(np.mean(ranges == inf))
    assert info.not_fired == pytest.approx(np.mean(np.isnan(ranges)))
    assert info.no_echo_by_sonar == pytest.approx(np.mean(ranges == inf, axis=0))
    assert info.length_m == pytest.approx(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())
    assert info.box_m == (*xy.min(axis=0), *xy.max(axis=0))
    if finite.size:
        assert (info.nearest_m, info.farthest_m) == (finite.min(), finite.max())
        assert info.median_m == pytest.approx(np.median(finite), abs=0.00501)
        later = np.isfinite(ranges[1:])
        repeated = (ranges[1:] == ranges[:-1]) & later
        assert info.stale == pytest.approx(repeated.sum() / max(later.sum(), 1))
