"""Where the robot was in the scans of a log: as the log says, as a file says, or as a map tells."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.doubts import Judge
from echogrid.errors import InputError
from echogrid.files import read_bytes
from echogrid.frame import Frame, Log, passing
from echogrid.grid import Grid
from echogrid.output.map_file import read_map
from echogrid.output.trajectory import read_tum
from echogrid.position.localise import Localised, localise
from echogrid.robot import Robot

SAME_S = 1e-3
"""A pose is that of a scan whose stamp is within this of its own."""

LEAST = 0.9
"""Share of the scans of a log for which a file or a map has to know the pose, so that the log is mapped."""

MAX_BYTES = 2**30
"""Of a file of poses."""


@dataclass
class Posed:
    """The frames of a log with the poses to map them at."""

    frames: Iterable[Frame]
    notes: dict[str, int] = field(default_factory=dict)
    """What is doubtful, and how often, once all frames were taken."""


@dataclass(frozen=True)
class OwnPoses:
    """As the log says."""

    def digest(self, log: Path) -> str:
        """What says of a record where its poses come from."""
        return "own"

    def place(self, log: Log, path: Path, robot: Robot) -> Posed:
        """The frames of a log at their poses."""
        return Posed(log, log.notes)


@dataclass(frozen=True)
class FilePoses:
    """As a TUM file says, or the one of the log's name in a folder: ``NAME.tum`` or ``NAME/trajectory.tum``."""

    path: str

    def at(self, log: Path) -> Path:
        """The file for a log.

        Raises:
            InputError: there is none.
        """
        path = Path(self.path)
        if not path.is_dir():
            return path
        name = log.name.split(".")[0]
        choices = [
            path / f"{stem}{rest}" for stem in (log.name, log.stem, name) for rest in (".tum", "/trajectory.tum")
        ]
        for choice in choices:
            if choice.is_file():
                return choice
        raise InputError(log, f"no poses for it in {path}", f"{name}.tum or {name}/trajectory.tum there")

    def digest(self, log: Path) -> str:
        """As of ``OwnPoses``."""
        content = read_bytes(self.at(log), "poses as a TUM file", MAX_BYTES)
        return f"file:{hashlib.sha256(content).hexdigest()}"

    def place(self, log: Log, path: Path, robot: Robot) -> Posed:
        """As of ``OwnPoses``; scans of which the file knows no pose are left out, and counted.

        Raises:
            InputError: these are more than a few.
        """
        where = self.at(path)
        stamps, poses = read_tum(where)
        frames = list(log)
        at = _rows(np.array([frame.stamp for frame in frames]), stamps)
        known = at >= 0
        if not known.any() or known.mean() < LEAST:
            found = f"poses for {known.sum()} of the {len(frames)} scans of {path.name}"
            raise InputError(where, found, f"rows with the stamps of {LEAST:.0%} of them")
        left = (
            {"scans of which the file of poses knows none were left out": int((~known).sum())} if any(~known) else {}
        )
        moved = [replace(frame, pose=poses[i]) for frame, i in zip(frames, at, strict=True) if i >= 0]
        return _judged(moved, robot, log.notes | left)


@dataclass(frozen=True)
class MapPoses:
    """Found by localisation in a map."""

    map_file: str
    """Its map.npz, which all workers see."""
    hash: str
    """Of the map."""
    start: tuple[float, float, float] | None
    """About where each log begins, m, m, rad; None: anywhere."""
    seed: int = 0

    def digest(self, log: Path) -> str:
        """As of ``OwnPoses``."""
        return f"localised:{self.hash}"

    def place(self, log: Log, path: Path, robot: Robot) -> Posed:
        """As of ``OwnPoses``; the few scans whose place is not sure are left out, and counted.

        Raises:
            InputError: the robot got lost, or it is not sure where it was.
        """
        frames = list(log)
        start = None if self.start is None else np.array(self.start)
        drive = localise(frames, _map(self.map_file), robot, start, self.seed)
        _check_sure(drive, path)
        sure = drive.sure
        left = {"scans whose place in the map is not sure were left out": int((~sure).sum())} if any(~sure) else {}
        moved = [
            replace(frame, pose=pose) for frame, pose, kept in zip(frames, drive.poses, sure, strict=True) if kept
        ]
        return _judged(moved, robot, log.notes | left)


Poses = OwnPoses | FilePoses | MapPoses


def map_hash(grid: Grid) -> str:
    """The hash of a map."""
    told = hashlib.sha256(f"{grid.resolution!r} {grid.origin!r} {grid.shape}".encode())
    told.update(np.ascontiguousarray(grid.log_odds).tobytes() + np.packbits(grid.observed).tobytes())
    return told.hexdigest()


def _check_sure(drive: Localised, log: Path) -> None:
    expected = "a log that the map explains from end to end: it was not mapped"
    if not len(drive.poses):
        raise InputError(log, "no frames", "at least one")
    for event in drive.events:
        if event.what != "sure":
            stamp = f"{event.stamp:.2f} s"
            what = {"lost": f"a place at {stamp} that did not explain what was heard"}
            raise InputError(log, what.get(event.what, f"poses that jump or begin anew at {stamp}"), expected)
    if not drive.sure[-1]:
        raise InputError(log, "several places where the robot can be at its end", expected)
    if drive.sure.mean() < LEAST:
        found = f"{(~drive.sure).sum()} of {len(drive.sure)} scans whose place is not sure"
        raise InputError(log, found, expected)


def _rows(stamps: Float[ndarray, "scans"], known: Float[ndarray, "rows"]) -> ndarray:
    """The row of the pose of each scan, by stamps (s); -1 where there is none."""
    if len(stamps) == len(known) and np.all(np.abs(stamps - known) <= SAME_S):
        return np.arange(len(stamps))  # of scans at one time each has its own
    order = np.argsort(known, kind="stable")
    after = np.clip(np.searchsorted(known[order], stamps), 1, len(known) - 1) if len(known) > 1 else np.zeros(1, int)
    before = np.maximum(after - 1, 0)
    ordered = known[order]
    nearer = np.where(np.abs(ordered[before] - stamps) <= np.abs(ordered[after] - stamps), before, after)
    return np.where(np.abs(ordered[nearer] - stamps) <= SAME_S, order[nearer], -1)


def _judged(frames: list[Frame], robot: Robot, notes: dict[str, int]) -> Posed:
    """Frames that were moved; what is doubtful about them now joins the notes."""
    judge = Judge(robot)
    for _ in passing(frames, judge):
        pass
    return Posed(frames, notes | judge.notes())


@lru_cache(maxsize=1)
def _map(path: str) -> Grid:
    return read_map(path)
