"""Where what was seen at one time contradicts what was seen at another: double walls, or places that changed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.lib.stride_tricks import sliding_window_view

from echogrid.geometry import transform
from echogrid.position.matching import Field

COARSE = 3
"""Cells of a local map along each side of one that is compared."""

WALL, FREE = 0.5, -0.7
"""2 p - 1 of the most occupied cell in one that is a wall, at least, and the mean in one that is free, at most."""

NEAR, TWICE = 2, 2
"""A wall that another piece saw as well lies no farther than so many cells off; it contradicts what so many others
saw, to whom it is free floor."""

TOGETHER, LEAST_CELLS, MOST_SHARE, JOINED = 5, 30, 0.3, 0.6
"""Pieces that are judged together, the cells of theirs that others saw too, at least, the share of them that may
contradict the others (mirrors and gaps make some), and the share of all walls that others saw too where pieces lie on
them: of a corridor beside another one wall may be the other's."""


class Cells(NamedTuple):
    """Cells of a local map: middles, m, as seen from the piece."""

    wall: Float[ndarray, "wall 2"]
    free: Float[ndarray, "free 2"]
    size_m: float


def cells(field: Field) -> Cells:
    """What a local map says, in coarse cells."""
    n = COARSE
    blocks = field.blocks(n)

    def middles(which: Bool[ndarray, "rows cols"]) -> Float[ndarray, "_ 2"]:
        return ((np.argwhere(which)[:, ::-1] + 0.5) * (n * field.cell_m) + field.origin).astype(np.float32)

    wall = blocks.max(axis=(1, 3)) > WALL
    return Cells(middles(wall), middles((blocks.mean(axis=(1, 3)) < FREE) & ~wall), n * field.cell_m)


class Compared(NamedTuple):
    """How the walls that each piece of a drive saw lie to what others saw."""

    seen: Int[ndarray, "pieces"]
    """Cells of wall."""
    alike: Int[ndarray, "pieces"]
    """Those of them where others saw a wall too."""
    against: Int[ndarray, "pieces"]
    """Those where others saw free floor, and none a wall."""

    @property
    def balance(self) -> int:
        """Cells that agree with others, less those that contradict them: a drive that is torn apart does neither."""
        return int(self.alike.sum() - self.against.sum())

    @property
    def doubtful(self) -> Bool[ndarray, "pieces"]:
        """Pieces that contradict the others."""
        _, alike, against = self._with_neighbours()
        return (alike + against > LEAST_CELLS) & (against > MOST_SHARE * (alike + against))

    @property
    def joined(self) -> Bool[ndarray, "pieces"]:
        """Pieces that saw the walls that others saw, and do not contradict them."""
        seen, alike, _ = self._with_neighbours()
        return (alike > LEAST_CELLS) & (alike > JOINED * seen) & ~self.doubtful

    def _with_neighbours(self) -> list[Int[ndarray, "pieces"]]:
        whole = np.pad(np.stack(self), ((0, 0), (TOGETHER // 2, TOGETHER // 2)))
        return list(sliding_window_view(whole, TOGETHER, axis=1).sum(axis=2))


def compared(poses: Float[ndarray, "pieces 3"], seen: Sequence[Cells], apart: int) -> Compared:
    """Lay the pieces of a drive together.

    Args:
        poses: of the pieces, m, m, rad.
        seen: what each of them saw.
        apart: of so many pieces after each other none is compared with another.
    """
    wall, free = ([transform(pose, each[i]) for pose, each in zip(poses, seen, strict=True)] for i in (0, 1))
    if not sum(map(len, wall)):
        return Compared(*np.zeros((3, len(seen)), dtype=int))
    size = seen[0].size_m
    low, high = (by([by(each, axis=0) for each in (*wall, *free) if len(each)], axis=0) for by in (np.min, np.max))
    low, rows = low - (NEAR + 1) * size, int((high[1] - low[1]) / size) + 2 * NEAR + 4

    def key(points: Float[ndarray, "_ 2"]) -> Int[ndarray, "_"]:
        at = ((points - low) / size).astype(np.int64)
        return np.unique(at[:, 0] * rows + at[:, 1])

    walls = [key(points) for points in wall]
    known: Int[ndarray, "known"] = np.unique(np.concatenate(walls))
    shift = np.arange(-NEAR, NEAR + 1)
    around = _found(known, known[:, None] + (shift[:, None] * rows + shift).ravel())
    own = [_found(known, keys) for keys in walls]
    floor = [_found(known, key(points)) for points in free]
    count = np.zeros((2, len(known) + 1), dtype=int)  # by others: of walls, and of free floor; the last is of no cell
    alike, against = np.zeros((2, len(seen)), dtype=int)

    def add(k: int, how: int) -> None:
        count[0, own[k]] += how
        count[1, floor[k]] += how
        count[:, -1] = 0

    for k in range(apart, len(seen)):
        add(k, 1)
    for k in range(len(seen)):
        if k:
            if k + apart - 1 < len(seen):
                add(k + apart - 1, -1)
            if k - apart >= 0:
                add(k - apart, 1)
        near = (count[0, around[own[k]]] > 0).any(axis=1)
        alike[k], against[k] = near.sum(), ((count[1, own[k]] >= TWICE) & ~near).sum()
    return Compared(np.array([len(each) for each in own]), alike, against)


def _found(known: Int[ndarray, "known"], keys: Int[ndarray, "*n"]) -> Int[ndarray, "*n"]:
    """Where keys are among the known, which are sorted; past the last those that are not."""
    at = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return np.where(known[at] == keys, at, len(known))
