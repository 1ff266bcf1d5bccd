"""The command line: the only place that prints."""

import io
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

import tyro

from echogrid import __version__
from echogrid.cli.info import Info
from echogrid.cli.live import Live
from echogrid.cli.maps import Map, Score
from echogrid.cli.simulation import Scan, Simulate, Train
from echogrid.errors import EchogridError

EXIT_ERROR = 2

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


def main(args: list[str] | None = None) -> None:
    """Run a command; an error that the user can mend is one line and exit status 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name may hold what the terminal cannot show
    try:
        try:
            _run(sys.argv[1:] if args is None else args)
        finally:
            print(end="", flush=True)  # here, where it can still be told that nobody takes the output
    except EchogridError as error:
        _fail(str(error))
    except MemoryError:
        _fail("memory: found too little, expected more for a job of this size")
    except KeyboardInterrupt:
        _stop()
    except BrokenPipeError:
        _drop_output()
        sys.exit(0)
    except OSError as error:
        _drop_output()
        _fail(f"{error.filename or 'output'}: found {error.strerror or error}, expected a file that can be used")
    except Exception as error:
        # NumPy turns a Ctrl-C that comes while it waits for JAX into a ValueError.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        _stop()


def _run(args: list[str]) -> None:
    if args in (["--version"], ["-V"]):
        print(f"echogrid {__version__}")
        return
    tyro.extras.subcommand_cli_from_dict(
        COMMANDS, prog="echogrid", description="Occupancy maps from ultrasonic ranges.", args=args
    ).run()


def _stop() -> NoReturn:
    print("echogrid: stopped", file=sys.stderr)
    sys.exit(130)


def _fail(text: str) -> NoReturn:
    print(f"echogrid: {text}", file=sys.stderr)
    sys.exit(EXIT_ERROR)


def _drop_output() -> None:
    """Let what is still to be written go nowhere: Python tries once more as it ends, and would complain."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
