"""A drive and its map as a recording for Rerun (.rrd), to go through in time.

Rerun is the extra ``viewer``; nothing else of the package needs it.
"""

from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from echogrid.extras import need
from echogrid.files import replacing
from echogrid.frame import Frame
from echogrid.geometry import transform
from echogrid.grid import Grid
from echogrid.output.follower import SILENT_M, Pace
from echogrid.robot import Robot

LOCAL_M = 6.0
"""Side of the square round the robot that the local map shows."""

LOCAL_PERIOD_S = 0.5
"""From one local map to the next."""

_STEP_M = 0.02
"""From one point of the drawn drive to the next."""

_ECHO, _SILENT, _ROBOT, _DRIVE = (230, 120, 20), (110, 150, 190), (44, 160, 44), (31, 119, 180)
_ABOVE_M = {"cones": 0.02, "drive": 0.03, "robot": 0.04}
"""Heights at which lines are drawn, so that the map does not hide them."""


class Viewing:
    """Writes a recording of Rerun (.rrd) while the drive is mapped; a context manager.

    The file takes its place when the block ends well; when it raises, nothing is left. The time line ``drive`` counts
    the seconds from the first frame, ``scan`` the frames from 1. Lengths are in metres, x and y those of the world:

    - world/robot: a disc of the robot's footprint with a line forward; world/drive: the whole way;
    - world/cones: for each sonar that fired, its cone up to the reading, or up to SILENT_M if there was no echo;
    - world/map: the map as it grew, at the times that Pace picks, and as it is at the end;
    - local/map: the LOCAL_M square round the robot, its sides along the world's axes, every LOCAL_PERIOD_S.

    In maps black is occupied, white free.
    """

    def __init__(self, path: str | Path, robot: Robot):
        """Nothing is written before the block begins.

        Args:
            path: the file (.rrd); one that is there is replaced.
            robot: the robot that drives; its mounts are in the order of the readings.

        Raises:
            UsageError: Rerun is not installed.
        """
        need("--rerun", "viewer")
        self.path, self.robot = Path(path), robot
        self._rr: Any = import_module("rerun")
        self._pace = Pace()
        self._grid: Grid | None = None
        self._way: list[Float[ndarray, "3"]] = []
        self._first = self._now = self._local_due = 0.0
        self._scans = 0

    def __enter__(self) -> "Viewing":
        with ExitStack() as stack:
            new = stack.enter_context(replacing(self.path))
            self._stream = self._rr.RecordingStream("echogrid")
            self._stream.save(new)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.disconnect()  # writes what is left and closes the file
        self._stack.__exit__(kind, error, trace)

    def add(self, frame: Frame) -> None:
        """Log a frame: the robot, the cones of its sonars, and the local map where it is time for one."""
        if not self._scans:
            self._first = self._local_due = frame.stamp
            self._pace.due(frame.stamp, 0)
        self._scans, self._now = self._scans + 1, frame.stamp
        self._stream.set_time("drive", duration=frame.stamp - self._first)
        self._stream.set_time("scan", sequence=self._scans)
        self._draw("robot", _footprint(frame.pose, self.robot.footprint_radius_m), [_ROBOT])
        echo = np.isfinite(frame.ranges)
        lines = _cones(frame, self.robot)
        colours = [_ECHO if heard else _SILENT for heard in echo[~np.isnan(frame.ranges)]]
        self._draw("cones", lines, colours)
        if not self._way or np.hypot(*(frame.pose - self._way[-1])[:2]) >= _STEP_M:
            self._way.append(np.array(frame.pose, dtype=np.float32))
        if self._grid is not None and frame.stamp >= self._local_due:
            self._local_due = frame.stamp + LOCAL_PERIOD_S
            self._show("local/map", around(self._grid, frame.pose[:2], LOCAL_M))

    def keep(self, grid: Grid) -> None:
        """Take the map so far; it is logged if it is time for one."""
        self._grid = grid
        if self._pace.due(self._now, grid.log_odds.size):
            self._show("world/map", grid)

    def finish(self, grid: Grid) -> None:
        """Log the map as it is at the last frame, and the way of the whole drive."""
        self._show("world/map", grid)
        self._show("local/map", around(grid, self._way[-1][:2], LOCAL_M))
        way = [np.array([pose[:2] for pose in self._way])]
        self._draw("drive", way, [_DRIVE], views=("world",), static=True)
        self._stream.send_blueprint(self._blueprint(grid))

    def _draw(
        self,
        name: str,
        lines: list[Float[ndarray, "_ 2"]],
        colours: list[tuple[int, int, int]],
        views: tuple[str, ...] = ("world", "local"),
        static: bool = False,
    ) -> None:
        """Log lines of points (x, y of the world, m)."""
        raised = [np.column_stack([line, np.full(len(line), _ABOVE_M[name])]) for line in lines]
        for view in views:
            strips = self._rr.LineStrips3D(raised, colors=colours, radii=self._rr.Radius.ui_points(1.0))
            self._stream.log(f"{view}/{name}", strips, static=static)

    def _show(self, entity: str, grid: Grid) -> None:
        rr = self._rr
        rows, cols = grid.shape
        picture = rr.GridMap(
            data=_greys(grid).tobytes(),
            format=rr.components.ImageFormat(width=cols, height=rows, color_model="L", channel_datatype="U8"),
            cell_size=grid.resolution,
            translation=[*grid.origin, 0.0],
            colormap=rr.components.Colormap.Grayscale,
        )
        self._stream.log(entity, picture)

    def _blueprint(self, grid: Grid) -> Any:
        """Both maps side by side, looked at from above."""
        rrb = import_module("rerun.blueprint")
        rows, cols = grid.shape
        width, height = cols * grid.resolution, rows * grid.resolution
        x, y = grid.origin[0] + width / 2, grid.origin[1] + height / 2

        def view(name: str, middle: tuple[float, float], side: float, follow: str | None = None) -> Any:
            place = (*middle, 0.0)
            eye = rrb.EyeControls3D(
                position=(middle[0], middle[1] - 0.01, 1.2 * side),
                look_target=place,
                eye_up=(0.0, 1.0, 0.0),
                tracking_entity=follow,
            )
            return rrb.Spatial3DView(origin=f"/{name}", name=f"{name.capitalize()} map", eye_controls=eye)

        robot = (float(self._way[-1][0]), float(self._way[-1][1]))
        return rrb.Blueprint(
            rrb.Horizontal(
                view("world", (x, y), max(width, height)), view("local", robot, LOCAL_M, follow="/local/robot")
            ),
            rrb.TimePanel(timeline="drive"),
            collapse_panels=True,
        )


