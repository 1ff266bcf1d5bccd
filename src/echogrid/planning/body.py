"""What a robot's body tells of the floor: where it has been there is room, and where it touched anything none."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.grid import P_MIN, Grid, logit
from echogrid.planning.clearance import Floor, swept

TRACK_P, TRACK_M = 0.9, 0.04
"""Where the robot has been there was room for it: what is occupied with less than this there is free, for the posts
of a door can look so near to each other afterwards that it would not get back. Places are kept so far apart, m."""

FRONT_RAD, TOUCHED_M, AHEAD = np.deg2rad(np.arange(-90.0, 91.0, 10.0)), 0.12, 0.05
"""Where a robot touches what it drives against, from forward, and so far beyond its footprint the map is looked up;
what probability a radian aside is worth, where one place is as likely as the other."""

BUMP_M = 0.05
"""Round what was touched so much is taken to be occupied: where a robot touches anything the map is wrong by some
centimetres, and it would touch it again."""

_AROUND = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)])


class Body:
    """A disc that was driven about."""

    def __init__(self) -> None:
        """It has been nowhere."""
        self._track: Float[ndarray, "n 2"] = np.empty((0, 2))
        self._touched: list[Float[ndarray, "2"]] = []

    def been(self, place: Float[ndarray, "2"]) -> None:
        """It is somewhere, m."""
        if not len(self._track) or np.linalg.norm(self._track[-1] - place) > TRACK_M:
            self._track = np.vstack([self._track, place])

    def touched(self, around: Grid, pose: Float[ndarray, "3"], radius_m: float) -> None:
        """It touched something that the map does not show.

        Bumpers and wheels that stall do not tell where: it is taken to be where the map is least sure that the front
        of the footprint is on free floor. In a door that is a post, and not the middle of the way.

        Args:
            around: the map round the robot.
            pose: of it, m, m, rad.
            radius_m: of its footprint.
        """
        angle = (pose[2] + FRONT_RAD)[:, None]
        rim = radius_m + np.arange(0.0, TOUCHED_M, around.resolution)
        points = pose[:2] + np.stack([rim * np.cos(angle), rim * np.sin(angle)], axis=-1)
        taken = around.probability_at(points.reshape(-1, 2)).reshape(points.shape[:2]).max(axis=1)
        self._touched.append(points[int(np.argmax(taken - AHEAD * np.abs(FRONT_RAD))), 0])

    def remapped(self) -> None:
        """The map was made anew, by other poses: it has not been where it was taken to have been."""
        self._track = np.empty((0, 2))

    def mark(self, floor: Floor) -> None:
        """Write into a floor's own map, which nobody has asked for anything yet, what the body tells."""
        grid = floor.grid
        index = grid.index_of(self._track)
        index = index[np.all((index >= 0) & (index < grid.shape), axis=1)]
        if len(index):
            been = np.zeros(grid.shape, dtype=bool)
            been[tuple(index.T)] = True
            crossed = swept(been, floor.radius_m, grid.resolution) & (grid.log_odds < logit(TRACK_P))
            grid.log_odds[crossed], grid.observed[crossed] = logit(P_MIN), True
        for touched in self._touched:
            for place in touched + BUMP_M * _AROUND:
                if (cell := floor.cell(place)) is not None:
                    grid.log_odds[cell], grid.observed[cell] = 5.0, True
