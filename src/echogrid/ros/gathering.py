"""Single readings of sonars, each at its own time, gathered into frames with poses: what ROS's messages become.

A frame holds each sonar at most once. Sonars that fire one after another share a frame; where the robot moved
between, the frame says from where each of them looked.
"""

from collections import Counter, deque
from collections.abc import Iterator
from math import inf, isnan, nan, radians
from statistics import median

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.robot import Robot
from echogrid.ros.rigid import IDENTITY, Rigid, compose, inverse, planar
from echogrid.ros.transforms import JUMP_S, Transforms

SILENT_S = 1.0
"""A sonar that was not heard for longer, and for five of its periods, is not waited for."""

BACK_S = 1.0
"""A stamp that lies farther back than this is a clock that has jumped, not a message that is late."""

LONGEST_S = 2.0
"""Readings farther apart in time are no one scan."""

GAP = 0.7
"""A pause of this share of the sonars' period ends a scan."""

WAITING = 5_000
"""Scans that wait for their pose at most."""

PAUSE_S = 30.0
"""How long a scan waits for a pose, by the stamps of those after it."""

SAME_M, SAME_RAD = 0.002, radians(0.2)
"""A sonar that moved less between its firing and the frame's pose has not moved."""

ENDS_S = 0.5
"""A scan that lies no farther outside of all poses has none because the one began to be heard before the other."""

_AT_ONCE_S = 1e-3
"""Readings no farther apart in time are of one pose."""

LATE = "a reading older than the one before of its sonar"
REPEATED = "a reading that came twice"
BACK = "a clock that jumped back"
NO_POSE = "a scan without a pose at its time"


