"""What a help says beyond what tyro makes of a command: whole sentences, defaults where there are any, examples."""

import dataclasses
from typing import Annotated, Any

import docstring_parser
from tyro.conf import arg

EXAMPLES = {
    "map": """
echogrid map                                       # the sample that ships with echogrid
echogrid map drive.bag --view                      # a bag of ROS says by itself where the sonars sit
echogrid map drive.csv --robot my-robot.yaml --out house
""",
    "info": """
echogrid info drive.bag
echogrid info drive.csv --robot p3dx
""",
    "live": """
echogrid live --out house                          # nodes of this machine that talk on loopback
echogrid live --interface eth0 --domain 7
""",
    "simulate": """
echogrid simulate corridor --robot p3dx --out drive.csv
echogrid simulate my-room.yaml --robot b21 --walls smooth --seed 3 --out drive.csv
""",
}
"""Of each command, shown at the end of its help."""


def examples(args: list[str]) -> str:
    """What the help that was asked for ends with; empty where there is nothing."""
    shown = EXAMPLES.get(args[0], "") if args else ""
    return f"examples:\n{''.join(f'  {line}\n' for line in shown.strip().splitlines())}" if shown else ""


def worded(command: Any) -> None:
    """Have tyro show the docstrings of a command's options as they are written.

    Left to itself it breaks the line wherever the source does, and calls None the default of what the text has just
    said the default of.
    """
    texts = {doc.arg_name: doc.description or "" for doc in docstring_parser.parse_from_object(command).params}
    for option in dataclasses.fields(command):
        text = " ".join(texts.get(option.name, "").split())
        hint = "" if option.default in (None, ()) else None
        kind: Any = option.type
        shown: Any = Annotated[kind, arg(help=text or None, help_behavior_hint=hint)]
        command.__annotations__[option.name] = option.type = shown
