"""What a look at a drive found, in lines: what, where, how much, and what to do."""

from collections.abc import Iterator

import numpy as np

from echogrid.calibration.calibrate import SURE, WIDE_SCALE, Calibration
from echogrid.calibration.health import Health
from echogrid.calibration.variants import AS_GIVEN, GAIN, Ranked

DOUBTED = 1.5
"""From so many standard deviations on it is told that another variant than the given one is likelier."""

SCALE_OFF = 0.005

SHORT_M = 15.0
"""On a shorter way swapped sonars may not be found: of simulated drives they were not in 13 of 40 shorter ones, and
in none of 120 longer ones."""


def of_health(health: Health) -> Iterator[str]:
    """What is amiss with sonars."""
    kinds = (
        (health.silent, "no valid reading", None, "is it connected? leave it out, or mend it"),
        (health.dead & ~health.silent, "no echo ever, though others hear some", None,
         "is it blind, covered, or too weak?"),
        (health.stuck, "one value wherever the robot is", "value",
         "has its driver died, or does it see the robot?"),
        (health.stale, "old values again while the robot moves", "repeats", "poll it no faster than it measures"),
        (health.cross_talk, "short readings among steady ones", "spikes",
         "does it hear the pulses of others? fire in turn"),
    )  # fmt: skip
    for which, what, told, remedy in kinds:
        if not which.any():
            continue
        much = ""
        if told == "value":
            much = f" ({health.value[which][0]:g} m)"
        elif told:
            much = f" (in up to {np.max(getattr(health, told)[which]):.0%} of its echoes)"
        yield f"{_named(np.flatnonzero(which).tolist())}: {what}{much}: {remedy}"


def _named(sonars: list[int]) -> str:
    shown = ", ".join(f"r{i}" for i in sonars[:8])
    more = f" and {len(sonars) - 8} more" if len(sonars) > 8 else ""
    return f"{shown}{more}"


def of_order(ranks: list[Ranked]) -> Iterator[str]:
    """Whether walls are sharper if the mounts, or the poses, are otherwise than given."""
    given, first = next(each for each in ranks if each.variant.name == AS_GIVEN), ranks[0]
    if first is given or first.share < GAIN * given.share or first.over(given) < DOUBTED:
        return
    sure = f"{first.share:.0%} of the echoes touch walls then, {given.share:.0%} as given"
    if first.surely_over(given):
        yield f"{first.variant.name} ({sure}; {first.over(given):.1f} standard deviations)"
    else:
        yield f"perhaps {first.variant.name} ({sure}, which may be chance): a longer log tells"


def of_swaps(found: Calibration) -> Iterator[str]:
    """Which sonars sit at others' mounts."""
    if found.swapped:
        pairs = ", ".join(f"r{sonar} at the mount of r{seat}" for sonar, seat in found.swapped)
        yield f"sonars are swapped: {pairs}: change their order in the robot file, or their cables"


def of_ranges(found: Calibration) -> Iterator[str]:
    """Whether ranges and poses have one scale."""
    if found.unsure or not found.scale_told:
        return
    scale, sd = found.places.scale, found.scale_sd
    if abs(scale - 1) > max(SCALE_OFF, SURE * sd):
        what = f"ranges read {scale:.4f} m a metre of the poses (+-{SURE * sd:.4f})"
        yield f"{what}: divide them by it, or multiply the poses; which of the two is wrong no log tells"


def untold(found: Calibration) -> Iterator[str]:
    """What cannot be told from the log."""
    yield "an offset of all ranges, and how far out all sonars sit: walls move with them; a tape tells"
    if found.unsure:
        yield f"mounts, beam, range scale: {found.unsure}; left as given: drive along straight, best smooth walls"
        return
    if found.way_m < SHORT_M and not found.swapped:
        yield f"swapped sonars: in {found.way_m:.0f} m of way they may pass for mounts that are off: drive 30 m"
    if found.soft:
        soft = np.rad2deg(found.beams.soft)
        yield f"the beam: its edge is soft by {soft:.1f} degrees, as before rough walls; left as given"
    if not found.scale_told:
        yield f"the range scale to better than {WIDE_SCALE:.0%}: drive straight at walls, and away from them"
    turned, moved = ~found.told[:, 2], ~found.told[:, 0]
    for which, what in ((turned, "axis to better than 5 degrees"), (moved, "place to better than 5 cm")):
        if which.any():
            names = _named(np.flatnonzero(which).tolist())
            yield f"of {names} the {what}, left as given: turn the robot beside a wall, both ways"
