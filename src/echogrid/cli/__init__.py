"""The command line: the only place that prints.

Here only what starts at once is imported: the commands take half a second, in which a Ctrl-C may come.
"""

import io
import os
import sys
from contextlib import suppress

from echogrid.cli.ending import ending
from echogrid.errors import EchogridError, escaped

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import NoReturn

EXIT_ERROR = 2


def main(args: list[str] | None = None) -> None:
    """Run a command; an error that the user can mend is one line and exit status 2."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name may hold what the terminal cannot show
    with ending() as end:
        try:
            try:
                from echogrid.cli import commands

                commands.run(sys.argv[1:] if args is None else args)
            finally:
                print(end="", flush=True)  # here, where it can still be told that nobody takes the output
        except EchogridError as error:
            _fail(str(error))
        except MemoryError:
            _fail("memory: found too little, expected more for a job of this size")
        except KeyboardInterrupt:
            _stop(end.status)
        except BrokenPipeError:
            _drop_output()
            sys.exit(0)
        except OSError as error:
            _drop_output()
            _fail(f"{error.filename or 'output'}: found {error.strerror or error}, expected a file that can be used")
        except Exception as error:
            # NumPy turns a Ctrl-C that comes while it waits for JAX into a ValueError, others into other errors.
            if end.number is None and not isinstance(error.__cause__, KeyboardInterrupt):
                raise
            _stop(end.status)


def _stop(status: int) -> "NoReturn":
    print("echogrid: stopped", file=sys.stderr)
    sys.exit(status)


def _fail(text: str) -> "NoReturn":
    print(f"echogrid: {escaped(text)}", file=sys.stderr)
    sys.exit(EXIT_ERROR)


def _drop_output() -> None:
    """Let what is still to be written go nowhere: Python tries once more as it ends, and would complain."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
