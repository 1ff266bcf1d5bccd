"""What goes along while a log is mapped, and makes a file of its own of the drive and the map as it grew."""

from typing import Protocol, runtime_checkable

from echogrid.frame import Frame
from echogrid.grid import Grid

SILENT_M = 2.5
"""No echo is drawn as a cone of this length: how far it reaches is not known, and long cones hide the map."""

MAX_MAPS, MAX_MAP_CELLS = 60, 100_000_000
"""At most so many maps, the last among them, and before the last at most so many cells in all of them together."""

MAP_PERIOD_S, MAP_PERIOD_SHARE = 5.0, 0.15
"""From one map to the next passes at least the first, and at least this share of the drive so far: so few maps cover
a drive of any length, and its lively beginning densely."""


@runtime_checkable
class Follower(Protocol):
    """Sees each frame as it is read and the map as often as there is a new one."""

    def add(self, frame: Frame) -> None:
        """Take the next frame."""

    def keep(self, grid: Grid) -> None:
        """Take the map so far."""

    def finish(self, grid: Grid) -> None:
        """Take the finished map."""


class Pace:
    """Picks few of the many maps of a growing drive, see MAX_MAPS."""

    def __init__(self) -> None:
        self._first: float | None = None
        self._due = 0.0
        self._maps = self._cells = 0

    def due(self, stamp: float, cells: int) -> bool:
        """Whether to take the map of that time (s) with so many cells; the first call begins to count."""
        if self._first is None:
            self._first, self._due = stamp, stamp + MAP_PERIOD_S
        if stamp < self._due or not cells or self._maps + 1 >= MAX_MAPS or self._cells + cells > MAX_MAP_CELLS:
            return False
        self._due = stamp + max(MAP_PERIOD_S, MAP_PERIOD_SHARE * (stamp - self._first))
        self._maps, self._cells = self._maps + 1, self._cells + cells
        return True
