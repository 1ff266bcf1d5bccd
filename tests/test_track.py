"""The line of a drive stays near it, however long it is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.track import NEAR_M, Track, line_of


def distance(points, line):
    """From each point to the nearest of a line, m: to each of its pieces, as one does by hand."""
    best = np.full(len(points), np.inf)
    for a, b in zip(line, [*line[1:], line[-1]], strict=True):
        along = b - a
        share = np.clip((points - a) @ along / max(along @ along, 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(points - a - share[:, None] * along, axis=1))
    return best


def tracked(path, **settings):
    track = Track(**settings)
    for x, y in path.tolist():
        track.add(x, y)
    return track


def winding(hours=2.0, rate=10.0, speed=0.5):
    """Up and down through a house of rooms of 3 m with doors at their corners, for hours."""
    steps = int(hours * 3600 * rate)
    s = np.arange(steps) * speed / rate
    lane, along = np.divmod(s, 9.0)
    along = np.where(lane % 2, 9.0 - along, along)
    return np.column_stack([along, 0.3 * (lane % 40) + 0.4 * np.sin(2 * np.pi * along / 1.5)])


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=60),
    st.sampled_from([0.003, 0.03, 0.5, 20.0]),
    st.booleans(),
)
def test_the_line_is_near_to_the_drive_and_the_drive_to_the_line(steps, scale, on):
    steps = np.array(steps) * scale
    path = np.cumsum(steps, axis=0) if on else steps
    line = tracked(path).points()
    np.testing.assert_array_equal(line[0], path[0])
    np.testing.assert_array_equal(line[-1], path[-1])
    assert distance(path, line).max() <= NEAR_M * (1 + 1e-6) + 1e-9
    dense = np.vstack([np.linspace(a, b, 20) for a, b in zip(line, [*line[1:], line[-1]], strict=True)])
    assert distance(dense, path).max() <= NEAR_M * (1 + 1e-6) + 1e-9


@pytest.mark.slow
def test_two_hours_of_driving_stay_on_their_way():
    path = winding()
    line = tracked(path).points()
    assert len(line) < 0.25 * len(path)
    pieces = np.array_split(np.arange(len(path)), 400)
    corners = [np.argmin(np.linalg.norm(path - corner, axis=1)) for corner in line[:: len(line) // 20]]
    assert max(corners) > 0.9 * len(path) % 3600  # it goes all the way, not only round the beginning
    for piece in pieces[:: len(pieces) // 40]:
        assert distance(path[piece], line).max() <= NEAR_M * 1.001


def test_what_goes_straight_or_stands_costs_nothing():
    straight = np.column_stack([np.linspace(0, 500, 100_000), np.full(100_000, 1.0)])
    assert len(tracked(straight).points()) == 2
    rng = np.random.default_rng(0)
    assert len(tracked(rng.uniform(-0.006, 0.006, (10_000, 2))).points()) == 2
    assert tracked(np.zeros((0, 2))).points().shape == (0, 2)
    assert tracked(np.zeros((1, 2))).points().shape == (1, 2)


@pytest.mark.parametrize("most", [50, 400])
def test_a_drive_of_too_many_corners_is_drawn_less_near_but_whole(most):
    path = winding(hours=0.2)
    track = tracked(path, most=most)
    line = track.points()
    assert len(line) <= most + 1
    np.testing.assert_array_equal(line[[0, -1]], path[[0, -1]])
    assert track.near > NEAR_M
    assert distance(path, line).max() <= 2 * track.near
    assert track._most == most


def test_a_line_of_a_path_is_as_near_as_asked_for():
    path = winding(hours=0.1)
    sizes = []
    for near in (0.001, 0.01, 0.1):
        line = line_of(path, near)
        assert distance(path, line).max() <= near * 1.001
        sizes.append(len(line))
    assert sizes[0] > sizes[1] > sizes[2]
