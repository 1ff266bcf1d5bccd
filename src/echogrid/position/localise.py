"""Where a robot was in a map that is known: a drive at once, backwards too."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid import _core
from echogrid.frame import Frame
from echogrid.grid import FREE_THRESH, Grid, logit
from echogrid.position.hypotheses import Hypotheses, same_place
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
    agreement: float = np.nan
    """As of ``Localiser``; less than FAIR is little."""


OFF_FLOOR_M = 0.1
"""Maps are exact to some centimetres."""


_PER_M2 = 1200.0
"""Particles to begin with anywhere: more than live there is time for."""


@dataclass
class _Stretch:
    """Frames from where the place is anyone, or a start that is given, until it is so again."""

    begin: int
    end: int
    """Number of the frame behind the last."""
    sure: int | None = None
    """Number of the frame at which one place remained of several."""
    possible: Hypotheses = field(default_factory=Hypotheses)
    """Places before that."""


def localise(
    frames: Iterable[Frame],
    grid: Grid,
    robot: Robot,
    start: Float[ndarray, "3"] | Sequence[float] | None = None,
    seed: int = 0,
) -> Localised:
    """Where a robot was in a map, frame by frame; once a place is sure, so is the way that led there.

    Where none became sure each way that the drive may have taken is judged by all that was heard.

    Args:
        frames: of a log, with poses by odometry.
        grid: the map.
        robot: the robot.
        start: about where it began in the map, m, m, rad; None: anywhere.
        seed: of the particles.

    Raises:
        UsageError: as of ``Localiser`` and its ``add``.
    """
    localiser, kept, found, driven = Localiser(grid, robot, start, seed, _PER_M2), [], [], []
    stretches, told, pieces = [_Stretch(0, 0)], 0, 0
    for k, frame in enumerate(frames):
        kept.append(frame)
        found.append(localiser.add(frame))
        driven.append(localiser.driven_m)
        for event in localiser.events[told:]:
            if event.what == "sure":
                stretches[-1].sure = k
            elif event.what != "jump":
                stretches[-1].end = k + (event.what == "lost")
                stretches.append(_Stretch(stretches[-1].end, 0))
        if localiser.pieces > pieces and not localiser.sure:
            stretches[-1].possible.note(localiser, k - stretches[-1].begin)
        told, pieces = len(localiser.events), localiser.pieces
    stretches[-1].end = len(kept)
    poses = np.array([each.pose for each in found]).reshape(-1, 3)
    sure = np.array([each.sure for each in found], dtype=bool)
    events = list(localiser.events)
    for part in stretches:
        if part.sure is not None:
            _walk_back(localiser, kept, slice(part.begin, part.sure + 1), poses, sure)
            if _upheld(localiser, kept, part, poses):
                continue
            events = [event for event in events if (event.what, event.frame) != ("sure", part.sure)]
        elif sure[part.begin : part.end].any():
            continue
        whole = slice(part.begin, part.end)
        way = part.possible.likeliest(localiser, kept[whole])
        sure[whole] = way is not None and way.fair and way.alone
        if way is not None:
            poses[whole] = way.poses
        if sure[whole].any():
            events.append(Event("sure", kept[part.end - 1].stamp, driven[part.end - 1], part.end - 1))
    events.sort(key=lambda event: event.frame)
    stamps = np.array([frame.stamp for frame in kept])
    return Localised(stamps, poses, sure, events, _off_floor(grid, poses), localiser.agreement)


def _upheld(localiser: Localiser, frames: list[Frame], part: _Stretch, poses: Float[ndarray, "frames 3"]) -> bool:
    """Whether the place that remained explains most, judged by as much again as led to it."""
    assert part.sure is not None
    at, end = part.sure - part.begin, min(part.end, 2 * part.sure - part.begin + 1)
    way = part.possible.likeliest(localiser, frames[part.begin : end], (at, poses[part.sure]))
    return way is None or (way.fair and same_place(way.poses[at], poses[part.sure]))


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
