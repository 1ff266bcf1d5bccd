"""Exploration in the simulator, closed: a robot drives, hears, maps, and chooses where to go."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import transform
from echogrid.grid import FREE_THRESH, Grid
from echogrid.mapping.mapper import Mapper
from echogrid.metrics import trajectory_error
from echogrid.planning.explorer import Explorer
from echogrid.planning.placing import Found, Given
from echogrid.robot import Robot
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.vehicle import Vehicle
from echogrid.simulation.world import World

CONTROL_TICKS = 4
"""From one command to the next."""

MOST_S = 3 * 3600.0
"""No exploration takes longer, in the robot's time."""

SEEN_SHARES = (0.9, 0.95, 0.99)

_SAME = np.zeros(3)
"""A map that lies where the world does."""

_CELL_M, SPARE_M, _SMALL_M = 0.05, 0.1, 0.1
"""Of the floor that is asked after; room beside the footprint in the places that count as reachable; and what is much
smaller than a robot: its radius."""


def _at_the_rim(cells: Bool[ndarray, "rows cols"]) -> bool:
    return bool(cells[[0, -1]].any() or cells[:, [0, -1]].any())


@dataclass
class Reachable:
    """The floor of a world that a robot can drive over from its start, as points."""

    points: Float[ndarray, "n 2"]
    beyond: float = 0.0
    """Share of the floor that is too narrow for it, or behind what is: where something much smaller would get to."""

    @staticmethod
    def of(world: World, robot: Robot, start: Float[ndarray, "2"]) -> "Reachable":
        """What its footprint covers where it keeps 10 cm beside it, and gets to from its start.

        Raises:
            UsageError: it has no footprint, or cannot move from there.
        """
        if robot.footprint_radius_m <= 0:
            raise UsageError(
                f"robot {robot.name}: footprint_radius_m: found 0, expected the radius of what is to drive, m"
            )
        low, high = world.bounds()
        cols, rows = np.ceil((high - low) / _CELL_M).astype(int) + 1
        x, y = (low[k] + (np.arange(n) + 0.5) * _CELL_M for k, n in enumerate((cols, rows)))
        middles = np.stack(np.meshgrid(x, y), axis=-1)
        gap = world.clearance(middles.reshape(-1, 2)).reshape(rows, cols)
        keep = robot.footprint_radius_m + SPARE_M
        pieces, _ = ndimage.label(gap > keep)
        col, row = np.floor((start - low) / _CELL_M).astype(int)
        inside = 0 <= row < rows and 0 <= col < cols
        if not inside or not (piece := pieces[row, col]):
            found = f"({start[0]:.2f}, {start[1]:.2f}) m, less than {keep:.2f} m from a wall, or outside"
            raise UsageError(f"world {world.name}: start: found {found}, expected a place to begin")
        off = ndimage.distance_transform_edt(pieces != piece) * _CELL_M
        border = pieces == piece
        if _at_the_rim(border):
            raise UsageError(
                f"world {world.name}: found a hole through which the robot gets out, expected walls all round"
            )
        reached = off <= robot.footprint_radius_m
        small, _ = ndimage.label(gap > _SMALL_M)
        floor = small == small[row, col]
        if _at_the_rim(floor):  # it gets out through a gap that is none for the robot
            floor = reached
        return Reachable(middles[reached], float(np.mean(~reached[floor])))

    def seen(self, grid: Grid, T_map_world: Float[ndarray, "3"] = _SAME) -> float:
        """Share of it that a map, which may lie elsewhere than the world, knows to be free."""
        free = grid.observed & (grid.probability() < FREE_THRESH)
        index = grid.index_of(transform(T_map_world, self.points))
        inside = np.all((index >= 0) & (index < grid.shape), axis=1)
        return float(np.sum(free[tuple(index[inside].T)]) / len(self.points))


