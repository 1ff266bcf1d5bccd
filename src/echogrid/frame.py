"""Frames and logs: the one form in which readings enter, recorded or simulated."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.doubts import Judge
from echogrid.errors import EchogridError, InputError
from echogrid.limits import as_reals
from echogrid.robot import Robot
from echogrid.yaml_keys import shown


@dataclass(frozen=True, slots=True)
class Frame:
    """All sonars of a robot at one instant.

    A range of ``+inf`` means fired and nothing came back; ``nan`` means not fired or not valid. A finite
    range lies within the robot's limits; nothing downstream compares with a maximum range.
    """

    stamp: float
    """Time, s."""
    pose: Float[ndarray, "3"]
    """Robot in the world: x (m), y (m), theta (rad)."""
    ranges: Float[ndarray, "sonars"]
    """One reading a sonar, m, in the order of the robot's mounts."""
    odom: Float[ndarray, "3"] | None = None
    """Dead-reckoned pose where the log has one besides the pose, same units."""
    mounts: Float[ndarray, "sonars 3"] | None = None
    """Where each sonar was when it fired, as seen from ``pose``: m, m, rad. None: all fired at the stamp, from
    the robot's own mounts."""

    def __repr__(self) -> str:
        # It is shown in errors as well, so it may hold anything.
        pose, ranges = as_reals(self.pose), as_reals(self.ranges)
        place = shown(self.pose) if pose is None else shown(np.round(pose, 3).tolist())
        told = shown(self.ranges)
        if ranges is not None:
            echoes = ranges[np.isfinite(ranges)]
            span = f" from {echoes.min():.3g} to {echoes.max():.3g} m" if echoes.size else ""
            told = f"{ranges.size}, {echoes.size} echoes{span}, {np.isposinf(ranges).sum()} without echo"
        moved = "" if self.mounts is None else ", mounts of its own"
        return " ".join(f"Frame(stamp={shown(self.stamp)}, pose={place}, ranges: {told}{moved})".split())


@dataclass
class Progress:
    """How far a log is read, and how far there is to go, for whoever shows it."""

    unit: str
    """What is counted."""
    total: Callable[[], int]
    """How many there are; that may have to be counted."""
    done: int | None = None
    """How many were taken since the log was last begun; None: one a frame."""


@dataclass(frozen=True)
class Log:
    """A sequence of frames that can be gone through again and again, read lazily where it lies in a file."""

    name: str
    """Where the frames come from, for messages."""
    sonars: int
    """Number of readings in each frame."""
    robot: Robot | None
    """The robot whose limits the ranges keep: the one that the log was loaded with, else the one that the
    log itself describes (CARMEN), else None."""
    open: Callable[[], Iterator[Frame]]
    """Starts again at the first frame."""
    notes: dict[str, int] = field(default_factory=dict)
    """What was left out, assumed or doubtful when the log was last gone through, and how often; 0 where that says
    nothing."""

    progress: Progress | None = None
    """How far it is read; None where the end is not known."""
    judges: bool = False
    """Whether the reader shows its frames to a judge itself, as one that has them in arrays can do for less."""

    def __iter__(self) -> Iterator[Frame]:
        """Go through the frames; at their end the notes are those of this time."""
        return self.open() if self.judges else _judged(self.open(), Judge(self.robot), self.notes)

    def __repr__(self) -> str:
        return f"Log({self.name!r}, {self.sonars} sonars, robot {self.robot and self.robot.name!r})"

    @staticmethod
    def of(frames: Iterable[Frame], name: str = "frames") -> "Log":
        """A log of frames in memory.

        Raises:
            InputError: the frames differ in their number of readings.
        """
        kept = tuple(frames)
        sonars = sorted({len(frame.ranges) for frame in kept})
        if len(sonars) > 1:
            raise InputError(name, f"frames of {sonars[0]} and of {sonars[-1]} readings", "one number")
        return Log(name, sonars[0] if sonars else 0, None, lambda: iter(kept))


_BATCH = 32
"""Frames that are judged together."""


def _judged(frames: Iterable[Frame], judge: Judge, notes: dict[str, int]) -> Iterator[Frame]:
    """The frames of a log; at their end its notes are told.

    Args:
        frames: of the log; those before an error come before it.
        judge: new, for it.
        notes: of the log; those of the judge join what its reader noted when all frames were taken.
    """
    notes.clear()
    source, error = iter(frames), None
    while error is None:
        batch: list[Frame] = []
        try:
            batch.extend(islice(source, _BATCH))
        except EchogridError as caught:
            error = caught
        if not batch and error is None:
            break
        if batch:
            show_to(judge, batch)
            yield from batch
    if error is not None:
        raise error
    notes |= judge.notes()


def passing(frames: Iterable[Frame], judge: Judge) -> Iterator[Frame]:
    """Frames that a judge sees as they pass: none is taken from their source before it is wanted."""
    batch: list[Frame] = []
    for frame in frames:
        batch.append(frame)
        yield frame
        if len(batch) == _BATCH:
            show_to(judge, batch)
            batch = []
    if batch:
        show_to(judge, batch)


def show_to(judge: Judge, batch: Iterable[Frame]) -> None:
    """Have frames, of which there is at least one, seen by a judge."""
    columns = zip(*((frame.stamp, frame.pose, frame.ranges) for frame in batch), strict=True)
    judge.see(*(np.array(column, dtype=float) for column in columns))
