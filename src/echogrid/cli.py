"""The command line: the only place that prints."""

import io
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import numpy as np
import tyro
from jaxtyping import Float
from numpy import ndarray
from tqdm import tqdm
from tyro.conf import Positional, arg

from echogrid import __version__
from echogrid.acoustics import BEAMS, Physics
from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.files import made, replacing, unwritable
from echogrid.log import Frame, Log, describe
from echogrid.readers import load_log
from echogrid.robot import TRANSDUCERS, Robot, preset_names, robot_yaml
from echogrid.world import World, world_names

EXIT_ERROR = 2

_WORLD = arg(metavar="WORLD", help=f"World file, or a shipped one: {', '.join(world_names())}.")


class _Path:
    """The drive of a log of any length, kept to a bounded number of points for the picture."""

    _MOST = 4000

    def __init__(self) -> None:
        self._points: list[tuple[float, float]] = []
        self._spacing = 0.02

    def add(self, frame: Frame) -> None:
        x, y = float(frame.pose[0]), float(frame.pose[1])
        if self._points and np.hypot(x - self._points[-1][0], y - self._points[-1][1]) < self._spacing:
            return
        self._points.append((x, y))
        if len(self._points) > self._MOST:
            self._points = self._points[::2]
            self._spacing *= 2

    def points(self) -> Float[ndarray, "n 2"]:
        return np.array(self._points).reshape(-1, 2)


