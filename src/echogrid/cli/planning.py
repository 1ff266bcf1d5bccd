"""Commands that drive, on a map or in a world: plan, explore."""

import json
import os
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from tqdm import tqdm
from tyro.conf import Positional, arg

from echogrid.cli.arguments import WORLD, check_physics, check_seed, drop, open_map, robot_arg, start_pose
from echogrid.cli.poses import TRAJECTORIES, write_trajectories
from echogrid.errors import UsageError, escaped
from echogrid.extras import need
from echogrid.files import check_writable, made, printable, read_text, replacing
from echogrid.frame import Frame
from echogrid.output.folder import check_folder
from echogrid.robot import Robot, parse_robot, robot_yaml, surrounded
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.world import World
from echogrid.yaml_keys import Keys, parse_yaml

if TYPE_CHECKING:
    from echogrid.metrics import Scores
    from echogrid.output.map_picture import Discs
    from echogrid.planning.explore import Explored
    from echogrid.planning.paths import Path as Way

_FILES = ("path.csv", "path.png")

_MOVED_M, _ROUND_M = 0.02, 0.005
"""A start or goal that was moved farther is told of; room is told to twice the second."""


@dataclass(frozen=True)
class Plan:
    """Find the shortest safe path on a map, or say why there is none.

    Writes path.csv (x, y, s along the path, clearance beside the robot, all in m) and path.png. The robot keeps off
    what is occupied and what is not known; exit status 2 where there is no path.
    """

    map: Annotated[Positional[Path], arg(metavar="MAP")]
    """A map folder or map.npz of echogrid, or the YAML of a map_server pair, drawn by anybody."""
    from_: Annotated[str, arg(name="from", metavar="X,Y")]
    """Where the robot's middle is, m, in the frame of the map; write --from=-1,2 where X is below 0."""
    to: Annotated[str, arg(metavar="X,Y")]
    """Where it is to go, likewise."""
    robot: Annotated[str | None, robot_arg(", for its footprint. Default: the robot of run.yaml beside the map")] = (
        None
    )
    unknown: bool = False
    """It may drive on what is not known, at 30 times the way: for ground that it will see as it comes."""
    out: Path = Path("planned")
    """Folder to write into."""

    def run(self) -> None:
        """Plan, and write the folder."""
        from echogrid.output.map_picture import draw_map
        from echogrid.planning.paths import plan

        start, goal = (_point(given, f"--{name}") for name, given in (("from", self.from_), ("to", self.to)))
        grid = open_map(self.map)
        robot = Robot.load(self.robot) if self.robot else _robot_of(self.map)
        if not self.robot and np.isclose(robot.footprint_radius_m, surrounded(robot.mounts), rtol=0, atol=1e-5):
            print(
                escaped(
                    f"note: {robot.name} is taken for a disc of {robot.footprint_radius_m:.2f} m, which its sonars "
                    "surround, for the log did not say how wide it is: if it is wider, give its footprint by --robot"
                ),
                file=sys.stderr,
            )
        way = plan(grid, start, goal, robot, self.unknown)
        with made(self.out):
            for name in _FILES:
                check_writable(self.out / name)
            title = escaped(f"{self.map.absolute().name}, {robot.name}, {way.length_m:.2f} m")
            with replacing(self.out / "path.png") as picture, replacing(self.out / "path.csv") as table:
                draw_map(picture, grid, way.points, title, drive="path", marks=_over(way), discs=_discs(way, robot))
                table.write_text(_csv(way), encoding="utf-8")
        for what, given, at in (("start", start, way.points[0]), ("goal", goal, way.points[-1])):
            if (off := float(np.hypot(*(at - given)))) > _MOVED_M:
                print(
                    f"note: the {what} was moved by {off:.2f} m, to ({at[0]:.2f}, {at[1]:.2f}) m, where by the map "
                    "the robot can stand",
                    file=sys.stderr,
                )
        if way.narrow is not None:
            print(
                f"note: at ({way.narrow[0]:.2f}, {way.narrow[1]:.2f}) m the way is hardly wide enough by the map, "
                "whose walls may be drawn too thick: drive slowly there, or map it once more from near",
                file=sys.stderr,
            )
        print(escaped(f"{self.out}/path.csv: {way.length_m:.2f} m, {_beside(way, robot.name)}; {self.out}/path.png"))


def _point(text: str, where: str) -> tuple[float, float]:
    try:
        x, y = (float(number) for number in text.split(","))
    except ValueError:
        x = y = np.nan
    if not np.isfinite([x, y]).all():
        raise UsageError(f"{where}: found {text}, expected X,Y in metres")
    return x, y


