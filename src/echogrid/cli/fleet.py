"""Commands for many logs and one map: fleet, tiles, changes."""

import os
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tqdm import tqdm
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, bar, check_map, drop, robot_arg, start_pose
from echogrid.errors import UsageError, escaped
from echogrid.extras import need
from echogrid.files import check_writable, made
from echogrid.output.folder import check_folder
from echogrid.output.map_file import read_map, write_grid, write_map
from echogrid.robot import Robot, robot_yaml

if TYPE_CHECKING:
    from distributed import Client

    from echogrid.fleet.job import Outcome, Task
    from echogrid.fleet.lattice import Region
    from echogrid.fleet.poses import Poses
    from echogrid.fleet.reading import Reading
    from echogrid.fleet.store import Record, Store
    from echogrid.grid import Grid

_REFUSED = 2
"""Exit status where a log was refused, though others were added."""

_COMPARED = 0.5
"""If less than this share of what one side saw can be compared, it is told."""

_MOST_NOTES = 10
"""Lines of notes; where there are more, the records in the store have them."""


@dataclass(frozen=True)
class Fleet:
    """Add the logs of many drives to a store, which maps them together: on all cores, or on a cluster of dask.

    A store keeps what each log says of cells, not probabilities: logs may come in any order and on many days, each
    counts once, and can be taken out again. A run that was stopped, or killed, goes on when it is started again. A
    log that cannot be mapped is told in a line, the rest goes on, and the exit status is 2. Needs the extra fleet.
    """

    logs: Annotated[Positional[tuple[str, ...]], arg(metavar="LOG [LOG ...]")] = ()
    """CSV or CARMEN logs, or bags of ROS 1 or ROS 2."""
    out: Annotated[Path, arg(metavar="STORE")] = field(kw_only=True)
    """The store, a folder; a new one is made."""
    robot: Annotated[str | None, robot_arg(". Default: the robot that each log describes")] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    poses: Annotated[Path | None, arg(metavar="FILE|FOLDER")] = None
    """Poses to map at instead of the logs' own: a TUM file, as SLAM writes it, or a folder that holds NAME.tum
    or NAME/trajectory.tum for a log NAME.csv."""
    localise: Annotated[Path | None, arg(metavar="MAP|STORE")] = None
    """Find each log's place in a map, or in the map so far of a store (this one, mostly), its poses being odometry. A
    log that is not sure where it is is refused."""
    start: Annotated[str | None, arg(metavar="X,Y,DEG")] = None
    """With --localise: about where each log begins in the map. Default: anywhere."""
    remove: bool = False
    """Take the logs out of the store instead; by their content, or by their name where the file is gone."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Run on the cluster of this dask scheduler (tcp://HOST:8786), whose workers see logs and store under the same
    paths. Default: processes of this machine."""
    workers: Annotated[int | None, arg(metavar="N")] = None
    """Processes of this machine. Default: one for each core."""

    def run(self) -> None:
        """Add the logs, or take them out."""
        need("fleet", "fleet")
        from echogrid.fleet.engine import run
        from echogrid.fleet.store import Store

        self._check()
        if self.remove:
            store = Store(self.out)
            with store.locked():
                self._remove(store)
            return
        robot = None if self.robot is None else robot_yaml(Robot.load(self.robot))
        start = None if self.start is None else start_pose(self.start).tolist()
        place = None if self.localise is None else _place(self.localise)
        if not Store.can_be_made(self.out):
            Store(self.out)  # what is none is told before there is much work
        begin = time.perf_counter()
        with self._client() as client, made(self.out):
            store = Store.made(self.out)
            with store.locked(), self._poses(store, place, start) as poses:
                tasks = list(self._tasks(store, robot, poses))
                outcomes = list(bar(run(client, tasks), "logs", "log", len(tasks)))
        _tell(outcomes, self.out)
        _summarise(outcomes, store, time.perf_counter() - begin)
        if any(each.what == "refused" for each in outcomes):
            sys.exit(_REFUSED)

    def _check(self) -> None:
        """Refuse options that do not go together."""
        if not self.logs:
            raise UsageError("fleet: found no logs, expected at least one")
        if self.poses is not None and self.localise is not None:
            raise UsageError("--poses, --localise: found both, expected one of the two")
        if self.start is not None and self.localise is None:
            raise UsageError("--start: found it without --localise, expected both or none")
        if self.workers is not None and not 1 <= self.workers <= 1024:
            raise UsageError(f"--workers: found {self.workers}, expected 1 to 1024")
        if self.workers is not None and self.scheduler is not None:
            raise UsageError(
                "--workers, --scheduler: found both, expected one of the two: the cluster has its workers"
            )
        if self.poses is not None and not os.path.lexists(self.poses):
            raise UsageError(
                f"--poses: found {self.poses}, which is not there, expected a TUM file or a folder of them"
            )
        if self.poses is not None and len(self.logs) > 1 and not self.poses.is_dir():
            raise UsageError(
                f"--poses: found one file for {len(self.logs)} logs, expected a folder with a file for each"
            )

    @contextmanager
    def _client(self) -> "Generator[Client]":
        """Who hands the work to workers."""
        from echogrid.fleet.engine import connected, local

        if self.scheduler is not None:
            with connected(self.scheduler) as client:
                _print_dashboard(client.dashboard_link)
                yield client
            return
        with local(self.workers) as (address, dashboard), connected(address) as client:
            _print_dashboard(dashboard)
            yield client

    def _tasks(self, store: "Store", robot: str | None, poses: "Poses") -> "Iterator[Task]":
        """What is to be done, under paths that any process understands."""
        from echogrid.fleet.job import Task

        path = os.path.abspath(store.path)
        for log in dict.fromkeys(map(os.path.abspath, self.logs)):
            yield Task(path, log, robot, self.ros.choice(), poses)

    @contextmanager
    def _poses(self, store: "Store", place: "Grid | None", start: list[float] | None) -> "Generator[Poses]":
        """Where the poses come from; a map that they are found in lies in the store meanwhile, for all to see."""
        from echogrid.fleet.poses import FilePoses, MapPoses, OwnPoses, map_hash

        if place is None:
            yield OwnPoses() if self.poses is None else FilePoses(os.path.abspath(self.poses))
            return
        name = map_hash(place)
        file = Path(os.path.abspath(store.path)) / f"place-{name}.npz"
        write_grid(file, place)
        try:
            yield MapPoses(str(file), name, None if start is None else (start[0], start[1], start[2]))
        finally:
            file.unlink(missing_ok=True)

    def _remove(self, store: "Store") -> None:
        found = list(self._named(store))
        for record in bar(found, "removing", "log"):
            store.remove(record)
        left = store.records()
        store.clear_merged(tile for record in left for tile in record.tiles)
        print(escaped(f"{store.path}: {_logs(len(found))} taken out; {_logs(len(left))} count"))

    def _named(self, store: "Store") -> "Iterator[Record]":
        """The records of the logs, each once; where one is not in the store nothing is removed."""
        from echogrid.fleet.job import log_hash

        records = store.records()
        by_hash, taken = {record.log: record for record in records}, set()
        for log in self.logs:
            if os.path.lexists(log):
                found = [by_hash[name]] if (name := log_hash(Path(log))) in by_hash else []
            else:
                found = [record for record in records if record.name == Path(log).name]
            if len(found) != 1:
                what = f"{len(found)} logs of that name" if found else "a log that is not in it"
                raise UsageError(f"{store.path}: {log}: found {what}, expected one that counts; nothing was removed")
            if found[0].log not in taken:
                taken.add(found[0].log)
                yield found[0]


