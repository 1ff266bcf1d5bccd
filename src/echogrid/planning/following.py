"""A path becomes wheel velocities; and whether the robot may go on, by what the map knows right now."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.geometry import wrap
from echogrid.planning.clearance import Floor

AHEAD_M = 0.35
"""The robot heads for the point of its path so far on from where it is."""

ON_THE_SPOT_RAD = np.deg2rad(35.0)
"""A robot that heads farther off than this turns before it goes on."""

THERE_M = 0.06
"""A robot so near to the end of its path has arrived."""

TURNED_RAD = np.deg2rad(4.0)
"""A robot that heads so nearly where it is to has turned."""

SLACK_M = 0.05
"""What lies so far past the place where the robot could stop is looked at besides."""

GRAZE_M = 0.03
"""So much nearer than its footprint a robot may come, off its path, to what is not known to be free: walls are mapped
thicker than that."""

REACTION_S = 0.3
"""From what is seen to wheels that slow down, as a rule."""


@dataclass(frozen=True)
class Pace:
    """How fast a robot is driven."""

    speed_m_s: float = 0.3
    turn_rad_s: float = 0.9
    braking_m_s2: float = 0.4
    turn_braking_rad_s2: float = 1.2
    creep_m_s: float = 0.1
    """Where there is little room beside the robot."""
    roomy_m: float = 0.25
    """With so much room beside it a robot need not slow down."""
    reaction_s: float = REACTION_S
    """From what is seen to wheels that slow down."""

    def reach_m(self, speed_m_s: float) -> float:
        """How far ahead of a robot that goes so fast the way is to be free."""
        return speed_m_s * self.reaction_s + speed_m_s**2 / (2 * self.braking_m_s2) + SLACK_M

    def late(self, seconds: float) -> "Pace":
        """The pace of a robot that is told what to do only so often (s): it goes no farther blindly than it would."""
        if seconds <= REACTION_S:
            return self
        share = REACTION_S / seconds
        return replace(
            self,
            speed_m_s=self.speed_m_s * share,
            turn_rad_s=self.turn_rad_s * share,
            creep_m_s=self.creep_m_s * share,
            reaction_s=seconds,
        )


def follow(
    points: Float[ndarray, "n 2"], pose: Float[ndarray, "3"], room_m: float, pace: Pace
) -> tuple[float, float] | None:
    """The velocity (m/s, rad/s) that leads along a path; None at its end.

    Args:
        points: of the path, at most some 5 cm apart, m.
        pose: of the robot, m, m, rad.
        room_m: beside it, m.
        pace: how fast it is driven.
    """
    off = np.linalg.norm(points - pose[:2], axis=1)
    nearest = int(np.argmin(off))
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points[nearest:], axis=0), axis=1)))
    to_end = float(off[nearest] + way[-1])
    if to_end < THERE_M:
        return None
    # In the narrow the robot keeps closer to its path.
    ahead = AHEAD_M * float(np.clip(0.4 + room_m / pace.roomy_m, 0.4, 1.0))
    target = points[nearest + min(int(np.searchsorted(way, ahead)), len(way) - 1)]
    bearing = float(wrap(np.arctan2(*(target - pose[:2])[::-1]) - pose[2]))
    if abs(bearing) > ON_THE_SPOT_RAD:
        return 0.0, turn_by(bearing, pace)
    share = float(np.clip(room_m / pace.roomy_m, 0.0, 1.0))
    speed = pace.creep_m_s + share * (pace.speed_m_s - pace.creep_m_s)
    speed = min(speed, np.sqrt(2 * pace.braking_m_s2 * to_end), pace.speed_m_s * np.cos(2 * bearing))
    distance = max(float(np.linalg.norm(target - pose[:2])), 0.1)
    turn = 2 * speed * np.sin(bearing) / distance + 0.8 * bearing
    return float(max(speed, min(0.03, pace.creep_m_s))), float(np.clip(turn, -pace.turn_rad_s, pace.turn_rad_s))


def turn_by(angle: float, pace: Pace) -> float:
    """The rate (rad/s) at which a robot that is to turn by an angle (rad) turns now."""
    rate = min(pace.turn_rad_s, float(np.sqrt(2 * pace.turn_braking_rad_s2 * abs(angle))))
    return float(np.copysign(rate, angle))


def may_go(floor: Floor, pose: Float[ndarray, "3"], velocity: tuple[float, float], pace: Pace) -> bool:
    """Whether nothing that is occupied or unknown comes under the footprint before the robot could stop.

    Where it stands already on what is not known, it may go to where it covers less of that.

    Args:
        floor: the map round the robot as it is now.
        pose: m, m, rad.
        velocity: that it is to have, m/s and rad/s.
        pace: how fast it is driven.
    """
    speed, turn = velocity
    if speed <= 0:
        return True
    reach = pace.reach_m(speed)
    s = np.append(np.arange(0.0, reach, 0.04), reach)
    heading = pose[2] + turn / speed * s / 2
    points = pose[:2] + np.stack([s * np.cos(heading), s * np.sin(heading)], axis=1)
    row, col = np.clip(floor.grid.index_of(points), 0, np.array(floor.grid.shape) - 1).T
    room = floor.known_m[row, col] - floor.radius_m
    return bool(np.all(room[1:] >= min(-GRAZE_M, float(room[0]) - 1e-6)))