def _robot_of(path: Path) -> Robot:
    """The robot that a map of ours was made with."""
    record = (path if os.path.isdir(path) else path.parent) / "run.yaml"
    if os.path.isfile(record):
        where = printable(record)
        run = Keys(where, parse_yaml(read_text(record, "the record of a map (YAML)"), where))
        if isinstance(run.data.get("robot"), str):
            return parse_robot(run.data["robot"], f"{where}: robot")
    raise UsageError(f"--robot: found none, and no robot in {printable(record)}, expected a preset or a robot file")


def _discs(way: "Way", robot: Robot) -> dict[str, "Discs"]:
    """The footprint at both ends of a way, and where it is hardly wide enough."""
    discs = {"footprint": ("tab:blue", way.points[[0, -1]], robot.footprint_radius_m)}
    if way.narrow is not None:
        discs["narrow"] = ("tab:red", np.array([way.narrow]), robot.footprint_radius_m)
    return discs


def _covers(way: "Way") -> Bool[ndarray, "n"]:
    """At which points the footprint covers what is not known to be free."""
    return way.clearance_m < -_ROUND_M


def _over(way: "Way") -> dict[str, tuple[str, Float[ndarray, "n 2"]]]:
    """Where it does, to be marked."""
    over = way.points[_covers(way)]
    return {"not surely free": ("tab:orange", over)} if len(over) else {}


def _beside(way: "Way", name: str) -> str:
    """How much room there is beside the robot."""
    least, over = float(np.min(way.clearance_m)), _covers(way)
    if not over.any():
        return f"{max(least, 0):.2f} m or more beside {name}"
    along = float(np.sum(np.diff(way.s_m)[over[1:] | over[:-1]]))
    return f"{along:.2f} m of it over what is not surely free, which {name} covers by up to {-least:.2f} m"


def _csv(way: "Way") -> str:
    columns = np.column_stack([way.points, way.s_m, way.clearance_m])
    return "x,y,s,clearance\n" + "".join(",".join(f"{v:.4f}" for v in row) + "\n" for row in columns.tolist())


_WIPED, _NARROW, _OFF_M = 0.01, 0.1, 0.3
"""What is told: more walls that are free in the map, more floor behind what is too narrow, and poses that are farther
off."""

_EXPLORED = ("drive.csv", "drive.truth.npz", "explore.json")


