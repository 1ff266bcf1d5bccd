"""What tests have the workers of a fleet do."""

import os
import signal
import time
from pathlib import Path

from echogrid.fleet.job import Outcome, Task, add


def dies_at_first(task: Task) -> Outcome:
    """Map a log; who is the first to try is killed before the end, or after it."""
    name = Path(task.log)
    before, after = name.with_suffix(".before"), name.with_suffix(".after")
    if not before.exists():
        before.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    outcome = add(task)
    if not after.exists():
        after.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return outcome


def breaks(task: Task) -> Outcome:
    raise ValueError("a mistake\nof ours")


def sleeps(task: Task) -> Outcome:
    time.sleep(60)
    return Outcome(task.log, "added")
