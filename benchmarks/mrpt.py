"""A compiled peer: MRPT's occupancy grid (``COccupancyGridMap2D``) fed with sonar readings (``CObservationRange``).

``mrpt/install.sh`` installs MRPT and builds the harness that ``mrpt_map`` runs. As a script: its speed on the drive
of mapping.py, as MRPT comes and with the cones centred, beside that of the paper's network on as many threads, in
turns; one line where the harness is not built. Target: the network maps at least as many scans a second.

MRPT draws the cone of a sonar clockwise from the sonar's axis instead of to both sides of it, so that all it says
lies half a beam off. ``centred=True`` undoes that from outside, by turning each sonar half a beam to the left.
"""

import os
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import _core
from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import transform
from echogrid.grid import Grid, logit
from echogrid.mapping.mapper import Mapper
from echogrid.robot import Robot

HARNESS = Path(__file__).parent / "mrpt" / "build" / "mrpt_grid"

BORDER_CELLS = 18
"""Cells kept free round all that is drawn: MRPT enlarges a grid, and so moves its cells, from 15 cells on."""

SCANS, TURNS, CELL_M = 20_000, 7, 0.12
"""Of the script."""

WARM = 128
"""Scans that are mapped before it begins."""


def available() -> bool:
    """Whether the harness has been built."""
    return os.access(HARNESS, os.X_OK)


def version() -> str:
    """The version of MRPT that the harness runs: MRPT and three numbers."""
    return run(HARNESS, b"", "--version").decode().strip()


def mrpt_map(
    frames: Iterable[Frame],
    robot: Robot,
    resolution: float,
    centred: bool,
    *,
    no_echo_m: float = 0.0,
    beam_width_rad: float | None = None,
    max_distance_m: float = 15.0,
    occupied_certainty: float = 0.65,
    free_certainty: float = 0.0,
    invalid_as_free: bool = True,
) -> tuple[Grid, float, float]:
    """The map that MRPT makes of a drive. What is not given has MRPT's own default.

    Args:
        frames: the drive; the poses are the robot's in the world (m, rad).
        robot: gives the mounts and the beam width.
        resolution: side of a cell, m. Cells lie on its multiples, counted from the world's origin.
        centred: whether the cones are turned back onto the axes of the sonars.
        no_echo_m: the distance that MRPT is given where no echo came back, m. 0 is MRPT's own sign for it, and
            changes nothing. ``inf``, or anything from ``max_distance_m`` on, is an invalid reading; the robot's
            maximum range, as many drivers report it, is an obstacle there.
        beam_width_rad: full width of the cone in place of the robot's, rad.
        max_distance_m: ``maxDistanceInsertion``. A reading from here on is an invalid one.
        occupied_certainty: ``maxOccupancyUpdateCertainty``, a probability in [0.5, 1]. One reading adds its log-odds
            (rounded to 1/16) three times to the cells of the arc.
        free_certainty: ``maxFreenessUpdateCertainty``, a probability in [0.5, 1], added once to the cells before the
            arc; 0 = ``occupied_certainty``.
        invalid_as_free: ``considerInvalidRangesAsFreeSpace``. An invalid reading frees the cone up to half of
            ``max_distance_m``; otherwise it changes nothing.

    Returns:
        The map, and the seconds that MRPT spent on inserting the readings, by the clock and of the CPU. Cells are
        observed where MRPT's probability is not 0.5: the rare cell in which evidence cancels to nothing counts as not
        observed.

    Raises:
        UsageError: the harness is not built, or does not take the drive or an option.
    """
    poses, ranges = table(frames, robot)
    beam_width = robot.beam_width_rad if beam_width_rad is None else beam_width_rad
    low, shape = _cells(poses, ranges, robot, resolution, no_echo_m, max_distance_m)
    x0, y0 = (float(first * resolution) for first in low)
    header = {
        "rows": shape[1],
        "cols": shape[0],
        "x0": x0,
        "y0": y0,
        "resolution": resolution,
        "beam_width": beam_width,
        "centred": centred,
        "no_echo": no_echo_m,
        "max_distance": max_distance_m,
        "occupied_certainty": occupied_certainty,
        "free_certainty": free_certainty,
        "invalid_as_free": invalid_as_free,
        "sonars": robot.sonars,
        "frames": len(poses),
    }
    numbers, cells = asked(HARNESS, header, [robot.mounts, np.hstack([poses, ranges])])
    p_free = np.frombuffer(cells, np.float32).reshape(int(numbers["rows"]), int(numbers["cols"]))
    grid = Grid(occupied_log_odds(p_free), p_free != 0.5, resolution, (x0, y0))
    return grid, numbers["seconds"], numbers["cpu_seconds"]


def occupied_log_odds(p_free: Float[ndarray, "rows cols"]) -> Float[ndarray, "rows cols"]:
    """Log-odds of occupied (float32) from MRPT's probabilities, which are those of free."""
    return (-logit(p_free.astype(float))).astype(np.float32)