@dataclass(frozen=True)
class Explore:
    """Let a simulated robot explore a world: it drives, maps, chooses where to go, until all in its reach is known.

    Then it drives back to where it began. Writes the map as echogrid map does, map.html, the log that it drove
    (drive.csv, with its truth in drive.truth.npz) and explore.json: what was seen by what way, collisions, clearance.
    """

    world: Annotated[Positional[str], WORLD]
    robot: Annotated[str, robot_arg()]
    out: Path = Path("explored")
    """Folder to write into."""
    start: Annotated[str | None, arg(metavar="X,Y,DEG")] = None
    """Where it begins: m, m, degrees. Default: the start of the world, else its roomiest place."""
    walls: Literal["smooth", "rough", "as-given"] = "as-given"
    """Make all walls smooth or rough."""
    slam: bool = False
    """Find the poses by odometry, which drifts, and ranges, as on a real robot; else the true ones are given. Also
    writes trajectory.tum (as found in the end) and odometry.tum."""
    seed: int = 0
    """The same seed gives the same drive."""
    physics: Physics = field(default_factory=Physics)

    def run(self) -> None:
        """Explore, and write the folder."""
        need("explore", "train")
        from echogrid.output.map_file import write_map
        from echogrid.output.page import Page
        from echogrid.planning.explore import Exploration

        check_physics(self.physics)
        check_seed(self.seed)
        world, robot = World.load(self.world).with_walls(self.walls), Robot.load(self.robot)
        start = self._start(world, robot)
        title = escaped(f"{world.name} explored by {robot.name}, walls {self.walls}")
        written = ["map.html", *(TRAJECTORIES if self.slam else ())]
        with made(self.out):
            check_folder(self.out, written)
            for name in _EXPLORED:
                check_writable(self.out / name)
            with (
                replacing(self.out / "map.html") as html,
                tqdm(desc="exploring", unit="m", disable=None, leave=False, bar_format="{desc}: {n:.1f} m") as line,
            ):
                page, last = Page(html, robot, title), start

                def show(frame: Frame) -> None:
                    nonlocal last
                    page.add(frame)
                    line.update(float(np.hypot(*(frame.pose - last)[:2])))
                    last = frame.pose

                found = Exploration(
                    world, robot, start, self.seed, self.physics, slam=self.slam, on_frame=show, on_map=page.keep
                ).run()
                settings = asdict(self) | {"robot": robot_yaml(robot), "frames": len(found.frames)}
                path = np.array([frame.pose[:2] for frame in found.placed])
                write_map(self.out, found.grid, path, settings, title)
                page.finish(found.grid)
            scores = self._write(world, robot, found)
        drop(self.out, written)
        self._report(world, robot, found, scores)

    def _start(self, world: World, robot: Robot) -> Float[ndarray, "3"]:
        """Where the robot begins, m, m, rad."""
        from echogrid.planning.explore import SPARE_M
        from echogrid.simulation.drive import start_of

        if self.start is None:
            return np.array([*start_of(world, robot.footprint_radius_m + SPARE_M), 0.0])
        return start_pose(self.start)

    def _write(self, world: World, robot: Robot, found: "Explored") -> "Scores | None":
        """Write what there is besides the map; how its walls compare with the true ones, where it lies as they do."""
        from echogrid.logs.csv_log import write_csv
        from echogrid.metrics import score
        from echogrid.output.map_file import write_truth
        from echogrid.simulation.drive import truth_of

        poses = np.array([frame.pose for frame in found.frames])
        seen = truth_of(world, poses)
        scores = None if self.slam else score(found.grid, seen)
        if self.slam:
            placed = ((frame.stamp, frame.pose, frame.odom) for frame in found.placed)
            write_trajectories(self.out, *(np.array(column) for column in zip(*placed, strict=True)))
        told: dict[str, Any] = {"world": world.name, "robot": robot.name, "walls": self.walls, "seed": self.seed}
        with (
            replacing(self.out / "explore.json") as record,
            replacing(self.out / "drive.truth.npz") as truth,
            replacing(self.out / "drive.csv") as log,
        ):
            write_csv(log, map(rounded, found.frames), robot.sonars)
            write_truth(truth, seen)
            walls = {name: scores and round(getattr(scores, name), 4) for name in ("found", "wiped")}
            record.write_text(json.dumps(told | found.told() | walls, indent=1) + "\n", encoding="utf-8")
        return scores

    def _report(self, world: World, robot: Robot, found: "Explored", scores: "Scores | None") -> None:
        from echogrid.planning.explore import SPARE_M

        seen, count = found.seen[-1, 2], found.bumps
        bumps = f"{count or 'no'} {'collision' if count == 1 else 'collisions'}"
        soon = found.until(0.95)
        soon = f" (95% by {soon[0]:.1f} m)" if soon else ""
        what = f"{world.name}: {robot.name} saw {seen:.1%} of the floor in reach{soon}"
        what += f", drove {found.way_m:.1f} m, {bumps}"
        print(escaped(f"{what}; it ends {found.home_m:.2f} m from its start: {found.end}"))
        if left := len(found.left):
            x, y = found.left[0]
            places = f"({x:.1f}, {y:.1f}) m" if left == 1 else f"{left} places, one at ({x:.1f}, {y:.1f}) m,"
            what = f"unknown ground is left at {places} that showed nothing new, or to which no way is sure"
            print(
                f"note: {what}: a door with less than 0.1 m to either side of the robot may stay shut",
                file=sys.stderr,
            )
        if found.beyond > _NARROW:
            wide = 2 * (robot.footprint_radius_m + SPARE_M)
            what = f"{found.beyond:.0%} of the floor is behind ways less than {wide:.2f} m wide"
            print(
                escaped(f"note: {what}, which {robot.name} takes for too narrow, and does not count as in reach"),
                file=sys.stderr,
            )
        if (off := found.ate_m) is not None and off > _OFF_M:
            what = (
                f"the poses that were found are {off:.2f} m off the true ones (root mean square), and so is the map"
            )
            print(
                f"note: {what}: do not judge it by how clean it looks; without --slam they are given", file=sys.stderr
            )
        if scores is not None and scores.wiped > _WIPED:
            what = (
                f"{scores.wiped:.1%} of the walls are free floor in the map: they sent too little back, as mirrors do"
            )
            print(f"note: {what}; do not plan on it where map.png shows none", file=sys.stderr)
        print(escaped(f"{self.out}/map.png, map.html, drive.csv; {self.out}/explore.json has the figures"))


def rounded(frame: Frame) -> Frame:
    """A frame with as many digits as a log has."""
    odom = None if frame.odom is None else np.round(frame.odom, 6)
    return Frame(round(frame.stamp, 3), np.round(frame.pose, 6), np.round(frame.ranges, 4), odom)
