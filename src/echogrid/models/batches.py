"""Scans that are read together, and where their patches of the map lie."""

from collections.abc import Iterable, Iterator
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
    """Where the patches of the global map lie of which a batch of scans tells."""

    first: Int[ndarray, "scans 2"]
    """Cell [row, col] of each patch's first cell in the window that holds them all."""
    centre: Float[ndarray, "scans 2"]
    """Centre of that cell relative to the robot, m, world axes, x first."""
    theta: Float[ndarray, "scans"]
    corner: Int[ndarray, "2"]
    """Global cell of the window's first."""
    end: Int[ndarray, "2"]
    """Global cell behind its last."""


def placed(poses: Float[ndarray, "scans 3"], side: int, resolution: float) -> Placed:
    """Where the patches of ``side`` cells (of a resolution in m) round poses (m, rad) lie."""
    first = np.floor(poses[:, :2] / resolution).astype(np.int64) - side // 2
    centre = ((first + 0.5) * resolution - poses[:, :2]).astype(np.float32)
    theta = np.mod(poses[:, 2], 2 * np.pi).astype(np.float32).astype(float)
    first = first[:, ::-1]
    corner, end = first.min(axis=0), first.max(axis=0) + side
    return Placed((first - corner).astype(np.int32), centre, theta, corner, end)


def near_each_other(frames: Iterable[Frame], span_s: float = np.inf) -> Iterator[list[Frame]]:
    """Frames in their order, as many together as one window of the map holds, and of at most so long a time."""
    batch: list[Frame] = []
    west = east = south = north = 0.0
    for frame in frames:
        x, y, _ = frame.pose.tolist()
        if batch:
            west, east, south, north = min(west, x), max(east, x), min(south, y), max(north, y)
            late = frame.stamp - batch[0].stamp > span_s
            if len(batch) == BATCH or late or east - west > WINDOW_M or north - south > WINDOW_M:
                yield batch
                batch = []
        if not batch:
            west = east = x
            south = north = y
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
