"""Commands that need no robot: simulate, scan, train."""

import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from echogrid.cli.arguments import WORLD, bar, check_physics, check_seed, robot_arg
from echogrid.errors import UsageError
from echogrid.extras import need
from echogrid.files import check_writable, replacing, unwritable
from echogrid.frame import Frame
from echogrid.robot import TRANSDUCERS, Robot
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.world import World


@dataclass(frozen=True)
class Simulate:
    """Drive a robot through a world and write the log, with the truth grid beside it.

    The truth (LOG with the ending .truth.npz) holds what the drive could see up to 1.4 m from its path.
    """

    world: Annotated[Positional[str], WORLD]
    robot: Annotated[str, robot_arg()]
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
        need("simulate", "train")
        from echogrid.logs.csv_log import write_csv
        from echogrid.output.map_file import write_truth
        from echogrid.simulation.drive import along, read_waypoints, tour, truth_of, turning
        from echogrid.simulation.simulate import Simulator

        check_physics(self.physics)
        check_seed(self.seed)
        check_writable(self.out)
        truth = self.out.with_suffix(".truth.npz")
        check_writable(truth)
        world, robot = World.load(self.world).with_walls(self.walls), Robot.load(self.robot)
        if self.drive == "auto":
            poses = turning(tour(world, robot.footprint_radius_m + 0.1))
        else:
            poses = along(read_waypoints(self.drive))
        poses = np.round(poses, 6)
        frames = Simulator(world, robot, self.physics).frames(poses, self.seed)
        rounded = (Frame(round(f.stamp, 3), f.pose, np.round(f.ranges, 4)) for f in frames)
        with replacing(self.out) as log:  # it appears only when its truth is there
            write_csv(log, bar(rounded, "simulating", "scan", len(poses)), robot.sonars)
            write_truth(truth, truth_of(world, poses))
        length = np.sum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))
        print(f"{world.name}: {len(poses)} scans of {robot.name} over {length:.1f} m in {self.out}, truth in {truth}")


@dataclass(frozen=True)
class Scan:
    """Turn one transducer on the spot and record range against orientation, 1 degree apart.

    Writes scan.csv and scan.png: the ranges, and the scan over the plan of the world.
    """

    world: Annotated[Positional[str], WORLD]
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
        need("scan", "train")
        from echogrid.output.scan_picture import write_scan
        from echogrid.simulation.simulate import rotary_scan

        check_physics(self.physics)
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

    robot: Annotated[str, robot_arg("; or any: a new array for each drive, as for the weights that ship")]
    out: Path
    """The weights to write (.npz)."""
    network: Literal["set", "paper"] = "set"
    """The set network, which reads any array, or the paper's."""
    drives: int = 5000
    """Simulated drives to learn from."""
    epochs: int = 16
    """Times to go through them."""
    seed: int = 1
    """The same seed gives the same weights."""

    def run(self) -> None:
        """Write the weights."""
        from echogrid.training.gradient_descent import train
        from echogrid.training.paper_training import PaperRecipe
        from echogrid.training.set_training import SetRecipe

        for name in ("drives", "epochs"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name}: found {getattr(self, name)}, expected 1 or more")
        check_seed(self.seed)
        if not self.out.name or self.out.is_dir():
            raise unwritable(self.out, "a folder")
        if self.out.parent.is_dir():
            check_writable(self.out)
        robot = None if self.robot == "any" else Robot.load(self.robot)
        begin = time.perf_counter()
        kind = SetRecipe if self.network == "set" else PaperRecipe
        recipe = kind(drives=self.drives, epochs=self.epochs, seed=self.seed)
        network = train(robot, recipe, self.out, progress=True)
        minutes = (time.perf_counter() - begin) / 60
        print(f"{self.out}: trained for {self.robot} in {minutes:.1f} min, loss {network.recipe['losses'][-1]:.4f}")
