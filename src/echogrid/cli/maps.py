"""Commands about logs and maps: map, info, score."""

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, bar, open_log, print_notes
from echogrid.errors import InputError, UsageError
from echogrid.files import made, replacing
from echogrid.frame import Frame, Track
from echogrid.grid import Grid
from echogrid.logs import bag
from echogrid.logs.contents import describe
from echogrid.logs.formats import load_log
from echogrid.robot import Robot, robot_yaml


class _Follower(Protocol):
    """What goes along while a log is mapped, and makes a file of its own of it."""

    def add(self, frame: Frame) -> None:
        """Take the next frame."""

    def keep(self, grid: Grid) -> None:
        """Take the map so far."""

    def finish(self, grid: Grid) -> None:
        """Take the finished map."""


@dataclass(frozen=True)
class Map:
    """Map a log: sonar ranges and poses in, an occupancy map out.

    Writes map.png (to look at), map.pgm + map.yaml (for ROS map_server), map.npz (log-odds) and run.yaml
    (what was done). Without LOG it maps the sample that ships with echogrid, a simulated drive of a B21.
    """

    log: Annotated[Positional[str | None], arg(metavar="[LOG]")] = None
    """CSV or CARMEN log, or a bag of ROS 1 or ROS 2 (.bag, .mcap, .db3 or a folder)."""
    robot: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Preset or robot file. Default: the robot that the log describes, else b21 if the log has 24 sonars."""
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    out: Path = Path("out")
    """Folder for the map."""
    resolution: Annotated[float | None, arg(metavar="M")] = None
    """Side of a cell of the map, m. Default: 0.04 for the set network, else 0.12."""
    interpreter: str = "set-network"
    """set-network, network (the paper's), a weights file, or a classical model: cone, cone-no-echo, moravec-elfes,
    elfes, nav2, nav2-clearing, nav2-tuned, himm, muriel, dempster-shafer, fuzzy, lim-cho, em."""
    half_life: Annotated[float | None, arg(metavar="S")] = None
    """For places that change: time in which what was seen comes to count half, s. Default: it never fades."""
    refine: bool = False
    """Clean the finished map with a 3x3 neighbourhood mask."""
    pgm: Literal["trinary", "scale", "raw"] = "trinary"
    """What map.pgm holds: for navigation trinary; scale and raw hold probabilities, in which Nav2 as it comes finds
    no walls (docs/formats.md says what to set)."""
    view: bool = False
    """Write map.html as well: the map and the drive to explore in a browser."""
    mcap: bool = False
    """Also write map.mcap: poses, ranges and the map as it grew as messages of ROS 2, for Foxglove and rosbags."""
    rerun: bool = False
    """Also write map.rrd and show it in the browser by Rerun (pip install 'echogrid[viewer]'): the drive in time, the
    cones, the map round the robot and the whole map. Served on 127.0.0.1 alone, until Ctrl-C."""

    def run(self) -> None:
        """Map the log and write the folder."""
        from echogrid.mapping.build import build_map
        from echogrid.models.network import Network
        from echogrid.models.set_network import SetNetwork
        from echogrid.models.table import sensor_model
        from echogrid.output.mapfile import write_map

        if self.resolution is not None and not 0.005 <= self.resolution <= 10:
            raise UsageError(f"--resolution: found {self.resolution:g}, expected 0.005 to 10 m")
        if self.half_life is not None and not 0.1 <= self.half_life <= 1e7:
            raise UsageError(f"--half-life: found {self.half_life:g}, expected 0.1 to 1e7 s")
        log, robot, named = open_log(self.log, self.robot, self.ros.choice())
        model = sensor_model(self.interpreter)
        title = f"{Path(log.name).name}, {robot.name}, {model.name}"
        path, count, grid = Track(), 0, None
        followers: list[_Follower] = []

        def frames() -> Iterator[Frame]:
            nonlocal count
            for frame in bar(log, "mapping", "scan"):
                path.add(frame)
                count += 1
                for follower in followers:
                    follower.add(frame)
                yield frame

        begin = time.perf_counter()
        with made(self.out), ExitStack() as stack:  # a folder that cannot be made is found now, not after the mapping
            followers += self._followers(robot, title, stack)
            for step in build_map(frames(), robot, model, self.resolution, self.half_life):
                grid = step
                for follower in followers:
                    follower.keep(grid)
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
            write_map(self.out, grid, path.points(), settings, title, self.pgm)
            for follower in followers:
                follower.finish(grid)
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        print_notes(log)
        rows, cols = grid.shape
        size = f"{cols * grid.resolution:.1f} x {rows * grid.resolution:.1f} m"
        files = f"{self.out}/map.png{', map.html' if self.view else ''}"
        print(f"{log.name}: {count} scans of {robot.name} in {seconds:.1f} s; map of {size} in {files}")
        if self.rerun:
            self._show()

    def _followers(self, robot: Robot, title: str, stack: ExitStack) -> Iterator[_Follower]:
        """What the options ask for beside the map; their files are whole when the stack is closed."""
        if self.view:
            from echogrid.output.page import Page

            yield Page(stack.enter_context(replacing(self.out / "map.html")), robot, title)
        if self.mcap:
            from echogrid.output.recorder import Recorder

            yield stack.enter_context(Recorder(self.out / "map.mcap", robot))
        if self.rerun:
            from echogrid.output.viewer import Viewing

            yield stack.enter_context(Viewing(self.out / "map.rrd", robot))

    def _show(self) -> None:
        """Show map.rrd until Ctrl-C."""
        from echogrid.output.viewer import served

        for sign in (signal.SIGTERM, signal.SIGHUP):  # whoever ends us, Rerun is to end with us
            signal.signal(sign, signal.default_int_handler)
        with suppress(KeyboardInterrupt), served(self.out / "map.rrd") as shown:
            print(f"{self.out}/map.rrd is at {shown.address} until Ctrl-C", flush=True)
            shown.wait()


@dataclass(frozen=True)
class Info:
    """Say what is in a log."""

    log: Annotated[Positional[Path], arg(metavar="LOG")]
    """CSV or CARMEN log, or a bag of ROS."""
    robot: Annotated[str | None, arg(metavar="NAME|FILE")] = None
    """Preset or robot file, for its range limits (and places, where a bag has none). Without it, readings count as
    they are."""
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)

    def run(self) -> None:
        """Print what is in the log."""
        robot = Robot.load(self.robot) if self.robot else None
        if bag.recognises(self.log):
            _print_bag(bag.survey(self.log, robot, self.ros.choice()))
        log = load_log(self.log, robot, self.ros.choice())
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
        print_notes(log)


def _print_bag(survey: bag.Survey) -> None:
    """What is in a bag: its topics, and each sonar with what the bag says of it."""
    print("topic                            messages  type")
    for topic in survey.topics:
        print(f"{topic.name:32} {topic.messages:8}  {topic.type}")
    print(
        "\nsonar (topic, frame)                       rate   x, y, axis on the robot     beam   limits      no echo"
    )
    for sonar in sorted(survey.heard, key=lambda each: each.order):
        heard = survey.heard[sonar]
        place = heard.amiss or "of the robot file"
        if heard.mount is not None:
            x, y, axis = heard.mount
            place = f"{x:5.2f} {y:5.2f} m {np.rad2deg(axis):6.1f} deg"
        low, high = heard.limits
        beam = f"{np.rad2deg(heard.field_of_view):4.0f} deg"
        limits = f"{low:.2f}-{high:.2f} m"
        name = f"{sonar.topic} {sonar.frame}"
        print(f"{name:40} {heard.rate:5.1f} Hz  {place:25} {beam}  {limits:11} {heard.no_echo / heard.readings:6.1%}")
    print(f"\nposes         of {survey.base} in {survey.fixed}\n")


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
        from echogrid.metrics import score
        from echogrid.output.mapfile import read_map, read_truth

        for name, value in asdict(score(read_map(self.map), read_truth(self.truth))).items():
            print(f"{name:13} {value}" if isinstance(value, int) else f"{name:13} {value:.4f}")
