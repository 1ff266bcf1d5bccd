"""What the numbers of frames and maps may be, whoever hands them over: a file, a command or a program."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.yaml_keys import shown

# Milliseconds since 1970 stand at 1.7e12, so that a stamp in a wrong unit is found.
MOST_STAMP_S, MOST_M, MOST_RAD = 1e11, 1e7, 1e7
"""No stamp, no coordinate and no heading of a pose is farther from 0."""

MOST_RANGE_M = 100.0
"""No range is longer; ranges in mm nearly all are."""


@dataclass(frozen=True)
class Limits:
    """Where a number lies, ends included, and its unit."""

    low: float
    high: float
    unit: str

    def check(self, value: object, where: str) -> float:
        """The value as a float, or a UsageError that begins with ``where``; what is no number is refused likewise."""
        number = as_real(value)
        if number is None or not self.low <= number <= self.high:
            found = shown(value) if number is None else f"{number:g}"
            raise UsageError(f"{where}: found {found}, expected {self.low:g} to {self.high:g} {self.unit}")
        return number


def as_real(value: object) -> float | None:
    """A number of Python or numpy as a float, None for anything else; True is no number."""
    numbers = as_reals(value)
    return float(numbers) if numbers is not None and not numbers.ndim else None


def as_reals(value: object) -> Float[ndarray, "*n"] | None:
    """Numbers in whatever array or list as an array of floats, None for anything else; what is masked is nan."""
    try:
        array = np.asanyarray(value)
    except Exception:  # what others' arrays raise that cannot become numpy's
        return None
    if array.dtype.kind not in "iuf":
        return None
    return np.asarray(np.ma.filled(array.astype(float), np.nan))


RESOLUTION, HALF_LIFE = Limits(0.005, 10, "m"), Limits(0.1, 1e7, "s")
"""Side of the cells of a map, and time in which its evidence comes to count half."""
