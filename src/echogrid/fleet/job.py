"""One log into a store: what a worker does, and may do twice."""

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np

from echogrid.doubts import POSES_MISREAD, RANGES_MISREAD, STARTS_ANEW, first_of
from echogrid.errors import EchogridError, InputError
from echogrid.fleet.lattice import Region, Tile, cut
from echogrid.fleet.poses import MapPoses, OwnPoses, Posed, Poses
from echogrid.fleet.store import Record, Store, facts, model_of_stores
from echogrid.fleet.sums import Writer
from echogrid.frame import Frame
from echogrid.logs.formats import load_log
from echogrid.mapping.intake import Heard
from echogrid.mapping.mapper import Mapper
from echogrid.robot import Robot, parse_robot, presets_with, robot_yaml
from echogrid.ros.messages import Choice

MOST_CELLS = 2**22
"""Cells of the map that a worker holds at once, 140 MB; of a drive that goes farther it puts by what it has."""


@dataclass(frozen=True)
class Task:
    """A log to be mapped; it travels to a worker."""

    store: str
    log: str
    """Path of the log; both are absolute, for workers may run elsewhere."""
    robot: str | None
    """The robot file (YAML) of the robot that drove; None: the one that the log describes."""
    choice: Choice | None
    """Of topics and frames of ROS."""
    poses: Poses

    @property
    def settings(self) -> str:
        """Hash of what it is mapped with, but for its poses."""
        told = json.dumps([facts(), self.robot, repr(self.choice)], sort_keys=True)
        return hashlib.sha256(told.encode()).hexdigest()


@dataclass(frozen=True)
class Outcome:
    """What became of a log."""

    log: str
    """Its path."""
    what: Literal["added", "there", "replaced", "refused"]
    """Whether it counts newly, as it did, in another way than it did, or not, for the reason."""
    hash: str = ""
    """Of its content."""
    frames: int = 0
    notes: tuple[str, ...] = ()
    where: str = ""
    reason: str = ""
    """Why it was refused: where, and what was found and expected."""


def add(task: Task) -> Outcome:
    """Have a log count in the store; nothing is raised that the log or its surroundings are to blame for."""
    try:
        return _added(task)
    except InputError as error:
        return _refused(task, error.where, f"found {error.found}, expected {error.expected}")
    except EchogridError as error:
        where, _, reason = str(error).partition(": ")
        return _refused(task, where, reason)
    except MemoryError:
        return _refused(task, task.log, "found too little memory, expected more for a log of this size")
    except OSError as error:
        found = error.strerror or str(error)
        return _refused(task, str(error.filename or task.log), f"found {found}, expected a file that can be used")


def _refused(task: Task, where: str, reason: str) -> Outcome:
    return Outcome(task.log, "refused", where=where, reason=reason)


def _added(task: Task) -> Outcome:
    store, path = Store(task.store), Path(task.log)
    log, settings, poses = log_hash(path), task.settings, task.poses.digest(path)
    before = store.record(log)
    # The map so far is another at each run: who was placed in an earlier one keeps his place.
    placed = isinstance(task.poses, MapPoses) and before is not None and before.poses.startswith("localised:")
    same = before is not None and before.settings == settings and (before.poses == poses or placed)
    if before is not None and same and store.sums_at(before.sums).exists():
        return Outcome(task.log, "there", log, before.frames)
    key = hashlib.sha256(f"{log} {settings} {poses}".encode()).hexdigest()
    record = _mapped(task, store, log, key, settings, poses)
    store.write(record)
    return Outcome(task.log, "replaced" if before else "added", log, record.frames, record.notes)


def log_hash(path: Path) -> str:
    """Hash of the content of a log, a file or a folder of files, whatever its name.

    Raises:
        InputError: it cannot be read.
    """
    if not os.path.lexists(path):
        raise InputError(path, "no such file", "a log")
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    if not all(map(os.path.isfile, files)):
        raise InputError(path, "something that is not a plain file", "a log")
    total = hashlib.sha256()
    for file in files:
        with open(file, "rb") as content:
            own = hashlib.file_digest(content, "sha256")
        if file == path:
            return own.hexdigest()
        total.update(f"{file.relative_to(path)} {own.hexdigest()}\n".encode())
    return total.hexdigest()


def _mapped(task: Task, store: Store, log: str, key: str, settings: str, poses: str) -> Record:
    """Map a log, and write its sums."""
    path = Path(task.log)
    read = load_log(task.log, None if task.robot is None else _robot(task.robot), task.choice)
    robot = read.robot
    if robot is None:
        expected = f"--robot to say where they sit{presets_with(read.sonars)}"
        raise InputError(path, f"{read.sonars} sonars", expected)
    posed = task.poses.place(read, path, robot)
    writer, heard = Writer("int32"), Heard()
    _sum(Mapper(robot, model_of_stores()), heard.of(posed.frames), writer)
    heard.check(str(path))
    _check_read(path, posed, own=isinstance(task.poses, OwnPoses))
    writer.write(store.sums_at(key), log=log)
    notes = tuple(doubt + (f" ({count} times)" if count else "") for doubt, count in posed.notes.items())
    tiles: tuple[Tile, ...] = tuple(sorted(set(writer.tiles)))
    told = task.robot or robot_yaml(robot)
    return Record(log, path.name, key, settings, poses, told, heard.frames, tiles, notes, str(path))


def _check_read(path: Path, posed: Posed, own: bool) -> None:
    """Refuse a log that would spoil the map of all, once its frames were taken: its numbers are not what it says."""
    bad = (*RANGES_MISREAD, *((*POSES_MISREAD, STARTS_ANEW) if own else ()))
    if doubt := first_of(posed.notes, bad):
        raise InputError(path, doubt, "a log that does not spoil the map: it was not mapped")


@lru_cache(maxsize=8)
def _robot(text: str) -> Robot:
    return parse_robot(text, "robot")


def _sum(mapper: Mapper, frames: Iterable[Frame], writer: Writer) -> None:
    """Map frames, and put the sums of their cells by: at the end, and before the map becomes too large to hold."""
    held: Region | None = None

    def put_by() -> None:
        for tile, kept in cut(*mapper.hand_over()):
            writer.add(tile, kept)

    for batch in mapper.batches(frames):
        evidence = mapper.prepare(batch)()
        both = window = Region(evidence.corner, evidence.end)
        if held is not None:
            both = Region(np.minimum(held.low, window.low), np.maximum(held.high, window.high))
            if np.prod(both.shape, dtype=float) > MOST_CELLS:
                put_by()
                both = window
        held = both
        mapper.fuse(evidence)
    if held is not None:
        put_by()
