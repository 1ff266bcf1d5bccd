"""echogrid: a log of ultrasonic ranges in, a trustworthy occupancy map of the room out.

from echogrid import Robot, build_map, load_log

robot = Robot.load("b21")
for grid in build_map(load_log("drive.csv", robot), robot):
    pass  # the map so far, after every 64 frames; a model that needs the whole log yields once
occupied = grid.probability() > 0.65
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING

__version__ = metadata.version("echogrid")

if TYPE_CHECKING:
    from echogrid.errors import EchogridError
    from echogrid.frame import Frame, Log
    from echogrid.grid import Grid
    from echogrid.logs.formats import load_log
    from echogrid.mapping.build import build_map
    from echogrid.robot import Robot
    from echogrid.simulation.world import World

_HOME = {
    "EchogridError": "errors",
    "Frame": "frame",
    "Grid": "grid",
    "Log": "frame",
    "Robot": "robot",
    "World": "simulation.world",
    "build_map": "mapping.build",
    "load_log": "logs.formats",
}

__all__ = ["EchogridError", "Frame", "Grid", "Log", "Robot", "World", "build_map", "load_log"]


def __getattr__(name: str) -> object:
    # Names are fetched when they are first used: reading a log must not pay for the start of JAX.
    if name == "dds":  # the messages that programs send to ``echogrid live``
        return import_module("echogrid.live.dds_types")
    if name in _HOME:
        return getattr(import_module(f"echogrid.{_HOME[name]}"), name)
    raise AttributeError(f"module 'echogrid' has no attribute {name!r}")
