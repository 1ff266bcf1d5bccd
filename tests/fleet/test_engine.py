"""Workers that die, and a scheduler that does."""

import os
import signal
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="found no dask.distributed")
pytest.importorskip("zarr", reason="found no zarr")

from benchmarks.fleet import tiles
from echogrid.errors import UsageError
from echogrid.fleet import engine
from echogrid.fleet.job import Task
from echogrid.fleet.poses import OwnPoses
from echogrid.fleet.store import Store
from fleet_samples import filled, logs, task
from fleet_work import breaks, dies_at_first, sleeps


@pytest.fixture(scope="module")
def client():
    with workers(2) as client:
        yield client


@contextmanager
def workers(count):
    """A cluster whose workers know what the tests ask of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        with engine.local(count) as (address, _), engine.connected(address) as client:
            yield client


def test_logs_count_once_though_workers_die_before_and_after_they_have_written_them(client, tmp_path):
    paths = logs(tmp_path)[:2]
    store = Store.made(tmp_path / "store")
    outcomes = list(engine.run(client, [task(store, path) for path in paths], dies_at_first))
    assert sorted(each.what for each in outcomes) == ["there", "there"]  # of whom came after the second death
    assert tiles(store) == tiles(filled(tmp_path / "calm", paths))
    left = [path.name for path in (store.path / "sums").iterdir()]
    assert sorted(left) == sorted(f"{record.sums}.zip" for record in store.records())


def test_a_mistake_of_ours_is_told_in_a_line_and_the_rest_goes_on(client, tmp_path):
    (outcome,) = engine.run(client, [Task("store", "a.csv", None, None, OwnPoses())], breaks)
    assert outcome.what == "refused"
    assert outcome.reason.startswith("found ValueError: a mistake")


def test_a_scheduler_that_goes_is_told_in_a_line_and_its_workers_go_too():
    with workers(1) as client:
        scheduler, (worker,) = client.run_on_scheduler(os.getpid), client.run(os.getpid).values()
        threading.Timer(1, os.kill, (scheduler, signal.SIGKILL)).start()
        with pytest.raises(UsageError, match="scheduler: found it gone with 1 logs to do, expected it to the end"):
            list(engine.run(client, [Task("store", "a.csv", None, None, OwnPoses())], sleeps))
    until = time.monotonic() + 10
    while Path(f"/proc/{worker}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense:xx"])
def test_a_scheduler_that_does_not_answer_is_told_in_a_line(address, monkeypatch):
    monkeypatch.setattr(engine, "CONNECT_S", 0.5)
    with (
        pytest.raises(UsageError, match=r"^--scheduler: found .* at .*, expected the address of a dask scheduler"),
        engine.connected(address),
    ):
        pass
