"""The map of a drive, scan by scan, by any sensor model."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from math import floor

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from echogrid.doubts import Judge, Whereabouts
from echogrid.frame import Frame, passing
from echogrid.grid import Grid, GrowingGrid, Layers
from echogrid.limits import HALF_LIFE, MOST_M, RESOLUTION, Limits
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.models.model import Evidence, Model
from echogrid.robot import Robot

_PLACE = Limits(-MOST_M, MOST_M, "m")

_MOST_AROUND = 20_000
"""Cells along a side of a square, as many as a map may have in all."""


class Mapper:
    """Builds the map of one drive.

    What cannot be mapped raises a UsageError of one line and leaves the map as it was, to go on with.
    """

    def __init__(
        self,
        robot: Robot,
        model: Model | str = DEFAULT,
        resolution: float | None = None,
        half_life: float | None = None,
    ):
        """An empty map.

        Args:
            robot: the robot that drives; its mounts are in the order of the readings.
            model: the sensor model, or its name.
            resolution: side of a cell, m; None: the model's own.
            half_life: time in which evidence comes to count half, s; None: it never fades.

        Raises:
            UsageError: no such robot or model, a resolution or half-life that no map can have, or evidence is to fade
                of a model other than the set network.
        """
        check_robot(robot)
        if not isinstance(model, Model):
            model = sensor_model(model)
        self.resolution = model.cell_m if resolution is None else RESOLUTION.check(resolution, "resolution")
        half_life = None if half_life is None else HALF_LIFE.check(half_life, "half_life")
        self._fusion = model.fusion(robot, self.resolution, half_life)
        self.cell_m = self._fusion.cell_m or self.resolution
        """Side of the cells in which the map is kept, m; it is told in cells of ``resolution``."""
        chosen = self._fusion.cell_m is None
        self._empty = partial(GrowingGrid, self.cell_m, self._fusion.blank, model.p_min, chosen)
        self._grown = self._empty()
        # Where nothing fades the stamps decide nothing, and scans may come in any order.
        self._latest = None if half_life is None else -np.inf

    @property
    def robot(self) -> Robot:
        """The robot that drives."""
        return self._fusion.robot

    @property
    def side_by_side(self) -> bool:
        """Whether what ``prepare`` returns is worth working out side by side, see ``Fusion``."""
        return self._fusion.side_by_side

    def equip(self, robot: Robot) -> None:
        """Go on with another array of sonars; the map stays, what was remembered of the surroundings does not."""
        check_robot(robot)
        self._fusion.equip(robot)

    def add(self, frames: Iterable[Frame]) -> None:
        """Take scans into the map at once, in their order: all of them or, where an error is raised, none.

        Ranges are cleaned by the limits of the robot (``Robot.clean``). Numbers may be lists, integers or of single
        precision. Stamps may be in any order where no evidence is to fade.

        Raises:
            UsageError: a frame has another number of readings than the robot has sonars, or a stamp, pose, range or
                mount that cannot be; time goes back by more than a second where evidence is to fade; the map would
                become too large; or a model that needs the whole log at once has had it. The line names the frame's
                number or stamp.
        """
        # Of a log there is more than memory holds, but ``build_map`` for that.
        checked = cleaned(list(fitting(frames, self.robot, self._latest)), self.robot)
        if not checked:
            return
        self._check_room(checked)
        for batch in self._fusion.batches(checked):
            self.fuse(self.prepare(batch)())
        if self._latest is not None:
            self._latest = max(self._latest, *(frame.stamp for frame in checked))

    def _check_room(self, frames: Sequence[Frame]) -> None:
        """Raise a UsageError if the map would become too large with these frames."""
        x, y, _ = zip(*(frame.pose.tolist() for frame in frames), strict=True)
        far = max(
            (float(np.max(np.abs(frame.mounts[:, :2]))) for frame in frames if frame.mounts is not None), default=0
        )
        if far:  # scans of models that take them apart are put where a sonar looked from
            far = np.sqrt(2) * (far + float(np.max(np.abs(self.robot.mounts[:, :2]))))
        reach = self._fusion.reach_cells + int(np.ceil(far / self.cell_m))
        low, high = ([floor(end(each) / self.cell_m) for each in (y, x)] for end in (min, max))
        self._grown.check_room(np.array(low) - reach, np.array(high) + 1 + reach)

    def batches(self, frames: Iterable[Frame], judge: Judge | None = None) -> Iterator[Sequence[Frame]]:
        """Frames of a log in their order, cleaned, as many together as ``prepare`` takes at once.

        Those at places that no robot can have got to are left out, see ``Whereabouts``. A judge sees all of them.

        Raises:
            UsageError: as of ``add``, but for the size of the map.
        """
        where = Whereabouts()
        fits = fitting(frames, self.robot, self._latest)
        fits = passing(fits, judge) if judge else fits
        reached = (frame for frame in fits if where.takes(float(frame.stamp), *frame.pose[:2].tolist()))
        for batch in self._fusion.batches(reached):
            yield cleaned(batch, self.robot)

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

    def hand_over(self) -> tuple[Int[ndarray, "2"], Layers]:
        """What the cells of the map hold, and its first cell [row, col], counted from the world's origin.

        The map begins anew, empty; what is remembered of the drive stays.
        """
        corner, cells = self._grown.reserved()[0], self._grown.layers()
        self._grown = self._empty()
        return corner, cells

    def grid(self) -> Grid:
        """The map so far: views of the growing arrays, not copies, where it is kept in cells of ``resolution``."""
        self._fusion.read_out(self._grown, *self._grown.reserved())
        grid = self._grown.grid()
        return grid if self.cell_m == self.resolution else grid.in_cells_of(self.resolution)

    def around(self, x: float, y: float, side_m: float) -> Grid:
        """A square of the map round a point, a copy.

        Args:
            x: of the point, m, world.
            y: likewise.
            side_m: side of the square, m; it is filled with what nobody spoke of where the map ends.

        Raises:
            UsageError: no number, too far off, or a square of too many cells.
        """
        x, y = (_PLACE.check(value, f"around: {name}") for name, value in (("x", x), ("y", y)))
        side_m = Limits(self.resolution, self.resolution * _MOST_AROUND, "m").check(side_m, "around: side_m")
        cells = round(side_m / self.resolution)
        corner = np.floor(np.array([y, x]) / self.resolution).astype(np.int64) - cells // 2
        if self.cell_m == self.resolution:
            self._fusion.read_out(self._grown, *self._grown.reserved(corner, (cells, cells)))
            return self._grown.part(corner, (cells, cells))
        low = np.floor(corner * self.resolution / self.cell_m).astype(np.int64) - 1
        high = np.ceil((corner + cells) * self.resolution / self.cell_m).astype(np.int64) + 1
        held = (int(high[0] - low[0]), int(high[1] - low[1]))
        self._fusion.read_out(self._grown, *self._grown.reserved(low, held))
        grid = self._grown.part(low, held).in_cells_of(self.resolution)
        return grid.part(corner - np.rint(np.array(grid.origin[::-1]) / self.resolution).astype(int), (cells, cells))
