"""What was heard a moment ago, where odometry says that it is: near the robot that holds where the map is wrong."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse, transform
from echogrid.grid import Grid, logit
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import DEFAULT
from echogrid.models.model import Model
from echogrid.planning.onward import Onward, taken_at
from echogrid.position.motion import broken
from echogrid.robot import Robot

HALF_LIFE_S = 10.0
"""What was heard so long ago counts half: by then a robot has come 2 or 3 m, on which odometry errs by some cm."""

REACH_M, SURE_P = 0.3, 0.9
"""What is occupied with more than this, so near to the footprint, is there: on such a way a robot stops. What is less
sure or farther off may be a door, whose posts are heard all over it."""


class Nearby:
    """A map that forgets, of what a robot hears that finds its poses.

    Poses that are found are put right now and then, by some centimetres against the walls that were mapped before,
    and several visits lie beside each other in the map: by more, at times, than there is beside a robot in a door.
    The way since a post was heard last is short, and odometry knows it to some centimetres.
    """

    def __init__(self, robot: Robot, model: Model | str = DEFAULT):
        """Nothing heard.

        Args:
            robot: its sonars and its footprint.
            model: the sensor model, one that can forget.
        """
        self._robot = robot
        self._make = lambda: Mapper(self._robot, model, half_life=HALF_LIFE_S)
        self._mapper, self._last = self._make(), None
        self._onward = Onward(robot)

    def add(self, frames: Sequence[Frame]) -> None:
        """Take scans, posed by odometry; where that jumps, or time goes back, all before is forgotten.

        Raises:
            UsageError: as of ``Mapper.add``.
        """
        for frame in frames:
            if self._last is not None:
                took = frame.stamp - self._last.stamp
                if took < 0 or broken(self._last.pose, frame.pose, took):
                    self._mapper = self._make()
                    self._onward.forget()
            self._last = frame
            self._mapper.add([frame])
            self._onward.add([frame])

    def equip(self, robot: Robot) -> None:
        """Go on with an array that has grown."""
        self._robot = robot
        self._mapper.equip(robot)
        self._onward.equip(robot)

    def laid_over(self, grid: Grid, pose: Float[ndarray, "3"], odometry: Float[ndarray, "3"]) -> Grid:
        """A map with what is surely near the robot in it, a copy.

        Args:
            grid: the map.
            pose: of the robot in it, m, m, rad.
            odometry: likewise, by odometry.
        """
        x, y, _ = odometry.tolist()
        reach = self._robot.footprint_radius_m + REACH_M
        near = self._mapper.around(x, y, 2 * reach)
        places = near.centre_of(np.argwhere(near.observed & (near.log_odds > logit(SURE_P))))
        places = places[np.hypot(*(places - odometry[:2]).T) < reach]
        grid = taken_at(grid, transform(compose(pose, inverse(odometry)), places))
        return self._onward.laid_over(grid, pose, odometry)
