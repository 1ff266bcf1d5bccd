"""A compiled peer: MRPT's particle filters for SLAM and in a known map, fed with sonars and odometry.

``mrpt/install.sh`` installs MRPT and builds the harness that is run here; position_peers.py sets it beside ours.

MRPT's filter for SLAM (``CMetricMapBuilderRBPF``, the program rbpf-slam) carries an occupancy grid in each particle.
Both filters weigh a sonar (``CObservationRange``) by MRPT's default likelihood, a field: points on the arc of the
echo, each by how far it is from the nearest cell that is occupied.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.mrpt import asked, run, table
from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.grid import Grid
from echogrid.robot import Robot

HARNESS = Path(__file__).parent / "mrpt" / "build" / "mrpt_position"


@dataclass(frozen=True)
class Filter:
    """What a filter of MRPT is told. Sigmas of odometry are those over a way of ``update_m``, a metre of it."""

    particles: int
    update_m: float = 0.2
    """Way between two updates, m; and ``update_rad`` the turn, rad."""
    update_rad: float = 0.2
    way: float = 0.068
    """``a1`` of MRPT's Gaussian model, m a m."""
    heading: float = float(np.deg2rad(2.45))
    """``a3``, rad a m."""
    turned: float = 0.0
    """``a4``, rad a rad."""
    hit_m: float = 0.1
    """``LF_stdHit``, m."""
    correspondence_m: float = 0.3
    """``LF_maxCorrsDistance``, m."""
    average: bool = True
    """``LF_alternateAverageMethod``: a sonar counts as one reading, not as the product over all points of its arc."""
    power: float = 1.0
    """``powFactor``, of the likelihood of all sonars."""
    cell_m: float = 0.08
    """Of the maps that SLAM makes, m."""
    centred: bool = True
    """Whether the cones that go into these maps are turned back onto the axes of the sonars (see mrpt.py)."""
    occupied_certainty: float = 0.65
    """``maxOccupancyUpdateCertainty`` of these maps."""


@dataclass(frozen=True)
class Driven:
    """What MRPT found."""

    then: Float[ndarray, "frames 3"]
    """The pose of each frame as it was known when it came, m, m, rad: the mean of the particles."""
    end: Float[ndarray, "frames 3"]
    """As it is known in the end: the path of the likeliest particle. In a known map the same as ``then``."""
    updates: int
    cpu_seconds: float
    """That the filter took, without its start."""


def available() -> bool:
    """Whether the harness has been built."""
    return os.access(HARNESS, os.X_OK)


def version() -> str:
    """The version of MRPT that the harness runs: MRPT and three numbers."""
    return run(HARNESS, b"", "--version").decode().strip()


def rbpf_slam(frames: Iterable[Frame], robot: Robot, options: Filter, seed: int = 1) -> Driven:
    """The poses that MRPT's filter finds where nothing is known; the first is the log's own first pose.

    Raises:
        UsageError: the harness is not built, or does not take the drive or an option.
    """
    poses, ranges = table(frames, robot)
    header = _header(poses, robot, options, seed) | {
        "centred": options.centred,
        "occupied_certainty": options.occupied_certainty,
    }
    local = compose(inverse(poses[0]), poses)
    numbers, data = asked(HARNESS, header, [robot.mounts, np.hstack([local, ranges])], "slam")
    return _driven(numbers, data, poses[0])


def monte_carlo(
    frames: Iterable[Frame],
    robot: Robot,
    grid: Grid,
    start: Float[ndarray, "3"],
    spread: Float[ndarray, "3"],
    options: Filter,
    seed: int = 1,
) -> Driven:
    """The poses that MRPT's filter finds in a known map.

    Args:
        frames: the drive, with poses by odometry.
        robot: the robot.
        grid: the map; its cells are MRPT's.
        start: about where the robot begins, m, m, rad.
        spread: standard deviations of that, m, m, rad; of the place the first counts.
        options: of the filter.
        seed: of its particles.

    Raises:
        UsageError: the harness is not built, or does not take the drive, the map or an option.
    """
    poses, ranges = table(frames, robot)
    rows, cols = grid.shape
    corner = np.array([*grid.origin, 0.0])
    header = _header(poses, robot, options, seed) | {
        "cell": grid.resolution,
        "start_m": spread[0],
        "start_rad": spread[2],
        "x0": 0.0,
        "y0": 0.0,
        "rows": rows,
        "cols": cols,
    }
    local = np.hstack([compose(inverse(poses[0]), poses), ranges])
    tables = [robot.mounts, local, np.asarray(start) - corner, 1 - grid.probability()]
    numbers, data = asked(HARNESS, header, tables, "localise")
    return _driven(numbers, data, corner)


def _header(poses: Float[ndarray, "frames 3"], robot: Robot, options: Filter, seed: int) -> dict[str, float]:
    """What both filters are told by name."""
    return {
        "beam_width": robot.beam_width_rad,
        "max_range": robot.max_range_m,
        "sonars": robot.sonars,
        "frames": len(poses),
        "particles": options.particles,
        "update_m": options.update_m,
        "update_rad": options.update_rad,
        "way": options.way,
        "heading": options.heading,
        "turned": options.turned,
        "hit": options.hit_m,
        "correspondence": options.correspondence_m,
        "average": options.average,
        "power": options.power,
        "seed": seed,
        "cell": options.cell_m,
    }


def _driven(numbers: dict[str, float], data: bytes, origin: Float[ndarray, "3"]) -> Driven:
    """An answer whose poses are seen from a pose (m, m, rad)."""
    then, end = compose(origin, np.frombuffer(data).reshape(2, int(numbers["frames"]), 3))
    return Driven(then, end, int(numbers["updates"]), numbers["cpu_seconds"])
