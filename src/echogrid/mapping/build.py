"""From a log to its map: scans are interpreted, and fused in their order."""

import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from echogrid.doubts import Judge
from echogrid.errors import DoubtWarning
from echogrid.frame import Frame, Log
from echogrid.grid import Grid, UnreadGrid
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import DEFAULT
from echogrid.models.model import Evidence, Model
from echogrid.robot import Robot

WORKERS = 2
"""Batches that are interpreted side by side."""


def build_map(
    frames: Iterable[Frame],
    robot: Robot,
    model: Model | str = DEFAULT,
    resolution: float | None = None,
    half_life: float | None = None,
) -> Iterator[Grid]:
    """Fuse the frames of a drive into a global map that grows as the robot drives.

    Ranges are cleaned by the limits of the robot (``Robot.clean``); those of a log that was loaded for it are clean.

    Args:
        frames: a log; each frame is read once, and not kept but by a model that needs the whole log. They may hold
            what ``Mapper.add`` takes, and are not to be changed while they are mapped.
        robot: the robot that drove; its mounts are in the order of the readings.
        model: a sensor model, or its name.
        resolution: side of a global cell, m; None: the model's own.
        half_life: time in which evidence comes to count half, s, for places that change; None: it never fades.

    Yields:
        The map so far, after each batch of frames: views of the growing arrays, not copies, read out when somebody
        first looks at them. A model that needs the whole log yields once. Frames at places that no robot can have got
        to are left out (``Whereabouts``).

    What is doubtful about frames that are no log of a robot (a list, a generator, a log without one), and so have no
    ``Log.notes`` that know its limits, is warned of when all are mapped: a DoubtWarning of one line for each kind.

    Raises:
        UsageError: as of ``Mapper`` at once, as of ``Mapper.add`` when the map comes to the frame.
    """
    noted = isinstance(frames, Log) and frames.robot is not None
    return _steps(Mapper(robot, model, resolution, half_life), frames, None if noted else Judge(robot))


def _steps(mapper: Mapper, frames: Iterable[Frame], judge: Judge | None) -> Iterator[Grid]:
    ahead = WORKERS if mapper.side_by_side else 0
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[Future[Evidence]] = deque()
        for batch in mapper.batches(frames, judge):
            # Of one size, for a log is read in less time than another program is compiled.
            waiting.append(pool.submit(mapper.prepare(batch, filled=True)))
            # What comes before it is fused while it is interpreted.
            if len(waiting) > ahead:
                mapper.fuse(waiting.popleft().result())
                yield UnreadGrid(mapper.grid)
        while waiting:
            mapper.fuse(waiting.popleft().result())
            yield UnreadGrid(mapper.grid)
    for doubt, count in judge.notes().items() if judge else ():
        # Told to the line that asks for the maps.
        warnings.warn(f"{doubt} ({count} times)" if count else doubt, DoubtWarning, stacklevel=2)
