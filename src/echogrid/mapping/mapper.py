"""The map of a drive, scan by scan, by any sensor model."""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.grid import Grid, GrowingGrid
from echogrid.models.model import Evidence, Model
from echogrid.robot import Robot


class Mapper:
    """Builds the map of one drive."""

    def __init__(self, robot: Robot, model: Model, resolution: float | None = None, half_life: float | None = None):
        """An empty map.

        Args:
            robot: the robot that drives; its mounts are in the order of the readings.
            model: the sensor model.
            resolution: side of a cell, m; None: the model's own.
            half_life: time in which evidence comes to count half, s; None: it never fades.

        Raises:
            UsageError: evidence is to fade of a model other than the set network.
        """
        self.resolution = resolution or model.cell_m
        self._fusion = model.fusion(robot, self.resolution, half_life)
        self._grown = GrowingGrid(self.resolution, self._fusion.blank)

    @property
    def robot(self) -> Robot:
        """The robot that drives."""
        return self._fusion.robot

    def equip(self, robot: Robot) -> None:
        """Go on with another array of sonars; the map stays, what was remembered of the surroundings does not."""
        self._fusion.equip(robot)

    def add(self, frames: Iterable[Frame]) -> None:
        """Take scans into the map at once, in their order.

        Raises:
            UsageError: a frame has another number of readings than the robot has sonars, or the map would become
                too large.
        """
        for batch in self.batches(frames):
            self.fuse(self.prepare(batch)())

    def batches(self, frames: Iterable[Frame]) -> Iterator[Sequence[Frame]]:
        """Frames in their order, as many together as ``prepare`` takes at once.

        Raises:
            UsageError: a frame has another number of readings than the robot has sonars.
        """
        return self._fusion.batches(self._fitting(frames))

    def _fitting(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        for frame in frames:
            if len(frame.ranges) != self.robot.sonars:
                found = f"a frame of {len(frame.ranges)} readings"
                raise UsageError(f"map: found {found}, expected {self.robot.sonars} (robot {self.robot.name})")
            yield frame

    def prepare(self, batch: Sequence[Frame], filled: bool = False) -> Callable[[], Evidence]:
        """Note a batch; what is returned works out, in any thread, what it tells. See ``Fusion.read``.

        Batches are to be prepared in their order, and what comes of them fused in it.
        """
        return self._fusion.read(batch, filled)

    def fuse(self, evidence: Evidence) -> None:
        """Add what a batch tells.

        Raises:
            UsageError: the map would become too large.
        """
        self._grown.reserve(evidence.corner, evidence.end)
        self._fusion.fuse(self._grown, evidence)

    def grid(self) -> Grid:
        """The map so far: views of the growing arrays, not copies."""
        self._fusion.read_out(self._grown.layers())
        return self._grown.grid()

    def around(self, x: float, y: float, side_m: float) -> Grid:
        """A square of the map round a point, a copy.

        Args:
            x: of the point, m, world.
            y: likewise.
            side_m: side of the square, m; it is filled with what nobody spoke of where the map ends.
        """
        cells = round(side_m / self.resolution)
        corner = np.floor(np.array([y, x]) / self.resolution).astype(np.int64) - cells // 2
        self._fusion.read_out(self._grown.overlap(corner, (cells, cells)))
        return self._grown.part(corner, (cells, cells))
