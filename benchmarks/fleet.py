"""What a fleet costs and whether it counts right: ``python -m benchmarks.fleet FOLDER [LOGS]``.

FOLDER is for the drives, which are simulated once (``benchmarks.fleet_drives``), LOGS how many of them. Printed are
logs a second on one worker and on two, each against as many processes that burn time alone, for the machine may be
shared; what a worker holds in memory while it works; the map beside that of one process; and the store after workers,
the scheduler and the command were killed at random, beside that of a run in peace.
"""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from distributed import Client

from benchmarks.fleet_drives import make
from echogrid.fleet import engine
from echogrid.fleet.job import Task
from echogrid.fleet.poses import OwnPoses
from echogrid.fleet.reading import Reading
from echogrid.fleet.store import Store, model_of_stores
from echogrid.grid import Grid, GrowingGrid
from echogrid.logs.formats import load_log
from echogrid.robot import Robot

KILLS = 20
ROBOT = Robot.load("p3dx")
COMMAND = "from echogrid.cli import main\nif __name__ == '__main__': main()"


def main(folder: Path, count: int) -> None:
    """Print all figures."""
    paths = make(folder / "logs", count)
    scans = sum(1 for path in paths for _ in path.open()) - len(paths)
    size = sum(path.stat().st_size for path in paths)
    print(f"{count} logs, {scans} scans, {size / 1e6:.0f} MB of CSV")
    rates = [_rate(folder, paths, workers) for workers in (1, 2)]
    print(f"efficiency of two workers: {rates[1] / rates[0]:.0%} of what the machine gives two processes")
    calm = Store(folder / "store2")
    _print_size(calm, scans)
    _print_map(calm, paths)
    _kill_workers(folder, paths, calm)
    _kill_commands(folder, paths, calm)


def _tasks(store: Store, paths: list[Path]) -> list[Task]:
    return [Task(str(store.path.resolve()), str(path.resolve()), ROBOT, None, OwnPoses()) for path in paths]


def _new(path: Path) -> Store:
    shutil.rmtree(path, ignore_errors=True)
    return Store.made(path)


@contextmanager
def _cluster(workers: int) -> Iterator[Client]:
    with engine.local(workers) as (address, _), engine.connected(address) as client:
        client.wait_for_workers(workers)
        list(engine.run(client, [], engine.add))
        yield client


def _rate(folder: Path, paths: list[Path], workers: int) -> float:
    """Logs a second, over what so many processes get done on this machine now."""
    store = _new(folder / f"store{workers}")
    with _cluster(workers) as client:
        warm = [Task(task.store, task.log, None, None, OwnPoses()) for task in _tasks(store, paths[:workers])]
        list(engine.run(client, warm))  # refused: it names no robot; what is to be imported is
        memory = _Memory(client)
        ours = spent(client)
        begin = time.perf_counter()
        outcomes = list(engine.run(client, _tasks(store, paths)))
        took = time.perf_counter() - begin
        ours = spent(client) - ours
        memory.stop()
    assert {each.what for each in outcomes} == {"added"}
    gets = _machine(workers)
    rate = len(paths) / took
    print(f"{workers} workers: {rate:.1f} logs/s, {ours / len(paths) * 1e3:.0f} ms of a core a log, ", end="")
    print(f"machine {gets:.2f} x one process; a worker holds {memory.told()}")
    return rate / gets


def spent(client: Client) -> float:
    """Time that the workers have spent on their cores, s."""
    return sum(client.run(time.process_time).values())


def _machine(processes: int) -> float:
    """How much so many processes that only count get done together, of what one does."""
    alone = _counting(1)
    return sum(_counting(processes)) / sum(alone)


def _counting(processes: int) -> list[int]:
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.map(_count, [0.2] * processes)
        return pool.map(_count, [5.0] * processes, chunksize=1)


def _count(seconds: float) -> int:
    until, done = time.perf_counter() + seconds, 0
    values = np.ones(20_000)
    while time.perf_counter() < until:
        values = np.sqrt(values + 1)
        done += 1
    return done


class _Memory:
    """Memory of the workers while they work, each second."""

    def __init__(self, client: Client) -> None:
        self._pids = list(client.run(os.getpid).values())
        self._seen: list[list[float]] = []
        self._on = True
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while self._on:
            with suppress(OSError):
                pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in self._pids]
                self._seen.append([each * os.sysconf("SC_PAGESIZE") / 1e6 for each in pages])
            time.sleep(0.5)

    def stop(self) -> None:
        self._on = False
        self._thread.join()

    def told(self) -> str:
        """Median over each quarter of the time, of the worker that holds most."""
        parts = np.array_split(np.max(self._seen, axis=1), 4)
        return " ".join(f"{np.median(part):.0f}" for part in parts if len(part)) + " MB"


