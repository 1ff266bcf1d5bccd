"""The files of an export: their text, what they take of flash and RAM, and the folder they go to."""

import os
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from echogrid import __version__
from echogrid.errors import UsageError, escaped
from echogrid.files import check_writable, made, replacing, unwritable
from echogrid.limits import Limits
from echogrid.microcontroller.constants import constants, real
from echogrid.models.networks.set_core import BEARINGS, RINGS
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import Robot

FILES = ("echogrid.h", "echogrid.c", "example.c")

PARTS = ("arithmetic", "array", "network", "memory", "window", "interface")
"""Of echogrid.c, in their order."""

MADE = "/* Made by echogrid export"
"""How a file begins that may be written anew."""

MOST_SONARS, MOST_UNITS = 64, 64
"""Of an array and of a layer: what the stack of a microcontroller holds."""

CELL, SIDE = Limits(0.02, 0.5, "m"), Limits(1.0, 50.0, "m")
"""Of the window."""

LEAST_CELLS, MOST_CELLS = 8, 500
"""Along the window's side."""

PLACES = 512
"""Places and headings that are remembered to have been looked from."""

CODE_BYTES = 7800
"""What the code takes of flash besides the tables, about: Cortex-M, -Os."""


@dataclass(frozen=True)
class Source:
    """An export before it is written."""

    texts: dict[str, str]
    """By file, see FILES."""
    side: int
    """Cells along the window's side."""
    cell_m: float
    table_bytes: int
    """Of constants, in flash."""
    state_bytes: int
    """Of the struct that the caller keeps, in RAM."""

    stack_bytes: int
    """Of stack, about: Cortex-M, -Os."""
    code_bytes: int = CODE_BYTES


def source_of(network: SetNetwork, robot: Robot, side_m: float, cell_m: float) -> Source:
    """The C of a network for a robot.

    Args:
        network: its surroundings are left out.
        robot: the array.
        side_m: of the window, m; rounded to whole cells.
        cell_m: of a cell, m.

    Raises:
        UsageError: a window that is none, or an array or network that is too large.
    """
    cell_m, side_m = CELL.check(cell_m, "--cell"), SIDE.check(side_m, "--side")
    side = round(side_m / cell_m)
    if not LEAST_CELLS <= side <= MOST_CELLS:
        raise UsageError(f"--side: found {side} cells of {cell_m:g} m, expected {LEAST_CELLS} to {MOST_CELLS}")
    if robot.sonars > MOST_SONARS:
        raise UsageError(f"robot {robot.name}: found {robot.sonars} sonars, expected at most {MOST_SONARS}")
    units = np.size(network.weights["b1"])
    if units > MOST_UNITS:
        raise UsageError(f"interpreter {network.name}: found layers of {units} units, expected at most {MOST_UNITS}")
    told = constants(network.weights, robot, cell_m)
    what = f"{robot.name}, {robot.sonars} sonars; {network.name}; {side} x {side} cells of {cell_m:g} m"
    head = (
        f"{MADE} {__version__} ({_comment(what)}).\n * It writes this file anew: keep what is yours elsewhere. */\n"
    )
    shape = {"sonars": robot.sonars, "side": side, "cell": real(cell_m), "places": PLACES}
    shape |= {"bearings": BEARINGS, "rings": RINGS}
    body = "\n".join([*told.lines, "", *(_template(f"{part}.c") for part in PARTS)])
    texts = {
        "echogrid.h": head + Template(_template("echogrid.h")).substitute(shape),
        "echogrid.c": f'{head}#include "echogrid.h"\n\n{body}',
        "example.c": head + _template("example.c"),
    }
    stack = 1000 + 24 * robot.sonars + 40 * int(units)
    return Source(texts, side, cell_m, told.table_bytes, state_bytes(robot.sonars, side), stack)


def state_bytes(sonars: int, side: int) -> int:
    """Size of ``struct echogrid``, whose fields go from the widest to the narrowest and so leave no gaps."""
    words = 4 + 2 + 8 + 6 * sonars + 2 * PLACES + BEARINGS
    size = 4 * words + 2 * BEARINGS * RINGS + (5 * 2 + 1) * side**2
    return -(-size // 4) * 4


def write(folder: Path, source: Source) -> None:
    """Write an export into a folder, which is made where there is none; files of earlier exports are replaced.

    Raises:
        UsageError: a file cannot be put there, or one of such a name is not of an export.
    """
    with made(folder):
        for name in FILES:
            _check_own(folder / name)
            check_writable(folder / name)
        for name, text in source.texts.items():
            with replacing(folder / name) as temporary:
                temporary.write_text(text, encoding="ascii")


def _check_own(path: Path) -> None:
    """Refuse to replace a file that no export has made."""
    if not os.path.isfile(path):
        return
    try:
        with path.open("rb") as file:
            own = file.read(len(MADE)) == MADE.encode()
    except OSError as error:
        raise unwritable(path, error.strerror or str(error)) from None
    if not own:
        raise unwritable(path, "a file that no export has made", "none, or one to replace")


def _template(name: str) -> str:
    return (resources.files("echogrid") / "microcontroller" / "c" / name).read_text(encoding="utf-8")


def _comment(text: str) -> str:
    """What may stand in a comment of C: names are the user's."""
    told = escaped(text).encode("ascii", "backslashreplace").decode()
    for ends, harmless in (("*/", "* /"), ("/*", "/ *"), ("??", "? ?")):  # ??/ is a backslash to some compilers
        told = told.replace(ends, harmless)
    return told