def _place(path: Path) -> "Grid":
    """The map to find places in: the map so far of a store, or any other."""
    from echogrid.fleet.reading import Reading
    from echogrid.fleet.store import Store

    return Reading.of(Store(path)).grid() if (path / "store.json").exists() else read_map(path)


def _print_dashboard(address: str) -> None:
    if address:
        print(escaped(f"dashboard: {address}"), file=sys.stderr)


def _tell(outcomes: "Sequence[Outcome]", out: Path) -> None:
    """Say which logs were refused and why, and what is doubtful of the others: a line for each reason."""
    lines: dict[tuple[str, str], list[str]] = {}
    names: dict[str, str] = {}
    for each in sorted(outcomes, key=lambda outcome: outcome.log):
        name = os.path.basename(each.log)
        if each.what == "refused":
            lines.setdefault(("echogrid", each.reason), []).append(each.where)
        elif each.hash in names:
            lines.setdefault(("note", f"the same log as {names[each.hash]}: it counts once"), []).append(name)
        else:
            names[each.hash] = name
        for note in each.notes:
            lines.setdefault(("note", note), []).append(name)
    told = 0
    for (kind, reason), where in lines.items():
        told += kind == "note"
        if kind == "note" and told > _MOST_NOTES:
            continue
        more = f" and {_logs(len(where) - 1)} more" if len(where) > 1 else ""
        print(escaped(f"{kind}: {where[0]}{more}: {reason}"), file=sys.stderr)
    if told > _MOST_NOTES:
        print(escaped(f"note: {told - _MOST_NOTES} notes more are in {out}/logs, under notes"), file=sys.stderr)


