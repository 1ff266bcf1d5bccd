"""The heading bias of odometry is that with which what was seen along a drive falls together."""

import numpy as np
import pytest

from echogrid.geometry import compose, inverse
from echogrid.position.bends import CELL_M, heading_bias, sharpness
from echogrid.position.motion import chained, corrected
from echogrid.position.pieces import Piece

PIECES, WAY_M, REACH_M = 240, 0.5, 4.0
CUT = [Piece(k, k + 1, k) for k in range(PIECES)]
STEP = np.column_stack([np.full(PIECES - 1, WAY_M), np.zeros(PIECES - 1), np.tile([0, 0, 0.2, -0.2], 60)[1:]])
POSES = chained(np.zeros(3), STEP)
SURFACES = np.random.default_rng(0).uniform([-5, -5], [130, 15], (3000, 2))


def seen(poses):
    """Surface points within reach of each pose, in its own frame."""
    near = (SURFACES[np.hypot(*(SURFACES - pose[:2]).T) < REACH_M] for pose in poses)
    flat = (np.column_stack([at, np.zeros(len(at))]) for at in near)
    return [compose(inverse(pose), at)[:, :2] for pose, at in zip(poses, flat, strict=True)]


POINTS = seen(POSES)


@pytest.mark.parametrize("bias", np.deg2rad([-3.0, 0.0, 4.0]))
def test_the_bias_of_odometry_is_found(bias):
    bent = corrected(STEP, np.array([0.0, -bias, 0.0]))
    assert heading_bias(bent, CUT, POINTS) == pytest.approx(bias, abs=np.deg2rad(0.3))


def test_a_short_drive_tells_less():
    bent = corrected(STEP, np.array([0.0, -np.deg2rad(6.0), 0.0]))
    found = [heading_bias(bent[: n - 1], CUT[:n], POINTS[:n]) for n in (13, 40, PIECES)]
    assert 0 < found[0] < found[1] < found[2] < np.deg2rad(6.3)
    assert found[0] < np.deg2rad(4.0)


def test_where_nothing_is_seen_there_is_no_bias():
    assert heading_bias(STEP, CUT, [np.zeros((0, 2))] * PIECES) == 0.0


def test_what_lies_together_is_counted_in_pairs_of_different_pieces():
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, np.pi / 2]])
    same = np.array([[0.5, 0.5]]) * CELL_M
    points = [np.repeat(same, 3, axis=0), compose(inverse(poses[1]), np.array([[*same[0], 0.0]]))[:, :2]]
    assert sharpness(poses, points) == 2 * 3
    assert sharpness(poses, points, alike=2) == 0
    assert sharpness(poses, [points[0], points[1] + 2 * CELL_M]) == 0