def table(
    frames: Iterable[Frame], robot: Robot
) -> tuple[Float[ndarray, "frames 3"], Float[ndarray, "frames sonars"]]:
    """Poses (m, rad) and ranges (m) of a drive."""
    kept = list(frames)
    if not kept:
        raise UsageError("mrpt: found no frames, expected at least one")
    for frame in kept:
        if len(frame.ranges) != robot.sonars:
            raise UsageError(f"mrpt: found a frame of {len(frame.ranges)} readings, expected {robot.sonars}")
    return np.array([frame.pose for frame in kept], float), np.array([frame.ranges for frame in kept], float)


def _cells(
    poses: Float[ndarray, "frames 3"],
    ranges: Float[ndarray, "frames sonars"],
    robot: Robot,
    resolution: float,
    no_echo_m: float,
    max_distance_m: float,
) -> tuple[ndarray, ndarray]:
    """First cell [x, y] and number of cells in x and y of a grid that holds all that MRPT will draw."""
    told = np.where(np.isposinf(ranges), no_echo_m, ranges)
    reach = np.where(told < max_distance_m, told, max_distance_m / 2)[~np.isnan(ranges)].max(initial=0.0)
    at = transform(poses[:, None], robot.mounts[:, :2]).reshape(-1, 2)
    low = np.floor((at.min(axis=0) - reach) / resolution) - BORDER_CELLS
    high = np.ceil((at.max(axis=0) + reach) / resolution) + BORDER_CELLS
    return low, high - low


def asked(
    harness: Path, header: Mapping[str, float], tables: Sequence[Float[ndarray, "..."]], *arguments: str
) -> tuple[dict[str, float], bytes]:
    """The numbers that a harness answers and the bytes behind them, given numbers by name and doubles.

    All goes through pipes: a drive of 800 frames is 170 kB, and no file can be left behind.

    Raises:
        UsageError: the harness is not built, or does not take it.
    """
    lines = "".join(f"{key} {float(value)!r}\n" for key, value in header.items()) + "data\n"
    drive = lines.encode() + b"".join(np.asarray(part, float).tobytes() for part in tables)
    answer, _, data = run(harness, drive, *arguments).partition(b"\ndata\n")
    return {key: float(value) for key, value in (line.split() for line in answer.decode().splitlines())}, data


def run(harness: Path, drive: bytes, *arguments: str) -> bytes:
    """What a harness says to a drive.

    Raises:
        UsageError: the harness is not built, or does not take it.
    """
    if not os.access(harness, os.X_OK):
        raise UsageError(f"mrpt: found no {harness}, expected it (benchmarks/mrpt/install.sh builds it)")
    done = subprocess.run([harness, *arguments], input=drive, capture_output=True, check=False)
    if done.returncode:
        raise UsageError(done.stderr.decode(errors="replace").strip() or f"{harness.name}: status {done.returncode}")
    return done.stdout


def by_mrpt(frames: Sequence[Frame], robot: Robot, centred: bool, threads: int) -> tuple[float, float]:
    """Seconds by the clock and of the CPU in which MRPT maps a drive.

    It has no threads: with two it makes two maps, each of half of the drive, which nobody puts together.
    """
    each = len(frames) // threads
    parts = [frames[k * each : (k + 1) * each] for k in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        clock, cpu = zip(*pool.map(lambda part: mrpt_map(part, robot, CELL_M, centred)[1:], parts), strict=True)
    return max(clock), sum(cpu)


def by_network(frames: Sequence[Frame], robot: Robot, threads: int) -> tuple[float, float]:
    """The same of the paper's network, from frames to the map, its start apart."""
    mapper = Mapper(robot, "network", CELL_M)
    mapper.add(frames[:WARM])
    _core.set_threads(threads)
    clock, cpu = time.perf_counter(), time.process_time()
    mapper.add(frames)
    return time.perf_counter() - clock, time.process_time() - cpu


def main() -> None:
    if not available():
        print("mrpt: not built (benchmarks/mrpt/install.sh)")
        return
    # It imports JAX, which who imports this module may do without.
    from benchmarks.mapping import long_log

    robot, frames = Robot.load("b21"), list(long_log(SCANS))
    print(f"mrpt: {version()}, {SCANS} scans of {robot.sonars} sonars, cells of {CELL_M} m; least of {TURNS} turns")
    before = _core.threads()
    for threads in (1, 2):
        rows: dict[str, Callable[[], tuple[float, float]]] = {
            "MRPT as shipped": lambda threads=threads: by_mrpt(frames, robot, False, threads),
            "MRPT centred": lambda threads=threads: by_mrpt(frames, robot, True, threads),
            "the paper's network": lambda threads=threads: by_network(frames, robot, threads),
        }
        turns = np.array([[work() for work in rows.values()] for _ in range(TURNS)])
        for name, (clock, cpu) in zip(rows, SCANS / turns.min(axis=0), strict=True):
            print(
                f"  {threads} thread{'s' * (threads > 1)}, {name}: {clock:.0f} scans/s by the clock, "
                f"{cpu:.0f} by the CPU time of one"
            )
    _core.set_threads(before)


if __name__ == "__main__":
    main()
