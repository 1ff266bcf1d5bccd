"""The command that maps many logs together: fleet."""

import os
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, bar, robot_arg, start_pose
from echogrid.errors import UsageError, escaped
from echogrid.extras import need
from echogrid.files import made
from echogrid.output.map_file import read_map, write_grid
from echogrid.robot import Robot, robot_yaml

if TYPE_CHECKING:
    from distributed import Client

    from echogrid.fleet.job import Outcome, Task
    from echogrid.fleet.poses import Poses
    from echogrid.fleet.store import Record, Store
    from echogrid.grid import Grid

_REFUSED = 2
"""Exit status where a log was refused, though others were added."""

_LEAST_HASH, _SHOWN_HASH = 8, 12
"""So much of a hash, at least, says which log is meant; so much of it is shown."""

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
    """Take the logs out of the store instead; by their content, or where the file is gone by their name, or by
    the beginning of the hash in the store's logs/HASH.json."""
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
        records = store.records()
        _tell_changed(outcomes, records)
        _summarise(outcomes, records, self.out, time.perf_counter() - begin)
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
        print(escaped(f"{store.path}: {counted(len(found))} taken out; {counted(len(left))} count"))

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
                if not found and len(log) >= _LEAST_HASH:
                    found = [record for record in records if record.log.startswith(log)]
            if len(found) != 1:
                which = ", ".join(f"{record.log[:_SHOWN_HASH]} of {record.path or record.name}" for record in found)
                what = f"{len(found)} logs of that name ({which})" if found else "a log that is not in it"
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
        more = f" and {counted(len(where) - 1)} more" if len(where) > 1 else ""
        print(escaped(f"{kind}: {where[0]}{more}: {reason}"), file=sys.stderr)
    if told > _MOST_NOTES:
        print(escaped(f"note: {told - _MOST_NOTES} notes more are in {out}/logs, under notes"), file=sys.stderr)


def _tell_changed(outcomes: "Sequence[Outcome]", records: "Sequence[Record]") -> None:
    """Say of which logs an earlier content counts too."""
    added = {each.log: each.hash for each in outcomes if each.what == "added"}
    for record in records:
        if record.log != added.get(record.path, record.log):
            what = "it held something else when it was added before, which counts still"
            remedy = f"if it is to go: --remove {record.log[:_SHOWN_HASH]}"
            print(escaped(f"note: {os.path.basename(record.path)}: {what}; {remedy}"), file=sys.stderr)


def _summarise(outcomes: "Sequence[Outcome]", records: "Sequence[Record]", out: Path, seconds: float) -> None:
    words = {"added": "added", "replaced": "mapped anew", "there": "there already", "refused": "refused"}
    counts = {what: sum(each.what == what for each in outcomes) for what in words}
    done = ", ".join(f"{count} {words[what]}" for what, count in counts.items() if count)
    scans = sum(record.frames for record in records)
    what = f"{out}: of {counted(len(outcomes))} {done} in {seconds:.1f} s"
    print(escaped(f"{what}; {counted(len(records))} with {scans} scans count"))


def counted(count: int) -> str:
    """So many logs, in words."""
    return f"{count} {'log' if count == 1 else 'logs'}"
