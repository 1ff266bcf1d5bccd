"""The set network: one set of weights for any array.

It asks, for a bearing round the robot, the sonars that look nearest to it, as a set: a token a sonar, one encoder
for all, attention and relations between their readings. It answers with the evidence along the whole bearing, as
profiles before and behind each echo, so that walls come out as sharp as the readings are, whatever the cells.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.models.networks.memory import TRAITS

TOKENS = 6
"""Sonars that are asked for a bearing."""

LIMIT = 4.0
"""Log-odds at which the evidence of one scan levels off."""

AT_M = 1.2
"""The sonars of a bearing are those whose axes point nearest to its point at this distance from the robot."""

TIE_RAD = 1e-5
"""A sonar that looks so nearly along a bearing, or away from it, has it on its left, whatever rounding makes of
it."""

STEPS_M = np.array([-0.5, -0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2, 0.45])
"""Knots of the profile of an echo: distance beyond it. Before the first the profile is flat, at the last it is 0."""

RINGS_M = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.6, 2.0, 2.5])
"""Knots of the profile that is not bound to an echo: distance from the robot."""

FUSE_UNITS = 12
"""Units of the layer that fuses views."""

HIDDEN_UNITS = 24
"""Units of each layer."""

LOOKS = 24.0
"""Looks at a point after which more of them, from wherever they come, hardly make the map surer. Views of one place
repeat each other's errors, and a wall that is driven past thirty times is the same wall."""

BEAM_RAD = 0.22
"""Half a common beam width, which a token's is compared with."""

FEATURES = 20
"""Numbers that the encoder is told of a token."""

Weights = dict[str, Any]
"""Arrays by name; see ``initial``."""


def nearest(
    mounts: Float[ndarray, "*n sonars 3"], bearing: Float[ndarray, "bearings"]
) -> Int[ndarray, "*n bearings tokens"]:
    """Indices of the sonars whose axes point nearest to each bearing, the nearest first; -1: no more."""
    x, y, axis = (mounts[..., None, :, k] for k in range(3))
    off = np.arctan2(AT_M * np.sin(bearing)[:, None] - y, AT_M * np.cos(bearing)[:, None] - x) - axis
    off = np.abs(wrap(off))
    missing = max(0, TOKENS - off.shape[-1])
    off = np.pad(np.where(np.isnan(off), 9.0, off), [(0, 0)] * (off.ndim - 1) + [(0, missing)], constant_values=9.0)
    # Ties are broken by the index, whatever rounding makes of them.
    index = np.argsort(np.round(off, 6), axis=-1, kind="stable")[..., :TOKENS]
    return np.where(np.take_along_axis(off, index, axis=-1) < 9.0, index, -1)


def initial(rng: np.random.Generator, hidden: int = HIDDEN_UNITS) -> Weights:
    """Random weights; the network begins by saying nothing."""
    h = hidden

    def dense(m: int, n: int, gain: float = 1.4) -> Float[ndarray, "m n"]:
        return (gain / np.sqrt(m) * rng.standard_normal((m, n))).astype(np.float32)

    zero = lambda n: np.zeros(n, dtype=np.float32)  # noqa: E731
    return {
        "w1": dense(FEATURES, h),
        "b1": zero(h),
        "a1": dense(h, 2, 1.0),
        "w2": dense(h, h),
        "w2p": dense(2 * h, h, 0.7),
        "w2t": dense(TRAITS, h, 0.7),
        "b2": zero(h),
        "a2": dense(h, 2, 1.0),
        "wp": dense(h, len(STEP_BENDS), 0.05),
        "bp": zero(len(STEP_BENDS)),
        "w3": dense(2 * h, h),
        "b3": zero(h),
        "ws": np.ones(1, dtype=np.float32),
        "wf": dense(4, FUSE_UNITS, 1.0),
        "bf": np.linspace(0.5, -3.0, FUSE_UNITS, dtype=np.float32),
        "wz": dense(FUSE_UNITS, 1, 0.02),
        "wr": dense(h, len(RINGS_M), 0.05),
        "br": zero(len(RINGS_M)),
    }


def _bends(knots: Float[ndarray, "knots"]) -> Float[ndarray, "knots bends"]:
    """From values at knots to the piecewise linear function through them, flat outside, as ``_bent`` takes it."""
    slopes = np.diff(np.eye(len(knots)), axis=0) / np.diff(knots)[:, None]
    changes = np.diff(np.pad(slopes, [(1, 1), (0, 0)]), axis=0)
    return np.concatenate([np.eye(len(knots))[:1], changes]).T.astype(np.float32)


# An echo's profile ends at 0.
STEP_BENDS = _bends(STEPS_M)[:-1]
RING_BENDS = _bends(RINGS_M)


def saturated(looks: Any, *sums: Any, xp: Any = np) -> tuple[Any, ...]:
    """Sums of evidence, brought down to what so many looks are worth; see LOOKS."""
    share = -LOOKS * xp.expm1(-looks / LOOKS) / xp.maximum(looks, 1e-6)
    return tuple(share * total for total in sums)


def fused(w: Weights, occupied: Any, free: Any, occupied2: Any, free2: Any, xp: Any = np) -> Any:
    """Log-odds of points from the sums of all views' evidence for a surface and against it, and of its squares.

    Where views are independent the difference of the sums is Bayes' rule; they are not: what tells mirrors from
    free space is how much of either there is. The sums are ``saturated``. ``xp``: numpy or jax.numpy.
    """
    told = [xp.log1p(v) for v in (occupied, free, occupied2, free2)]
    total = w["ws"][0] * (occupied - free)
    for i in range(FUSE_UNITS):
        total = total + w["wz"][i, 0] * xp.maximum(
            sum(w["wf"][j, i] * v for j, v in enumerate(told)) + w["bf"][i], 0.0
        )
    return total
