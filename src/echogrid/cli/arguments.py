"""What several commands take: a log with its robot, a world, physics, a seed; and their progress bar."""

import sys
from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from tqdm import tqdm
from tyro.conf import arg

from echogrid.errors import UsageError, escaped
from echogrid.frame import Frame, Log
from echogrid.grid import Grid
from echogrid.limits import HALF_LIFE, RESOLUTION
from echogrid.logs.formats import load_log
from echogrid.output.folder import drop_stale
from echogrid.packed import compression_of
from echogrid.robot import Robot, preset_names, presets_with
from echogrid.ros.messages import Choice
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.beam_patterns import BEAMS
from echogrid.simulation.world import world_names

WORLD = arg(metavar="WORLD", help=f"World file, or a shipped one: {', '.join(world_names())}.")


def robot_arg(more: str = ""):
    """What an option that names a robot shows in the help; more: what else there is to say."""
    return arg(metavar="NAME|FILE", help=f"Preset ({', '.join(preset_names())}) or robot file{more}.")


@dataclass(frozen=True)
class Ros:
    """What of ROS's topics and frames to take, where it cannot be told."""

    topics: Annotated[tuple[str, ...], arg(metavar="[TOPIC ...]")] = ()
    """Topics of the sonars (and of odometry), by name or pattern ('/front/*'). Default: all."""
    base_frame: Annotated[str | None, arg(metavar="FRAME")] = None
    """Frame of the robot. Default: the one that carries the sonars and has a pose."""
    fixed_frame: Annotated[str | None, arg(metavar="FRAME")] = None
    """Frame to map in. Default: map, else odom, or what stands highest."""

    def choice(self, odometry: bool = False) -> Choice:
        """What to listen to; ``odometry``: whether the poses are to be odometry."""
        return Choice(self.topics, self.base_frame, self.fixed_frame, odometry)


def open_log(log_file: str | None, robot_name: str | None, choice: Choice | None = None) -> tuple[Log, Robot, bool]:
    """The log, the robot to map it with, and whether the user or the log named that robot."""
    if log_file is None:
        robot = Robot.load(robot_name or "b21")
        return load_log(str(resources.files("echogrid") / "data" / "sample.csv"), robot), robot, True
    if robot_name is not None:
        robot = Robot.load(robot_name)
        return load_log(log_file, robot, choice), robot, True
    log = load_log(log_file, choice=choice)
    if log.robot is not None:
        return log, log.robot, True
    robot = Robot.load("b21")
    if log.sonars != robot.sonars:
        packed = f" (unpacked by {kind})" if (kind := compression_of(Path(log_file))) else ""
        raise UsageError(
            f"{log.name}: found {log.sonars} sonars{packed}, expected --robot to say where they sit"
            f"{presets_with(log.sonars)}"
        )
    return load_log(log_file, robot), robot, False


def print_notes(log: Log) -> None:
    """Say what was left out of a log, or assumed."""
    for what, count in log.notes.items():
        print(f"note: {escaped(what)}" + (f" ({count} times)" if count else ""), file=sys.stderr)


def open_map(path: Path) -> Grid:
    """Read a map; what is doubtful about it is told.

    Raises:
        InputError: not there, damaged, or not a map.
    """
    from echogrid.output.map_file import read_map_noted

    grid, doubt = read_map_noted(path)
    if doubt:
        print(escaped(f"note: {doubt}"), file=sys.stderr)
    return grid


def drop(folder: Path, besides: Collection[str] = (), log: str | None = None) -> None:
    """Remove what shows an older map than the one that a folder now holds, and say so."""
    if removed := drop_stale(folder, besides, log):
        print(escaped(f"note: removed {', '.join(removed)} of an older map from {folder}"), file=sys.stderr)


def bar[T](items: Iterable[T], what: str, unit: str, total: int | None = None) -> Iterator[T]:
    """A progress bar round an iterable; silent where there is no terminal."""
    return iter(tqdm(items, desc=what, unit=unit, total=total, disable=None, leave=False))


@contextmanager
def steps(what: str, unit: str) -> Generator[Callable[[int, int], None]]:
    """A progress bar that is told how much is done, and of how much; silent where there is no terminal."""
    with tqdm(desc=what, unit=unit, disable=None, leave=False) as line:

        def progress(done: int, of: int) -> None:
            line.total = of
            line.update(done - line.n)

        yield progress


def shown(log: Log, what: str) -> Iterator[Frame]:
    """The frames of a log under a progress bar, which knows the end where the log does."""
    progress = log.progress
    if progress is None or not sys.stderr.isatty():
        yield from bar(log, what, "scan")
        return
    with tqdm(desc=what, unit=progress.unit, total=progress.total(), leave=False) as line:
        for frame in log:
            line.update(1 if progress.done is None else progress.done - line.n)
            yield frame


_PHYSICS_LIMITS = {
    "temperature_c": (-50.0, 60.0),
    "humidity_percent": (0.0, 100.0),
    "facet_slope_deg": (0.1, 80.0),
    **dict.fromkeys(("walk_error", "range_noise", "range_scale", "lost", "cross_talk", "stale"), (0.0, 1.0)),
}
_LEVEL_LIMITS_DB = (-200.0, 200.0)
"""Of all other fields of Physics."""


def check_physics(physics: Physics) -> None:
    """Refuse physics that cannot be."""
    if physics.beam not in BEAMS:
        raise UsageError(f"--physics.beam: found {physics.beam}, expected {', '.join(BEAMS)}")
    for name in (item.name for item in fields(physics) if item.name != "beam"):
        value, (low, high) = getattr(physics, name), _PHYSICS_LIMITS.get(name, _LEVEL_LIMITS_DB)
        if not low <= value <= high:
            shown = name.replace("_", "-")
            raise UsageError(f"--physics.{shown}: found {value:g}, expected {low:g} to {high:g}")


def check_map(resolution: float | None, half_life: float | None) -> None:
    """Refuse cells (m) and half-lives (s) that no map can have."""
    if resolution is not None:
        RESOLUTION.check(resolution, "--resolution")
    if half_life is not None:
        HALF_LIFE.check(half_life, "--half-life")


def start_pose(text: str) -> Float[ndarray, "3"]:
    """The pose (m, m, rad) that --start says."""
    try:
        x, y, degrees = (float(number) for number in text.split(","))
    except ValueError:
        raise UsageError(f"--start: found {text}, expected X,Y,DEG in m, m and degrees") from None
    if not np.isfinite([x, y, degrees]).all():
        raise UsageError(f"--start: found {text}, expected finite numbers")
    return np.array([x, y, np.deg2rad(degrees)])


def check_seed(seed: int) -> None:
    """Refuse a seed below 0."""
    if seed < 0:
        raise UsageError(f"--seed: found {seed}, expected 0 or more")
