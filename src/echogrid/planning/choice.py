"""What an explorer may choose from on a map, and what it would rather."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.grid import FREE_THRESH
from echogrid.planning.asides import SAME_M
from echogrid.planning.clearance import Floor
from echogrid.planning.frontiers import LEAST_M2, Frontier, Reach, frontiers
from echogrid.robot import Robot

MOST_GAIN_M2 = 4.0
"""More unknown ground than this is worth no more."""

STEP_OFF_M, ISLAND_M2 = 0.4, 0.1
"""A robot that stands where it cannot be, by the map, or could go nowhere over more than the second, looks so far
around for a place to go from: in a door whose posts look nearer than they are no way leads on or back."""


class Level(NamedTuple):
    """How much an explorer dares."""

    door_p: float
    """What is occupied with less than this may be a door: its posts, from afar, are heard all over it."""
    free_p: float
    """What is occupied with less than this is driven on."""
    looks: int
    """At a place that shows nothing new, from so many others; where more is dared the robot turns round at each."""
    dear_m: float = 0.0
    """Metres by which places of levels that dare less may be farther and are gone to all the same."""
    promise_m2: float = 0.0
    """Places that promise less are not looked at."""
    share: float = 1.0
    """Of the robot's width that a door has in the map at least."""

    @property
    def doubtful(self) -> bool:
        """Whether it takes for doors what is more likely wall."""
        return self.door_p > LIKELY_P

    def covers(self, other: "Level") -> bool:
        """Whether it dares all that another does, a place being as doubtful by both.

        What was like a wall and is like a door by now is worth looks of its own.
        """
        return self.door_p >= other.door_p and self.free_p >= other.free_p and self.doubtful == other.doubtful


LIKELY_P = 0.9
"""What is occupied with more than this is more likely wall than door."""

ROOM_M2, LEAST_PROMISE_M2 = 0.5, 0.3
"""What is likely wall is looked at only with so much room behind it, as it were open, and so much promise, but for
the last level's."""

LEVELS: tuple[Level, ...] = (
    Level(LIKELY_P, FREE_THRESH, 2),
    Level(LIKELY_P, 0.4, 2),
    Level(0.975, FREE_THRESH, 2, 1.0, LEAST_PROMISE_M2),
    Level(0.975, 0.4, 2, 2.0, LEAST_PROMISE_M2),
    Level(0.99, FREE_THRESH, 1, 2.0, LEAST_PROMISE_M2, share=0.6),
    Level(0.99, FREE_THRESH, 1, 100.0),
)
"""Behind a door in a mirror room too little comes back for ground to be surely free: the second creeps on where it is
likely so, and sees more from there. The last two take every weak spot of a wall for a door: one that was passed at a
distance can be as occupied as that, though walls are more so. To creep on there as well would be to touch them: the
ends of smooth walls look likely free. Posts that were heard from the side alone look so thick that a door seems
narrower than the robot. The very last is for when there is nothing else: a door that leads out of all that is known,
behind which nothing was heard, promises nothing."""

DOUBT_M, DOUBT_M2 = 25.0, 1.5
"""Metres that such a place costs besides if it promises nothing; e times less with each so many m2 that it does."""

LEAST_GAIN_M2 = (0.25, 0.5)
"""A place is looked at only where so much unknown ground is to be seen, at the first level and at the others: between
rooms that are known there is nothing to be found, and who goes round a pillar to see its far side is deaf there."""


class Choice(NamedTuple):
    """A frontier, and what it costs to go there less what is to be seen, m."""

    frontier: Frontier
    worth: float


