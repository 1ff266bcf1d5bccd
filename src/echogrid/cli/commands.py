"""The commands by name, and what is asked of them."""

from collections.abc import Callable

import tyro

from echogrid import __version__
from echogrid.cli.calibrating import Calibrate, Doctor
from echogrid.cli.completion import completion
from echogrid.cli.export import Export
from echogrid.cli.fleet import Fleet
from echogrid.cli.helping import examples, folded, worded
from echogrid.cli.info import Info
from echogrid.cli.live import Live
from echogrid.cli.localise import Localise
from echogrid.cli.maps import Map, Score
from echogrid.cli.planning import Explore, Plan
from echogrid.cli.robot import SimulatedRobot
from echogrid.cli.simulation import Scan, Simulate, Train
from echogrid.cli.stores import Changes, Tiles

Command = (
    Map
    | Localise
    | Calibrate
    | Doctor
    | Plan
    | Explore
    | SimulatedRobot
    | Live
    | Simulate
    | Scan
    | Train
    | Export
    | Score
    | Info
    | Fleet
    | Tiles
    | Changes
)

COMMANDS: dict[str, Callable[..., Command]] = {
    "map": Map,
    "localise": Localise,
    "plan": Plan,
    "explore": Explore,
    "robot": SimulatedRobot,
    "live": Live,
    "simulate": Simulate,
    "scan": Scan,
    "train": Train,
    "export": Export,
    "score": Score,
    "info": Info,
    "doctor": Doctor,
    "calibrate": Calibrate,
    "fleet": Fleet,
    "tiles": Tiles,
    "changes": Changes,
}


def run(args: list[str]) -> None:
    """Run the command that the arguments ask for."""
    if args in (["--version"], ["-V"]):
        print(f"echogrid {__version__}")
        return
    if args[:1] == ["--tyro-print-completion"]:
        print(completion(args[1:], COMMANDS))
        return
    _asked_for(args).run()


def _asked_for(args: list[str]) -> Command:
    for command in [COMMANDS[args[0]]] if args and args[0] in COMMANDS else COMMANDS.values():
        worded(command)
    try:
        with folded():
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS, prog="echogrid", description="Occupancy maps from ultrasonic ranges.", args=args
            )
    except SystemExit as left:
        if left.code in (0, None):  # a help was shown
            print(examples(args), end="")
        raise
