"""The command that takes the set network to a microcontroller: export."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from echogrid.cli.arguments import robot_arg
from echogrid.errors import UsageError, escaped
from echogrid.robot import Robot


@dataclass(frozen=True)
class Export:
    """Write the set network for a robot as C for a microcontroller.

    Writes echogrid.h, echogrid.c and example.c: C11 that needs no heap and no library. A scan in, a window of the map
    round the robot out. Each cell is read alone: the map's surroundings are left out.
    """

    c: Annotated[Path, arg(metavar="DIR")]
    """Folder for the files."""
    robot: Annotated[str, robot_arg()] = "b21"
    interpreter: Annotated[str, arg(metavar="WEIGHTS")] = "set-network"
    """set-network, or a weights file of a set network."""
    side: Annotated[float, arg(metavar="M")] = 6.0
    """Side of the window, m."""
    cell: Annotated[float, arg(metavar="M")] = 0.1
    """Side of a cell, m."""

    def run(self) -> None:
        """Write the files, and say what they take."""
        robot = Robot.load(self.robot)

        from echogrid.mapping.registry import sensor_model
        from echogrid.microcontroller.source import source_of, write
        from echogrid.models.networks.set_network import SetNetwork

        network = sensor_model(self.interpreter)
        if not isinstance(network, SetNetwork):
            raise UsageError(f"--interpreter: found {network.name}, expected set-network or weights of a set network")
        source = source_of(network, robot, self.side, self.cell)
        write(self.c, source)
        side = f"{source.side * source.cell_m:g}"
        what = f"{side} x {side} m in {source.side} x {source.side} cells round {robot.name} ({robot.sonars} sonars)"
        print(escaped(f"{self.c}/echogrid.c: {what}"))
        print(f"flash: {source.table_bytes} bytes of tables, about {source.code_bytes} of code")
        print(f"RAM: {source.state_bytes} bytes, sizeof(struct echogrid), and about {source.stack_bytes} of stack")
        paths = (shlex.quote(f"{self.c}/{name}") for name in ("echogrid.c", "example.c", "example", "example"))
        print(escaped("try it here: gcc -std=c11 -O2 {} {} -o {} && {}".format(*paths)))
