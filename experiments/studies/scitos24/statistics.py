"""What can be said of readings without poses: shares of what they do, and how they are distributed."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

CURVES: dict[str, tuple[str, ndarray]] = {
    "reading": ("reading (m)", np.linspace(0.2, 5.0, 49)),
    "neighbour step": ("step between neighbouring sonars (m)", np.geomspace(0.001, 5.0, 49)),
    "time step": ("step of a sonar from scan to scan (m)", np.geomspace(0.001, 5.0, 49)),
    "second difference": ("second difference in time (m)", np.geomspace(0.001, 5.0, 49)),
    "no echo, sonar": ("no echo of a sonar, share of its scans", np.linspace(0, 1, 51)),
    "no-echo run": ("scans in a row without echo", np.unique(np.geomspace(1, 60, 33).round())),
}
"""What cumulative distributions are drawn of, and where they are read."""

STATISTICS = {
    "no echo": "no echo",
    "neighbours within 2 cm": "neighbours agree within 2 cm",
    "neighbours within 5 cm": "neighbours agree within 5 cm",
    "neighbours beyond 50 cm": "neighbours differ by over 50 cm",
    "steps beyond 10 cm": "step in time over 10 cm",
    "repeats": "exactly the last reading",
    "outliers, long": "outlier in time, over 50 cm too long",
    "outliers, short": "outlier in time, over 50 cm too short",
    "flickers": "10 cm off between two that agree",
    "echo lost": "no echo after an echo",
    "echo found": "echo after no echo",
    "dropouts": "no echo between two that agree",
    "ghosts": "echo between two without",
    "one-scan gaps": "gaps that last one scan",
    "noise": "white error (m)",
}
"""Shares (but for the last), and how the picture names them."""


def share(of: ndarray, among: ndarray | None = None) -> float:
    """How many of those ``among`` which something is asked are so; nan if it is asked of none."""
    asked = of if among is None else of[among]
    return float(np.mean(asked)) if asked.size else np.nan


def samples(r: Float[ndarray, "frames sonars"]) -> dict[str, Float[ndarray, "n"]]:
    """What CURVES draws."""
    second = np.abs(r[2:] - 2 * r[1:-1] + r[:-2])
    values = {
        "reading": r,
        "neighbour step": np.abs(np.roll(r, -1, axis=1) - r),
        "time step": np.abs(np.diff(r, axis=0)),
        "second difference": second,
        "no echo, sonar": np.isnan(r).mean(axis=0),
        "no-echo run": gaps(r),
    }
    return {name: value[~np.isnan(value)] for name, value in values.items()}


def gaps(r: Float[ndarray, "frames sonars"]) -> Float[ndarray, "n"]:
    """Lengths of the runs of scans in which a sonar hears nothing, but for those that the drive's ends cut."""
    lengths = []
    for column in r.T:
        change = np.flatnonzero(np.diff(np.isnan(column).astype(int))) + 1
        run = np.diff(change)
        lengths.append(run[0 if change.size and np.isnan(column[change[0]]) else 1 :: 2])
    return np.concatenate(lengths).astype(float)


def statistics(r: Float[ndarray, "frames sonars"]) -> dict[str, float]:
    """STATISTICS of readings in m (nan = no echo)."""
    neighbour = samples(r)["neighbour step"]
    step = np.abs(np.diff(r, axis=0))
    both = ~np.isnan(step)
    before, here, after = r[:-2], r[1:-1], r[2:]
    agree = np.abs(after - before) < 0.05
    silent = np.isnan(r)
    second = np.abs(before - 2 * here + after)
    run = gaps(r)
    return {
        "no echo": share(silent),
        "neighbours within 2 cm": share(neighbour <= 0.02),
        "neighbours within 5 cm": share(neighbour <= 0.05),
        "neighbours beyond 50 cm": share(neighbour > 0.5),
        "steps beyond 10 cm": share(step > 0.1, both),
        "repeats": share(step < 0.0005, both),
        "outliers, long": share(here - np.maximum(before, after) > 0.5, agree),
        "outliers, short": share(np.minimum(before, after) - here > 0.5, agree),
        "flickers": share(np.minimum(np.abs(here - before), np.abs(here - after)) > 0.1, agree),
        "echo lost": share(silent[1:], ~silent[:-1]),
        "echo found": share(~silent[1:], silent[:-1]),
        "dropouts": share(np.isnan(here), agree),
        "ghosts": share(~np.isnan(here), np.isnan(before) & np.isnan(after)),
        "one-scan gaps": share(run == 1),
        "noise": 1.4826 * float(np.nanmedian(second)) / np.sqrt(6.0),
    }


def cumulative(r: Float[ndarray, "frames sonars"]) -> dict[str, Float[ndarray, "n"]]:
    """CURVES of readings in m (nan = no echo)."""
    return {
        name: np.searchsorted(np.sort(value), CURVES[name][1], side="right") / max(len(value), 1)
        for name, value in samples(r).items()
    }