@dataclass(frozen=True)
class Map:
    """Map a log: sonar ranges and poses in, an occupancy map out.

    Writes map.png (to look at), map.pgm + map.yaml (for ROS map_server), map.npz (log-odds) and run.yaml
    (what was done). Without LOG it maps the sample that ships with echogrid, a simulated drive of a B21.
    """

    log: Annotated[Positional[str | None], arg(metavar="[LOG]")] = None
    """CSV or CARMEN log."""
    robot: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Preset or robot file. Default: the robot that the log describes, else b21 if the log has 24 sonars."""
    out: Path = Path("out")
    """Folder for the map."""
    resolution: Annotated[float | None, arg(metavar="M")] = None
    """Side of a cell of the map, m. Default: 0.04 for the set network, else 0.12."""
    interpreter: str = "set-network"
    """set-network, network (the paper's), a weights file, or a classical model: cone, cone-no-echo, moravec-elfes,
    elfes, nav2, nav2-clearing, nav2-tuned, himm, muriel, dempster-shafer, fuzzy, lim-cho, em."""
    refine: bool = False
    """Clean the finished map with a 3x3 neighbourhood mask."""

    def run(self) -> None:
        """Map the log and write the folder."""
        from echogrid.interpret import Network
        from echogrid.mapfile import write_map
        from echogrid.mapping import build_map
        from echogrid.models import sensor_model
        from echogrid.set_network import SetNetwork

        if self.resolution is not None and not 0.005 <= self.resolution <= 10:
            raise UsageError(f"--resolution: found {self.resolution:g}, expected 0.005 to 10 m")
        log, robot, named = _open(self.log, self.robot)
        model = sensor_model(self.interpreter)
        path, count, grid = _Path(), 0, None

        def frames() -> Iterator[Frame]:
            nonlocal count
            for frame in _bar(log, "mapping", "scan"):
                path.add(frame)
                count += 1
                yield frame

        begin = time.perf_counter()
        with made(self.out):  # a folder that cannot be made is found now, not after the mapping
            for step in build_map(frames(), robot, model, self.resolution):
                grid = step
            if grid is None:
                raise InputError(log.name, "no frames", "at least one")
            seconds = time.perf_counter() - begin
            if self.refine:
                grid = grid.refined()
            settings = asdict(self) | {"log": log.name, "robot": robot_yaml(robot), "frames": count}
            settings["resolution"] = grid.resolution
            if isinstance(model, Network | SetNetwork):
                settings |= {"weights": model.recipe}
            elif is_dataclass(model) and not isinstance(model, type):
                settings |= {"parameters": asdict(model)}
            title = f"{Path(log.name).name}, {robot.name}, {model.name}"
            write_map(self.out, grid, path.points(), settings, title)
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        rows, cols = grid.shape
        size = f"{cols * grid.resolution:.1f} x {rows * grid.resolution:.1f} m"
        print(f"{log.name}: {count} scans of {robot.name} in {seconds:.1f} s; map of {size} in {self.out}/map.png")


@dataclass(frozen=True)
class Simulate:
    """Drive a robot through a world and write the log, with the truth grid beside it.

    The truth (LOG with the ending .truth.npz) holds what the drive could see up to 1.4 m from its path.
    """

    world: Annotated[Positional[str], _WORLD]
    robot: Annotated[str, arg(metavar="NAME|FILE")]
    """Preset or robot file."""
    out: Path
    """The log to write (CSV)."""
    drive: str = "auto"
    """File of waypoints (x,y in m, a line each), or auto: a tour of the whole room."""
    walls: Literal["smooth", "rough", "as-given"] = "as-given"
    """Make all walls smooth or rough."""
    seed: int = 0
    """The same seed gives the same readings."""
    physics: Physics = field(default_factory=Physics)

    def run(self) -> None:
        """Write the log and its truth."""
        from echogrid.drive import along, read_waypoints, tour, truth_of
        from echogrid.mapfile import write_truth
        from echogrid.readers.csv_log import write_csv
        from echogrid.simulate import Simulator

        _check(self.physics)
        _check_seed(self.seed)
        world, robot = World.load(self.world).with_walls(self.walls), Robot.load(self.robot)
        if self.drive == "auto":
            poses = tour(world, robot.footprint_radius_m + 0.1)
        else:
            poses = along(read_waypoints(self.drive))
        poses = np.round(poses, 6)
        frames = Simulator(world, robot, self.physics).frames(poses, self.seed)
        rounded = (Frame(round(f.stamp, 3), f.pose, np.round(f.ranges, 4)) for f in frames)
        with replacing(self.out) as log:  # it appears only when its truth is there
            write_csv(log, _bar(rounded, "simulating", "scan", len(poses)), robot.sonars)
            truth = self.out.with_suffix(".truth.npz")
            write_truth(truth, truth_of(world, poses))
        length = np.sum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))
        print(f"{world.name}: {len(poses)} scans of {robot.name} over {length:.1f} m in {self.out}, truth in {truth}")


@dataclass(frozen=True)
class Scan:
    """Turn one transducer on the spot and record range against orientation, 1 degree apart.

    Writes scan.csv and scan.png: the ranges, and the scan over the plan of the world.
    """

    world: Annotated[Positional[str], _WORLD]
    at: Annotated[str, arg(metavar="X,Y")]
    """Where: X,Y in m."""
    out: Path = Path("out")
    """Folder for the scan."""
    transducer: str = "polaroid-7000"
    """polaroid-600 or polaroid-7000."""
    walls: Literal["smooth", "rough", "as-given"] = "as-given"
    """Make all walls smooth or rough."""
    max_range: float = 10.0
    """Longest range, m."""
    physics: Physics = field(default_factory=Physics)

    def run(self) -> None:
        """Write the scan."""
        from echogrid.picture import write_scan
        from echogrid.simulate import rotary_scan

        _check(self.physics)
        world = World.load(self.world).with_walls(self.walls)
        numbers = re.fullmatch(r"\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*", self.at)
        try:
            at = (float(numbers[1]), float(numbers[2])) if numbers else None
        except ValueError:
            at = None
        if at is None or not np.max(np.abs(at)) <= 1e4:
            raise UsageError(f"--at: found {self.at!r}, expected X,Y in metres, within 10 km")
        if not 0 < self.max_range <= 100:
            raise UsageError(f"--max-range: found {self.max_range:g}, expected more than 0, up to 100 m")
        if self.transducer not in TRANSDUCERS:
            raise UsageError(f"--transducer: found {self.transducer}, expected {' or '.join(TRANSDUCERS)}")
        bearing, ranges = rotary_scan(world, TRANSDUCERS[self.transducer], self.max_range, at, self.physics)
        write_scan(self.out, world, at, bearing, ranges, f"{world.name}, {self.transducer}, walls {self.walls}")
        heard = np.mean(np.isfinite(ranges))
        print(f"{world.name}: {len(ranges)} bearings, {heard:.0%} with an echo; {self.out}/scan.png, scan.csv")


@dataclass(frozen=True)
class Train:
    """Train a network for a robot from nothing, simulated drives included.

    Takes up again where it was stopped, from OUT.checkpoint.npz, if the settings are the same.
    """

    robot: Annotated[str, arg(metavar="NAME|FILE")]
    """Preset, robot file, or any: a new array for each drive, as for the weights that ship."""
    out: Path
    """The weights to write (.npz)."""
    network: Literal["set", "paper"] = "set"
    """The set network, which reads any array, or the paper's."""
    drives: int = 6000
    """Simulated drives to learn from."""
    epochs: int = 24
    """Times to go through them."""
    seed: int = 1
    """The same seed gives the same weights."""

    def run(self) -> None:
        """Write the weights."""
        from echogrid.set_training import SetRecipe
        from echogrid.train import Recipe, train

        for name in ("drives", "epochs"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name}: found {getattr(self, name)}, expected 1 or more")
        _check_seed(self.seed)
        if not self.out.name or self.out.is_dir():
            raise unwritable(self.out, "a folder")
        robot = None if self.robot == "any" else Robot.load(self.robot)
        begin = time.perf_counter()
        kind = SetRecipe if self.network == "set" else Recipe
        recipe = kind(drives=self.drives, epochs=self.epochs, seed=self.seed)
        network = train(robot, recipe, self.out, progress=True)
        minutes = (time.perf_counter() - begin) / 60
        print(f"{self.out}: trained for {self.robot} in {minutes:.1f} min, loss {network.recipe['losses'][-1]:.4f}")


@dataclass(frozen=True)
class Score:
    """Score a map against a truth grid.

    found, wiped: surface cells that the map shows, or shows as free; free: free cells shown free; false: free
    cells shown occupied; auc, nll, brier, ece: how well the probabilities tell surface from free.
    """

    map: Annotated[Positional[Path], arg(metavar="MAP")]
    """Map folder, map.npz or map_server map.yaml."""
    truth: Annotated[Positional[Path], arg(metavar="TRUTH")]
    """Truth grid (.npz)."""

    def run(self) -> None:
        """Print the scores."""
        from echogrid.mapfile import read_map, read_truth
        from echogrid.metrics import score

        for name, value in asdict(score(read_map(self.map), read_truth(self.truth))).items():
            print(f"{name:13} {value}" if isinstance(value, int) else f"{name:13} {value:.4f}")


@dataclass(frozen=True)
class Info:
    """Say what is in a log."""

    log: Annotated[Positional[Path], arg(metavar="LOG")]
    """CSV or CARMEN log."""
    robot: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Preset or robot file, for its range limits. Without it, readings count as they are."""

    def run(self) -> None:
        """Print what is in the log."""
        log = load_log(self.log, Robot.load(self.robot) if self.robot else None)
        info = describe(log)
        x0, y0, x1, y1 = info.box_m
        print(f"log           {info.name}")
        print(f"frames        {info.frames}")
        print(f"sonars        {info.sonars}")
        rate = f", {(info.frames - 1) / info.span_s:.1f} Hz" if info.span_s > 0 else ""
        print(f"span          {info.span_s:.2f} s{rate}")
        print(f"drive         {info.length_m:.2f} m within x {x0:.2f} .. {x1:.2f}, y {y0:.2f} .. {y1:.2f} m")
        print(f"no echo       {info.no_echo:.1%}")
        print(f"not fired     {info.not_fired:.1%}")
        print(f"stale         {info.stale:.1%} of the finite readings repeat the one before")
        ranges = f"{info.nearest_m:.3f} .. {info.farthest_m:.3f} m, median {info.median_m:.2f} m"
        print(f"ranges        {'none' if np.isnan(info.median_m) else ranges}")
        print("no echo of    " + " ".join(f"r{i} {v:.0%}" for i, v in enumerate(info.no_echo_by_sonar)))


Command = Map | Simulate | Scan | Train | Score | Info

COMMANDS: dict[str, Callable[..., Command]] = {
    "map": Map,
    "simulate": Simulate,
    "scan": Scan,
    "train": Train,
    "score": Score,
    "info": Info,
}


def _open(log_file: str | None, robot_name: str | None) -> tuple[Log, Robot, bool]:
    """The log, the robot to map it with, and whether the user or the log named that robot."""
    if log_file is None:
        robot = Robot.load(robot_name or "b21")
        return load_log(str(resources.files("echogrid") / "data" / "sample.csv"), robot), robot, True
    if robot_name is not None:
        robot = Robot.load(robot_name)
        return load_log(log_file, robot), robot, True
    log = load_log(log_file)
    if log.robot is not None:
        return log, log.robot, True
    robot = Robot.load("b21")
    if log.sonars != robot.sonars:
        fits = [name for name in preset_names() if Robot.load(name).sonars == log.sonars]
        known = f" (presets with {log.sonars}: {', '.join(fits)})" if fits else ""
        raise UsageError(f"{log.name}: found {log.sonars} sonars, expected --robot to say where they sit{known}")
    return load_log(log_file, robot), robot, False


def _bar[T](items: Iterable[T], what: str, unit: str, total: int | None = None) -> Iterator[T]:
    """A progress bar round an iterable; silent where there is no terminal."""
    return iter(tqdm(items, desc=what, unit=unit, total=total, disable=None, leave=False))


_PHYSICS_LIMITS = {
    "temperature_c": (-50.0, 60.0),
    "humidity_percent": (0.0, 100.0),
    "facet_slope_deg": (0.1, 80.0),
    **dict.fromkeys(("walk_error", "range_noise", "range_scale", "lost", "cross_talk", "stale"), (0.0, 1.0)),
}
_LEVEL_LIMITS_DB = (-200.0, 200.0)
"""Of all other fields of Physics."""


def _check(physics: Physics) -> None:
    if physics.beam not in BEAMS:
        raise UsageError(f"--physics.beam: found {physics.beam}, expected {', '.join(BEAMS)}")
    for name in (item.name for item in fields(physics) if item.name != "beam"):
        value, (low, high) = getattr(physics, name), _PHYSICS_LIMITS.get(name, _LEVEL_LIMITS_DB)
        if not low <= value <= high:
            shown = name.replace("_", "-")
            raise UsageError(f"--physics.{shown}: found {value:g}, expected {low:g} to {high:g}")


def _check_seed(seed: int) -> None:
    if seed < 0:
        raise UsageError(f"--seed: found {seed}, expected 0 or more")


def main(args: list[str] | None = None) -> None:
    """Run a command; an error that the user can mend is one line and exit status 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name may hold what the terminal cannot show
    try:
        try:
            _run(sys.argv[1:] if args is None else args)
        finally:
            print(end="", flush=True)  # here, where it can still be told that nobody takes the output
    except EchogridError as error:
        _fail(str(error))
    except MemoryError:
        _fail("memory: found too little, expected more for a job of this size")
    except KeyboardInterrupt:
        _stop()
    except BrokenPipeError:
        _drop_output()
        sys.exit(0)
    except OSError as error:
        _drop_output()
        _fail(f"{error.filename or 'output'}: found {error.strerror or error}, expected a file that can be used")
    except Exception as error:
        # NumPy turns a Ctrl-C that comes while it waits for JAX into a ValueError.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        _stop()


def _run(args: list[str]) -> None:
    if args in (["--version"], ["-V"]):
        print(f"echogrid {__version__}")
        return
    tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="echogrid", description="Occupancy maps from ultrasonic ranges.", args=args
    ).run()


def _stop() -> NoReturn:
    print("echogrid: stopped", file=sys.stderr)
    sys.exit(130)


def _fail(text: str) -> NoReturn:
    print(f"echogrid: {text}", file=sys.stderr)
    sys.exit(EXIT_ERROR)


def _drop_output() -> None:
    """Let what is still to be written go nowhere: Python tries once more as it ends, and would complain."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
