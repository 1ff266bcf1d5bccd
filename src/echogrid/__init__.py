"""echogrid: a log of ultrasonic ranges in, a trustworthy occupancy map of the room out.

from echogrid import Robot, build_map, load_log

robot = Robot.load("b21")
for grid in build_map(load_log("drive.csv", robot), robot):
    pass  # the map so far, after every 64 frames; a model that needs the whole log yields once
occupied = grid.probability() > 0.65
"""

from importlib import import_module

TYPE_CHECKING = False  # as of typing, whose import would be a good part of the start of the command
if TYPE_CHECKING:
    __version__: str

    from echogrid.errors import DoubtWarning, EchogridError
    from echogrid.frame import Frame, Log
    from echogrid.grid import Grid
    from echogrid.logs.formats import load_log
    from echogrid.mapping.build import build_map
    from echogrid.mapping.mapper import Mapper
    from echogrid.mapping.registry import sensor_model
    from echogrid.metrics import score
    from echogrid.output.map_file import read_map, read_truth, write_map
    from echogrid.planning.paths import NoPathError, Path, plan
    from echogrid.position.corrected import slam
    from echogrid.position.localise import localise
    from echogrid.position.localiser import Localiser
    from echogrid.robot import Robot
    from echogrid.simulation.world import World

_HOME = {
    "DoubtWarning": "errors",
    "EchogridError": "errors",
    "Frame": "frame",
    "Grid": "grid",
    "Localiser": "position.localiser",
    "Log": "frame",
    "Mapper": "mapping.mapper",
    "NoPathError": "planning.paths",
    "Path": "planning.paths",
    "Robot": "robot",
    "World": "simulation.world",
    "build_map": "mapping.build",
    "load_log": "logs.formats",
    "localise": "position.localise",
    "plan": "planning.paths",
    "read_map": "output.map_file",
    "read_truth": "output.map_file",
    "score": "metrics",
    "sensor_model": "mapping.registry",
    "slam": "position.corrected",
    "write_map": "output.map_file",
}

__all__ = [
    "DoubtWarning",
    "EchogridError",
    "Frame",
    "Grid",
    "Localiser",
    "Log",
    "Mapper",
    "NoPathError",
    "Path",
    "Robot",
    "World",
    "build_map",
    "load_log",
    "localise",
    "plan",
    "read_map",
    "read_truth",
    "score",
    "sensor_model",
    "slam",
    "write_map",
]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> object:
    # Names are fetched when they are first used: reading a log must not pay for the start of JAX.
    if name == "dds":  # the messages that programs send to ``echogrid live``
        return import_module("echogrid.live.dds_types")
    if name in _HOME:
        return getattr(import_module(f"echogrid.{_HOME[name]}"), name)
    if name == "__version__":
        return import_module("importlib.metadata").version("echogrid")
    raise AttributeError(f"module 'echogrid' has no attribute {name!r}")
