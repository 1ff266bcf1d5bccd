"""What was seen at different times, laid together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.geometry import compose
from echogrid.position.contradictions import NEAR, TWICE, Cells, cells, compared
from echogrid.position.matching import Field

CELL = 0.12


def room(count, apart_m=0.0):
    """So many looks at a room of 4 m x 3 m; those of the second half lie so far beside the first."""
    x, y = np.arange(0, 4, CELL), np.arange(0, 3, CELL)
    wall = np.concatenate([np.column_stack([x, np.full(len(x), at)]) for at in (0, 3)])
    free = np.stack(np.meshgrid(x, y[2:-2]), axis=-1).reshape(-1, 2)
    poses = np.zeros((count, 3))
    poses[count // 2 :, 1] = apart_m
    return poses, [Cells(wall, free, CELL)] * count


def test_cells_of_a_local_map():
    b = np.full((6, 6), -0.9)
    b[0, 0], b[3:, 3:], b[5, 5] = 0.6, 0.0, 0.4
    told = cells(Field(b, (1.0, 2.0), 0.04))
    assert told.size_m == pytest.approx(0.12)
    assert told.wall == pytest.approx(np.array([[1.06, 2.06]]))
    assert told.free == pytest.approx(np.array([[1.18, 2.06], [1.06, 2.18]]))


@pytest.mark.parametrize(("apart_m", "doubtful"), [(0.0, False), (0.2, False), (1.0, True)])
def test_what_lies_beside_itself_is_at_odds(apart_m, doubtful):
    told = compared(*room(40, apart_m), 20)
    early = slice(3, 15)  # that are compared with many of the other half, and none of their own
    assert np.all(told.doubtful[early] == doubtful)
    assert np.all(told.joined[early] != doubtful)
    assert (told.balance == told.alike.sum()) != doubtful


def test_neighbours_are_not_compared():
    told = compared(*room(20, 1.0), 20)
    assert not np.any(told.alike + told.against)


def test_where_nothing_was_seen_nothing_is_said():
    none = Cells(np.zeros((0, 2)), np.zeros((0, 2)), CELL)
    told = compared(np.zeros((3, 3)), [none] * 3, 1)
    assert (told.balance, told.doubtful.tolist(), told.joined.tolist()) == (0, [False] * 3, [False] * 3)


def laid_by_hand(poses, seen, apart):
    """Cell by cell, in sets; where cells begin is told by all of them."""
    laid = [
        [compose(pose, np.column_stack([own, np.zeros(len(own))]))[:, :2] for own in each[:2]]
        for pose, each in zip(poses, seen, strict=True)
    ]
    low = np.concatenate([points for both in laid for points in both]).min(axis=0) - (NEAR + 1) * CELL
    walls, free = ([set(map(tuple, np.floor((both[i] - low) / CELL).astype(int))) for both in laid] for i in (0, 1))
    shift = range(-NEAR, NEAR + 1)
    alike, against = [], []
    for k, own in enumerate(walls):
        others = [j for j in range(len(walls)) if abs(j - k) >= apart]
        near = {
            (x, y) for x, y in own if any((x + i, y + j) in walls[o] for o in others for i in shift for j in shift)
        }
        alike.append(len(near))
        against.append(sum(sum(cell in free[o] for o in others) >= TWICE for cell in own - near))
    return alike, against


@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.integers(1, 4))
def test_all_is_counted_as_by_hand(seed, count, apart):
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, [0.5, 0.5, 1.0], (count, 3))
    seen = [Cells(*(rng.uniform(-1, 1, (int(rng.integers(1, 30)), 2)) for _ in range(2)), CELL) for _ in range(count)]
    told = compared(poses, seen, apart)
    alike, against = laid_by_hand(poses, seen, apart)
    assert (told.alike.tolist(), told.against.tolist()) == (alike, against)
