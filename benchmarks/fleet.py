"""What a fleet costs and whether it counts right: ``python -m benchmarks.fleet FOLDER [LOGS]``.

FOLDER is for the drives, which are simulated once (``benchmarks.fleet_drives``), LOGS how many of them. Printed are
logs a second on one worker and on two, and, for the machine may be shared, how many cores they got, and how many they
wanted (Linux says how long each thread ran, and how long it waited for a core): below one a worker, it idles; what a
worker holds in memory while it works; the map beside that of one process; and the store after workers, the scheduler
and the command were killed at random, beside that of a run in peace.
"""

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from distributed import Client
from jaxtyping import Float
from numpy import ndarray

from benchmarks.fleet_drives import make
from echogrid import _core
from echogrid.fleet import engine
from echogrid.fleet.job import Task, add
from echogrid.fleet.lattice import Tile
from echogrid.fleet.poses import OwnPoses
from echogrid.fleet.reading import Reading
from echogrid.fleet.store import Store, model_of_stores
from echogrid.grid import Grid, GrowingGrid
from echogrid.logs.formats import load_log
from echogrid.robot import Robot, robot_yaml
from echogrid.ros.messages import Choice

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
    print(f"efficiency: two workers do {rates[1] / rates[0]:.0%} of what one does in a second of a core")
    plain = [_plain(folder, paths[:300], processes) for processes in (1, 2)]
    print(f"the same without dask, each process with its half of the logs: {plain[1] / plain[0]:.0%}")
    calm = Store(folder / "store2")
    _print_size(calm, scans)
    _print_map(calm, paths)
    _kill_workers(folder, paths, calm)
    _kill_commands(folder, paths, calm)


def _tasks(store: Store, paths: list[Path]) -> list[Task]:
    folder, robot = str(store.path.resolve()), robot_yaml(ROBOT)
    return [Task(folder, str(path.resolve()), robot, Choice(), OwnPoses()) for path in paths]


def _new(path: Path) -> Store:
    shutil.rmtree(path, ignore_errors=True)
    return Store.made(path)


@contextmanager
def _cluster(workers: int) -> Generator[Client]:
    with engine.local(workers) as (address, _), engine.connected(address) as client:
        client.wait_for_workers(workers)
        list(engine.run(client, [], engine.add))
        yield client


def _rate(folder: Path, paths: list[Path], workers: int) -> float:
    """Logs that so many workers map in a second of a core."""
    store = _new(folder / f"store{workers}")
    with _cluster(workers) as client:
        warm = [Task(task.store, task.log, None, None, OwnPoses()) for task in _tasks(store, paths[:workers])]
        list(engine.run(client, warm))  # refused, for it names no robot; but what is to be imported is
        memory = _Memory(list(client.run(os.getpid).values()))
        before = memory.wanted()
        begin = time.perf_counter()
        outcomes = list(engine.run(client, _tasks(store, paths)))
        took = time.perf_counter() - begin
        ran, waited = memory.wanted() - before
        memory.stop()
    assert {each.what for each in outcomes} == {"added"}
    busy = (ran + waited) / took
    print(f"{workers} workers: {len(paths) / took:.1f} logs/s, {ran / len(paths) * 1e3:.0f} ms of a core a log")
    print(f"  they want {busy:.2f} cores and get {ran / took:.2f}; a worker holds {memory.told()}")
    return len(paths) / ran


def _plain(folder: Path, paths: list[Path], processes: int) -> float:
    """Logs that so many processes, of which each maps its own, map in a second of a core."""
    tasks = _tasks(_new(folder / "plain"), paths)
    with get_context("spawn").Pool(processes) as pool:
        spent = pool.map(_map_all, [tasks[k::processes] for k in range(processes)], chunksize=1)
    return len(paths) / sum(spent)


