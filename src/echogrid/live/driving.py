"""A robot that is sent through what the map does not know yet, or driven there: places or velocities to publish."""

from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.geometry import compose, inverse, wrap
from echogrid.live.hearing import Hearing
from echogrid.live.live_map import LiveMap
from echogrid.live.placing import Slam
from echogrid.live.sonar_array import listed
from echogrid.planning.explorer import NOWHERE, Explorer
from echogrid.planning.following import Pace
from echogrid.planning.guiding import Guide
from echogrid.position.motion import restarted
from echogrid.ros.messages import few

CONTROL_S = 0.1
"""From one velocity to the next, by the robot's clock."""

SILENT_S, ALIVE_S = 1.0, 1.0
"""A map that lies so far behind what is heard, by the robot's clock, is no map to drive by; nor is one where no range
came for so long by the caller's."""

POSE_S = 0.4
"""How far past the last odometry the robot is taken to have gone on."""

JUMP_M, JUMP_RAD, SETTLES_S = 0.1, np.deg2rad(5.0), 3.0
"""When what SLAM says of the pose moves by more than this at once, the map is made anew: so long the robot stands."""

FASTER, SLACK_M, SLACK_RAD = 3.0, 0.15, 0.5
"""A pose that moves so many times faster than the robot is driven, and by so much, has jumped."""

OTHERS = 1.0, 2.0
"""How fast a robot is taken to be at most that somebody else drives, m/s and rad/s."""

YIELDS_S = 3.0
"""A robot that another program drove, so long ago at most, is left to that."""

STALLED_S, STALLED_M, STALLED_RAD = 2.0, 0.01, np.deg2rad(3.0)
"""A robot that is driven for so long and gets no farther than this has touched something, or does not obey."""

ELSEWHERE_M = 0.3
"""A robot that could not begin where it stood, and was moved so far, tries again."""

GAPS = 20
"""Times from one velocity to the next that are looked at."""

REST = 10
"""Times that it is told to stand when it is done; then others may drive it."""


class Goal(NamedTuple):
    """Where to go next."""

    frame: str
    """Of the map."""
    stamp: float
    """s"""
    pose: Float[ndarray, "3"]
    """m, m, rad."""


class Velocity(NamedTuple):
    """How fast to drive, m/s and rad/s."""

    speed: float
    turn: float


STOP = Velocity(0.0, 0.0)

YIELDS = "another program drives it as well: stop one of the two"

REMADE = "SLAM moved the pose: the map is made anew"


@dataclass(frozen=True)
class Drives:
    """How the robot explores."""

    radius_m: float | None = None
    """Of its footprint; None: what its sonars surround."""
    itself: bool = False
    """Whether it is driven; else somebody else drives it to the goals."""
    pace: Pace = field(default_factory=Pace)
    """How fast it is driven."""


