"""Many logs at once, by dask.distributed: on the cores of this machine, or on a cluster that is named."""

import logging
import os
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.fleet.job import Outcome, Task, add

DEATHS = 9
"""A log on which more workers die than this is refused. Those that others die beside are innocent."""

CONNECT_S = 10
"""How long a scheduler is waited for."""


@contextmanager
def cluster(scheduler: str | None, workers: int | None = None) -> Generator[Client]:
    """Workers to run on.

    Args:
        scheduler: address of the scheduler of a cluster; None: processes of this machine.
        workers: how many processes; None: one for each core.

    Raises:
        UsageError: no scheduler answers there.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is told in lines of our own
    if scheduler is not None:
        with dask.config.set({"distributed.comm.timeouts.connect": CONNECT_S}):
            try:
                client = Client(scheduler, timeout=CONNECT_S)
            except (OSError, ValueError, TypeError) as error:
                reason = "no scheduler that answers" if isinstance(error, OSError) else str(error)
                expected = "the address of a dask scheduler, as tcp://HOST:8786"
                raise UsageError(f"--scheduler: found {reason} at {scheduler}, expected {expected}") from None
        with client:
            yield client
        return
    count = workers or len(os.sched_getaffinity(0))
    with dask.config.set(_settings()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the port of the dashboard is taken, and the next one is as good
        # One worker of dask keeps what it has to say from standing between the lines of the command.
        with (
            LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:8787" if dashboards() else None,
                silence_logs=logging.CRITICAL,
            ) as local,
            Client(local) as client,
        ):
            yield client


def dashboards() -> bool:
    """Whether dask can show its dashboard."""
    return find_spec("bokeh") is not None


def _settings() -> dict[str, Any]:
    """Of dask, for workers of this machine."""
    environment = dict(dask.config.get("distributed.nanny.pre-spawn-environ"))
    # Handing memory back after each task costs a third of the time.
    environment.pop("MALLOC_TRIM_THRESHOLD_", None)
    return {
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.logging.distributed": "critical",
    }


def run(client: Client, tasks: Sequence[Task], work: Callable[[Task], Outcome] = add) -> Iterator[Outcome]:
    """What became of logs, each as it is done.

    Raises:
        UsageError: the scheduler was lost.
    """
    futures = client.map(_alone, [work] * len(tasks), tasks, key="add", pure=False, retries=0)
    task_of = dict(zip((future.key for future in futures), tasks, strict=True))
    left = len(tasks)
    for future in as_completed(futures):
        task, status = task_of[future.key], future.status
        if status == "finished":
            yield future.result()
        elif status == "error":
            error = future.exception()
            found = f"{type(error).__name__}: {error}"
            if isinstance(error, KilledWorker):
                found = f"that {DEATHS + 1} workers died while they mapped it"
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
