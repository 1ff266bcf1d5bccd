"""Which sonars sit at each other's mounts: each reading tried at each mount, before walls that all have found."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.calibration.beams import LEAST_CHANCES, NEAREST_M, Beams
from echogrid.calibration.readings import Readings
from echogrid.calibration.walls import Walls
from echogrid.geometry import compose, wrap

NEAR_M, SOFT_RAD = 0.05, np.deg2rad(3.0)
"""How far off places and axes may be that are only to be told from those of other sonars."""


def agreement(
    readings: Readings, mounts: Float[ndarray, "sonars 3"], beams: Beams, scale: float, walls: Walls, miss_m: float
) -> Float[ndarray, "sonars mounts"]:
    """How well each sonar's readings fit each mount: log-likelihood a wall over that of hearing by chance."""
    n, gate = readings.sonars, max(NEAR_M, 2 * miss_m)
    blurred = replace(beams, soft=max(beams.soft, SOFT_RAD))
    out = np.zeros((n, n))
    parts = walls.parts()
    fresh = readings.fresh & ~np.isnan(readings.ranges)
    for sonar in range(n):
        for mount in range(n):
            off, heard = [np.zeros(0)], [np.zeros(0, dtype=bool)]
            for first, last, which in parts:
                f, w = (each.ravel() for each in np.meshgrid(np.arange(first, last), which, indexing="ij"))
                at = compose(readings.poses[f, sonar], mounts[mount])
                distance, to, along = walls.seen(w, at[:, :2])
                miss = readings.ranges[f, sonar] / scale - distance
                ok = walls.faces(w, along) & fresh[f, sonar]
                ok &= (miss > -gate) & (distance > NEAREST_M)
                turned = wrap(np.arctan2(to[:, 1], to[:, 0]) - at[:, 2])
                ok &= np.abs(turned) < 3 * beams.half
                off.append(turned[ok])
                heard.append(miss[ok] < gate)
            y, share = np.concatenate(heard), np.clip(blurred.share(np.concatenate(off)), 1e-3, 1 - 1e-3)
            if len(y) >= LEAST_CHANCES:
                chance = np.clip(np.mean(share), 1e-3, 1 - 1e-3)
                told = np.where(y, np.log(share / chance), np.log((1 - share) / (1 - chance)))
                out[sonar, mount] = float(np.mean(told))
    return out


def likely_pairs(agreement: Float[ndarray, "sonars mounts"], most: int) -> list[tuple[int, int]]:
    """Pairs of sonars that agree better with each other's mounts than with their own, the most so first."""
    own = np.diag(agreement)
    gain = agreement + agreement.T - own[:, None] - own
    one, two = np.triu_indices(len(own), 1)
    order = np.argsort(-gain[one, two])[:most]
    return [(int(one[k]), int(two[k])) for k in order if gain[one[k], two[k]] > 0]
