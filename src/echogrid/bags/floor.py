"""Rangers of a bag that are pitched at the floor and hear it, by their places in tf."""

from math import asin, degrees, inf, radians, sin

import numpy as np

from echogrid.bags.survey import Survey
from echogrid.errors import InputError
from echogrid.ros.messages import Sonar, few
from echogrid.ros.rigid import slope
from echogrid.ros.sonars import BEAM_WIDTH_RAD, beam_width

_MOST, _FEWEST = 0.6, 10
"""The share of a ranger's readings that hear the floor where it does; readings of which nothing is said."""

_PITCH_RAD = radians(15.0)
"""A ranger that is pitched less sees ahead."""

_NEAR = 0.3
"""How far, as a share, the floor that is heard lies off the point where the axis meets it, at most."""


def without_floor(survey: Survey, sonars: list[Sonar], base: str) -> tuple[list[Sonar], dict[str, int]]:
    """Those sonars that do not hear the floor most of the time, and a note on the others.

    Raises:
        InputError: all of them do.
    """
    seen = {sonar: place for sonar in sonars if (place := _floor(survey, sonar, base))}
    if not seen:
        return sonars, {}
    pitches, heights, ranges = (np.median(values) for values in zip(*seen.values(), strict=True))
    found = (
        f"{few(seen)} pitched down by {degrees(pitches):.0f} degrees at a height of {heights:.2f} m, whose ranges of"
        f" about {ranges:.2f} m are those of the floor"
    )
    if len(seen) == len(sonars):
        raise InputError(survey.name, found, "rangers that look ahead, or tf with their true pitch and height")
    for sonar in seen:
        survey.heard[sonar].amiss, survey.heard[sonar].mount = "one that hears the floor", None
    told = f"{found}: left out (if they look ahead: mend their pitch or height in tf, or give --robot)"
    return [sonar for sonar in sonars if sonar not in seen], {told: 0}


def _floor(survey: Survey, sonar: Sonar, base: str) -> tuple[float, float, float] | None:
    """How far a sonar is pitched down (rad), its height (m) and what it reads (m), where it hears the floor."""
    heard, transforms = survey.heard[sonar], survey.transforms
    there = transforms.rigid(base, sonar.frame, heard.last, reach=inf)
    down = -slope(there) if there is not None else 0.0
    if down < sin(_PITCH_RAD) or heard.finite < _FEWEST:
        return None
    feet = (name for name in transforms.children() if name.rsplit("/", 1)[-1] == "base_footprint")
    foot = next((name for name in [*feet, "base_footprint"] if not transforms.moves(name, base)), survey.fixed)
    above = transforms.rigid(foot, sonar.frame, heard.last, reach=inf)
    if above is None or above.translation[2] <= 0:
        return None
    pitch, height = asin(min(down, 1.0)), above.translation[2]
    half = (beam_width(heard.field_of_view) or BEAM_WIDTH_RAD) / 2
    # What a wide beam meets of the floor before and behind its axis.
    nearest = max(height / sin(min(pitch + half, radians(90))), (1 - _NEAR) * height / down)
    farthest = min(height / sin(max(pitch - half, 1e-3)), (1 + _NEAR) * height / down)
    ranges = heard.ranges.array()
    hits = ranges[(ranges > 0.9 * nearest) & (ranges < 1.1 * farthest)]
    share = len(hits) / len(ranges) * heard.finite / heard.readings
    return (pitch, height, float(np.median(hits))) if share > _MOST else None
