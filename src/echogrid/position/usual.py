"""How well what is heard usually agrees with a map, and when it does so no longer."""

from math import sqrt

KNOWN_AFTER, MEMORY = 12, 40
"""Pieces after which it is known what is usual, and those that count."""

POOR, LEAST = 2.5, 3.0
"""Agreement that lies so many standard deviations below its mean is poor; and their least, as a log-likelihood."""


class Usual:
    """Mean and spread of the agreement of a robot that is where it is thought to be."""

    def __init__(self) -> None:
        self._count, self._mean, self._variance = 0, 0.0, 0.0

    def poor(self, agreement: float) -> bool:
        """Whether an agreement (a log-likelihood) is one that is hardly ever met where the place is right."""
        spread = max(sqrt(self._variance), LEAST)
        return self._count >= KNOWN_AFTER and agreement < self._mean - POOR * spread

    def add(self, agreement: float) -> None:
        """Take an agreement for one that is usual."""
        self._count += 1
        rate = 1 / min(self._count, MEMORY)
        off = agreement - self._mean
        self._mean += rate * off
        self._variance = (1 - rate) * (self._variance + rate * off**2)
