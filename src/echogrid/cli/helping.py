"""What a help says beyond what tyro makes of a command: whole sentences, defaults where there are any, examples."""

import dataclasses
import io
import shutil
import sys
import textwrap
from collections.abc import Generator
from contextlib import contextmanager, redirect_stdout
from functools import cache
from typing import Annotated, Any, override

import docstring_parser
from tyro.conf import arg

EXAMPLES = {
    "": """
echogrid map --view            # the sample that ships with echogrid: look at out/map.png, or out/map.html
echogrid info drive.bag        # what is in a log of your own
echogrid map drive.bag --view
echogrid map --help            # each command has a help of its own
""",
    "map": """
echogrid map                                       # the sample that ships with echogrid
echogrid map drive.bag --view                      # a bag of ROS says by itself where the sonars sit
echogrid map drive.csv --robot my-robot.yaml --out house
""",
    "localise": """
echogrid localise drive.bag --map plan.yaml --start 1.5,2,90
echogrid localise drive.csv --robot my-robot.yaml --map house --anywhere
""",
    "plan": """
echogrid plan house --from 1,2 --to 4.5,4          # by the robot that mapped it
echogrid plan plan.yaml --robot my-robot.yaml --from=-1.5,2 --to 6.5,3
""",
    "explore": """
echogrid explore corridor --robot b21              # look at explored/map.png, or explored/map.html
echogrid explore my-building.yaml --robot my-robot.yaml --walls smooth --seed 3
""",
    "robot": """
echogrid robot corridor --robot b21                # a robot that hears /cmd_vel; Ctrl-C ends it
echogrid robot my-building.yaml --robot p3dx --speed 4 --out drive.csv
""",
    "info": """
echogrid info drive.bag
echogrid info drive.csv --robot p3dx
""",
    "doctor": """
echogrid doctor drive.bag
echogrid doctor drive.csv --robot my-robot.yaml
""",
    "calibrate": """
echogrid calibrate drive.csv --robot my-robot.yaml # look at calibrated/calibration.png
echogrid map drive.csv --robot calibrated/robot.yaml
""",
    "fleet": """
echogrid fleet logs/*.csv --robot my-robot.yaml --out store      # again with new logs: it goes on
echogrid fleet today.bag --localise store --out store            # placed in the map so far
echogrid fleet broken.csv --out store --remove
echogrid tiles store --out house
""",
    "tiles": """
echogrid tiles store --out house                   # all that was seen; look at house/map.png
echogrid tiles store --region=-5,0,20,12 --out lab
echogrid tiles store --view --out page             # to explore in a browser, however large it is
""",
    "changes": """
echogrid changes monday tuesday --out changes      # two stores; look at changes/changes.png
""",
    "live": """
echogrid live --out house                          # nodes of this machine that talk on loopback
echogrid live --interface eth0 --domain 7
echogrid live --slam --explore                     # sends a robot of Nav2 to what is not known yet
""",
    "simulate": """
echogrid simulate corridor --robot p3dx --out drive.csv
echogrid simulate my-room.yaml --robot b21 --walls smooth --seed 3 --out drive.csv
""",
    "scan": """
echogrid scan lab --at 1,0.8 --out scan
""",
    "train": """
echogrid train --robot p3dx --out mine.npz         # an hour on 2 cores; goes on where it was stopped
echogrid map drive.csv --robot p3dx --interpreter mine.npz
""",
    "export": """
echogrid export --c firmware --robot my-robot.yaml
echogrid export --c firmware --robot p3dx --side 8 --cell 0.12
""",
    "score": """
echogrid simulate corridor --robot p3dx --out drive.csv
echogrid map drive.csv --robot p3dx --out out
echogrid score out drive.truth.npz
""",
}
"""Of each command, shown at the end of its help; of the whole under no name."""


def examples(args: list[str]) -> str:
    """What the help that was asked for ends with."""
    shown = EXAMPLES[args[0] if args and args[0] in EXAMPLES else ""]
    return f"examples:\n{''.join(f'  {line}\n' for line in shown.strip().splitlines())}"


@cache
def worded(command: Any) -> None:
    """Have tyro show the docstrings of a command and of its options, groups of them too, as they are written.

    Left to itself it breaks the line wherever the source does, and calls None the default of what the text has just
    said the default of. It takes some milliseconds: for commands that nobody asks for they are saved.
    """
    texts = {doc.arg_name: doc.description or "" for doc in docstring_parser.parse_from_object(command).params}
    for option in dataclasses.fields(command):
        text = _whole(texts.get(option.name, ""))
        hint = "" if option.default in (None, ()) else None
        kind: Any = option.type
        if dataclasses.is_dataclass(group := getattr(kind, "__origin__", kind)):
            worded(group)
        shown: Any = Annotated[kind, arg(help=text or None, help_behavior_hint=hint)]
        command.__annotations__[option.name] = option.type = shown
    command.__doc__ = "\n\n".join(map(_whole, (command.__doc__ or "").split("\n\n")))


def _whole(text: str) -> str:
    """A paragraph in one line, as it is meant for a terminal."""
    return " ".join(text.replace("``", "").split())


class _Held(io.TextIOWrapper):
    """Text that is held back from the output, and made as for that."""

    @override
    def isatty(self) -> bool:
        return sys.__stdout__ is not None and sys.__stdout__.isatty()


@contextmanager
def folded() -> Generator[None]:
    """Fold the lines that are printed as paragraphs to the width of the terminal, which tyro does in boxes alone."""
    kept = io.BytesIO()
    held = _Held(kept, (sys.stdout.encoding or "ascii").lower(), "backslashreplace", write_through=True)
    try:
        with redirect_stdout(held):
            yield
    finally:
        fold = textwrap.TextWrapper(
            shutil.get_terminal_size().columns, break_long_words=False, break_on_hyphens=False
        ).fill
        for line in kept.getvalue().decode(held.encoding).splitlines():
            print(fold(line) if line[:1].isalpha() else line)
