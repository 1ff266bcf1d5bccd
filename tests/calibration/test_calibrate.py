from dataclasses import replace

import numpy as np
import pytest

from echogrid.calibration import findings
from echogrid.calibration.calibrate import _robot, calibrate
from echogrid.calibration.health import examine
from echogrid.calibration.readings import gather, some
from echogrid.calibration.variants import AS_GIVEN, ranked, variants
from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from mirror_room import HALF_DEG, changed, frames_of, ring

TRUE = ring()
FRAMES = frames_of(TRUE)


def off_by_a_little(robot, seed):
    rng = np.random.default_rng(seed)
    wrong = np.column_stack([rng.normal(0, 0.02, (robot.sonars, 2)), np.deg2rad(rng.normal(0, 3, robot.sonars))])
    # How far out all sit no log tells: the mean stays.
    out = np.stack([np.cos(robot.mounts[:, 2]), np.sin(robot.mounts[:, 2])], axis=1)
    wrong[:, :2] -= np.mean(np.sum(wrong[:, :2] * out, axis=1)) * out
    return replace(robot, mounts=robot.mounts + wrong, beam_width_rad=np.deg2rad(32.0))


@pytest.fixture(scope="module")
def found():
    return calibrate(frames_of(TRUE, scale=1.02, seed=1), off_by_a_little(TRUE, 2))


def test_mounts_beam_and_scale_are_those_that_made_the_log(found):
    assert found.unsure == ""
    off = found.robot.mounts - TRUE.mounts
    assert np.abs(off[:, :2]).max() < 0.02
    assert np.abs(np.rad2deg(wrap(off[:, 2]))).max() < 1.0
    assert np.rad2deg(found.robot.beam_width_rad) == pytest.approx(2 * HALF_DEG, abs=3.0)
    assert found.places.scale == pytest.approx(1.02, abs=0.005)


def test_intervals_hold_the_truth(found):
    there = found.given.mounts + found.moved
    off = there - TRUE.mounts
    off[:, 2] = wrap(off[:, 2])
    assert np.mean(np.abs(off) < 3 * found.moved_sd) > 0.9


def test_weak_echoes_that_are_read_late_pass_neither_for_a_place_nor_for_a_scale():
    found = calibrate(frames_of(TRUE, late=0.015), TRUE)
    assert found.unsure == ""
    assert np.abs(found.moved[:, :2]).max() < 0.01
    assert found.places.scale == pytest.approx(1.0, abs=0.002)
    assert found.places.late.sum() > 0.001


def test_a_wrong_scale_is_told_and_a_right_one_is_not(found):
    assert any("ranges read 1.0" in line for line in findings.of_ranges(found))
    assert not list(findings.of_swaps(found))
    assert not list(findings.of_order(found.ranks))
    assert not list(findings.of_health(found.health))


def test_swapped_and_dead_sonars_are_found():
    def change(ranges):
        ranges[:, [1, 4]] = ranges[:, [4, 1]]
        ranges[:, 6] = np.inf
        return ranges

    found = calibrate(changed(FRAMES, change), TRUE)
    assert sorted(found.swapped) == [(1, 4), (4, 1)]
    assert found.health.useless == [6]
    assert "r1 at the mount of r4" in " ".join(findings.of_swaps(found))
    assert "r6: no echo ever" in " ".join(findings.of_health(found.health))


def test_of_a_short_way_it_is_said_that_swapped_sonars_may_pass_for_other_mounts(found):
    way = np.array([frame.pose[:2] for frame in FRAMES])
    assert found.way_m == pytest.approx(np.sum(np.hypot(*np.diff(way, axis=0).T)))
    short, long = (" ".join(findings.untold(replace(found, way_m=way_m))) for way_m in (9.0, 30.0))
    assert "swapped sonars: in 9 m of way" in short
    assert "swapped sonars" not in long


@pytest.mark.parametrize("which", [1, 2, 5, 9])
def test_what_is_wrong_with_the_order_or_the_mounts_comes_first(which):
    wrong = [v for v in variants(TRUE) if not v.poses][which]
    ranks = ranked(gather(FRAMES, TRUE), replace(TRUE, mounts=wrong.mounts))
    first = ranks[0].variant.mounts
    assert np.allclose(first[:, :2], TRUE.mounts[:, :2], atol=0.02)
    given = next(each for each in ranks if each.variant.name == AS_GIVEN)
    assert ranks[0].surely_over(given)
    assert len(list(findings.of_order(ranks))) == 1


def test_the_right_robot_comes_first_and_nothing_is_said():
    ranks = ranked(gather(FRAMES, TRUE), TRUE)
    assert ranks[0].variant.name == AS_GIVEN
    assert not list(findings.of_order(ranks))