@dataclass(frozen=True)
class Preferences:
    """Where an explorer would rather go."""

    levels: tuple[Level, ...] = LEVELS
    """How much it may dare."""
    gain_m: float = 1.0
    """Metres that a square metre of ground not yet seen is worth."""
    turn_m: float = 0.3
    """Metres that a turn of one radian costs at the beginning of a way."""
    faith_m: float = 1.5
    """Metres by which another place must be better than that to which the robot is under way."""

    def covers(self, one: int, other: int) -> bool:
        """Whether the first of two levels dares all that the second does."""
        return self.levels[one].covers(self.levels[other])

    def least(self, number: int) -> float:
        """What any place costs at a level, at least, m; less by ``faith_m`` where it is the goal."""
        return self.levels[number].dear_m - self.gain_m * MOST_GAIN_M2

    def best(
        self,
        found: Iterable[Frontier],
        pose: Float[ndarray, "3"],
        number: int,
        goal: Float[ndarray, "2"] | None,
        most: float,
    ) -> Choice | None:
        """The frontier at a level that is worth most, if it costs less than ``most`` (m).

        Args:
            found: frontiers at the level.
            pose: of the robot, m, m, rad.
            number: of the level.
            goal: to which it is under way, m.
            most: see above.
        """
        best = None
        for one in found:
            if one.cost + self.least(number) - self.faith_m >= most:
                continue  # whatever it shows; to look at all takes long
            if self._worthy(one, number) and (worth := self._worth(one, pose, number, goal)) < most:
                best, most = Choice(one, worth), worth
        return best

    def _worthy(self, frontier: Frontier, number: int) -> bool:
        """Whether a frontier is to be looked at, at a level."""
        if (least := self.levels[number].promise_m2) and frontier.promise_m2 < least:
            return False
        return frontier.gain_m2 >= LEAST_GAIN_M2[min(number, 1)]

    def _worth(
        self, frontier: Frontier, pose: Float[ndarray, "3"], number: int, goal: Float[ndarray, "2"] | None
    ) -> float:
        to = frontier.place - pose[:2]
        turn = abs(float(wrap(np.arctan2(to[1], to[0]) - pose[2]))) if np.linalg.norm(to) > 0.1 else 0.0
        worth = frontier.cost + self.turn_m * turn - self.gain_m * min(frontier.gain_m2, MOST_GAIN_M2)
        worth += self.levels[number].dear_m
        if self.levels[number].doubtful:
            worth += DOUBT_M * float(np.exp(-frontier.promise_m2 / DOUBT_M2))
        under_way = goal is not None and np.linalg.norm(frontier.place - goal) < SAME_M
        return worth - self.faith_m if under_way else worth


@dataclass(frozen=True)
class View:
    """What there is by a map at one level."""

    reach: Reach
    robot: Robot
    level: Level

    @property
    def floor(self) -> Floor:
        """The map."""
        return self.reach.floor

    @cached_property
    def frontiers(self) -> list[Frontier]:
        """Those nearest to the robot first."""
        room = ROOM_M2 if self.level.doubtful else LEAST_M2
        return frontiers(self.reach, self.robot, self.level.door_p, room, self.level.share)


class Views:
    """Likewise at each level, worked out when it is asked for; None where the robot could not stand by it."""

    def __init__(self, floor: Floor, robot: Robot, pose: Float[ndarray, "3"], levels: tuple[Level, ...]):
        """Of one map.

        Args:
            floor: the map.
            robot: for its sonars.
            pose: of it, m, m, rad.
            levels: how much it may dare.
        """
        self._floor, self._robot, self._pose, self._levels = floor, robot, pose, levels
        self._reaches: dict[float, Reach | None] = {}
        self._kept: dict[int, View | None] = {}

    def __getitem__(self, number: int) -> View | None:
        if number not in self._kept:
            level = self._levels[number]
            reach = self._reach(level.free_p)
            self._kept[number] = None if reach is None else View(reach, self._robot, level)
        return self._kept[number]

    def _reach(self, free_p: float) -> Reach | None:
        if free_p not in self._reaches:
            floor = self._floor if free_p == self._floor.free_p else self._floor.daring(free_p)
            self._reaches[free_p] = _reach_from(floor, self._pose[:2])
        return self._reaches[free_p]


def _reach_from(floor: Floor, place: Float[ndarray, "2"]) -> Reach | None:
    """Where a robot gets to that is somewhere (m); None: it could not be there, nor near by."""
    best, most = None, 0.0
    cells = np.array([floor.grid.index_of(place)]) + _disc(STEP_OFF_M / floor.grid.resolution)
    cells = cells[np.all((cells >= 0) & (cells < floor.grid.shape), axis=1)]
    cells = cells[np.isfinite(floor.known_costs[tuple(cells.T)])]
    cells = cells[np.argsort(np.linalg.norm(floor.grid.centre_of(cells) - place, axis=1), kind="stable")]
    while len(cells):
        row, col = cells[0].tolist()
        reach = Reach.of(floor, (row, col))
        area = float(np.count_nonzero(reach.cells)) * floor.grid.resolution**2
        if area > most:
            best, most = reach, area
        if area >= ISLAND_M2:
            break
        cells = cells[~reach.cells[tuple(cells.T)]]
    return best


def _disc(radius: float) -> Int[ndarray, "n 2"]:
    """The cells [row, col] of a lattice that are within a radius of the first of all."""
    off = np.arange(-int(radius), int(radius) + 1)
    cells = np.stack(np.meshgrid(off, off, indexing="ij"), axis=-1).reshape(-1, 2)
    return cells[np.hypot(*cells.T) <= radius]
