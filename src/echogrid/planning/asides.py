"""Places that an explorer leaves alone for now: nothing new was seen there, or it did not get there."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

SAME_M = 0.6
"""Places so near to each other are the same, a moment later."""

TRIES = 2
"""A place that was left alone so often at a level is not tried there again."""


@dataclass
class _Aside:
    place: Float[ndarray, "2"]
    tries: Counter[int] = field(default_factory=Counter)
    """How often it was left alone, by level."""
    held: set[int] = field(default_factory=set)
    """Levels at which it is now."""


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
        one = next((one for one in self._places if np.linalg.norm(one.place - place) < SAME_M), None)
        if one is None:
            self._places.append(one := _Aside(place))
        one.tries.update(levels)
        one.held.update(levels)

    def forgive(self, which: Callable[[Float[ndarray, "2"], set[int]], bool] = lambda _place, _levels: True) -> bool:
        """Let what was left alone once be tried once more: by now more is known around it. Whether anything was.

        Args:
            which: whether a place (m) that is left alone at some levels is to be.
        """
        before = [len(one.held) for one in self._places]
        for one in self._places:
            if which(one.place, one.held):
                one.held = {level for level in one.held if one.tries[level] >= TRIES}
        return before != [len(one.held) for one in self._places]

    def holds(self, place: Float[ndarray, "2"], level: int) -> bool:
        """Whether a place (m) is left alone at a level."""
        return any(
            any(self._covers(held, level) for held in one.held) and np.linalg.norm(one.place - place) < SAME_M
            for one in self._places
        )
