"""The array of sonars as messages and transforms describe it: its frames, mounts, beams and limits.

Also what a reading means by the limits of its sonar.
"""

from collections.abc import Sequence
from math import inf, isfinite, isnan, nan, radians
from statistics import median

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.robot import TRANSDUCERS, Robot, surrounded
from echogrid.ros.rigid import IDENTITY, planar, slope
from echogrid.ros.transforms import Transforms, stands_still

BEAM_WIDTH_RAD = radians(25.0)
"""Taken for a sonar that does not say its own."""

MIN_RANGE_M, MAX_RANGE_M = 0.0, 100.0
"""Limits of the range for a sonar that does not say its own."""


def reading(range_m: float, min_range_m: float, max_range_m: float) -> float:
    """A reading by REP 117 and its sonar's limits: +inf no echo, nan not valid, else the range (m).

    +inf, or at or past the maximum: no echo. -inf (too close), nan, 0 and less, below the minimum: not valid. A limit
    that is no positive number limits nothing.
    """
    if isnan(range_m) or range_m <= 0 or (isfinite(min_range_m) and range_m < min_range_m):
        return nan
    if max_range_m > 0 and range_m >= max_range_m:
        return inf
    return inf if range_m > MAX_RANGE_M else range_m


def beam_width(field_of_view: float) -> float | None:
    """A beam width (rad) if it can be one, else None."""
    return field_of_view if radians(1.0) <= field_of_view <= radians(180.0) else None


def robot_of(
    name: str,
    mounts: Float[ndarray, "sonars 3"],
    beam_widths: Sequence[float],
    limits: Sequence[tuple[float, float]],
) -> Robot:
    """The robot as far as messages describe it.

    Args:
        name: what to call it.
        mounts: m, m, rad.
        beam_widths: of the sonars that say one, rad.
        limits: minimum and maximum range that each sonar says, m.

    Returns:
        A robot with the widest limits of its sonars (and the maximum of each where they differ), the median of their
        beam widths, a footprint that the mounts surround, and a Polaroid 600 for its transducer, which
        mapping does not read.
    """
    lows = [low for low, _ in limits if 0 <= low < MAX_RANGE_M]
    highs = [high for _, high in limits if 0 < high <= MAX_RANGE_M]
    low, high = min(lows, default=MIN_RANGE_M), max(highs, default=MAX_RANGE_M)
    own = np.array([each if 0 < each <= MAX_RANGE_M else high for _, each in limits])
    return Robot(
        name=name,
        footprint_radius_m=surrounded(mounts),
        transducer=TRANSDUCERS["polaroid-600"],
        min_range_m=low if low < high else MIN_RANGE_M,
        max_range_m=high,
        beam_width_rad=median(beam_widths) if beam_widths else BEAM_WIDTH_RAD,
        mounts=mounts,
        own_max_ranges_m=own if own.size == len(mounts) and own.min() < high else None,
    )


def mount(transforms: Transforms, base: str, frame: str, stamp: float) -> Float[ndarray, "3"] | str | None:
    """Where a sonar's frame sits on the robot: x, y (m), axis (rad).

    None if nothing joins the two frames at the time (s); a few words if there is no such mount in the plane.
    """
    rigid = IDENTITY if frame.lstrip("/") == base else transforms.rigid(base, frame, stamp, reach=inf)
    if rigid is None:
        return None
    if abs(slope(rigid)) > 0.7:
        return "an axis that points up or down"
    x, y, axis = planar(rigid)
    return np.array([x, y, axis]) if max(abs(x), abs(y)) <= 10.0 else "a place more than 10 m from the robot"


def base_of(transforms: Transforms, frame: str) -> str:
    """The frame of the robot that carries a frame: the first below the frames that stand still.

    Where tf does not lead that far up, the root of what there is.
    """
    line = transforms.line(frame)
    return next((name for name in reversed(line) if not stands_still(name)), line[-1])


def fixed_of(transforms: Transforms, base: str, odometry: bool = False) -> str | None:
    """The frame to map in: ``map`` if the robot's pose leads up to one, else the highest; None if there is none.

    Args:
        transforms: what is known of frames.
        base: the robot's.
        odometry: whether ``odom`` is rather taken than ``map``.
    """
    above = transforms.line(base)[1:]
    for wanted in ("odom", "map") if odometry else ("map",):
        for name in above:
            if stands_still(name) and wanted in name.split("/")[-1]:
                return name
    return above[-1] if above else None