def _summarise(outcomes: "Sequence[Outcome]", store: "Store", seconds: float) -> None:
    words = {"added": "added", "replaced": "mapped anew", "there": "there already", "refused": "refused"}
    counts = {what: sum(each.what == what for each in outcomes) for what in words}
    done = ", ".join(f"{count} {words[what]}" for what, count in counts.items() if count)
    records = store.records()
    scans = sum(record.frames for record in records)
    what = f"{store.path}: of {_logs(len(outcomes))} {done} in {seconds:.1f} s"
    print(escaped(f"{what}; {_logs(len(records))} with {scans} scans count"))


def _logs(count: int) -> str:
    return f"{count} {'log' if count == 1 else 'logs'}"


_REGION = arg(metavar="X0,Y0,X1,Y1")


@dataclass(frozen=True)
class Tiles:
    """Make the map of a store that echogrid fleet has filled, or of a part of it: the ordinary files of a map.

    Writes map.png, map.pgm + map.yaml, map.npz and run.yaml, as map does. Only the tiles that the part touches are
    read.
    """

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """A store of echogrid fleet."""
    region: Annotated[str | None, _REGION] = None
    """The part, m, world (--region=-1,0,20,9 where it begins below 0). Default: all that was seen."""
    out: Path = Path("out")
    """Folder for the map."""
    resolution: Annotated[float | None, arg(metavar="M")] = None
    """Side of a cell of the map, m. Default: 0.04."""
    pgm: Literal["trinary", "scale", "raw"] = "trinary"
    """What map.pgm holds, see map."""
    view: bool = False
    """Write a page to explore the map in a browser instead, however large it is: map.html, and its pictures in
    map_tiles."""

    def run(self) -> None:
        """Read the tiles and write the folder."""
        need("tiles", "fleet")
        from echogrid.fleet.reading import Reading
        from echogrid.fleet.store import Store

        check_map(self.resolution, None)
        begin = time.perf_counter()
        reading = Reading.of(Store(self.store))
        if self.view:
            self._view(reading)
            return
        region = _region(reading, self.region)
        with made(self.out):
            check_folder(self.out)
            grid = _grid(reading, region, "reading")
            if self.region is None:
                grid = grid.observed_part() or grid
            if self.resolution is not None and self.resolution != grid.resolution:
                grid = grid.in_cells_of(self.resolution)
            title = f"{self._name()}, {_logs(len(reading.records))}"
            write_map(self.out, grid, np.empty((0, 2)), self._settings(reading, grid), escaped(title), self.pgm)
        drop(self.out)
        _print_robots(reading)
        (rows, cols), cell = grid.shape, grid.resolution
        seconds = time.perf_counter() - begin
        what = f"{self.store}: {_logs(len(reading.records))} in {seconds:.1f} s"
        files = f"{self.out}/map.png; {self.out}/map.yaml is for Nav2's map_server"
        print(escaped(f"{what}; map of {cols * cell:.1f} x {rows * cell:.1f} m in {files}"))

    def _view(self, reading: "Reading") -> None:
        """Write the page instead."""
        from echogrid.fleet.page import PAGE, write_tile_page

        if self.region is not None or self.resolution is not None:
            raise UsageError("--view: found it with --region or --resolution, expected it alone: the page has all")
        with made(self.out), _bar("reading") as progress:
            check_writable(self.out / PAGE)
            title = f"{self._name()}, {_logs(len(reading.records))}"
            write_tile_page(self.out, reading, escaped(title), progress)
        _print_robots(reading)
        print(escaped(f"{self.store}: {_logs(len(reading.records))}; open {self.out / PAGE} in a browser"))

    def _name(self) -> str:
        return self.store.name or self.store.resolve().name

    def _settings(self, reading: "Reading", grid: "Grid") -> dict[str, object]:
        """What run.yaml holds: what is needed to repeat the run."""
        logs = {record.name: record.log for record in reading.records}
        return asdict(self) | {"robot": next(iter(reading.robots)), "resolution": grid.resolution, "logs": logs}


