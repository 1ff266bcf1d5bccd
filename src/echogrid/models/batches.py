"""Scans that are read together, and where their patches of the map lie."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.robot import Robot

BATCH = 64
"""Scans that are read together; few enough to stay in the cache."""

WINDOW_M = 3.0
"""Way along an axis within which scans are taken together into one window of the map."""


class Placed(NamedTuple):
    """A batch of scans, filled up, and where its patches of the global map lie."""

    ranges: Float[ndarray, "scans sonars"]
    """m; nan behind the last scan."""
    first: Int[ndarray, "scans 2"]
    """Global cell [row, col] of each patch's first cell."""
    corner: Float[ndarray, "scans 2"]
    """Centre of that cell relative to the robot, m, world axes, x first."""
    theta: Float[ndarray, "scans"]


def placed(batch: Sequence[Frame], size: int, side: int, resolution: float) -> Placed:
    """Fill a batch up to ``size`` scans, so that one compilation serves all."""
    fill = size - len(batch)
    poses = np.pad([frame.pose for frame in batch], [(0, fill), (0, 0)], mode="edge")
    ranges = np.pad([frame.ranges for frame in batch], [(0, fill), (0, 0)], constant_values=np.nan)
    first = np.floor(poses[:, :2] / resolution).astype(np.int64) - side // 2
    corner = ((first + 0.5) * resolution - poses[:, :2]).astype(np.float32)
    theta = np.mod(poses[:, 2], 2 * np.pi).astype(np.float32)
    return Placed(ranges.astype(np.float32), first[:, ::-1], corner, theta)


def near_each_other(frames: Iterable[Frame], span_s: float = np.inf) -> Iterator[list[Frame]]:
    """Frames in their order, as many together as one window of the map holds, and of at most so long a time."""
    batch: list[Frame] = []
    low = high = np.zeros(2)
    for frame in frames:
        place = frame.pose[:2]
        low, high = (np.minimum(low, place), np.maximum(high, place)) if batch else (place, place)
        late = bool(batch) and frame.stamp - batch[0].stamp > span_s
        if batch and (len(batch) == BATCH or late or np.any(high - low > WINDOW_M)):
            yield batch
            batch, low, high = [], place, place
        batch.append(frame)
    if batch:
        yield batch


def apart(frames: Iterable[Frame], robot: Robot) -> Iterator[Frame]:
    """Frames whose sonars all look from the robot's own mounts: others fall into one for each place of the robot."""
    for frame in frames:
        if frame.mounts is None:
            yield frame
            continue
        places = compose(frame.pose, compose(frame.mounts, inverse(robot.mounts)))
        kinds, kind = np.unique(np.round(places, 4), axis=0, return_inverse=True)
        for k in range(len(kinds)):
            same = kind == k
            ranges = np.where(same, frame.ranges, np.nan)
            if not np.isnan(ranges).all():
                yield Frame(frame.stamp, places[np.argmax(same)], ranges)
