"""How a command ends when it is told to from outside: Ctrl-C, a kill, a terminal that is closed."""

import signal
import sys
from collections.abc import Generator
from contextlib import contextmanager
from types import FrameType

AGAIN_S = 0.01
"""How long after an interruption that could not be, or was lost, the next one comes."""

_BY_DEFAULT = {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGTERM: signal.SIG_DFL,
    signal.SIGHUP: signal.SIG_DFL,
}
"""What a signal does where nobody has asked for anything else, as nohup does."""


class Ending:
    """Takes the signals that end a command: what is being done is broken off, and cleans up behind itself."""

    def __init__(self) -> None:
        self.number: int | None = None
        """The signal that came; None: none did."""

    @property
    def status(self) -> int:
        """The exit status, as a shell counts."""
        return 128 + (self.number or signal.SIGINT)

    def take(self, number: int, frame: FrameType | None) -> None:
        """A handler."""
        self.number = number
        if number != signal.SIGINT:
            for other in (signal.SIGTERM, signal.SIGHUP):  # they often come together
                signal.signal(other, signal.SIG_IGN)
        self.again(number, frame)

    def again(self, _: int, frame: FrameType | None) -> None:
        """A handler of the same, as often as it takes."""
        if _importing(frame):
            # What is half imported makes another exception of it, or an abort (jaxlib).
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            raise KeyboardInterrupt

    def lost(self, what: "sys.UnraisableHookArgs") -> None:
        """A hook: an exception that nobody can catch, as in what JAX does when Python collects garbage."""
        if self.number is not None and issubclass(what.exc_type, KeyboardInterrupt):
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            sys.__unraisablehook__(what)


def _importing(frame: FrameType | None) -> bool:
    """Whether a frame is within an import."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


@contextmanager
def ending() -> Generator[Ending]:
    """Signals to end raise KeyboardInterrupt in the block, so that temporary files go; SIGKILL cannot be taken."""
    ending = Ending()
    taken = [number for number, default in _BY_DEFAULT.items() if signal.getsignal(number) == default]
    before = {number: signal.getsignal(number) for number in (*taken, signal.SIGALRM)}
    hook = sys.unraisablehook
    try:
        signal.signal(signal.SIGALRM, ending.again)
    except ValueError:  # not in the main thread, where no signal comes
        yield ending
        return
    for number in taken:
        signal.signal(number, ending.take)
    sys.unraisablehook = ending.lost
    try:
        yield ending
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = hook
        for number, handler in before.items():
            signal.signal(number, handler)