def _region(reading: "Reading", text: str | None, option: str = "--region") -> "Region | None":
    """The part that an option says."""
    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(number) for number in text.split(","))
    except ValueError:
        x0 = y0 = x1 = y1 = np.nan
    if not (x0 < x1 and y0 < y1 and np.isfinite([x0, y0, x1, y1]).all()):
        raise UsageError(f"{option}: found {text}, expected X0,Y0,X1,Y1 in m, X0 below X1 and Y0 below Y1")
    return reading.region(x0, y0, x1, y1)


def _grid(reading: "Reading", region: "Region | None", what: str) -> "Grid":
    """The map of a part, under a progress bar."""
    with _bar(what) as progress:
        return reading.grid(region, progress)


@contextmanager
def _bar(what: str) -> Generator[Callable[[int, int], None]]:
    """A progress bar that is told how much is done, and of how much."""
    with tqdm(desc=what, unit="block", disable=None, leave=False) as line:

        def progress(done: int, of: int) -> None:
            line.total = of
            line.update(done - line.n)

        yield progress


def _print_robots(reading: "Reading") -> None:
    """Say whose sonars the map is read for, where there are several kinds."""
    if len(reading.robots) > 1:
        others, total = len(reading.robots) - 1, sum(reading.robots.values())
        share = next(iter(reading.robots.values())) / total
        what = f"sonars of {reading.robot.name} ({share:.0%} of the scans), though {others} other kinds drove too"
        print(
            escaped(f"note: the map is read for the {what}: walls that only they saw may look otherwise"),
            file=sys.stderr,
        )


@dataclass(frozen=True)
class Changes:
    """Compare two stores of one place: what became occupied, and what became free, from one to the other.

    Writes changes.csv (a row for each area: where, how large, what speaks for it on both sides) and changes.png. A
    cell counts where scans of both stores spoke of it, and where the other side knows no wall within 12 cm.
    """

    before: Annotated[Positional[Path], arg(metavar="BEFORE")]
    """A store of echogrid fleet."""
    after: Annotated[Positional[Path], arg(metavar="AFTER")]
    """Another one, in the same frame."""
    region: Annotated[str | None, _REGION] = None
    """The part, m, world. Default: all that both have seen."""
    out: Path = Path("changes")
    """Folder to write into."""

    def run(self) -> None:
        """Compare the stores and write the folder."""
        need("changes", "fleet")
        from echogrid.fleet.changes import common, compare
        from echogrid.fleet.changes_files import check_changes_folder, write_changes
        from echogrid.fleet.reading import Reading
        from echogrid.fleet.store import Store

        readings = [Reading.of(Store(path)) for path in (self.before, self.after)]
        region = _region(readings[1], self.region) or common(*readings)
        with made(self.out):
            check_changes_folder(self.out)
            before, after = (_grid(reading, region, "reading") for reading in readings)
            found = compare(before, after)
            title = f"{self.after.name}, and what has changed since {self.before.name}"
            write_changes(self.out, found, escaped(title))
        for reading in readings:
            _print_robots(reading)
        if found.compared < _COMPARED * min(found.seen):
            share = f"{found.compared / max(min(found.seen), 1):.0%} of the cells that the smaller side saw"
            print(f"note: only {share} were compared: were the drives elsewhere, or too short?", file=sys.stderr)
        counts = [sum(area.became == what for area in found.areas) for what in ("occupied", "free")]
        area = found.compared * after.resolution**2
        what = f"{counts[0]} areas became occupied, {counts[1]} free, of {area:.1f} m2 that both saw"
        print(escaped(f"{self.before}, {self.after}: {what}; {self.out}/changes.png, {self.out}/changes.csv"))
