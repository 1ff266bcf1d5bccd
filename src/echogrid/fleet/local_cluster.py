"""A cluster of dask on this machine, as a program: ``python -m echogrid.fleet.local_cluster WORKERS``.

It says its address and that of its dashboard in a line, and lives as long as its standard input is open: so it ends
with who started it, however that ends, and no signal that a terminal sends to that one makes it break off half-way.
"""

import json
import logging
import os
import select
import signal
import sys
import warnings
from importlib.util import find_spec
from typing import Any

import dask
from distributed import LocalCluster
from distributed.core import Status

DEATHS = 9
"""A log on which more workers die than this is refused. Those that others die beside are innocent."""

LOOK_S = 1.0
"""How often it is seen to that all workers live."""

DASHBOARD = "127.0.0.1:8787"
"""Where it is, unless the port is taken."""


def main(workers: int) -> None:
    """Serve until standard input ends."""
    with dask.config.set(_settings()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the port of the dashboard is taken, and another is as good
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            dashboard_address=DASHBOARD if find_spec("bokeh") else None,
            silence_logs=logging.CRITICAL,
        )
        told = {
            "scheduler": cluster.scheduler_address,
            "dashboard": cluster.dashboard_link if find_spec("bokeh") else "",
        }
        os.write(1, json.dumps(told).encode() + b"\n")
        while not select.select([0], [], [], LOOK_S)[0] or os.read(0, 1):
            _mend(cluster, workers)
    os.killpg(0, signal.SIGKILL)  # what is half done counts for nothing, and needs no farewell


def _mend(cluster: LocalCluster, workers: int) -> None:
    """Start workers anew that dask has given up, as it does where one dies while it starts."""
    gone = [name for name, keeper in cluster.workers.items() if keeper.status in (Status.closed, Status.failed)]
    for name in gone:
        del cluster.workers[name]
    if len(cluster.workers) < workers:
        cluster.scale(workers)


def _settings() -> dict[str, Any]:
    """Of dask, for workers that map."""
    environment = dict(dask.config.get("distributed.nanny.pre-spawn-environ"))
    # Handing memory back after each task costs a third of the time.
    environment.pop("MALLOC_TRIM_THRESHOLD_", None)
    return {
        "distributed.nanny.pre-spawn-environ": environment,
        "distributed.scheduler.allowed-failures": DEATHS,
    }


if __name__ == "__main__":
    main(int(sys.argv[1]))
