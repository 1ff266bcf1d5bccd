"""The map of a robot that drives: scans go in as they are complete, pictures of it come out when they are due."""

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any

import numpy as np
from jaxtyping import Float, Int8
from numpy import ndarray

from echogrid.doubts import Judge, Whereabouts
from echogrid.errors import InputError, UsageError
from echogrid.frame import Frame, show_to
from echogrid.geometry import compose
from echogrid.grid import Grid
from echogrid.live.known import Known
from echogrid.live.placing import Correction, RobotPose, Slam
from echogrid.live.sonar_array import SonarArray
from echogrid.live.telling import in_live
from echogrid.mapping.mapper import Mapper
from echogrid.models.networks.set_network import SetNetwork
from echogrid.output.map_server_file import occupancy
from echogrid.planning.nearby import Nearby
from echogrid.position.remapping import Renewed
from echogrid.robot import Robot, robot_yaml
from echogrid.ros.messages import Choice
from echogrid.track import Track

MAP_EVERY_S = 1.0
"""The map is published no more often."""

MAX_CELLS = 16_000_000
"""A map of more cells is refused while live: 160 x 160 m in cells of 4 cm, 0.4 GB."""

_REACH_M = 8.0
"""How much wider than the drive a map is at most."""

MAX_READY = 5_000
"""Scans that wait to be mapped."""

_BATCH = 32
"""Scans that are judged together."""

AT_ONCE = 10
"""Scans that are mapped before it is looked again what has come."""


@dataclass(frozen=True)
class Settings:
    """What the user may choose."""

    choice: Choice = field(default_factory=Choice)
    """Which topics and frames."""
    resolution: float | None = None
    """Side of a cell, m; None: the mapper's own."""
    half_life: float | None = None
    """Time in which evidence comes to count half, s; None: it never fades."""
    local_side: float = 6.0
    """Side of the local map, m."""
    slam: bool = False
    """Whether poses are odometry that drifts, and are to be found."""
    known: Grid | None = None
    """The map in which the robot is to be found by that odometry, where it is known."""
    start: Float[ndarray, "3"] | None = None
    """About where it is in that map, m, m, rad; None: anywhere."""
    map_frame: str = "map"
    """Frame of the map, where it is not that of the odometry."""
    tolerance: float = 1.0
    """How long after its scan what is said of that frame holds, s."""


