"""Plausible mistakes about a robot and its poses, tried one after the other, by the sharpness of walls.

A wrong order of the sonars, or mounts that are mirrored, smear walls: fewer echoes touch any that many touch.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.calibration.readings import Readings, some, windows
from echogrid.calibration.walls import MOST_WALLS, find
from echogrid.geometry import compose, wrap
from echogrid.robot import Robot

AS_GIVEN = "as given"

SURE, GAIN = 3.0, 1.05
"""A variant is surely better than another if parts of the drive agree on it by so many standard deviations, and so
many times as many echoes touch walls."""

LEAST_PARTS = 4
"""Of fewer parts of the drive nothing is concluded."""

ALL_ORDERS = 4
"""Of so many sonars all orders are tried."""

MOST_PARTS, FEW_PARTS, KEPT = 60, 6, 6
"""So many parts, spread over the drive, are enough; a few of them tell which variants are worth looking at in all."""

SAME_M = 0.02


@dataclass(frozen=True)
class Variant:
    """What may be so instead of what was given."""

    name: str
    """Words for a message, as of what is wrong."""
    mounts: Float[ndarray, "sonars 3"]
    """Of each reading, m, m, rad."""
    poses: str = ""
    """How the poses have to be changed, of POSES; empty: not."""
    late_s: float = 0.0
    """So much later than the poses of the same moment the ranges come."""
    times: float = 1.0
    """What the ranges have to be multiplied by."""


@dataclass(frozen=True)
class Ranked:
    """A variant and how sharp its walls are."""

    variant: Variant
    touching: Int[ndarray, "parts"]
    """Echoes that touch walls, in each part of the drive."""
    share: float
    """Of all echoes that could."""

    def over(self, other: "Ranked") -> float:
        """By how many standard deviations it is better than another."""
        more = (self.touching - other.touching).astype(float)
        spread = float(np.sqrt(np.sum((more - more.mean()) ** 2) * len(more) / max(len(more) - 1, 1)))
        return float(more.sum()) / max(spread, 1.0)

    def surely_over(self, other: "Ranked") -> bool:
        """Whether it is better beyond doubt."""
        many = len(self.touching) >= LEAST_PARTS
        return many and self.share > GAIN * other.share and self.over(other) > SURE


_QUARTERS = {90: "a quarter left", 180: "half round", -90: "a quarter right"}

LATE_S = (0.25, 0.5, 1.0)
"""By so much ranges may come later than poses, or sooner."""

SCALED = 1.6
"""So many times as many echoes have to touch walls where the ranges are of another scale: shorter ones touch more of
anything, 1.35 times at most on recordings that are right; those in feet or of half the length 2 to 3 times."""

TIMES = {
    1 / 3.28084: "the ranges are in feet: divide them by 3.2808",
    2.0: "the ranges are half of what they should be: multiply them by 2",
    0.5: "the ranges are twice what they should be, the way there and back: divide them by 2",
}

POSES = {
    "theta": np.array([1.0, 1.0, -1.0]),
    "y": np.array([1.0, -1.0, 1.0]),
}


def variants(robot: Robot) -> Iterator[Variant]:
    """What may be wrong, what was given first."""
    mounts, n = robot.mounts, robot.sonars
    mirrored = mounts * [1, -1, -1]
    yield Variant(AS_GIVEN, mounts)
    yield Variant("left and right are swapped: the mounts are mirrored (or y and theta of the poses)", mirrored)
    for degrees, how in _QUARTERS.items():
        turn = np.array([0.0, 0.0, np.deg2rad(degrees)])
        yield Variant(
            f"the mounts are turned: all sonars look {how} of where they are said to", compose(turn, mounts)
        )
        yield Variant(f"the mounts are mirrored and turned {how}", compose(turn, mirrored))
    if n <= ALL_ORDERS:
        for order in permutations(range(n)):
            names = ", ".join(f"r{i}" for i in order)
            yield Variant(
                f"the sonars are in another order: at the mounts are, one by one, {names}", _at(mounts, order)
            )
    else:
        numbers = list(range(n))
        for first in range(n):
            order = numbers[first:] + numbers[:first]
            if first:
                yield Variant(f"the numbering is shifted: the first mount is that of r{first}", _at(mounts, order))
            name = f"the sonars are numbered the other way round: the first mount is that of r{order[-1]}"
            yield Variant(name, _at(mounts, order[::-1]))
    for late in LATE_S:
        told = f"the clocks of ranges and poses are apart: the ranges come some {late:g} s"
        yield Variant(f"{told} after the poses, subtract that from their stamps", mounts, late_s=late)
        yield Variant(f"{told} before the poses, add that to their stamps", mounts, late_s=-late)
    for times, told in TIMES.items():
        yield Variant(told, mounts, times=times)
    yield Variant("theta is counted clockwise: it has to be counter-clockwise", mounts, "theta")
    yield Variant("y points to the right: it has to point to the left of x", mounts, "y")


def _at(mounts: Float[ndarray, "sonars 3"], order: tuple[int, ...] | list[int]) -> Float[ndarray, "sonars 3"]:
    """Mounts of each reading if at mount i is the sonar of reading ``order[i]``."""
    out = np.empty_like(mounts)
    out[list(order)] = mounts
    return out


def ranked(readings: Readings, robot: Robot, hasty: bool = False) -> list[Ranked]:
    """All variants that differ, the one of the sharpest walls first; of those alike the simplest is kept.

    Only the first KEPT, and that as given, are judged by all parts of the drive; the others follow, judged by a few.

    Args:
        readings: of the drive.
        robot: as it was said to be.
        hasty: whether what was given is believed if it comes first by a few parts.
    """
    different: list[Variant] = []
    for variant in variants(robot):
        if not any(_alike(variant, other) for other in different):
            different.append(variant)

    def best_first(some_of: list[Variant], parts: list[slice]) -> list[Ranked]:
        found = [judged(_changed(readings, each), each, parts, robot.beam_width_rad) for each in some_of]
        least = SCALED * next(each.share for each in found if each.variant.name == AS_GIVEN)
        kept = (each for each in found if each.variant.times == 1 or each.share > least)
        return sorted(kept, key=lambda each: -each.share)

    parts = some(windows(readings), MOST_PARTS)
    first = best_first(different, some(parts, FEW_PARTS))
    if hasty and first[0].variant.name == AS_GIVEN:
        return first
    kept = [each.variant for i, each in enumerate(first) if i < KEPT or each.variant.name == AS_GIVEN]
    return best_first(kept, parts) + [each for each in first if not any(each.variant is one for one in kept)]


def taken(ranks: list[Ranked]) -> Ranked:
    """The sharpest, if it is so beyond doubt; else what was given."""
    given = next(each for each in ranks if each.variant.name == AS_GIVEN)
    return ranks[0] if ranks[0].surely_over(given) else given


def judged(
    readings: Readings, variant: Variant, parts: list[slice], beam_width: float, most: int = MOST_WALLS
) -> Ranked:
    """How sharp the walls (``most`` a part) are of a drive with the poses of a variant; beam width in rad."""
    ranges, half = readings.only(parts).near(), max(beam_width / 2, np.deg2rad(8.0)) + np.deg2rad(4.0)
    walls = find(compose(readings.poses, variant.mounts), ranges, parts, half, most)
    touching = np.array(
        [np.sum((walls.frame >= part.start) & (walls.frame < part.stop)) for part in parts], dtype=int
    )
    return Ranked(variant, touching, float(touching.sum()) / max(int(np.isfinite(ranges).sum()), 1))


def _alike(one: Variant, other: Variant) -> bool:
    same = (one.poses, one.late_s, one.times) == (other.poses, other.late_s, other.times)
    return same and bool(
        np.abs(one.mounts[:, :2] - other.mounts[:, :2]).max() < SAME_M
        and np.abs(np.exp(1j * one.mounts[:, 2]) - np.exp(1j * other.mounts[:, 2])).max() < SAME_M
    )


def applied(readings: Readings, robot: Robot, variant: Variant) -> tuple[Readings, Robot]:
    """A drive and its robot as a variant has them."""
    return _changed(readings, variant), replace(robot, mounts=variant.mounts)


def _changed(readings: Readings, variant: Variant) -> Readings:
    if variant.times != 1:
        return replace(readings, ranges=readings.ranges * variant.times)
    if variant.late_s:
        return replace(readings, poses=_sooner(readings, variant.late_s))
    return replace(readings, poses=readings.poses * POSES[variant.poses]) if variant.poses else readings


def _sooner(readings: Readings, late_s: float) -> Float[ndarray, "frames sonars 3"]:
    """Where the robot was so much before each reading, between the poses that are known; at the ends where it was."""
    at = np.interp(readings.stamps - late_s, readings.stamps, np.arange(len(readings.stamps)))
    before = np.minimum(at.astype(int), max(len(at) - 2, 0))
    after, share = np.minimum(before + 1, len(at) - 1), (at - before)[:, None, None]
    step = readings.poses[after] - readings.poses[before]
    step[..., 2] = wrap(step[..., 2])
    return readings.poses[before] + share * step
