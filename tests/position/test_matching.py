import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.geometry import compose, inverse, transform, wrap
from echogrid.position import matching, walls


def room(width=4.0, depth=3.0, cell=0.04):
    """2 p - 1 of a room with a box in it, as seen from its middle; beyond the walls nothing is known."""
    y, x = np.mgrid[-3:3:cell, -3:3:cell] + cell / 2
    inside = (np.abs(x) < width / 2) & (np.abs(y) < depth / 2)
    wall = ~inside & (np.abs(x) < width / 2 + 0.1) & (np.abs(y) < depth / 2 + 0.1)
    box = (np.abs(x - 1.2) < 0.2) & (np.abs(y - 0.8) < 0.3)
    b = np.where(inside, -0.9, 0.0)
    b[wall | box] = 0.9
    return matching.Field(b, (-3.0, -3.0), cell)


@settings(deadline=None, max_examples=15)
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_what_was_seen_is_found_where_it_was_seen(x, y, theta):
    what = matching.seen(room(), 900, np.random.default_rng(0))
    pose = np.array([x, y, theta])
    seen_from = inverse(pose)
    moved = what._replace(
        surface=transform(seen_from, what.surface.astype(float)).astype(np.float32),
        free=transform(seen_from, what.free.astype(float)).astype(np.float32),
    )
    found = matching.match(matching.Target(room()), moved, np.zeros(3), np.diag([0.05, 0.05, 0.05]) ** 2, wide=True)
    assert found is not None
    assert np.hypot(*(found.pose[:2] - pose[:2])) < 0.03
    assert abs(wrap(found.pose[2] - pose[2])) < np.deg2rad(2)


def test_along_a_bare_corridor_nothing_is_claimed():
    y, _ = np.mgrid[-2:2:0.04, -6:6:0.04] + 0.02
    corridor = matching.Field(np.where(np.abs(y) < 1, -0.9, np.where(np.abs(y) < 1.1, 0.9, 0.0)), (-6.0, -2.0), 0.04)
    short = matching.Field(corridor.b[:, 100:200], (-2.0, -2.0), 0.04)
    what = matching.seen(short, 900, np.random.default_rng(0))
    found = matching.match(matching.Target(corridor), what, np.zeros(3), np.diag([0.3, 0.3, 0.1]) ** 2)
    assert found is not None
    along, across, _ = 1 / np.sqrt(np.diag(found.information))
    assert along > 0.3
    assert across < 0.05


def test_free_floor_alone_is_no_match():
    floor = matching.Field(np.full((100, 100), -0.9), (-2.0, -2.0), 0.04)
    what = matching.seen(floor, 900, np.random.default_rng(0))
    assert what.strength == 0
    assert matching.match(matching.Target(floor), what, np.zeros(3), np.eye(3) * 0.01) is None


@settings(deadline=None, max_examples=20)
@given(st.floats(0.0, np.pi / 2 - 0.01))
def test_walls_tell_their_direction_whatever_it_is(angle):
    rng = np.random.default_rng(1)
    points = np.concatenate([np.column_stack([rng.uniform(-3, 3, 150), np.full(150, 1.0)]),
                             np.column_stack([np.full(100, -3.0), rng.uniform(-1, 1, 100)])])  # fmt: skip
    points += rng.normal(0, 0.02, points.shape)
    turned = compose(np.array([0.3, -0.2, angle]), np.column_stack([points, np.zeros(len(points))]))[:, :2]
    found = walls.direction(turned)
    assert found is not None
    off = (found - angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(off) < np.deg2rad(1.5)


def test_a_heap_of_points_has_no_direction():
    assert walls.direction(np.random.default_rng(2).normal(0, 1, (400, 2))) is None
    assert walls.direction(np.zeros((10, 2))) is None


def test_quarters():
    assert walls.nearest_quarter(0.1, 3.2) == pytest.approx(0.1 + np.pi)