@dataclass(frozen=True)
class Picture:
    """A map to publish, as ``nav_msgs/OccupancyGrid`` has it."""

    cells: Int8[ndarray, "rows cols"]
    """100 occupied, 0 free, -1 unknown; row 0 the lowest y."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """x, y of the lower left corner of cell [0, 0] in the frame, m."""
    stamp: float
    """Time of the newest scan in it, s."""
    frame: str
    """Frame that it lies in."""
    local: bool
    """Whether it is the part round the robot only."""


@dataclass(frozen=True)
class Snapshot:
    """All that is needed to save a map, apart from what goes on changing."""

    grid: Grid
    """The map, a copy."""
    path: Float[ndarray, "poses 2"]
    """The drive, m."""
    settings: dict[str, Any]
    """How the map was made."""
    title: str
    """Heading of the picture."""


def picture_of(grid: Grid, stamp: float, frame: str, local: bool) -> Picture:
    """A map as it is published; arguments as of ``Picture``."""
    return Picture(occupancy(grid), grid.resolution, grid.origin, stamp, frame, local)


class LiveMap:
    """The map that the scans of an array of sonars make."""

    def __init__(self, array: SonarArray, network: SetNetwork, settings: Settings, refused: Counter[str]):
        """An empty map.

        Args:
            array: the sonars.
            network: the sensor model.
            settings: what the user chose.
            refused: where it is counted which scans are not mapped, by reason.
        """
        self.scans = 0
        """How many are in the map."""
        self.array, self._network, self._settings, self._refused = array, network, settings, refused
        self._empty = lambda robot: Mapper(robot, network, settings.resolution, settings.half_life)
        self._mapper = self._empty(array.robot)
        self.placing: Slam | Known | None = None
        if settings.known is not None:
            self.placing = Known(array, settings.known, settings.start, settings.map_frame, settings.tolerance)
        elif settings.slam:
            self.placing = Slam(array, self._empty, settings.map_frame, settings.tolerance)
        """Finds where the robot is in the map; None: the poses that are heard say it."""
        self.nearby: Nearby | None = None
        """What was heard a moment ago, for who drives the robot."""
        self._judge, self._whereabouts = Judge(array.robot), Whereabouts()
        self._unjudged: list[Frame] = []
        self._notes: dict[str, int] = {}
        self._valid = False
        self._low, self._high = np.full(2, inf), np.full(2, -inf)
        self._path = Track()
        self._ready: deque[Frame] = deque()
        self._last: Frame | None = None
        self._changed, self._due = False, -inf
        self.footprint_radius_m: float | None = None
        """Of the robot, where somebody says so; mapping asks only for ground that it surely covers."""

    @property
    def frame(self) -> str:
        """In which the map lies."""
        return self.placing.frame if self.placing else self.array.fixed

    def equip(self) -> None:
        """Go on with the array as it has grown; scans of the array as it was are to be mapped before."""
        self._mapper.equip(self.array.robot)
        if self.placing:
            self.placing.equip()
        if self.nearby:
            self.nearby.equip(self._robot)
        self._notes, self._judge = self.notes(), Judge(self.array.robot)

    @property
    def _robot(self) -> Robot:
        """Whose scans are mapped, as large as somebody says."""
        robot, radius = self._mapper.robot, self.footprint_radius_m
        return robot if radius is None else replace(robot, footprint_radius_m=radius)

    @property
    def newest(self) -> float:
        """Stamp of the newest scan in the map, s; -inf without any."""
        return -inf if self._last is None else self._last.stamp

    def in_map(self, pose: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
        """A pose (m, m, rad) as it is told, by odometry where the robot is to be found, in the frame of the map."""
        return compose(self.placing.correction, pose) if isinstance(self.placing, Slam) else pose

    def follow(self, robot: Robot) -> None:
        """Remember from now on what is heard near the robot, for who drives it."""
        self.nearby = Nearby(robot, self._network)

    def with_near(self, grid: Grid, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]) -> Grid:
        """The map or a part of it, where it is followed with what was heard near the robot a moment ago.

        Args:
            grid: it.
            pose: of the robot in the map, m, m, rad.
            odometry: likewise, as it is told.
        """
        return self.nearby.laid_over(grid, pose, odometry) if self.nearby else grid

    def grid(self) -> Grid:
        """The map; it goes on to grow."""
        return self._mapper.grid()

    def around(self, pose: Float[ndarray, "3"], side_m: float) -> Grid:
        """A square of the map round a pose in it, a copy."""
        return self._mapper.around(float(pose[0]), float(pose[1]), side_m)

    @property
    def busy(self) -> bool:
        """Whether scans wait to be mapped."""
        return bool(self._ready)

    def step(self, now: float, reach: float) -> Iterator[Picture | Correction | RobotPose]:
        """Map some of the scans that are complete; what is to be published by then, what is urgent first.

        A picture is drawn when it is asked for: what is sent at once does not wait for the next.

        Args:
            now: the caller's clock, s.
            reach: as of ``Scans.frames``, s.
        """
        self._gather(reach)
        if self.placing and (renewed := self.placing.renewed(now)):
            self._renew(renewed)
        mapped = self._map(AT_ONCE)
        yield from self.placing.sent() if self.placing else ()
        if mapped:
            yield self._picture(local=True)
        if self._changed and now >= self._due and self._settings.known is None:
            self._changed, self._due = False, now + MAP_EVERY_S
            yield self._picture(local=False)

    def catch_up(self, reach: float, final: bool = False) -> None:
        """Map all scans that are complete; arguments as of ``Scans.frames``."""
        self._gather(reach, final)
        self._map(len(self._ready))
        if final and self.placing and self.scans and (renewed := self.placing.final()):
            self._renew(renewed)

    def _renew(self, renewed: Renewed) -> None:
        """Go on with another map of the same drive."""
        self._mapper, self._path, self._changed = renewed.mapper, Track(), True
        for x, y in renewed.path.tolist():
            self._path.add(x, y)
        self._low, self._high = renewed.path.min(axis=0), renewed.path.max(axis=0)

    def _gather(self, reach: float, final: bool = False) -> None:
        for frame in self.array.scans.frames(reach, final):
            self._unjudged.append(frame)
            if len(self._unjudged) >= _BATCH:
                self._see()
            if not self._whereabouts.takes(frame.stamp, *frame.pose[:2].tolist()):
                continue  # the judge tells of it
            frame = replace(frame, ranges=self.array.clean(frame.ranges))
            self._valid |= not np.isnan(frame.ranges).all()
            if len(self._ready) >= MAX_READY:
                self._refused["a scan too many to keep up with"] += 1
            else:
                self._ready.append(frame)

    def _see(self) -> None:
        """Have scans judged."""
        if self._unjudged:
            show_to(self._judge, self._unjudged)
            self._unjudged.clear()

    def notes(self) -> dict[str, int]:
        """What is doubtful about the scans so far, and how often."""
        self._see()
        return self._notes | {in_live(note): count for note, count in self._judge.notes().items()}

    def refuse_nothing(self) -> None:
        """Raise an InputError if no reading of any scan can be used."""
        if self.scans and not self._valid:
            found = "no valid reading of any sonar: all are 0 m, nan or below min_range"
            raise InputError("live", found, "ranges in m, or +inf where there is no echo")

    def _fits(self, pose: Float[ndarray, "3"]) -> bool:
        low, high = np.minimum(self._low, pose[:2]), np.maximum(self._high, pose[:2])
        if np.prod((high - low + _REACH_M) / self._mapper.resolution) > MAX_CELLS:
            self._refused["a pose so far off that the map would become too large"] += 1
            return False
        self._low, self._high = low, high
        return True

    def _map(self, most: int) -> bool:
        """Put scans into the map; whether there was one."""
        before = self.scans
        for _ in range(min(most, len(self._ready))):
            frame = self._ready.popleft()
            heard = frame
            try:
                frame = self.placing.place(frame) if self.placing else frame
                if not self._fits(frame.pose):
                    continue
                self._mapper.add([frame])
                if self.nearby:
                    self.nearby.add([heard])
            except UsageError:  # the map is as it was
                self._refused["a scan whose stamp, pose or mounts cannot be"] += 1
                continue
            self._last = frame
            self.scans += 1
            where = self.placing.where if self.placing else frame.pose
            if where is not None:
                self._path.add(float(where[0]), float(where[1]))
        if self.scans == before:
            return False
        self._changed = True
        return True

    def _picture(self, local: bool) -> Picture:
        assert self._last is not None
        x, y = (float(v) for v in self._last.pose[:2])
        grid = self._mapper.around(x, y, self._settings.local_side) if local else self._mapper.grid()
        return picture_of(grid, self._last.stamp, self.frame, local)

    def snapshot(self, refused: Counter[str], doubts: Iterable[str]) -> Snapshot | None:
        """The map to be saved, with what was refused and what is doubtful; None if there is none yet."""
        if not self.scans:
            return None
        grid = deepcopy(self._mapper.grid()) if self._settings.known is None else self._settings.known
        settings = {
            "log": "live",
            "robot": robot_yaml(self._robot),
            "sonars": list(self.array.numbers),
            "fixed_frame": self.array.fixed,
            "robot_frame": self.array.base,
            "frames": self.scans,
            "resolution": grid.resolution,
            "half_life": self._settings.half_life,
            "refused": dict(refused),
            "notes": dict.fromkeys(doubts, 0) | self.notes(),
            "weights": self._network.recipe,
        }
        settings |= self.placing.settings() if self.placing else {}
        return Snapshot(
            grid, self._path.points(), settings, f"live, {self._mapper.robot.sonars} sonars, {self._network.name}"
        )
