"""Places that an explorer leaves alone for now: nothing new was seen there, or it did not get there."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

SAME_M = 0.6
"""Places so near to each other are the same, a moment later."""

TRIES = 2
"""A place that was left alone so often is not tried again."""


@dataclass
class _Aside:
    place: Float[ndarray, "2"]
    tries: int
    levels: list[int]
    forgiven: bool = False


class Asides:
    """The places that are left alone, each at some levels of daring and at all that dare less."""

    def __init__(self, covers: Callable[[int, int], bool]) -> None:
        """None yet.

        Args:
            covers: whether the first of two levels dares all that the second does.
        """
        self._covers = covers
        self._places: list[_Aside] = []

    def add(self, place: Float[ndarray, "2"], *levels: int) -> None:
        """Leave a place (m) alone, at some levels and all that these cover."""
        for one in self._places:
            if np.linalg.norm(one.place - place) < SAME_M:
                one.tries, one.forgiven = one.tries + 1, False
                one.levels += levels
                return
        self._places.append(_Aside(place, 1, list(levels)))

    def forgive(self) -> None:
        """Try once more what was left alone once: by now more is known around it."""
        for one in self._places:
            one.forgiven = one.tries < TRIES

    def holds(self, place: Float[ndarray, "2"], level: int) -> bool:
        """Whether a place (m) is left alone at a level."""
        return any(
            not one.forgiven
            and any(self._covers(tried, level) for tried in one.levels)
            and np.linalg.norm(one.place - place) < SAME_M
            for one in self._places
        )
