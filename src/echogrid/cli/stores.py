"""Commands that read stores of fleets: tiles, changes."""

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from echogrid.cli.arguments import check_map, drop, steps
from echogrid.cli.fleet import counted
from echogrid.errors import UsageError, escaped
from echogrid.extras import need
from echogrid.files import check_writable, made
from echogrid.output.folder import check_folder
from echogrid.output.map_file import write_map

if TYPE_CHECKING:
    from echogrid.fleet.lattice import Region
    from echogrid.fleet.reading import Reading
    from echogrid.grid import Grid

_COMPARED = 0.5
"""If less than this share of what one side saw can be compared, it is told."""

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
            grid = _grid(reading, region)
            if self.region is None:
                grid = grid.observed_part() or grid
            if self.resolution is not None and self.resolution != grid.resolution:
                grid = grid.in_cells_of(self.resolution)
            title = f"{self._name()}, {counted(len(reading.records))}"
            write_map(self.out, grid, np.empty((0, 2)), self._settings(reading, grid), escaped(title), self.pgm)
        drop(self.out)
        _print_robots(reading)
        (rows, cols), cell = grid.shape, grid.resolution
        seconds = time.perf_counter() - begin
        what = f"{self.store}: {counted(len(reading.records))} in {seconds:.1f} s"
        files = f"{self.out}/map.png; {self.out}/map.yaml is for Nav2's map_server"
        print(escaped(f"{what}; map of {cols * cell:.1f} x {rows * cell:.1f} m in {files}"))

    def _view(self, reading: "Reading") -> None:
        """Write the page instead."""
        from echogrid.fleet.page import PAGE, write_tile_page

        if self.region is not None or self.resolution is not None:
            raise UsageError("--view: found it with --region or --resolution, expected it alone: the page has all")
        with made(self.out), steps("reading", "block") as progress:
            check_writable(self.out / PAGE)
            title = f"{self._name()}, {counted(len(reading.records))}"
            write_tile_page(self.out, reading, escaped(title), progress)
        _print_robots(reading)
        print(escaped(f"{self.store}: {counted(len(reading.records))}; open {self.out / PAGE} in a browser"))

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


def _grid(reading: "Reading", region: "Region | None") -> "Grid":
    """The map of a part, under a progress bar."""
    with steps("reading", "block") as progress:
        return reading.grid(region, progress)


def _print_robots(reading: "Reading") -> None:
    """Say whose sonars the map is read for, where there are several kinds."""
    if len(reading.robots) > 1:
        others, total = len(reading.robots) - 1, sum(reading.robots.values())
        share = next(iter(reading.robots.values())) / total
        kinds = "another kind" if others == 1 else f"{others} other kinds"
        what = f"sonars of {reading.robot.name} ({share:.0%} of the scans), though {kinds} drove too"
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
            before, after = (_grid(reading, region) for reading in readings)
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
        areas = "area" if counts[0] == 1 else "areas"
        what = f"{counts[0]} {areas} became occupied, {counts[1]} free, of {area:.1f} m2 that both saw"
        print(escaped(f"{self.before}, {self.after}: {what}; {self.out}/changes.png, {self.out}/changes.csv"))
