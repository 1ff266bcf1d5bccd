"""Many logs at once, by dask.distributed: on the cores of this machine, or on a cluster that is named."""

import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from tempfile import TemporaryFile

import dask
from distributed import Client, KilledWorker, as_completed

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.fleet.job import Outcome, Task, add

CONNECT_S = 10
"""How long a scheduler is waited for."""


@contextmanager
def connected(scheduler: str) -> Generator[Client]:
    """A client of the scheduler at an address.

    Raises:
        UsageError: none answers there.
    """
    for name in [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # what matters is told in lines of our own
    with dask.config.set({"distributed.comm.timeouts.connect": CONNECT_S}):
        try:
            client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            reason = "no scheduler that answers" if isinstance(error, OSError) else str(error)
            expected = "the address of a dask scheduler, as tcp://HOST:8786"
            raise UsageError(f"--scheduler: found {reason} at {scheduler}, expected {expected}") from None
        try:
            yield client
        finally:
            client.close(timeout=1)


@contextmanager
def local(workers: int | None = None) -> Generator[tuple[str, str]]:
    """A cluster of processes on this machine: the addresses of its scheduler and of its dashboard, if it has one.

    Args:
        workers: how many; None: one for each core.

    Raises:
        UsageError: it does not start.
    """
    count = workers or len(os.sched_getaffinity(0))
    command = [sys.executable, "-m", "echogrid.fleet.local_cluster", str(count)]
    with TemporaryFile() as complaints:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=complaints, start_new_session=True
        )
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if not line:
                complaints.seek(0)
                lines = complaints.read().decode(errors="replace").strip().splitlines() or ["nothing said"]
                raise UsageError(f"workers: found that they did not start ({lines[-1]}), expected {count} processes")
            told = json.loads(line)
            yield told["scheduler"], told["dashboard"]
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def run(client: Client, tasks: Sequence[Task], work: Callable[[Task], Outcome] = add) -> Iterator[Outcome]:
    """What became of logs, each as it is done.

    Raises:
        UsageError: the scheduler was lost.
    """
    futures = client.map(_alone, [work] * len(tasks), tasks, key="add", pure=False, retries=0)
    task_of = dict(zip((future.key for future in futures), tasks, strict=True))
    left = len(tasks)
    completed = as_completed(futures, loop=client.loop)
    for future in completed:
        task, status = task_of[future.key], future.status
        if status in ("pending", "lost"):
            completed.add(future)  # who knew what became of it has died, and it is asked again
            continue
        if status == "finished":
            yield future.result()
        elif status == "error":
            error = future.exception()
            found = f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')}"
            if isinstance(error, KilledWorker):
                found = "that one worker after the other died while it mapped this log"
            yield Outcome(task.log, "refused", where=task.log, reason=f"found {found}, expected a log as others")
        else:
            raise lost(left)
        future.release()
        left -= 1


def lost(left: int) -> UsageError:
    """The error for a scheduler that went away."""
    return UsageError(
        f"scheduler: found it gone with {left} logs to do, expected it to the end: run the same command again, "
        "it goes on with what is missing"
    )


def _alone(work: Callable[[Task], Outcome], task: Task) -> Outcome:
    """Work on one core, as the worker is given one."""
    _core.set_threads(1)
    return work(task)
