"""Commands that drive, on a map or in a world: plan."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import Positional, arg

from echogrid.cli.arguments import robot_arg
from echogrid.errors import UsageError, escaped
from echogrid.files import check_writable, made, printable, read_text, replacing
from echogrid.robot import Robot, parse_robot
from echogrid.yaml_keys import Keys, parse_yaml

if TYPE_CHECKING:
    from echogrid.planning.paths import Path as Way

_FILES = ("path.csv", "path.png")


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
        from echogrid.output.map_file import read_map
        from echogrid.output.map_picture import draw_map
        from echogrid.planning.paths import plan

        start, goal = (_point(given, f"--{name}") for name, given in (("from", self.from_), ("to", self.to)))
        grid = read_map(self.map)
        robot = Robot.load(self.robot) if self.robot else _robot_of(self.map)
        way = plan(grid, start, goal, robot, self.unknown)
        with made(self.out):
            for name in _FILES:
                check_writable(self.out / name)
            title = escaped(f"{self.map.name}, {robot.name}, {way.length_m:.2f} m")
            with replacing(self.out / "path.png") as picture, replacing(self.out / "path.csv") as table:
                draw_map(picture, grid, way.points, title, drive="path")
                table.write_text(_csv(way), encoding="utf-8")
        least = float(np.min(way.clearance_m))
        print(escaped(f"{self.out}/path.csv: {way.length_m:.2f} m, {max(least, 0):.2f} m or more beside {robot.name}"
                      f"{'' if least >= 0 else ', over ground that is not known'}; {self.out}/path.png"))  # fmt: skip


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


def _csv(way: "Way") -> str:
    columns = np.column_stack([way.points, way.s_m, way.clearance_m])
    return "x,y,s,clearance\n" + "".join(",".join(f"{v:.4f}" for v in row) + "\n" for row in columns.tolist())
