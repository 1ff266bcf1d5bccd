"""Graphs of poses as text that g2o, gtsam and their like read: VERTEX_SE2 and EDGE_SE2."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.files import replacing
from echogrid.geometry import compose, inverse

_UPPER = np.triu_indices(3)


def write_g2o(
    path: str | Path,
    poses: Float[ndarray, "nodes 3"],
    first: Int[ndarray, "edges"],
    second: Int[ndarray, "edges"],
    measured: Float[ndarray, "edges 3"],
    information: Float[ndarray, "edges 3 3"],
) -> None:
    """Write a graph.

    Args:
        path: the file.
        poses: of the nodes, m, m, rad. Edges may begin at one node more, of which the direction alone is known (that
            of the walls): it is written with the heading that they give it, at the place of the first node.
        first: nodes of the edges.
        second: their other nodes.
        measured: pose of the second as seen from the first, m, m, rad.
        information: inverse of its covariance, in the frame of the measured pose, as g2o has it; its upper
            triangle is written row by row.

    Raises:
        UsageError: the file cannot be written.
    """
    beyond = first >= len(poses)
    if beyond.any():
        seen = compose(poses[second[beyond]], inverse(measured[beyond]))[:, 2]
        heading = np.arctan2(np.sin(seen).sum(), np.cos(seen).sum())
        poses = np.concatenate([poses, [[*poses[0, :2], heading]]])
    lines = [f"VERTEX_SE2 {i} {x:.6f} {y:.6f} {theta:.9f}\n" for i, (x, y, theta) in enumerate(poses.tolist())]
    numbers = np.concatenate([measured, information[:, *_UPPER]], axis=1).tolist()
    for i, j, row in zip(first.tolist(), second.tolist(), numbers, strict=True):
        lines.append(f"EDGE_SE2 {i} {j} {' '.join(f'{value:.9g}' for value in row)}\n")
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="ascii", newline="\n")
