"""What a sensor model is to the mapper: the one seam between what readings say and the map that holds it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.grid import P_MIN, GrowingGrid, Layers
from echogrid.models.batches import apart, near_each_other
from echogrid.robot import Robot

LOOK_RAD = np.deg2rad(30.0)
"""To the networks a point farther than this off the axes of all sonars that fired is one that no sonar looks at."""

CONE_RAD = LOOK_RAD + np.deg2rad(15.0)
"""Where the range of sonars ends within a network's local map, none tells of anything farther off its axis than this:
where it looks, and as much as that takes to fade."""


class Evidence(NamedTuple):
    """What a batch of scans adds to the map."""

    corner: Int[ndarray, "2"]
    """Global cell [row, col] of the first cell of the window that it tells of."""
    end: Int[ndarray, "2"]
    """Global cell behind its last."""
    told: Any
    """What is told, in the model's own terms."""


class Fusion(ABC):
    """A sensor model at work on one drive: it reads batches of scans, and fuses what they tell into the map.

    Batches are read in their order, worked out in any, side by side, and fused in their order.
    """

    blank: Layers
    """Layers that its cells have besides those of every map, see ``GrowingGrid``."""
    side_by_side: ClassVar[bool] = True
    """Whether batches are worth working out side by side; not where the work is done in ``fuse``."""
    reach_cells: int = 0
    """How far, at most, the window of ``Evidence`` reaches past the places of the robot in its scans."""
    cell_m: float | None = None
    """Side of the cells in which it fuses, m, where that is its own; None: what the map is asked for."""

    def __init__(self, robot: Robot):
        self.equip(robot)

    def equip(self, robot: Robot) -> None:
        """Take the scans that follow for those of this array; its mounts are in the order of the readings."""
        self.robot = robot

    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        """Frames in their order, as many together as ``read`` takes at once."""
        return near_each_other(apart(frames, self.robot))

    @abstractmethod
    def read(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        """Note a batch; what is returned works out, in any thread, what it tells.

        Args:
            batch: scans as of ``batches``.
            filled: whether a small batch is to be worked out like a full one: of many batches one compilation then
                serves all, which takes a second or more.
        """

    @abstractmethod
    def fuse(self, grown: GrowingGrid, evidence: Evidence) -> None:
        """Add what a batch tells to a map in which its window has been reserved."""

    def changed(self, corner: Int[ndarray, "2"], end: Int[ndarray, "2"]) -> None:  # noqa: B027
        """Cells ``corner <= [row, col] < end`` hold something else, and are to be read out anew."""

    def read_out(self, grown: GrowingGrid, corner: Int[ndarray, "2"], shape: tuple[int, int]) -> None:  # noqa: B027
        """Bring ``log_odds`` and ``observed`` of a rectangle of cells up to date; most models fuse in full.

        Args:
            grown: the map; all of the rectangle has been reserved in it.
            corner: the first cell [row, col], counted from the world's origin.
            shape: rows and columns.
        """


class Model(ABC):
    """A sensor model: a network with its weights, or a model from the literature with its parameters."""

    cell_m: ClassVar[float] = 0.12
    """Side (m) of the cells that its map has unless another is asked for."""
    p_min: ClassVar[float] = P_MIN
    """Least probability that its map is read out with; the greatest is 1 - this."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name for reports."""

    @abstractmethod
    def told(self) -> dict[str, Any]:
        """What a run's record says of it."""

    @abstractmethod
    def fusion(self, robot: Robot, resolution: float, half_life: float | None = None) -> Fusion:
        """Begin a drive.

        Args:
            robot: the robot that drives.
            resolution: side of a cell of the map, m.
            half_life: time in which evidence comes to count half, s; None: it never fades.

        Raises:
            UsageError: evidence is to fade of a model whose evidence cannot.
        """

    def refuse_fading(self, half_life: float | None) -> None:
        """Raise a UsageError if evidence is to fade; for models whose evidence cannot."""
        if half_life is not None:
            raise UsageError(f"map: found model {self.name}, expected the set network, whose evidence can fade")
