"""From a log to its map: scans are interpreted, and fused in their order."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

from echogrid.doubts import Whereabouts
from echogrid.frame import Frame
from echogrid.grid import Grid
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import DEFAULT, sensor_model
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

    Args:
        frames: a log; each frame is read once, and not kept but by a model that needs the whole log.
        robot: the robot that drove; its mounts are in the order of the readings.
        model: a sensor model, or its name.
        resolution: side of a global cell, m; None: the model's own.
        half_life: time in which evidence comes to count half, s, for places that change; None: it never fades.

    Yields:
        The map so far, after each batch of frames: views of the growing arrays, not copies. A model that needs the
        whole log yields once. Frames at places that no robot can have got to are left out (``Whereabouts``).

    Raises:
        UsageError: the frames do not fit the robot, the map would become too large, or evidence is to fade of a model
            other than the set network.
    """
    mapper = Mapper(robot, sensor_model(model) if isinstance(model, str) else model, resolution, half_life)
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: deque[Future[Evidence]] = deque()
        where = Whereabouts()
        reached = (frame for frame in frames if where.takes(frame.stamp, *frame.pose[:2].tolist()))
        for batch in mapper.batches(reached):
            # Of one size, for a log is read in less time than another program is compiled.
            waiting.append(pool.submit(mapper.prepare(batch, filled=True)))
            # What comes before it is fused while it is interpreted.
            if len(waiting) > WORKERS:
                mapper.fuse(waiting.popleft().result())
                yield mapper.grid()
        while waiting:
            mapper.fuse(waiting.popleft().result())
            yield mapper.grid()