class Driving:
    """Sends a robot, or drives it, until nothing in its reach is unknown.

    It stands wherever that is in doubt, and while it is: nothing near is known to be free, sonars are silent, the map
    lies behind, the pose is old or has jumped.
    """

    def __init__(self, drives: Drives):
        """Nothing decided yet."""
        self._drives = drives
        self.notices: deque[str] = deque(maxlen=100)
        """What the user should know and was not told yet."""
        self.explorer: Explorer | None = None
        self.halted = ""
        """Why it does not go on until it is begun anew."""
        self._map: LiveMap | None = None
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._stamp, self._now, self._rest = -np.inf, -np.inf, REST
        self._doubt, self._last, self._told_halted = "", None, False
        self._settled = -np.inf
        self._gaps: deque[float] = deque(maxlen=GAPS)
        self._stall: tuple[float, Float[ndarray, "3"]] | None = None
        self._moved, self._said = False, ""
        self._ended = np.zeros(3)

    def step(self, live_map: LiveMap, hearing: Hearing, now: float) -> list[Goal | Velocity]:
        """What is to be published now.

        Args:
            live_map: the map.
            hearing: what was heard.
            now: the caller's clock, s.
        """
        self._keep_to(live_map)
        assert self.explorer is not None
        silent = now - hearing.last_range > ALIVE_S
        stands = (
            now - self._now >= ALIVE_S and hearing.newest == self._stamp and now - hearing.last_range < ALIVE_S / 2
        )
        due = abs(hearing.newest - self._stamp) >= CONTROL_S or (silent and now - self._now >= CONTROL_S)
        due |= now - self._now >= ALIVE_S
        if not due or not live_map.scans:
            return []
        if self.explorer.state == "done" and not self._doubt:
            return self._done(live_map, hearing)
        self._keep_pace(hearing.newest - self._stamp)
        self._stamp, self._now = hearing.newest, now
        odometry = self._odometry_at(live_map, hearing)
        if odometry is not None and not self.halted:
            self._watch(live_map, odometry, hearing.newest)
        stopped = "the robot's clock stands" if stands else ""
        doubt = self._rivals(hearing, now) or self._doubts(live_map, hearing, odometry, silent)
        self._tell(self.halted or stopped or doubt)
        if self._doubt or odometry is None:
            self.explorer.path = None  # by the map as it is then
            self._stall = None
            return [STOP] if self._drives.itself and self._doubt != YIELDS else []
        pose = live_map.in_map(odometry)
        sent = (self._driven if self._drives.itself else self._sent)(live_map, pose, odometry)
        if self.explorer.state == "done":
            self._tell_end(pose)
        return sent

    def _tell_end(self, pose: Float[ndarray, "3"]) -> None:
        explorer = self.explorer
        assert explorer is not None
        self._ended = pose
        if explorer.end == NOWHERE:
            radius = explorer.robot.footprint_radius_m
            self.notices.append(
                f"cannot explore from here: by the map there is no room for a disc of {radius:.2f} m; if the robot "
                "is smaller start again with its --radius, else move it"
            )
            return
        home = pose[:2] if explorer.home is None else explorer.home
        off = float(np.linalg.norm(pose[:2] - home))
        left = f"; {len(explorer.left)} places showed nothing new" if explorer.left else ""
        self.notices.append(f"explored: {explorer.end}; the robot stands {off:.2f} m from where it began{left}")

    def _keep_to(self, live_map: LiveMap) -> None:
        """Explore this map; another one, or another drive in it, is explored anew."""
        robot = live_map.array.robot
        radius = self._drives.radius_m or robot.footprint_radius_m
        drives = live_map.placing.drives if isinstance(live_map.placing, Slam) else 0
        if self.explorer is None or live_map is not self._map or drives != self._number:
            if self.halted:
                self.notices.append("another drive begins: it is explored from here on")
            self._map, self._number, self._array, self.halted = live_map, drives, robot, ""
            self.explorer = Explorer(
                replace(robot, footprint_radius_m=radius), self._drives.pace, turns=self._drives.itself
            )
            self._guide = Guide(self.explorer)
            live_map.footprint_radius_m = self._drives.radius_m
            if self._drives.itself:
                live_map.follow(self.explorer.robot)
            self._begin_anew()
        elif robot is not self._array:
            self._array, self.explorer.robot = robot, replace(robot, footprint_radius_m=radius)

    def _keep_pace(self, took: float) -> None:
        """Drive the slower the more time (s, by the robot's clock) passes from one velocity to the next.

        A computer that has too much to do, or a simulation that goes faster than real time, makes it long.
        """
        assert self.explorer is not None
        if 0 < took < np.inf:
            self._gaps.append(took)
            # What was seen has come some time ago, and the velocity holds until the next.
            self.explorer.pace = self._drives.pace.late(2 * float(np.quantile(self._gaps, 0.8)))

    def _odometry_at(self, live_map: LiveMap, hearing: Hearing) -> Float[ndarray, "3"] | None:
        """Where the robot is by what is told, now; None where that is old."""
        array = live_map.array
        return hearing.transforms.pose(array.fixed, array.base, hearing.newest, POSE_S, hold=True)

    def _watch(self, live_map: LiveMap, odometry: Float[ndarray, "3"], stamp: float) -> None:
        """See whether what is told of the pose goes on as a robot does."""
        assert self.explorer is not None
        pose = live_map.in_map(odometry)
        if self._last is not None:
            before, told, shift = self._last
            took = max(stamp - before, CONTROL_S)
            step = compose(inverse(told), odometry)
            pace = self._drives.pace
            speed, turn = (pace.speed_m_s, pace.turn_rad_s) if self._drives.itself else OTHERS
            far = np.hypot(*step[:2]) > FASTER * speed * took + SLACK_M
            round_ = abs(step[2]) > FASTER * turn * took + SLACK_RAD
            if far or round_ or restarted(told, odometry, took):
                jump = f"{np.hypot(*step[:2]):.2f} m and {np.rad2deg(abs(step[2])):.0f} degrees within {took:.1f} s"
                self.halted = f"the pose jumped by {jump}, so its place is in doubt: start echogrid live again"
            # By how much the same place would be told elsewhere.
            off = compose(pose, inverse(odometry)) - shift
            moved = np.hypot(*(compose(shift, odometry) - pose)[:2])
            if moved > JUMP_M or abs(wrap(off[2])) > JUMP_RAD:
                self._settled = stamp + SETTLES_S
                self.explorer.remapped()
        self._last = stamp, odometry, compose(pose, inverse(odometry))

    def _rivals(self, hearing: Hearing, now: float) -> str:
        """Who else speaks for the robot, or to it, by the caller's clock (s); nothing if nobody does."""
        if hearing.senders.at_odds(now):
            return f"two programs at once tell {few(hearing.senders.contested)}"
        return YIELDS if self._drives.itself and now - hearing.commanded < YIELDS_S else ""

    def _doubts(self, live_map: LiveMap, hearing: Hearing, odometry: Float[ndarray, "3"] | None, silent: bool) -> str:
        """Why the robot must not drive now; nothing if it may."""
        array = live_map.array
        if silent:
            return f"no range came for {ALIVE_S:g} s"
        if array.silent:
            return f"{listed(array.silent)}: silent"
        if odometry is None:
            return f"no odometry came for {POSE_S:g} s"
        if hearing.newest - live_map.newest > SILENT_S:
            return f"the map lies more than {SILENT_S:g} s behind the ranges"
        if hearing.newest < self._settled:
            return REMADE
        return ""

    def _tell(self, doubt: str) -> None:
        """Say once why the robot stands, and when it goes on again."""
        routine = self._doubt in ("", REMADE) and doubt in ("", REMADE)  # each loop that is closed does that
        what = ("the robot stands", "the robot goes on") if self._drives.itself else ("no goals", "goals again")
        if not routine:
            if doubt and (not self._doubt or (self.halted and not self._told_halted)):
                self.notices.append(f"{what[0]}: {doubt}")
                self._told_halted = bool(self.halted)
            elif not doubt:
                self.notices.append(what[1])
        self._doubt = doubt

    def _think(self, live_map: LiveMap, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]) -> bool:
        """Decide where to go, if that is due; whether it is known where to."""
        explorer = self.explorer
        assert explorer is not None
        if explorer.due(self._stamp):
            try:
                explorer.think(live_map.with_near(live_map.grid(), pose, odometry), pose, self._stamp)
            except UsageError:  # nothing is known to be free yet
                return False
        return True

    def _driven(
        self, live_map: LiveMap, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]
    ) -> list[Goal | Velocity]:
        explorer = self.explorer
        assert explorer is not None
        if not self._think(live_map, pose, odometry):
            return [STOP]
        around = live_map.with_near(live_map.around(pose, explorer.around_m()), pose, odometry)
        velocity = Velocity(*explorer.drive(around, pose))
        if self._stalls(velocity, odometry):
            if self._moved and velocity.speed > 0:
                x, y = pose[:2].tolist()
                self.notices.append(
                    f"the robot is stuck at ({x:.2f}, {y:.2f}) m: it backs off, and keeps away from there"
                )
                explorer.bumped(around, pose)
            else:
                self._say_once("the robot does not move as it is told: who hears the commands, and is it allowed to?")
        return [velocity]

    def _say_once(self, text: str) -> None:
        if self._said != text:
            self._said = text
            self.notices.append(text)

    def _stalls(self, velocity: Velocity, odometry: Float[ndarray, "3"]) -> bool:
        """Whether the robot is driven ahead, or turned, and does not get anywhere."""
        if velocity == STOP or velocity.speed < 0:
            self._stall = None
            return False
        if self._stall is not None:
            off = odometry - self._stall[1]
            if np.hypot(*off[:2]) > STALLED_M or abs(wrap(off[2])) > STALLED_RAD:
                self._moved, self._stall = True, None
        if self._stall is None:
            self._stall = self._stamp, odometry
        if self._stamp - self._stall[0] < max(STALLED_S, 10 * max(self._gaps, default=0.0)):
            return False
        self._stall = None
        return True

    def _sent(
        self, live_map: LiveMap, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]
    ) -> list[Goal | Velocity]:
        explorer = self.explorer
        assert explorer is not None
        if not self._think(live_map, pose, odometry):
            return []
        target = self._guide.target(pose, self._stamp)
        if target is None:
            return []
        return [Goal(live_map.frame, self._stamp, target)]

    def _done(self, live_map: LiveMap, hearing: Hearing) -> list[Goal | Velocity]:
        """A robot that is done is told to stand, and then nothing; where it could not begin it begins elsewhere."""
        assert self.explorer is not None
        if self.explorer.end == NOWHERE and (odometry := self._odometry_at(live_map, hearing)) is not None:
            off = np.hypot(*(live_map.in_map(odometry) - self._ended)[:2])
            self._map = None if off > ELSEWHERE_M else self._map
        self._rest -= 1
        return [STOP] if self._drives.itself and self._rest >= 0 else []

    def ended(self) -> list[Goal | Velocity]:
        """What is to be published last, whatever happens."""
        return [STOP] * 3 if self._drives.itself else []

    def status(self) -> str:
        """How it goes."""
        explorer = self.explorer
        if explorer is None or (explorer.state == "looking" and not self._doubt):
            return "looking round"
        if self._doubt:
            return f"stands: {self._doubt}"
        if explorer.state == "exploring" and explorer.goal is not None:
            x, y = explorer.goal.place.tolist()
            return f"exploring: to ({x:.2f}, {y:.2f}) m"
        if explorer.end == NOWHERE:
            return f"cannot explore: {NOWHERE}"
        return {"done": f"explored: {explorer.end}", "returning": "driving home"}.get(explorer.state, "exploring")

    def settings(self) -> dict[str, str]:
        """What run.yaml says of it."""
        return {"explored": self.status()}
