"""What is asked of a robot that explores while it is mapped: options of live."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from echogrid.errors import UsageError

if TYPE_CHECKING:
    from echogrid.live.driving import Drives

MOST_SPEED_M_S, MOST_RADIUS_M = 1.0, 2.0
"""Sonars are too slow, and their maps too coarse, for more."""


@dataclass(frozen=True)
class Explores:
    """Whether the robot explores, and who drives it."""

    explore: bool = False
    """Send the robot to what is not known yet, place by place, as Nav2 takes them (geometry_msgs/PoseStamped on
    /goal_pose), and home in the end."""
    drive: bool = False
    """With --explore: drive it there, by geometry_msgs/Twist on /cmd_vel, in place of sending goals. It stands where
    nothing near is known to be free, where ranges are silent, and where its pose is in doubt. THE ROBOT MOVES: read
    docs/how-to/safety.md."""
    radius: Annotated[float | None, arg(metavar="M")] = None
    """With --explore: radius of the robot's footprint, m; --drive needs it. Default: what its sonars surround."""
    max_speed: Annotated[float | None, arg(metavar="M/S")] = None
    """With --drive: how fast it is driven at most, m/s. Default: 0.3."""
    goal_topic: str = "/goal_pose"
    """Where to publish the next place."""
    cmd_vel_topic: str = "/cmd_vel"
    """Where to publish velocities."""

    def drives(self, known: bool) -> "Drives | None":
        """How the robot is to explore; None: it is not.

        Args:
            known: whether the map is known already.
        """
        if not self.explore:
            self._refuse_without("explore", "drive", "radius", "max_speed", "goal_topic", "cmd_vel_topic")
            return None
        if not self.drive:
            self._refuse_without("drive", "max_speed", "cmd_vel_topic")  # who takes goals drives as fast as he likes
        elif self.goal_topic != Explores.goal_topic:
            raise UsageError("--goal-topic: found --drive, which sends no goals, expected one of the two")
        if known:
            raise UsageError("--explore, --map: found both, expected one of the two: a known map is not explored")
        if self.radius is None and self.drive:
            raise UsageError("--drive: found no --radius, expected that of the robot's footprint, m")
        if self.radius is not None and not 0.02 <= self.radius <= MOST_RADIUS_M:
            raise UsageError(f"--radius: found {self.radius:g}, expected 0.02 to {MOST_RADIUS_M:g} m")
        if not 0.05 <= self._speed <= MOST_SPEED_M_S:
            raise UsageError(f"--max-speed: found {self._speed:g}, expected 0.05 to {MOST_SPEED_M_S:g} m/s")
        from echogrid.live.driving import Drives
        from echogrid.planning.following import Pace

        pace = Pace(speed_m_s=self._speed, creep_m_s=min(self._speed, Pace.creep_m_s))
        return Drives(self.radius, self.drive, pace)

    def _refuse_without(self, needed: str, *names: str) -> None:
        for name in names:
            if getattr(self, name) != getattr(Explores, name):
                raise UsageError(f"--{name.replace('_', '-')}: found no --{needed}, expected both")

    @property
    def _speed(self) -> float:
        from echogrid.planning.following import Pace

        return Pace.speed_m_s if self.max_speed is None else self.max_speed

    def topics(self) -> tuple[str | None, str | None]:
        """Where goals and velocities go, None where none are sent.

        Who drives sends no goals: whoever takes them would drive as well.
        """
        if not self.explore:
            return None, None
        return (None, self.cmd_vel_topic) if self.drive else (self.goal_topic, None)

    def told(self) -> str:
        """What everybody near the robot is to know."""
        if not self.drive:
            return f"explores: sends goals on {self.goal_topic}; whoever takes them, as Nav2 does, moves the robot"
        return (
            f"DRIVES THE ROBOT ITSELF by {self.cmd_vel_topic}, up to {self._speed:g} m/s, "
            f"a disc of {self.radius:g} m: stand clear, keep an emergency stop at hand; Ctrl-C stops it"
        )
