"""What a cell of the set network's map holds, read with what lies round it.

A cell's own sums say what its views saw; a wall goes straight on, has free floor on one side at least, and is as thin
as its face. A small stack of dilated convolutions reads the sums of a neighbourhood and corrects the cell's log-odds:
the heir of the paper's neighbourhood mask, learnt on maps of simulated drives.

Cells are taken four together, so that the stack works on squares of 8 cm where cells have 4, and are told apart again
at its end.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.models.networks.set_layers import BEAM_RAD, LOOKS

PACK = 2
"""Cells along the side of a square that the stack works on."""

UNITS = 16
"""Channels of the stack."""

DILATIONS = (1, 2, 4, 8, 1)
"""Of its layers, in squares."""

REACH = PACK * sum(DILATIONS)
"""Cells within which the surroundings count."""

FEATURES = 7
"""Numbers that the stack is told of a cell."""

TOLD = 4
"""Numbers that it is told of the array."""

PASSED = 4
"""Numbers that it hands to each cell."""

CELL_UNITS = 8
"""Units of the last layer, which each cell has for itself."""

Weights = dict[str, Any]


def initial(rng: np.random.Generator) -> Weights:
    """Random weights; the stack begins by correcting nothing."""

    def dense(*shape: int, gain: float = 1.4) -> Float[ndarray, "..."]:
        return (gain / np.sqrt(np.prod(shape[:-1])) * rng.standard_normal(shape)).astype(np.float32)

    zero = lambda n: np.zeros(n, dtype=np.float32)  # noqa: E731
    weights: Weights = {
        "si": dense(PACK**2 * FEATURES, UNITS),
        "sa": dense(TOLD, UNITS, gain=0.5),
        "sb": zero(UNITS),
        "so": dense(UNITS, PACK**2 * PASSED, gain=0.7),
        "cw": dense(FEATURES + PASSED, CELL_UNITS),
        "cb": zero(CELL_UNITS),
        "co": dense(CELL_UNITS, 1, gain=0.05),
        "cs": np.ones(1, dtype=np.float32),
    }
    for i, _ in enumerate(DILATIONS):
        weights |= {f"s{i}": dense(9, UNITS, UNITS, gain=0.5), f"s{i}b": zero(UNITS)}
    return weights


def features(
    sums: Any, looks: Float[Any, "*n"], log_odds: Float[Any, "*n"], covered: Float[Any, "*n"], xp: Any = np
) -> Float[Any, "*n features"]:
    """What the stack is told of cells.

    Args:
        sums: the four sums of evidence, ``saturated``.
        looks: what the looks at each cell count.
        log_odds: of each cell alone, ``fused``.
        covered: 1 where the robot has stood, else 0.
        xp: numpy or jax.numpy.
    """
    told = [xp.log1p(each) for each in sums]
    return xp.stack([*told, log_odds / 4, xp.log1p(looks) / np.log1p(LOOKS), covered], axis=-1)


def told_of(beam_width: float, max_range: float, mounts: Float[ndarray, "sonars 3"]) -> Float[ndarray, "told"]:
    """What the stack is told of an array.

    How wide its beams are (rad), how far they reach (m), how many there are, and whether they look all round (0) or
    one way (1): from such an array walls beside the path look like free floor.

    Args:
        beam_width: rad.
        max_range: m.
        mounts: m and rad; nan: no such sonar.
    """
    axis = mounts[~np.isnan(mounts[:, 2]), 2]
    one_way = abs(np.mean(np.exp(1j * axis))) if axis.size else 0.0
    told = [np.log(beam_width / 2 / BEAM_RAD), min(max_range, 4.0) / 4, min(axis.size, 24) / 24, one_way]
    return np.array(told, np.float32)


def corrected(
    w: Weights, told: Float[Any, "*b rows cols features"], array: Float[Any, "*b told"], xp: Any = np
) -> Float[Any, "*b rows cols"]:
    """Log-odds of cells by their surroundings; what lies past the rim counts as unknown.

    Args:
        w: as of ``initial``.
        told: of cells, see ``features``; rows and columns are even, the first cell has even indices in the world.
        array: as of ``told_of``.
        xp: numpy or jax.numpy.
    """
    *lead, rows, cols, _ = told.shape
    high, wide = rows // PACK, cols // PACK
    packed = told.reshape(*lead, high, PACK, wide, PACK, FEATURES)
    packed = xp.moveaxis(packed, -4, -3).reshape(*lead, high, wide, PACK**2 * FEATURES)
    h = xp.maximum(packed @ w["si"] + (array @ w["sa"] + w["sb"])[..., None, None, :], 0.0)
    for i, dilation in enumerate(DILATIONS):
        h = xp.maximum(h + _convolved(w[f"s{i}"], h, dilation, xp) + w[f"s{i}b"], 0.0)
    passed = (h @ w["so"]).reshape(*lead, high, wide, PACK, PACK, PASSED)
    passed = xp.moveaxis(passed, -4, -3).reshape(*lead, rows, cols, PASSED)
    own = xp.maximum(xp.concatenate([told, passed], axis=-1) @ w["cw"] + w["cb"], 0.0)
    return (w["cs"] * 4 * told[..., 4]) + (own @ w["co"])[..., 0] + passed[..., 0]


def _convolved(w: Float[Any, "9 m k"], h: Float[Any, "*b rows cols m"], dilation: int, xp: Any) -> Any:
    """A convolution of 3 x 3 with holes, as nine products of matrices."""
    *lead, rows, cols, _ = h.shape
    padded = xp.pad(h, [(0, 0)] * len(lead) + [(dilation, dilation), (dilation, dilation), (0, 0)])
    total = 0.0
    for tap in range(9):
        row, col = (dilation * k for k in divmod(tap, 3))
        total = total + padded[..., row : row + rows, col : col + cols, :] @ w[tap]
    return total
