"""Means over rooms and what is sure of them: 95 % intervals by the bootstrap."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

RESAMPLES = 2000


def interval(values: Float[ndarray, "rooms"], rng: np.random.Generator) -> list[float] | None:
    """Mean over rooms and its interval, rounded; rooms that have no value are left out, None if none has one."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    means = values[rng.integers(0, values.size, (RESAMPLES, values.size))].mean(axis=1)
    return [round(float(v), 4) for v in (values.mean(), *np.quantile(means, [0.025, 0.975]))]


def against(
    network: Float[ndarray, "rooms"], other: Float[ndarray, "rooms"], rng: np.random.Generator
) -> dict[str, list[float | None] | None]:
    """Ratio and difference of two means over the same rooms, with intervals, rounded; a ratio to 0 (inf) is None."""
    drawn = rng.integers(0, len(other), (RESAMPLES, len(other)))
    ours, theirs = network[drawn].mean(axis=1), other[drawn].mean(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.append(network.mean(), ours) / np.append(other.mean(), theirs)
    differences = np.append(network.mean() - other.mean(), ours - theirs)
    found: dict[str, list[float | None] | None] = {}
    for name, values in {"ratio": ratios, "difference": differences}.items():
        # Of 0 to 0 nothing can be said; the rest of the draws say what there is to say.
        drawn_values = values[1:][~np.isnan(values[1:])]
        if np.isnan(values[0]) or not drawn_values.size:
            found[name] = None
            continue
        low, high = np.quantile(drawn_values, [0.025, 0.975], method="nearest")
        found[name] = [None if np.isinf(v) else round(float(v), 4) for v in (values[0], low, high)]
    return found
