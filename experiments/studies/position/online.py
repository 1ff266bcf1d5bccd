"""Poses found while a robot drives, as methods of ``experiments.studies.position``: as known then, or in the end."""

import time

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Log, Robot
from echogrid.position.online import OnlineSlam


def driven(log: Log, robot: Robot) -> Float[ndarray, "frames 3"]:
    """The pose of each scan as it was known when the scan came, each piece being placed before the next scan."""
    return _replayed(log, robot)[0]


def final(log: Log, robot: Robot) -> Float[ndarray, "frames 3"]:
    """The poses of all scans as they are known in the end; those of a robot that stands are its first."""
    return _replayed(log, robot)[1]


def _replayed(log: Log, robot: Robot) -> tuple[Float[ndarray, "frames 3"], Float[ndarray, "frames 3"]]:
    finder = OnlineSlam(robot)
    poses, took = [], []
    for frame in log:
        begin = time.perf_counter()
        finder.add(frame)
        took.append(time.perf_counter() - begin)
        finder.wait()
        poses.append(finder.pose)
    graph = finder.graph
    finder.close()
    print(f"a scan: median {np.median(took) * 1e3:.2f} ms, 99 % {np.quantile(took, 0.99) * 1e3:.1f} ms")
    then = np.array(poses)
    if graph is None:
        return then, then
    kept = np.array([frame.stamp for frame in graph.frames])
    stamps = np.array([frame.stamp for frame in log])
    at = np.clip(np.searchsorted(kept, stamps, side="right") - 1, 0, None)
    final = graph.frame_poses()[at]
    late = stamps > kept[-1]
    final[late] = then[late]
    return then, final
