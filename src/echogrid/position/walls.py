"""In which direction walls run: in most buildings all stand at right angles, which is as good as a compass."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.position.matching import Field

DISTINCT = 0.75
"""How far the best direction must stand out of the others; less is no direction."""

LEAST_POINTS, MOST_POINTS = 100, 80
"""Surface points that a direction needs, and those that each piece is to bring at most."""

BIN_M = 0.08
STEP_RAD = np.deg2rad(1.5)
QUARTER = np.pi / 2


def surface_points(field: Field, most: int, rng: np.random.Generator) -> Float[ndarray, "points 2"]:
    """Middles (m) of at most so many cells of a local map that hold a surface."""
    index = np.argwhere(field.b > 0.3)
    if len(index) > most:
        index = index[rng.choice(len(index), most, replace=False)]
    return (index[:, ::-1] + 0.5) * field.cell_m + field.origin


def direction(points: Float[ndarray, "points 2"]) -> float | None:
    """Direction (rad, in [0, pi / 2)) along which, and across which, surface points lie in lines.

    None where no direction is distinct.
    """
    angle, distinct = sharpest(points)
    return angle if distinct >= DISTINCT else None


def sharpest(points: Float[ndarray, "points 2"]) -> tuple[float, float]:
    """The direction of ``direction``, and how far it stands out of the others.

    Projected onto an axis across a wall its points fall into few bins: the sum of squares of the histograms along
    and across is largest there.
    """
    if len(points) < LEAST_POINTS:
        return 0.0, 0.0
    angles = np.arange(0, QUARTER - 1e-9, STEP_RAD)
    axes = np.concatenate([angles, angles + QUARTER])
    bins = np.floor((points[:, :1] * np.cos(axes) + points[:, 1:] * np.sin(axes)) / BIN_M).astype(int)
    bins -= bins.min()
    width = bins.max() + 1
    counts = np.bincount((bins + np.arange(len(axes)) * width).ravel(), minlength=width * len(axes))
    counts = counts.reshape(len(axes), width).astype(float)
    sharp = ((counts[:, :-1] + counts[:, 1:]) ** 2).sum(axis=1)
    sharp = sharp[: len(angles)] + sharp[len(angles) :]
    i = int(np.argmax(sharp))
    before, best, after = sharp[i - 1], sharp[i], sharp[(i + 1) % len(angles)]
    bend = before - 2 * best + after
    off = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(np.mod(angles[i] + off * STEP_RAD, QUARTER)), float(sharp[i] / np.median(sharp) - 1)


def nearest_quarter(heading: float, to: float) -> float:
    """A heading turned by the right angles that bring it nearest to another, rad."""
    return heading + QUARTER * float(np.round((to - heading) / QUARTER))
