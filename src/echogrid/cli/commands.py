"""The commands by name, and what is asked of them."""

from collections.abc import Callable

import tyro

from echogrid import __version__
from echogrid.cli.info import Info
from echogrid.cli.live import Live
from echogrid.cli.maps import Map, Score
from echogrid.cli.simulation import Scan, Simulate, Train

Command = Map | Live | Simulate | Scan | Train | Score | Info

COMMANDS: dict[str, Callable[..., Command]] = {
    "map": Map,
    "live": Live,
    "simulate": Simulate,
    "scan": Scan,
    "train": Train,
    "score": Score,
    "info": Info,
}


def run(args: list[str]) -> None:
    """Run the command that the arguments ask for."""
    if args in (["--version"], ["-V"]):
        print(f"echogrid {__version__}")
        return
    tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="echogrid", description="Occupancy maps from ultrasonic ranges.", args=args
    ).run()
