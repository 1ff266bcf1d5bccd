"""What a log says of the robot that drove: a robot file from the log itself, and what the log cannot tell.

docs/how-to/calibrate.md tells how it works and what it reaches.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.calibration import beams, places
from echogrid.calibration.beams import Beams, Chances
from echogrid.calibration.health import Health, examine
from echogrid.calibration.places import Axes, Places
from echogrid.calibration.readings import WINDOW_M, Readings, gather, some, windows
from echogrid.calibration.swaps import agreement, likely_pairs
from echogrid.calibration.variants import AS_GIVEN, Ranked, Variant, applied, judged, ranked, taken
from echogrid.calibration.walls import MOST_WALLS, find
from echogrid.errors import InputError
from echogrid.frame import Frame, Log
from echogrid.geometry import compose, wrap
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.robot import Robot

LONGER_M, MOST_PARTS = (3.0, 6.0, 12.0), 200
"""Parts of the drive are as long as the poses hold: longer ones tell more, but where the poses drift fewer echoes
touch walls in them. Of a longer drive so many parts, spread over it, are looked at."""

LEAST_WALLS, LEAST_ECHOES = 8, 200
"""Of fewer walls, or echoes that touch them, nothing is concluded."""

WIDER_RAD = np.deg2rad([8.0, 6.0, 4.0, 3.0, 3.0])
"""Round after round, by how much more than the beam a sonar may hear off its axis."""

FIRST, HALVES = WIDER_RAD[:2], WIDER_RAD[3:]
"""The rounds by which swapped sonars are looked for, and those of half a drive, begun where the whole one ended."""

LEAST_HALF_RAD = np.deg2rad(8.0)

SHARPER, CANDIDATES, FEWEST, MOST_SWAPS = 2.0, 5, 3, 4
"""Walls have to become sharper by so many standard deviations where two sonars are taken to be swapped. So many pairs
that speak for it are tried, and those of so many sonars whose echoes touch the fewest walls; again after each swap
that is found, up to so many."""

SOFT_RAD, LEAST_SHARE, MOST_APART = np.deg2rad(2.2), 0.35, 4.0
"""A beam whose edge seems softer has looked at rough walls, which are heard far off the axis too, and stays as it was
given. Of an array whose echoes touch walls less often something else is wrong, and halves of a drive that differ so
many times their spread hang on chance: then mounts, beam and scale stay."""

SURE = 1.96
"""Standard deviations to each side of an interval of 95 %."""

WIDE_M, WIDE_RAD, WIDE_SCALE = 0.05, np.deg2rad(5.0), 0.03
"""Of wider intervals than to these sides a place, an axis or a scale is not told, and stays as it was given."""

APART, SCALE_SD = (1.4, 1.7, 1.4), 0.001
"""Spreads of places, axes and scale are multiplied by so much at least: in simulated drives they were too small by
that, though halves of a drive agreed. What weak echoes from far away are read late passes for so much of a scale."""


@dataclass(frozen=True)
class Calibration:
    """What a log says of the robot that drove."""

    robot: Robot
    """With the mounts and the beam that were found, if they were."""
    given: Robot
    """As it was said to be, in the order that was found."""
    health: Health
    ranks: list[Ranked] = field(repr=False)
    """Plausible mistakes, the one of the sharpest walls first."""
    taken: Ranked
    """That of them which was taken: another than as given only where that is sure."""
    seats: list[int]
    """The mount (of ``taken``) at which each sonar was found."""
    places: Places = field(repr=False)
    beams: Beams = field(repr=False)
    chances: Chances = field(repr=False)
    inflation: tuple[float, float, float]
    """By what the spreads of places, axes and scale are multiplied: both halves of the drive differ so much more."""
    echoes: int
    """That could touch a wall."""
    way_m: float
    """That the robot drove."""

    @property
    def swapped(self) -> list[tuple[int, int]]:
        """Sonars that sit at another mount than theirs, and that mount."""
        return [(sonar, seat) for sonar, seat in enumerate(self.seats) if sonar != seat]

    @property
    def share(self) -> float:
        """Of the echoes, those that touch a wall."""
        return len(self.places.walls.wall) / max(self.echoes, 1)

    @property
    def moved(self) -> Float[ndarray, "sonars 3"]:
        """How far each mount is from where it was said to be: x, y, m; axis, rad."""
        off = np.column_stack([self.places.mounts[:, :2], self.beams.yaw]) - self.given.mounts
        return np.column_stack([off[:, :2], wrap(off[:, 2])])

    @property
    def moved_sd(self) -> Float[ndarray, "sonars 3"]:
        """Standard deviations of that."""
        place, axis, _ = self.inflation
        return np.column_stack([self.places.place_sd * place, self.beams.yaw_sd * axis])

    @property
    def told(self) -> Bool[ndarray, "sonars 3"]:
        """What of each mount the log tells: x and y, or neither, and the axis."""
        off = SURE * self.moved_sd
        place = np.max(off[:, :2], axis=1) <= WIDE_M
        return np.column_stack([place, place, off[:, 2] <= WIDE_RAD])

    @property
    def scale_sd(self) -> float:
        """Standard deviation of the scale of the ranges."""
        return float(np.hypot(self.places.scale_sd * self.inflation[2], SCALE_SD))

    @property
    def scale_told(self) -> bool:
        """Whether the log tells the scale of the ranges."""
        return SURE * self.scale_sd <= WIDE_SCALE

    @property
    def soft(self) -> bool:
        """Whether the beam was left as it was given, for its edge is soft, as before rough walls."""
        return bool(self.beams.soft > SOFT_RAD)

    @property
    def unsure(self) -> str:
        """Why mounts, beam and scale were left as they were given; empty: they were not."""
        if self.share < LEAST_SHARE:
            return f"{self.share:.0%} of the echoes touch walls that the drive agrees on, too few"
        if max(self.inflation[:2]) > MOST_APART:
            return f"two halves of the drive differ by {max(self.inflation[:2]):.1f} times what is likely"
        return ""


class _Parts(NamedTuple):
    spans: list[slice]
    long_m: float

    @property
    def most(self) -> int:
        """Walls of each."""
        return round(MOST_WALLS * self.long_m / WINDOW_M)

    def every_second(self, first: int) -> "_Parts":
        return _Parts(self.spans[first::2], self.long_m)


class _Fitted(NamedTuple):
    places: Places
    beams: Beams
    chances: Chances


def calibrate(frames: Iterable[Frame], robot: Robot) -> Calibration:
    """What a drive says of the robot that drove.

    Args:
        frames: a log of the robot, or frames in a list. Their poses are trusted over some metres.
        robot: as it is said to be: mounts within some centimetres and degrees, or wrong in one of the ways of
            ``variants``.

    Raises:
        InputError: there are no frames, or too few echoes of straight walls or corners to tell anything by.
        UsageError: frames that cannot be of the robot.
    """
    check_robot(robot)
    name = frames.name if isinstance(frames, Log) else "frames"
    kept = cleaned(list(fitting(frames, robot)), robot)
    readings = gather(kept, robot, name)
    way_m = float(np.sum(np.hypot(*np.diff([frame.pose[:2] for frame in kept], axis=0).T)))
    health = examine(readings)
    useful = readings.without(health.useless)
    ranks = ranked(useful, robot)
    best = taken(ranks)
    useful, given = applied(useful, robot, best.variant)
    parts = _parts(useful, given)
    seat, begin = _seats(useful, given, parts, name)
    given = replace(given, mounts=given.mounts[seat])
    whole = _fitted(useful, given, parts, name, WIDER_RAD[len(FIRST) :], begin)
    inflation = _inflation(useful, given, parts, whole)
    echoes = int(np.isfinite(useful.only(parts.spans).near()).sum())
    found = Calibration(given, given, health, ranks, best, seat, *whole, inflation, echoes, way_m)
    return found if found.unsure else replace(found, robot=_robot(found))


def _parts(readings: Readings, robot: Robot) -> _Parts:
    """Parts of the drive as long as the poses hold."""
    best, most = _Parts([], 0.0), -1.0
    for long_m in LONGER_M:
        parts = _Parts(some(windows(readings, long_m), MOST_PARTS), long_m)
        share = judged(readings, Variant(AS_GIVEN, robot.mounts), parts.spans, robot.beam_width_rad, parts.most).share
        if share < most:
            break
        best, most = parts, share
    return best


def _robot(found: Calibration) -> Robot:
    """The robot as it was found; what is not told of a sonar stays as it was said to be."""
    mounts = found.given.mounts + np.where(found.told, found.moved, 0.0)
    mounts[:, 2] = wrap(mounts[:, 2])
    mounts[found.health.useless] = found.given.mounts[found.health.useless]
    width = float(np.clip(2 * found.beams.half, np.deg2rad(1.0), np.pi))
    if found.soft:
        width = found.given.beam_width_rad
    return replace(found.given, mounts=mounts, beam_width_rad=width)


def _fitted(
    readings: Readings, given: Robot, parts: _Parts, name: str, wider: ndarray, begin: _Fitted | None = None
) -> _Fitted:
    """Walls, places, scale, axes and beam, in turn until they agree.

    Args:
        readings: of the drive.
        given: what was said of the robot before the log.
        parts: of the drive.
        name: of the log.
        wider: of WIDER_RAD, a round each.
        begin: where to begin; without it that is as it was given.

    Raises:
        InputError: there is too little to tell anything by.
    """
    mounts, scale, half = given.mounts, 1.0, given.beam_width_rad / 2
    yaw_sd = np.full(given.sonars, beams.YAW_RAD)
    if begin:
        mounts = np.column_stack([begin.places.mounts[:, :2], begin.beams.yaw])
        scale, half, yaw_sd = begin.places.scale, begin.beams.half, begin.beams.yaw_sd
    near = readings.near()
    for more in wider.tolist():
        off = max(half, LEAST_HALF_RAD) + more
        walls = find(compose(readings.poses, mounts), near / scale, parts.spans, off, parts.most)
        if len(walls.place) < LEAST_WALLS or len(walls.wall) < LEAST_ECHOES:
            found = f"{len(walls.wall)} echoes that touch {len(walls.place)} straight walls or corners"
            expected = (
                f"{LEAST_ECHOES} and {LEAST_WALLS}, as of some {LEAST_WALLS} m along walls, to tell anything by"
            )
            raise InputError(name, found, expected)
        place = places.fit(readings, mounts, given.mounts, walls, scale, Axes(yaw_sd, half))
        scale = place.scale
        chances = beams.chances(readings, place.mounts, scale, place.walls, place.miss_m)
        beam = beams.fit(chances, given.mounts[:, 2], mounts[:, 2], half)
        mounts, half, yaw_sd = np.column_stack([place.mounts[:, :2], beam.yaw]), beam.half, beam.yaw_sd
    return _Fitted(place, beam, chances)


def _seats(readings: Readings, given: Robot, parts: _Parts, name: str) -> tuple[list[int], _Fitted]:
    """The mount of each sonar, and a first fit with them.

    Likely pairs change places as long as that makes the walls sharper.
    """
    seat = np.arange(given.sonars)
    hearing = np.isfinite(readings.only(parts.spans).near()).sum(axis=0)
    for _ in range(MOST_SWAPS):
        now = replace(given, mounts=given.mounts[seat])
        first = _fitted(readings, now, parts, name, FIRST)
        place, beam = first.places, first.beams
        told = agreement(readings, now.mounts, beam, place.scale, place.walls, place.miss_m)
        as_is = judged(readings, Variant(AS_GIVEN, now.mounts), parts.spans, now.beam_width_rad, parts.most)
        best, most = None, SHARPER
        touching = np.bincount(place.walls.sonar, minlength=len(seat)) / np.maximum(hearing, 1)
        touching[hearing == 0] = np.inf
        least = sorted(np.argsort(touching)[:FEWEST].tolist())
        for one, two in {*likely_pairs(told, CANDIDATES), *combinations(least, 2)}:
            mounts = now.mounts.copy()
            mounts[[one, two]] = mounts[[two, one]]
            sharper = judged(readings, Variant("swapped", mounts), parts.spans, now.beam_width_rad, parts.most).over(
                as_is
            )
            if sharper > most:
                best, most = [one, two], sharper
        if best is None:
            return seat.tolist(), first
        seat[best] = seat[best[::-1]]
    return seat.tolist(), _fitted(readings, replace(given, mounts=given.mounts[seat]), parts, name, FIRST)


def _inflation(readings: Readings, given: Robot, parts: _Parts, whole: _Fitted) -> tuple[float, float, float]:
    """By how much more than their spreads places, axes and scale of two halves of a drive differ; APART at least."""
    try:
        one, other = (_fitted(readings, given, parts.every_second(first), "half", HALVES, whole) for first in (0, 1))
    except InputError:
        return 2.5, 2.5, 2.5  # half the drive says too little to tell
    apart = (one.places.mounts - other.places.mounts)[:, :2] / np.hypot(one.places.place_sd, other.places.place_sd)
    turned = wrap(one.beams.yaw - other.beams.yaw) / np.hypot(one.beams.yaw_sd, other.beams.yaw_sd)
    scaled = (one.places.scale - other.places.scale) / np.hypot(one.places.scale_sd, other.places.scale_sd)
    place, axis = (float(np.sqrt(np.mean(each**2))) for each in (apart, turned))
    # One number hangs on chance: that of the places, which are fitted with it, counts four times as much.
    differ = place, axis, float(np.sqrt((4 * max(place, APART[0]) ** 2 + scaled**2) / 5))
    return max(differ[0], APART[0]), max(differ[1], APART[1]), max(differ[2], APART[2])