def around(grid: Grid, p_world: Float[ndarray, "2"], side: float) -> Grid:
    """The part of a map in a square round a point, a copy.

    Args:
        grid: the map.
        p_world: the middle, m.
        side: of the square, m; cells outside of the map are not observed.
    """
    low = grid.index_of(np.asarray(p_world, dtype=float) - side / 2)
    count = int(np.ceil(side / grid.resolution))
    return grid.part(low, (count, count))


def _greys(grid: Grid) -> UInt8[ndarray, "rows cols"]:
    """Black is occupied, white free; the first row is the highest y."""
    p = np.where(grid.observed, grid.probability(), 0.5)
    return np.flipud(np.rint(255 * (1 - p)).astype(np.uint8))


def _footprint(pose: Float[ndarray, "3"], radius: float) -> list[Float[ndarray, "_ 2"]]:
    """A circle and a line forward, in the world, m."""
    turn = np.linspace(0, 2 * np.pi, 33)
    circle = radius * np.column_stack([np.cos(turn), np.sin(turn)])
    return [transform(pose, line) for line in (circle, np.array([[0.0, 0.0], [radius, 0.0]]))]


def _cones(frame: Frame, robot: Robot) -> list[Float[ndarray, "_ 2"]]:
    """The outline of the cone of each sonar that fired, in the world, m."""
    mounts = robot.mounts if frame.mounts is None else frame.mounts
    half = robot.beam_width_rad / 2
    turn = np.linspace(-half, half, 9)
    lines = []
    for mount, metres in zip(mounts, frame.ranges, strict=True):
        if np.isnan(metres):
            continue
        reach = metres if np.isfinite(metres) else SILENT_M
        arc = reach * np.column_stack([np.cos(turn), np.sin(turn)])
        outline = np.vstack([np.zeros((1, 2)), arc, np.zeros((1, 2))])
        lines.append(transform(frame.pose, transform(mount, outline)))
    return lines
