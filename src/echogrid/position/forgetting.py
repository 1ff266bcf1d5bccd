"""Which pieces of a long drive are forgotten, and how what was known of them is handed to their neighbours."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.geometry import compose, inverse, wrap
from echogrid.position.drive import MatchEdge

NEAR_M, NEAR_RAD = 0.7, np.deg2rad(60.0)
"""Pieces within this of each other saw the same."""

RECENT = 60
"""So many of the last pieces are never forgotten."""


def to_forget(poses: Float[ndarray, "pieces 3"], count: int) -> list[int]:
    """Pieces to be forgotten, at most so many: no two neighbours, neither the first nor one of the last.

    Those go first whose place most others saw as well; among these the oldest.
    """
    seen = np.zeros(len(poses), dtype=int)
    for k, pose in enumerate(poses):
        off = poses - pose
        near = np.hypot(off[:, 0], off[:, 1]) < NEAR_M
        seen[k] = np.sum(near & (np.abs(wrap(off[:, 2])) < NEAR_RAD))
    taken: list[int] = []
    kept: Bool[ndarray, "pieces"] = np.ones(len(poses), dtype=bool)
    for k in np.argsort(-seen[: len(poses) - RECENT], kind="stable").tolist():
        if len(taken) == count:
            break
        if k > 0 and kept[k - 1] and kept[k + 1]:
            kept[k] = False
            taken.append(k)
    return sorted(taken)


def handed_on(
    edge: MatchEdge, poses: Float[ndarray, "pieces 3"], first: int, second: int
) -> tuple[Float[ndarray, "3"], Float[ndarray, "3 3"]]:
    """What a match says of two other pieces, by where they lie to its own now: pose (m, m, rad) and information.

    Args:
        edge: the match.
        poses: of all pieces.
        first: the piece that takes the place of its first.
        second: likewise.
    """
    before = compose(inverse(poses[first]), poses[edge.first])
    behind = compose(inverse(poses[edge.second]), poses[second])
    x, y, cos, sin = behind[0], behind[1], np.cos(behind[2]), np.sin(behind[2])
    # How far off the second one is, by how far off the one behind it is: the adjoint of the way between them.
    moved = np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]])
    return compose(compose(before, edge.pose), behind), moved.T @ edge.information @ moved


def chained_variance(one: Float[ndarray, "3"], other: Float[ndarray, "3"], way: float) -> Float[ndarray, "3"]:
    """Variances of a step of odometry and the next (m2, m2, rad2) together, the next being so long (m)."""
    both = one + other
    both[:2] += one[2] * way**2
    return both
