"""Logs of one place for the tests of stores."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from commands import SAMPLE
from echogrid.fleet.job import Outcome, Task, add
from echogrid.fleet.poses import OwnPoses, Poses
from echogrid.fleet.store import Store
from echogrid.frame import Frame
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from echogrid.robot import Robot, robot_yaml

ROBOT = Robot.load("b21")
FRAMES = list(load_log(SAMPLE, ROBOT))
PIECES = [FRAMES[first : first + 150] for first in (0, 90, 180, 270, 360)]
"""Drives through one room, which see much of it twice."""


def logs(folder: Path, pieces: Sequence[Sequence[Frame]] = PIECES) -> list[Path]:
    """The drives as logs."""
    paths = [folder / f"drive{k}.csv" for k in range(len(pieces))]
    for path, piece in zip(paths, pieces, strict=True):
        write_csv(path, iter(piece), ROBOT.sonars)
    return paths


def task(store: Store, log: Path, poses: Poses | None = None, robot: Robot | None = ROBOT) -> Task:
    text = None if robot is None else robot_yaml(robot)
    return Task(str(store.path), str(log), text, None, poses or OwnPoses())


def filled(folder: Path, paths: Sequence[Path]) -> Store:
    """A store with logs that were added in this order."""
    store = Store.made(folder)
    for path in paths:
        assert added(store, path).what == "added"
    return store


def added(store: Store, log: Path, poses: Poses | None = None) -> Outcome:
    return add(task(store, log, poses))


def shifted(frames: Sequence[Frame], x: float, y: float) -> list[Frame]:
    """The same drive in another place."""
    return [Frame(frame.stamp, frame.pose + np.array([x, y, 0.0]), frame.ranges) for frame in frames]
