"""Leonard's four targets of sonar: planes, corners, edges, cylinders, and where a sensor sees them (eq. 1 to 3)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray


@dataclass(frozen=True)
class Plane:
    """A wall's line in Hessian form: x cos(theta) + y sin(theta) = R, seen from one side."""

    R: float
    """Distance of the line from the origin, m."""
    theta: float
    """Direction of the normal, rad."""
    V: int
    """The visible half plane: +1 the side of the origin (for R > 0), -1 the other."""

    def range_bearing(self, p_world: Float[ndarray, "2"]) -> tuple[float, float]:
        """Range (m) and bearing (rad) from a sensor; visible if the range is positive (eq. 1).

        The paper prints the bearing as theta for both sides; for V = -1 that points away from the wall.
        """
        reach = self.V * (self.R - p_world[0] * np.cos(self.theta) - p_world[1] * np.sin(self.theta))
        return float(reach), self.theta if self.V > 0 else self.theta + np.pi


@dataclass(frozen=True)
class Corner:
    """A concave corner: two walls that meet in front of the sensor."""

    x: float
    y: float

    def range_bearing(self, p_world: Float[ndarray, "2"]) -> tuple[float, float]:
        """Range (m) and bearing (rad) from a sensor (eq. 2)."""
        return float(np.hypot(self.x - p_world[0], self.y - p_world[1])), _bearing(self, p_world)


@dataclass(frozen=True)
class Edge(Corner):
    """A convex edge or the free end of a wall; range and bearing as for a corner (eq. 2)."""


@dataclass(frozen=True)
class Cylinder:
    """A convex cylinder seen from outside."""

    x: float
    y: float
    radius: float

    def range_bearing(self, p_world: Float[ndarray, "2"]) -> tuple[float, float]:
        """Range (m) and bearing (rad) from a sensor (eq. 3)."""
        reach = np.hypot(self.x - p_world[0], self.y - p_world[1]) - self.radius
        return float(reach), _bearing(self, p_world)


def _bearing(target: Corner | Cylinder, p_world: Float[ndarray, "2"]) -> float:
    return float(np.arctan2(target.y - p_world[1], target.x - p_world[0]))
