"""Regions of constant depth: the flat pieces of a rotary scan (Leonard and Durrant-Whyte 1992).

A smooth wall or a corner answers with one range as long as it lies in the beam, so range against orientation is
made of flat pieces. The middle of a piece is the bearing of the wall's normal or of the corner.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.geometry import wrap


@dataclass(frozen=True)
class RegionOfConstantDepth:
    """A connected run of returns of nearly one range, in the frame in which the scan's bearings are given."""

    first_bearing: float
    """Bearing of the run's first return, rad, in [-pi, pi)."""
    width: float
    """From the first return counter-clockwise to the last, rad."""
    mean_range: float
    """Mean of the run's ranges, m."""
    readings: Int[ndarray, "n"]
    """Which readings of the scan belong to the run, counter-clockwise."""

    @property
    def last_bearing(self) -> float:
        """Bearing of the run's last return, rad, in [-pi, pi)."""
        return float(wrap(self.first_bearing + self.width))

    @property
    def bearing(self) -> float:
        """Bearing of the run's middle, rad, in [-pi, pi): where the target lies."""
        return float(wrap(self.first_bearing + self.width / 2))


def regions_of_constant_depth(
    bearing: Float[ndarray, "steps"],
    ranges: Float[ndarray, "steps"],
    delta_m: float = 0.02,
    delta_share: float = 0.0,
    least_width: float = np.deg2rad(10.0),
    bridge: int = 0,
) -> list[RegionOfConstantDepth]:
    """Find the regions of constant depth of a rotary scan, in the order of their first readings.

    A run may wrap round the end of the scan. Where runs overlap, the wider is taken first, of equally wide ones the
    flatter; what it leaves of the other may still be a region.

    Args:
        bearing: axis of each reading, rad, in even steps counter-clockwise once round the circle.
        ranges: m; inf or nan = no echo.
        delta_m: the ranges of a run differ by less than this, m.
        delta_share: or by less than this share of its shortest range, if that is more (ranging noise that grows
            with range).
        least_width: narrower runs are dropped, rad.
        bridge: so many readings in a row without echo do not end a run (a module loses echoes now and then).

    Raises:
        UsageError: the bearings do not go round the circle in even steps.
    """
    steps = len(ranges)
    pitch = 2 * np.pi / max(steps, 1)
    if not np.allclose(wrap(np.roll(bearing, -1) - bearing - pitch), 0, atol=1e-3 * pitch):
        raise UsageError(f"bearing: found uneven steps, expected {steps} even ones round the circle")
    heard = np.isfinite(ranges)
    taken = np.zeros(steps, dtype=bool)
    regions = []
    while (run := _widest_run(ranges, heard, taken, (delta_m, delta_share, bridge))).size:
        width = float((run[-1] - run[0]) * pitch)
        if width < least_width - 1e-6 * pitch:
            break
        run %= steps
        taken[run] = True
        regions.append(RegionOfConstantDepth(float(wrap(bearing[run[0]])), width, float(np.mean(ranges[run])), run))
    return sorted(regions, key=lambda region: region.readings[0])


def _widest_run(
    ranges: Float[ndarray, "steps"],
    heard: Bool[ndarray, "steps"],
    taken: Bool[ndarray, "steps"],
    rule: tuple[float, float, int],
) -> Int[ndarray, "n"]:
    """The widest run of readings not yet taken, of equally wide ones the flattest, counted on past the scan's end."""
    delta_m, delta_share, bridge = rule
    steps = len(ranges)
    widest, flattest = (0, -1), np.inf
    for first in np.flatnonzero(heard & ~taken):
        low = high = ranges[first]
        last, spread = first, 0.0
        for at in range(first + 1, first + steps):
            reading = ranges[at % steps]
            if not heard[at % steps] and at - last <= bridge:
                continue
            low, high = min(low, reading), max(high, reading)
            if not heard[at % steps] or taken[at % steps] or not high - low < max(delta_m, delta_share * low):
                break
            last, spread = at, high - low
        gain = (last - first) - (widest[1] - widest[0])
        if gain > 0 or (gain == 0 and spread < flattest):
            widest, flattest = (first, last), spread
    run = np.arange(widest[0], widest[1] + 1)
    return run[heard[run % steps]]
