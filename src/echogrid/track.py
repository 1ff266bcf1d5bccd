"""Where a drive went, as a line of few corners that stays near it."""

from math import asin, atan2, hypot, inf, pi

import numpy as np
from jaxtyping import Float
from numpy import ndarray

NEAR_M = 0.02
"""A line of at most MOST corners passes every pose within this distance, and is nowhere farther from the drive."""

MOST = 100_000
"""Corners that are kept; of a drive with more they are taken again by twice the distance, and so on."""


class Track:
    """A drive of any length, kept to a bounded number of corners.

    From one corner to the next the drive stays in a cone that is as narrow as the line is to be near, and goes on in
    it (Sklansky & Gonzalez, 1980): so the line leaves out what it passes within ``near`` metres, and nothing else.
    """

    def __init__(self, near: float = NEAR_M, most: int = MOST) -> None:
        self.near, self._most = near, most
        self._corners: list[tuple[float, float]] = []
        self._last = (0.0, 0.0)
        self._begin()

    def _begin(self) -> None:
        """Nothing is known of the way on from the last corner."""
        self._far, self._axis, self._low, self._high = 0.0, 0.0, -inf, inf

    def add(self, x: float, y: float) -> None:
        """Go on to a place, m, world."""
        if not self._corners:
            self._corners.append((x, y))
        elif not self._goes_on(x, y):
            self._corners.append(self._last)
            if len(self._corners) >= self._most:
                self._coarsen()
            self._begin()
            self._goes_on(x, y)
        self._last = (x, y)

    def _goes_on(self, x: float, y: float) -> bool:
        """Whether a straight line from the last corner to here is near to all between; if so, this is between too."""
        x0, y0 = self._corners[-1]
        far = hypot(x - x0, y - y0)
        if far < self._far:
            return False
        if far <= self.near:
            return True
        if not self._far:
            self._axis = atan2(y - y0, x - x0)
        turn = (atan2(y - y0, x - x0) - self._axis + pi) % (2 * pi) - pi
        if not self._low <= turn <= self._high:
            return False
        half = asin(self.near / far)
        self._far, self._low, self._high = far, max(self._low, turn - half), min(self._high, turn + half)
        return True

    def _coarsen(self) -> None:
        coarser = Track(2 * self.near, self._most)
        for corner in self._corners:
            coarser.add(*corner)
        self.near, self._corners = coarser.near, [*coarser._corners, coarser._last]

    def points(self) -> Float[ndarray, "n 2"]:
        """x, y of the corners, m, world: from where the drive began to where it is."""
        end = [self._last] if self._corners and self._corners[-1] != self._last else []
        return np.array([*self._corners, *end]).reshape(-1, 2)


def line_of(path: Float[ndarray, "poses 2"], near: float) -> Float[ndarray, "fewer 2"]:
    """The corners of a line that stays within ``near`` metres of a path."""
    track = Track(near)
    for x, y in path.tolist():
        track.add(x, y)
    return track.points()