class Scans:
    """Gathers readings into frames, in bounded memory."""

    def __init__(self, robot: Robot, transforms: Transforms, fixed: str, base: str):
        """A new drive.

        Args:
            robot: its mounts are in the order of the sonars' numbers.
            transforms: where the poses come from; others may add to it as time goes on.
            fixed: frame to map in.
            base: frame of the robot.
        """
        self.robot, self.fixed, self.base = robot, fixed, base
        self.dropped: Counter[str] = Counter()
        """How many readings or scans were left out, by reason; but for scans at the ends of the drive, see ENDS_S."""
        self._transforms = transforms
        self._gathering: dict[int, tuple[float, float]] = {}
        self._first = self._last = -inf
        self._waiting: deque[dict[int, tuple[float, float]]] = deque()
        self._heard = [nan] * robot.sonars
        self._awaited = set(range(robot.sonars))
        self._periods: deque[float] = deque(maxlen=64)
        self._period, self._counted = inf, 0
        self._begin, self._newest, self._stamp = inf, -inf, -inf

    def add(self, sonar: int, stamp: float, range_m: float) -> str | None:
        """Take a reading (m; +inf no echo, nan not valid) of a sonar by its number, fired at a time (s).

        Returns:
            None if it was taken, else why it was dropped: LATE, REPEATED, or BACK, after which it is the caller's to
            say whether the log is broken or time begins anew.
        """
        before = self._heard[sonar]
        if stamp <= before:
            reason = REPEATED if stamp == before else BACK if stamp < before - BACK_S else LATE
            self.dropped[reason] += 1
            return reason
        if self._gathering and (
            sonar in self._gathering
            or stamp - self._last > GAP * self._period
            or abs(stamp - self._first) > LONGEST_S
        ):
            self._close()
        if isnan(before):
            self._begin = min(self._begin, stamp)
        else:
            self._learn(stamp - before)
        self._heard[sonar] = stamp
        if stamp > self._newest:
            self._newest = stamp
        if not self._gathering:
            self._first = self._last = stamp
        elif stamp > self._last:
            self._last = stamp
        self._gathering[sonar] = stamp, range_m
        if len(self._gathering) >= len(self._awaited) and self._awaited <= self._gathering.keys():
            self._close()
        return None

    def _learn(self, interval: float) -> None:
        if interval > 1e-6:
            self._periods.append(interval)
            self._counted += 1
            if self._counted <= 8 or self._counted % 64 == 0:
                self._period = median(self._periods)

    def silent(self) -> list[int]:
        """Numbers of the sonars that have not been heard for so long that they are not waited for."""
        patience = max(SILENT_S, 5 * self._period if self._period < inf else 0.0)
        # One that was never heard is not silent before it had its time.
        heard = (self._begin if isnan(last) else last for last in self._heard)
        return [number for number, last in enumerate(heard) if self._newest - last > patience]

    def _close(self) -> None:
        self._waiting.append(self._gathering)
        self._gathering = {}
        self._awaited = set(range(len(self._heard))).difference(self.silent())
        if len(self._waiting) > WAITING:
            self._waiting.popleft()
            self.dropped[NO_POSE] += 1

    @property
    def newest(self) -> float:
        """Stamp of the latest reading, s."""
        return self._newest

    @property
    def pending(self) -> int:
        """Scans that are complete and wait for their poses."""
        return len(self._waiting)

    def frames(self, reach: float = 0.0, final: bool = False) -> Iterator[Frame]:
        """Frames of the scans that are complete and whose poses are known.

        Args:
            reach: how far past the newest transform a pose is still taken from it, s.
            final: nothing comes any more: what is gathered is a scan, and what has no pose never gets one.
        """
        if final and self._gathering:
            self._close()
        while self._waiting:
            scan = self._waiting[0]
            frame = self._frame(scan, reach)
            if frame is None:
                known = self._transforms.known(self.fixed, self.base)
                end = max(stamp for stamp, _ in scan.values())
                newest = max(stamp for stamp, _ in self._waiting[-1].values())
                waited = newest - end
                if final or waited > JUMP_S:  # a correction that comes so seldom need not be waited for
                    frame = self._frame(scan, reach, hold=True)
                if frame is None and not final and (known is None or known[1] < end) and waited < PAUSE_S:
                    return  # its pose may still come
                if frame is None and not _at_the_ends(scan, known):
                    self.dropped[NO_POSE] += 1
            if frame is not None:
                yield frame
            self._waiting.popleft()

    def _frame(self, scan: dict[int, tuple[float, float]], reach: float, hold: bool = False) -> Frame | None:
        stamps = [stamp for stamp, _ in scan.values()]
        end = max(stamps)
        there = self._transforms.rigid(self.fixed, self.base, end, reach, hold)
        if there is None:
            return None
        ranges = np.full(self.robot.sonars, nan)
        for number, (_, value) in scan.items():
            ranges[number] = value
        mounts = None
        if end - min(stamps) > _AT_ONCE_S:
            mounts = self._mounts(scan, end, there, reach, hold)
            if mounts is None:
                return None
            moved = np.abs(mounts - self.robot.mounts)
            if np.all(moved[:, :2] < SAME_M) and np.all(np.abs(wrap(moved[:, 2])) < SAME_RAD):
                mounts = None
        self._stamp = max(self._stamp, end)
        return Frame(self._stamp, np.array(planar(there)), ranges, mounts=mounts)

    def _mounts(
        self, scan: dict[int, tuple[float, float]], end: float, there: Rigid, reach: float, hold: bool
    ) -> Float[ndarray, "sonars 3"] | None:
        """Where each sonar was when it fired, as seen from the robot at the end (m, m, rad); None if that is not
        known of all.
        """
        mounts = self.robot.mounts.copy()
        back, poses = inverse(there), {end: IDENTITY}
        for number, (stamp, _) in scan.items():
            if end - stamp <= _AT_ONCE_S:
                continue
            if stamp not in poses:
                then = self._transforms.rigid(self.fixed, self.base, stamp, reach, hold)
                if then is None:
                    return None
                poses[stamp] = compose(back, then)
            x, y, turn = planar(poses[stamp])
            mx, my, axis = self.robot.mounts[number]
            cos, sin = np.cos(turn), np.sin(turn)
            mounts[number] = x + cos * mx - sin * my, y + sin * mx + cos * my, axis + turn
        return mounts


def _at_the_ends(scan: dict[int, tuple[float, float]], known: tuple[float, float] | None) -> bool:
    """Whether a scan begins shortly before the first pose or ends shortly after the last."""
    stamps = [stamp for stamp, _ in scan.values()]
    return known is not None and (0 < known[0] - min(stamps) <= ENDS_S or 0 < max(stamps) - known[1] <= ENDS_S)
