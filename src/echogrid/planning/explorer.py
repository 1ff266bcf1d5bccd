"""Where to go next on a map that grows, and how: until nothing is left that can be reached and is not known."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.grid import FREE_THRESH, Grid, logit
from echogrid.planning.asides import SAME_M, Asides
from echogrid.planning.body import Body
from echogrid.planning.choice import Preferences, View, Views
from echogrid.planning.clearance import Floor
from echogrid.planning.following import TURNED_RAD, Pace, follow, may_go, turn_by
from echogrid.planning.frontiers import Frontier
from echogrid.planning.paths import path_along
from echogrid.planning.patience import FAITH, Patience
from echogrid.robot import Robot

THINK_S = 1.0
"""So often, at least, a robot that drives thinks about where to."""

MOST_LOOKS, NEAR_M, FAR_M = 8, 0.7, 1.1
"""A place is come to again, from another place within FAR_M of it: looks from one and the same place tell the same.
After those of its level only while something new is seen within NEAR_M, and so often at most."""

NEW_CELLS_M2 = 0.006
"""What has become free there by one look, at least, to be something new."""

AFAR_M = 4.0
"""A place that was left alone is tried again from so far off: at once it would look the same."""

BLOCKS = 4
"""A place on the way to which the robot had to stop so often is set aside."""

PAST_M = 0.3
"""A robot that has come so far since it had to stop is past that."""

LOOKS_BACK = 2
"""A robot to which the way home looks shut looks round so often before it gives up."""

SLOW_M_S = Pace.speed_m_s
"""A robot that is driven faster goes on so slowly before it stops."""

AROUND_M = 1.6
"""Side of the square, beside the footprint, that is looked at at each step, m, at least."""

EASY_M, DEAR = 0.2, 3.0
"""As those of the floor; who explores keeps farther off, for the ends of smooth walls are hardly heard:
through a door it goes in the middle."""

RIM_M = 0.6
"""So much unknown ground is thought of round the map."""

BACK_M = 0.15
"""Backwards from what was touched."""

_KNOWN = "nothing that can be reached is unknown"

NOWHERE = "the robot stands where by the map it cannot be"
"""Why it ends before it has begun, or when the map has changed."""

State = Literal["looking", "exploring", "returning", "done"]


@dataclass
class Explorer:
    """Drives a robot through what it does not know: map and pose in, wheel velocities out.

    It keeps the footprint on what the map knows to be free. It begins with a look round; goes where the way is short
    and much is to be seen, and stays with that unless another place is clearly better; leaves alone what shows
    nothing new, and tries that once more before it is done; then it drives back to where it began.
    """

    robot: Robot
    pace: Pace = field(default_factory=Pace)
    turns: bool = True
    """Whether it turns the robot round to look; somebody else who drives it does not."""
    preferences: Preferences = field(default_factory=Preferences)
    """Where it would rather go."""

    def __post_init__(self) -> None:
        self.state: State = "looking"
        self.goal: Frontier | None = None
        self.path: Float[ndarray, "n 2"] | None = None
        self.end = ""
        """Why it is done."""
        self.left: list[Frontier] = []
        """Frontiers that remain when it is done, none of which showed anything new."""
        self._home: Float[ndarray, "2"] | None = None
        self._turn, self._heading = 2 * np.pi if self.turns else 0.0, None
        self._asides = Asides(self.preferences.covers)
        self._body = Body()
        self._back_m = 0.0
        self._last: Float[ndarray, "2"] | None = None
        self._thought_s, self._blocked, self._blocked_m = -np.inf, 0, 0.0
        self._looks: list[Float[ndarray, "2"]] = []
        self._free_m2 = 0.0
        self._view: View | None = None
        self._level = self._least = self._looks_back = 0
        self._way_m = 0.0
        self._patience: Patience | None = None

    def around_m(self) -> float:
        """Side of the square round the robot that ``drive`` is to be given, m."""
        ahead = 2 * self.pace.reach_m(self.pace.speed_m_s)
        return 2 * self.robot.footprint_radius_m + max(AROUND_M, ahead)

    def due(self, stamp: float) -> bool:
        """Whether to ``think`` before the next ``drive``."""
        if self.state == "done" or self._turn or self._back_m:
            return False
        return self.path is None or stamp - self._thought_s >= THINK_S

    def bumped(self, around: Grid, pose: Float[ndarray, "3"]) -> None:
        """Something was touched that the map does not show: remember it, and back off.

        Args:
            around: the map, ``around_m`` round the robot.
            pose: of the robot, m, m, rad.
        """
        self._body.touched(around, pose, self.robot.footprint_radius_m)
        self._back_m, self.path, self.goal, self._turn = BACK_M, None, None, 0.0

    def think(self, grid: Grid, pose: Float[ndarray, "3"], stamp: float) -> None:
        """Decide where to go, by the map as it is now.

        Args:
            grid: the map.
            pose: of the robot in it, m, m, rad.
            stamp: s.
        """
        self._thought_s = stamp
        if self._home is None:
            self._home = pose[:2].copy()
        self._note_news(grid, stamp)
        views = Views(self.floor(grid), self.robot, pose, self.preferences.levels)
        if not any(views[number] for number in range(len(self.preferences.levels))):
            self._finish(NOWHERE)
        elif not self._explore(views, pose):  # on its way home, too: it sees more of what it passes
            self.state = "returning"
            self._return(views)

    def _explore(self, views: Views, pose: Float[ndarray, "3"]) -> bool:
        """Choose where to go, daring no more than it takes; whether there is anything."""
        self.state = "exploring"
        if self.end:
            return False
        goal = self.goal
        if goal is not None and self._level and (view := views[self._level]):  # it stays with what it dared
            near = [one for one in view.frontiers if np.linalg.norm(one.place - goal.place) < SAME_M]
            if near and not self._asides.holds(goal.place, self._level):
                self.goal = min(near, key=lambda one: float(np.linalg.norm(one.place - goal.place)))
                self._go(view, self._looked_from(self.goal))
                return True
        best = self._chosen(views, pose)
        doubtful = [level.doubtful for level in self.preferences.levels]

        def likely(place: Float[ndarray, "2"], levels: set[int]) -> bool:
            return not all(doubtful[k] for k in levels) and float(np.linalg.norm(place - pose[:2])) > AFAR_M

        # Before it looks at walls it tries likelier places once more, and all before it is done.
        if best is not None and doubtful[best[1]] and self._asides.forgive(likely):
            best = self._chosen(views, pose)
        if best is None and self._asides.forgive():
            best = self._chosen(views, pose)
        if best is None:
            self.goal = None
            return False
        if goal is None or np.linalg.norm(best[0].place - goal.place) > SAME_M:
            self._blocked, self._looks = 0, []
        self.goal, self._level, view = best
        self._go(view, self._looked_from(self.goal))
        return True

    def _looked_from(self, frontier: Frontier) -> tuple[int, int]:
        """Where to go: first where sonars hear what is beyond; afterwards close to it, for doors show only there.

        Not as close to what is more likely wall: its corners may be mapped by some centimetres too far off.
        """
        if not self._looks:
            return frontier.stand
        return frontier.off_walls if self.preferences.levels[self._level].doubtful else frontier.cell

    def floor(self, grid: Grid) -> Floor:
        """The floor of a map, with what was touched. Walls of our maps are thicker than they are; that is margin."""
        floor = Floor.of(grid, self.robot.footprint_radius_m, RIM_M, 0.0, EASY_M, DEAR, deaf_m=self.robot.deaf_m)
        self._body.mark(floor)
        return floor

    def drive(self, around: Grid, pose: Float[ndarray, "3"]) -> tuple[float, float]:
        """The velocity (m/s, rad/s) that wheels are to have now.

        Args:
            around: the map as it is now, ``around_m`` round the robot.
            pose: of the robot, m, m, rad.
        """
        moved = self.note_way(pose)
        if self.state == "done":
            return 0.0, 0.0
        if self._back_m:
            self._back_m = max(0.0, self._back_m - moved - 1e-4)
            return -0.1, 0.0
        if self._turn:
            return 0.0, self._turned(float(pose[2]))
        if self.path is None:
            return 0.0, 0.0
        if not np.any(around.observed & (around.probability() < FREE_THRESH)):
            return self._stop()
        floor = self.floor(around)
        cell = floor.cell(pose[:2])
        # Where it dares it creeps, for there is no room that is surely free.
        room = 0.0 if cell is None else float(floor.known_m[cell]) - self.robot.footprint_radius_m
        velocity = follow(self.path, pose, room, self.pace)
        if velocity is None:
            self.arrived()
            return 0.0, 0.0
        if self._level and (free_p := self.preferences.levels[self._level].free_p) > FREE_THRESH:
            floor = floor.daring(free_p)
        if may_go(floor, pose, velocity, self.pace):
            return velocity
        speed, turn = velocity
        if speed > SLOW_M_S:  # it needs less room to stop
            slowed = SLOW_M_S, turn * SLOW_M_S / speed
            if may_go(floor, pose, slowed, self.pace):
                return slowed
        return self._stop()

    def note_way(self, pose: Float[ndarray, "3"]) -> float:
        """Take down where the robot is (m, m, rad); how far it has come since it was asked last, m."""
        moved = 0.0 if self._last is None else float(np.linalg.norm(pose[:2] - self._last))
        self._way_m += moved
        self._last = pose[:2].copy()
        self._body.been(self._last)
        return moved

    @property
    def home(self) -> Float[ndarray, "2"] | None:
        """Where it began, m; None before it has thought."""
        return self._home

    def target(self) -> Float[ndarray, "3"] | None:
        """Where its way leads (m, m), and how it is to head there (rad); None: it has no way."""
        if self.path is None or self.state == "done":
            return None
        end, goal = self.path[-1], self.goal
        if goal is None:
            return np.array([*end, 0.0])
        there = float(np.linalg.norm(end - goal.place)) < SAME_M
        heading = goal.heading if there else float(np.arctan2(*(goal.place - end)[::-1]))
        return np.array([*end, heading])

    def remapped(self) -> None:
        """The map was made anew, by other poses: the way, and where the robot has been, are not as they were."""
        self.path = None
        self._body.remapped()
        if self._patience is not None:
            self._patience.remapped()

    def give_up(self) -> None:
        """The robot does not get where it was sent."""
        if self.state == "returning":
            self._finish("something is in the way back")
        elif self.goal is not None:
            self._set_aside(self.goal, *range(len(self.preferences.levels)))  # to dare more is no help
        self.path = None

    def _turned(self, heading: float) -> float:
        """Go on with a turn; its rate, rad/s."""
        if self._heading is not None:
            self._turn = max(0.0, self._turn - max(0.0, float(wrap(heading - self._heading))))
        self._heading = heading
        if self._turn < TURNED_RAD:
            self._turn, self._heading = 0.0, None
            return 0.0
        return turn_by(self._turn, self.pace)

    def _stop(self) -> tuple[float, float]:
        """What lies ahead is not known to be free, other than it was when the way was chosen."""
        on = self._way_m - self._blocked_m > PAST_M
        self._blocked, self._blocked_m = 1 if on else self._blocked + 1, self._way_m
        if self._blocked >= BLOCKS and self.goal is not None:
            levels = self.preferences.levels  # to take more for doors is no help where the way is not free
            self._set_aside(
                self.goal, *(k for k, one in enumerate(levels) if one.free_p <= levels[self._level].free_p)
            )
        elif self._blocked >= BLOCKS and self.state == "returning" and self._least < len(self.preferences.levels) - 1:
            self._least, self._blocked = self._least + 1, 0
        elif self._blocked >= BLOCKS and self.state == "returning":
            self._end_where_it_is()
        self.path = None
        return 0.0, 0.0

    def arrived(self) -> None:
        """The robot is where its way leads."""
        self.path = None
        if self.state == "returning":
            if self._is_home() or self._looks_back >= LOOKS_BACK:
                self._end_where_it_is()
            else:  # it stands as near as there is a way, and looks for one
                self._looks_back += 1
                self._turn = 2 * np.pi if self.turns else 0.0
        elif self.goal is not None and self._last is not None:
            if np.linalg.norm(self._last - self.goal.place) > SAME_M:
                return  # it has come to a place to come from
            free = self._free_near(self.goal)
            if self._looks:
                news = free >= self._free_m2 + NEW_CELLS_M2
                again = len(self._looks) < (MOST_LOOKS if news else self.preferences.levels[self._level].looks)
                if not again or not self._step_back(self.goal):
                    self._set_aside(self.goal)
                    return
            if self.turns and (not self._looks or self._level):  # for between its sonars lie gaps
                self._turn = 2 * np.pi
            self._looks.append(self._last)
            self._free_m2 = free

    def _is_home(self) -> bool:
        if self._home is None or self._last is None:
            return False
        return float(np.linalg.norm(self._home - self._last)) < SAME_M

    def _end_where_it_is(self) -> None:
        self._finish(self.end or _KNOWN if self._is_home() else "something is in the way back")

    def _free_near(self, frontier: Frontier) -> float:
        """Floor that is known to be free near a frontier, m2."""
        if self._view is None:
            return 0.0
        cells = np.argwhere(self._view.floor.free)
        near = np.linalg.norm(self._view.floor.grid.centre_of(cells) - frontier.place, axis=1) < NEAR_M
        return float(np.count_nonzero(near)) * self._view.floor.grid.resolution**2

    def _step_back(self, frontier: Frontier) -> bool:
        """Go to a place from which to come again; whether there is one."""
        if self._view is None:
            return False
        floor, reach = self._view.floor, self._view.reach
        cells = np.argwhere(reach.cells)
        places = floor.grid.centre_of(cells)
        off = np.linalg.norm(places - frontier.place, axis=1)
        fits = (off > SAME_M) & (off < FAR_M)
        if not fits.any():
            return False
        cells, places = cells[fits], places[fits]
        before = np.array(self._looks)
        apart = np.min(np.linalg.norm(places[:, None] - before, axis=2), axis=1)
        short = floor.short_m(cells, self.robot.deaf_m)
        best = int(np.argmax(apart - 0.3 * reach.to_go[tuple(cells.T)] - short))
        row, col = cells[best].tolist()
        self._looks.append(places[best])
        self._go(self._view, (row, col))
        return True

    def _set_aside(self, frontier: Frontier, *levels: int) -> None:
        self._asides.add(frontier.place, *(levels or (self._level,)))
        self.goal, self._blocked, self._looks = None, 0, []

    def _chosen(self, views: Views, pose: Float[ndarray, "3"]) -> tuple[Frontier, int, View] | None:
        """The frontier that is worth most, its level and how it is seen there; None: none is left."""
        best, most = None, np.inf
        goal = None if self.goal is None else self.goal.place
        for number in range(len(self.preferences.levels)):
            if most <= self.preferences.least(number):
                break  # nothing can be better
            if (view := views[number]) is None:
                continue
            fresh = (one for one in view.frontiers if not self._asides.holds(one.place, number))
            if choice := self.preferences.best(fresh, pose, number, goal, most):
                best, most = (choice.frontier, number, view), choice.worth
        return best

    def _go(self, view: View, cell: tuple[int, int]) -> None:
        self._view = view
        # The field leads to the robot; the way is the same backwards.
        self.path = path_along(view.floor, view.floor.known_costs, view.reach.to_go, cell).points[::-1]

    def _return(self, views: Views) -> None:
        """Go home, or as near to it as there is a way, daring no more than it takes."""
        home, best = self._home, None
        assert home is not None
        for number in range(self._least, len(self.preferences.levels)):
            if (view := views[number]) is None or (cell := view.floor.nearest(view.reach.cells, home)) is None:
                continue
            off = float(np.linalg.norm(view.floor.grid.centre_of(np.array(cell)) - home))
            if best is None or off < best[0] - SAME_M:
                best = off, number, view, cell
        if best is None:
            self._finish("no way leads back")
            return
        _, self._level, view, cell = best
        self.left = view.frontiers
        self._go(view, cell)

    def _note_news(self, grid: Grid, stamp: float) -> None:
        """Take down how much floor is known, and end where that does not grow."""
        free = grid.observed & (grid.log_odds < logit(FREE_THRESH))
        at = np.array([self._way_m, stamp])
        if self._patience is None:
            self._patience = Patience(at)
        counts = 1.0 if self.preferences.levels[self._level].doubtful else FAITH
        known_m2 = float(np.count_nonzero(free)) * grid.resolution**2
        self._patience.note(known_m2, at, 0.0 if self.state == "returning" else counts)
        if self._patience.over:
            self.end = self.end or "nothing new was seen for a long way"

    def _finish(self, why: str) -> None:
        self.state, self.end, self.path, self.goal = "done", why, None, None