@dataclass
class Explored:
    """What came of an exploration."""

    frames: list[Frame]
    """The log, a frame a tick: true poses, and those of the odometry."""
    placed: list[Frame]
    """Those that are in the map, with the poses by which it was made."""
    grid: Grid
    end: str
    """Why it ended."""
    home_m: float
    """From where it ended to where it began, true."""
    way_m: float
    time_s: float
    """By the robot's clock."""
    bumps: int
    """Times that it touched anything."""
    least_m: float
    """Least room that was truly beside it."""
    seen: Float[ndarray, "n 3"]
    """Way (m), time (s) and share of the reachable floor that the map knew to be free by then."""
    decision_s: Float[ndarray, "decisions"]
    """Time that each decision took the computer."""
    left: Float[ndarray, "n 2"]
    """Places at the edge of what is known that showed nothing new, m, in the map."""
    beyond: float
    """See ``Reachable``."""
    ate_m: float | None
    """How far the poses in the map are off the true ones after rigid alignment (root mean square); None: those were
    given."""

    def until(self, share: float) -> tuple[float, float] | None:
        """Way (m) and time (s) until a share of the reachable floor was seen; None: it never was."""
        there = np.flatnonzero(self.seen[:, 2] >= share)
        return (float(self.seen[there[0], 0]), float(self.seen[there[0], 1])) if there.size else None

    def told(self) -> dict[str, object]:
        """What explore.json holds."""
        reached = {f"{share:.0%}": self.until(share) for share in SEEN_SHARES}
        return {
            "end": self.end,
            "seen": round(float(self.seen[-1, 2]), 4),
            "way_m": round(self.way_m, 2),
            "time_s": round(self.time_s, 1),
            "until": {
                key: None if value is None else {"way_m": round(value[0], 2), "time_s": round(value[1], 1)}
                for key, value in reached.items()
            },
            "collisions": self.bumps,
            "least_clearance_m": round(self.least_m, 3),
            "home_m": round(self.home_m, 3),
            "ate_m": self.ate_m and round(self.ate_m, 3),
            "frontiers_left": len(self.left),
            "left_at": np.round(self.left, 2).tolist(),
            "too_narrow": round(self.beyond, 4),
            "decisions": len(self.decision_s),
            "decision_ms": {
                "median": round(1000 * float(np.median(self.decision_s)), 1),
                "most": round(1000 * float(np.max(self.decision_s)), 1),
            },
        }


@dataclass
class Exploration:
    """A robot that explores a world."""

    world: World
    robot: Robot
    start: Float[ndarray, "3"]
    """m, m, rad."""
    seed: int = 0
    physics: Physics = field(default_factory=Physics)
    mapper: Callable[[Robot], Mapper] = Mapper
    """Makes an empty map."""
    slam: bool = False
    """Whether poses are found by odometry and ranges; else the true ones are given."""
    explorer: Explorer | None = None
    """What decides; None: as it comes."""
    on_frame: Callable[[Frame], object] = lambda _: None
    """Called with each frame when it is mapped."""
    on_map: Callable[[Grid], object] = lambda _: None
    """Called with the map after each decision; it goes on to grow."""

    def run(self) -> Explored:
        """Explore until it is done.

        Raises:
            UsageError: it cannot begin, or the world is not closed.
            MissingError: JAX is not installed.
        """
        reachable = Reachable.of(self.world, self.robot, self.start[:2])
        vehicle = Vehicle(self.world, self.robot, self.start, self.seed, self.physics)
        explorer = self.explorer or Explorer(self.robot)
        placing = Found(self.robot, self.mapper) if self.slam else Given(self.mapper(self.robot))
        frames: list[Frame] = []
        seen, took = [], []
        while explorer.state != "done" and vehicle.time_s < MOST_S:
            bumps, made = vehicle.bumps, placing.made
            heard = vehicle.go_on(CONTROL_TICKS)
            frames += heard
            for frame in placing.add(heard):
                self.on_frame(frame)
            if placing.made > made:
                explorer.remapped()
            if vehicle.bumps > bumps:
                explorer.bumped(placing.mapper.around(*placing.pose[:2].tolist(), explorer.around_m()), placing.pose)
            if explorer.due(vehicle.time_s):
                begin = time.perf_counter()
                grid = placing.mapper.grid()
                explorer.think(placing.with_near(grid), placing.pose, vehicle.time_s)
                took.append(time.perf_counter() - begin)
                seen.append((vehicle.way_m, vehicle.time_s, reachable.seen(grid, placing.off())))
                self.on_map(grid)
            x, y, _ = placing.pose.tolist()
            around = placing.mapper.around(x, y, explorer.around_m())
            vehicle.command(*explorer.drive(placing.with_near(around), placing.pose))
        placed, off = placing.end(), placing.off()
        grid = placing.mapper.grid()
        seen.append((vehicle.way_m, vehicle.time_s, reachable.seen(grid, off)))
        ate = None
        if self.slam:
            true = {frame.stamp: frame.pose for frame in frames}
            mapped = np.array([(frame.pose, true[frame.stamp]) for frame in placed])
            ate = trajectory_error(mapped[:, 0], mapped[:, 1]).aligned_rms_m
        return Explored(
            frames, placed, grid, explorer.end or "the time was up",
            float(np.linalg.norm(vehicle.pose[:2] - self.start[:2])), vehicle.way_m, vehicle.time_s, vehicle.bumps,
            vehicle.least_m, np.array(seen), np.array(took),
            np.array([one.place for one in explorer.left]).reshape(-1, 2), reachable.beyond, ate,
        )  # fmt: skip
