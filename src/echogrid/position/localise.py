"""Where a robot was in a map that is known: a drive at once, backwards too."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid import _core
from echogrid.frame import Frame
from echogrid.grid import FREE_THRESH, Grid, logit
from echogrid.position.localiser import Event, Localiser
from echogrid.robot import Robot


@dataclass(frozen=True)
class Localised:
    """A drive in a map."""

    stamps: Float[ndarray, "frames"]
    """s"""
    poses: Float[ndarray, "frames 3"]
    """In the map, m, m, rad."""
    sure: Bool[ndarray, "frames"]
    """Whether each is of the one place that remained; else it is the likeliest."""
    events: list[Event]
    off_floor: Bool[ndarray, "frames"]
    """Whether each lies more than OFF_FLOOR_M from what the map knows to be free: no robot can have been there."""


OFF_FLOOR_M = 0.1
"""Maps are exact to some centimetres."""


def localise(
    frames: Iterable[Frame],
    grid: Grid,
    robot: Robot,
    start: Float[ndarray, "3"] | Sequence[float] | None = None,
    seed: int = 0,
) -> Localised:
    """Where a robot was in a map, frame by frame; once a place is sure, so is the way that led there.

    Args:
        frames: of a log, with poses by odometry.
        grid: the map.
        robot: the robot.
        start: about where it began in the map, m, m, rad; None: anywhere.
        seed: of the particles.

    Raises:
        UsageError: as of ``Localiser`` and its ``add``.
    """
    localiser, kept, found = Localiser(grid, robot, start, seed), [], []
    for frame in frames:
        kept.append(frame)
        found.append(localiser.add(frame))
    poses = np.array([each.pose for each in found]).reshape(-1, 3)
    sure = np.array([each.sure for each in found], dtype=bool)
    begin = 0
    for event in localiser.events:
        if event.what == "sure":
            _walk_back(localiser, kept, slice(begin, event.frame + 1), poses, sure)
        elif event.what == "lost":
            begin = event.frame + 1
    stamps = np.array([frame.stamp for frame in kept])
    return Localised(stamps, poses, sure, localiser.events, _off_floor(grid, poses))


def _off_floor(grid: Grid, poses: Float[ndarray, "frames 3"]) -> Bool[ndarray, "frames"]:
    """Which poses lie off the free floor of a map."""
    free = grid.observed & (grid.log_odds < logit(FREE_THRESH))
    row, col = grid.index_of(poses[:, :2]).T
    rows, cols = grid.shape
    inside = (row >= 0) & (row < rows) & (col >= 0) & (col < cols)
    off = np.ones(len(poses), dtype=bool)
    off[inside] = (_core.distance(free) * grid.resolution)[row[inside], col[inside]] > OFF_FLOOR_M
    return off


def _walk_back(localiser: Localiser, frames: list[Frame], part: slice, poses: ndarray, sure: ndarray) -> None:
    """Find the poses of a part of a drive from its last, which is sure; as far as they are explained."""
    back = localiser.at(poses[part.stop - 1])
    for k in reversed(range(part.start, part.stop)):
        estimate = back.add(frames[k])
        if not estimate.sure:
            break
        poses[k], sure[k] = estimate.pose, True
