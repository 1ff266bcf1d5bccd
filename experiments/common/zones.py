"""Drones with four sensors of eight zones each (VL53L5CX): their arrays, and ranges from what the zones read."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Robot

SIDES = {"f": (0.02, 0.0, 0.0), "b": (-0.02, 0.0, 180.0), "l": (0.0, 0.025, 90.0), "r": (0.0, -0.025, -90.0)}
"""Places of the four sensors: m, m, degrees."""
ZONES, ZONE_DEG = 8, 5.625
ZONE_OFF_DEG = ((ZONES - 1) / 2 - np.arange(ZONES)) * ZONE_DEG
KINDS = ("cones", "rays")


def drone(kind: str, max_range: float) -> Robot:
    """Each side as a cone of 45 degrees, or as a ray for each of its zones; ``max_range`` in m."""
    offs = [0.0] if kind == "cones" else ZONE_OFF_DEG.tolist()
    mounts = [(x, y, turn + off) for x, y, turn in SIDES.values() for off in offs]
    return replace(
        Robot.load("p3dx"),
        name=f"tof-{kind}",
        footprint_radius_m=0.06,
        min_range_m=0.05,
        max_range_m=max_range,
        beam_width_rad=float(np.deg2rad(45.0 if kind == "cones" else 6.0)),
        mounts=np.array(mounts) * [1, 1, np.pi / 180],
    )


def zone_ranges(depth: Float[ndarray, "frames 4 8"], kind: str, robot: Robot) -> Float[ndarray, "frames sonars"]:
    """Ranges (m) from the zones' distances along the axes of their sides (m; nan: none); a cone reads the least."""
    slant = depth / np.cos(np.deg2rad(ZONE_OFF_DEG))
    if kind == "rays":
        return robot.clean(slant.reshape(len(slant), -1))
    least = np.min(np.where(np.isnan(slant), np.inf, slant), axis=2)
    return robot.clean(np.where(np.isinf(least), np.nan, least))  # nothing valid in a side is not valid