def _print_size(store: Store, scans: int) -> None:
    sums = [path.stat().st_size for path in (store.path / "sums").iterdir()]
    records = [path.stat().st_size for path in (store.path / "logs").iterdir()]
    print(f"store: {np.mean(sums) / 1e6:.2f} MB a log ({sum(sums) / scans / 1e3:.1f} kB a scan), record ", end="")
    print(f"{np.mean(records) / 1e3:.1f} kB, {np.mean([len(r.tiles) for r in store.records()]):.1f} tiles a log")


def _print_map(store: Store, paths: list[Path]) -> None:
    shutil.rmtree(store.path / "merged")
    (store.path / "merged").mkdir()
    began = time.perf_counter()
    reading = Reading.of(store)
    listed = time.perf_counter() - began
    grid = reading.grid()
    first = time.perf_counter() - began
    again = time.perf_counter()
    grid = Reading.of(store).grid()
    again = time.perf_counter() - again
    print(f"map: {len(reading.by_tile)} tiles; records {listed:.2f} s, first {first:.1f} s, again {again:.2f} s")
    begin = time.perf_counter()
    theirs = one_process(paths)
    took = time.perf_counter() - begin
    ours = grid.part(grid.index_of(theirs.centre_of(np.array([0, 0]))), theirs.shape)
    off = np.abs(ours.log_odds - theirs.log_odds)
    print(f"one process: {len(paths) / took:.1f} logs/s; log-odds differ by at most {off.max():.1e}, ", end="")
    print(f"{np.sum(ours.observed != theirs.observed)} cells are seen by one alone")


def one_process(paths: list[Path]) -> Grid:
    """The map of all logs: each is a drive with a memory of its own, and all add to the same cells."""
    model = model_of_stores()
    grown = GrowingGrid(model.cell_m, model.fusion(ROBOT, model.cell_m).blank, model.p_min)
    fusion = model.fusion(ROBOT, model.cell_m)
    for path in paths:
        fusion = model.fusion(ROBOT, model.cell_m)
        for batch in fusion.batches(list(load_log(path, ROBOT))):
            evidence = fusion.read(batch)()
            grown.reserve(evidence.corner, evidence.end)
            fusion.fuse(grown, evidence)
    corner, shape = grown.reserved()
    fusion.changed(corner, corner + np.array(shape))
    fusion.read_out(grown, corner, shape)
    return grown.grid()


def _same(store: Store, calm: Store) -> str:
    """Whether two stores say the same, bit by bit."""
    ours, theirs = (
        {tile: kept.tobytes() for tile, kept in reading.tiles(reading.by_tile)}
        for reading in (Reading.of(store), Reading.of(calm))
    )
    records = [{record.sums for record in each.records()} for each in (store, calm)]
    return "equal bit by bit" if ours == theirs and records[0] == records[1] else "NOT EQUAL"


def _kill_workers(folder: Path, paths: list[Path], calm: Store) -> None:
    """Workers are killed while the command runs."""
    store, rng, killed = _new(folder / "killed"), np.random.default_rng(0), 0
    with _cluster(2) as client:
        on = True

        def kill() -> None:
            nonlocal killed
            while on and killed < KILLS:
                time.sleep(rng.uniform(0.2, 1.5))
                with suppress(Exception):
                    pids = list(client.run(os.getpid).values())
                    os.kill(int(rng.choice(pids)), signal.SIGKILL)
                    killed += 1

        killer = threading.Thread(target=kill)
        killer.start()
        outcomes = list(engine.run(client, _tasks(store, paths)))
        on = False
        killer.join()
    refused = sum(each.what == "refused" for each in outcomes)
    print(f"{killed} workers killed: {len(store.records())} logs count, {refused} refused; ", end="")
    print(_same(store, calm))


def _kill_commands(folder: Path, paths: list[Path], calm: Store) -> None:
    """The scheduler, or the whole command, is killed at random; it is started again each time."""
    path, rng, kills, rounds = folder / "stopped", np.random.default_rng(1), {"scheduler": 0, "command": 0}, 0
    shutil.rmtree(path, ignore_errors=True)
    command = [sys.executable, "-c", COMMAND, "fleet", *map(str, paths), "--robot", "p3dx", "--out", str(path)]
    while rounds < 200:
        rounds += 1
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        if sum(kills.values()) < KILLS:
            what = "scheduler" if rounds % 2 else "command"
            time.sleep(rng.uniform(3.0, 6.0))
            with suppress(ProcessLookupError, IndexError):
                pid = _child(process.pid) if what == "scheduler" else process.pid
                if process.poll() is None:
                    os.kill(pid, signal.SIGKILL)
                    kills[what] += 1
        if process.wait() == 0 and sum(kills.values()) >= KILLS:
            break
    store = Store(path)
    what = f"scheduler killed {kills['scheduler']} times, the command {kills['command']} times"
    print(f"{what}: {len(store.records())} logs count after {rounds} runs; {_same(store, calm)}")


def _child(pid: int) -> int:
    """The process of the cluster that a command has started."""
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1000)