@pytest.mark.parametrize(("late", "told"), [(0.5, "0.5 s after"), (-0.5, "0.5 s before"), (1.1, "1 s after")])
def test_clocks_that_are_apart_are_told(late, told):
    stamps = np.array([frame.stamp for frame in FRAMES])
    poses = np.unwrap(np.array([frame.pose for frame in FRAMES]), axis=0)
    later = np.column_stack([np.interp(stamps + late, stamps, each) for each in poses.T])
    frames = [replace(frame, pose=pose) for frame, pose in zip(FRAMES, later, strict=True)]
    (line,) = findings.of_order(ranked(gather(frames, TRUE), TRUE, hasty=True))
    assert "the clocks of ranges and poses are apart" in line
    assert told in line


def test_a_clockwise_heading_is_told():
    frames = [replace(frame, pose=frame.pose * [1, 1, -1]) for frame in FRAMES]
    assert "theta is counted clockwise" in " ".join(findings.of_order(ranked(gather(frames, TRUE), TRUE)))


@pytest.mark.parametrize(("times", "told"), [(3.28084, "in feet"), (0.5, "half of what"), (2.0, "twice what")])
def test_ranges_of_another_scale_are_told(times, told):
    frames = changed(FRAMES, lambda ranges: np.where(ranges * times < TRUE.max_range_m, ranges * times, np.inf))
    ranks = ranked(gather(frames, TRUE), TRUE)
    assert told in " ".join(findings.of_order(ranks))


def test_what_a_log_does_not_tell_of_a_mount_stays_as_it_was_given(found):
    unsure = replace(found, inflation=(40.0, 40.0, 1.0))  # intervals so wide that they tell nothing
    assert not unsure.told.any()
    assert np.allclose(_robot(unsure).mounts, found.given.mounts, atol=1e-12)
    lines = "\n".join(findings.untold(replace(found, inflation=(3.9, 3.9, 1e3))))
    assert "the range scale to better than 3%" in lines
    assert not list(findings.of_ranges(replace(found, inflation=(3.9, 3.9, 1e3))))


def test_sonars_that_are_stuck_stale_or_hear_others_are_told_and_no_others():
    rng = np.random.default_rng(3)

    def change(ranges):
        ranges[:, 2] = 1.25
        for i in range(1, len(ranges)):
            if rng.random() < 0.4:
                ranges[i, 3] = ranges[i - 1, 3]
        hit = rng.random(len(ranges)) < 0.15
        ranges[hit, 5] = rng.uniform(0.1, 0.5, hit.sum())
        ranges[:, 7] = np.nan
        return ranges

    health = examine(gather(changed(FRAMES, change), TRUE))
    assert np.flatnonzero(health.stuck).tolist() == [2]
    assert np.flatnonzero(health.stale).tolist() == [3]
    assert np.flatnonzero(health.cross_talk).tolist() == [5]
    assert np.flatnonzero(health.silent).tolist() == [7]


def test_a_sonar_that_hears_the_wall_along_which_it_drives_is_not_stuck():
    there = np.column_stack([np.linspace(1.0, 5.0, 100), np.full(100, 1.5), np.zeros(100)])
    turn = np.column_stack([np.full((20, 2), [5.0, 1.5]), np.linspace(0.1, 3.1, 20)])
    back = there[::-1] + np.array([0.0, 0.0, np.pi])
    ranges = np.full((220, TRUE.sonars), np.inf)
    ranges[:100, [2, 6]] = ranges[120:, [2, 6]] = 1.3
    ranges[100:120, [2, 6]] = np.linspace(1.31, 1.9, 20)[:, None]
    poses = np.concatenate([there, turn, back])
    frames = [Frame(0.1 * i, pose, row) for i, (pose, row) in enumerate(zip(poses, ranges, strict=True))]
    assert not examine(gather(frames, TRUE)).stuck.any()
    ranges[:, 6] = 1.3
    assert np.flatnonzero(examine(gather(frames, TRUE)).stuck).tolist() == [6]


def test_ranges_in_coarse_steps_are_not_stale():
    health = examine(gather(changed(FRAMES, lambda ranges: np.round(ranges, 1)), TRUE))
    assert not health.stale.any()


def test_too_little_is_an_error_of_one_line():
    with pytest.raises(InputError, match="no echo of any sonar"):
        calibrate(changed(FRAMES, lambda ranges: np.full_like(ranges, np.inf)), TRUE)
    with pytest.raises(InputError, match="echoes that touch"):
        calibrate(FRAMES[:40], TRUE)
    with pytest.raises(InputError, match="no frames"):
        calibrate([], TRUE)


def test_the_frame_of_the_world_does_not_matter():
    moved = [Frame(f.stamp, compose(np.array([30.0, -7.0, 1.1]), f.pose), f.ranges) for f in FRAMES]
    here, there = (ranked(gather(frames, TRUE), TRUE)[0] for frames in (FRAMES, moved))
    assert there.variant.name == here.variant.name
    assert there.share == pytest.approx(here.share, abs=0.03)


def test_parts_are_spread_over_the_drive():
    parts = [slice(i, i + 1) for i in range(100)]
    assert some(parts, 200) == parts
    assert [part.start for part in some(parts, 3)] in ([0, 50, 99], [0, 49, 99])