def _map_all(tasks: list[Task]) -> float:
    """Map logs, and say what that took of a core, s."""
    _core.set_threads(1)
    add(tasks[0])
    begin = time.process_time()
    for task in tasks[1:]:
        add(task)
    return (time.process_time() - begin) * len(tasks) / (len(tasks) - 1)


class _Memory:
    """Memory of the workers while they work, each second."""

    def __init__(self, pids: list[int]) -> None:
        self._pids, self._on = pids, True
        self._seen: list[list[float]] = []
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def wanted(self) -> Float[ndarray, "2"]:
        """Time that the workers ran, and that they waited for a core, s."""
        files = [file for pid in self._pids for file in Path(f"/proc/{pid}/task").glob("*/schedstat")]
        return np.sum([[float(value) for value in file.read_text().split()[:2]] for file in files], axis=0) / 1e9

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
    theirs = one_process(paths, ROBOT)
    took = time.perf_counter() - begin
    ours = grid.part(grid.index_of(theirs.centre_of(np.array([0, 0]))), theirs.shape)
    off = np.abs(ours.log_odds - theirs.log_odds)
    print(f"one process: {len(paths) / took:.1f} logs/s; log-odds differ by at most {off.max():.1e}, ", end="")
    print(f"{np.sum(ours.observed != theirs.observed)} cells are seen by one alone")


def one_process(paths: Sequence[Path], robot: Robot) -> Grid:
    """The map of all logs: each is a drive with a memory of its own, and all add to the same cells."""
    model = model_of_stores()
    fusion = model.fusion(robot, model.cell_m)
    grown = GrowingGrid(model.cell_m, fusion.blank, model.p_min)
    for path in paths:
        fusion = model.fusion(robot, model.cell_m)
        for batch in fusion.batches(list(load_log(path, robot))):
            evidence = fusion.read(batch)()
            grown.reserve(evidence.corner, evidence.end)
            fusion.fuse(grown, evidence)
    corner, shape = grown.reserved()
    fusion.changed(corner, corner + np.array(shape))
    fusion.read_out(grown, corner, shape)
    return grown.grid()


def tiles(store: Store) -> dict[Tile, bytes]:
    """What the cells of all tiles hold, bit by bit."""
    reading = Reading.of(store)
    return {tile: kept.tobytes() for tile, kept in reading.tiles(reading.by_tile)}


def _same(store: Store, calm: Store) -> str:
    """Whether two stores say the same, bit by bit."""
    records = [{record.sums for record in each.records()} for each in (store, calm)]
    return "equal bit by bit" if tiles(store) == tiles(calm) and records[0] == records[1] else "NOT EQUAL"


def _kill_workers(folder: Path, paths: list[Path], calm: Store) -> None:
    """Workers are killed while the command runs."""
    store, rng, killed = _new(folder / "killed"), np.random.default_rng(0), 0
    with _cluster(2) as client:
        on, scheduler = True, client.run_on_scheduler(os.getpid)

        def kill() -> None:
            nonlocal killed
            while on and killed < KILLS:
                time.sleep(rng.uniform(0.2, 1.5))
                if workers := [pid for pid in _children(scheduler) if "spawn_main" in _command(pid)]:
                    os.kill(int(rng.choice(workers)), signal.SIGKILL)
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
                pid = _children(process.pid)[0] if what == "scheduler" else process.pid
                if process.poll() is None:
                    os.kill(pid, signal.SIGKILL)
                    kills[what] += 1
        if process.wait() == 0 and sum(kills.values()) >= KILLS:
            break
    store = Store(path)
    what = f"scheduler killed {kills['scheduler']} times, the command {kills['command']} times"
    print(f"{what}: {len(store.records())} logs count after {rounds} runs; {_same(store, calm)}")


def _children(pid: int) -> list[int]:
    """The processes that one has started, in any of its threads."""
    files = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(each) for file in files for each in file.read_text().split()]


def _command(pid: int) -> str:
    with suppress(OSError):
        return Path(f"/proc/{pid}/cmdline").read_text()
    return ""


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1000)
