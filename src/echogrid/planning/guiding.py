"""Where to send a robot that somebody else drives, as Nav2: one place after the other."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.planning.explorer import Explorer

NEAR_M = 0.3
"""A robot so near to where it was sent has arrived: Nav2 stops .25 m off."""

PATIENCE_S, NEARER_M = 30.0, 0.1
"""A robot that comes no nearer for so long, by so much, does not get there."""

AGAIN_S = 10.0
"""A place that the robot does not come nearer to is told again so often: who drives may not have been there."""

AGAIN_M = 0.25
"""A place that moves by less is the same one."""


class Guide:
    """Takes an explorer's places one by one to somebody who drives to them and says nothing."""

    def __init__(self, explorer: Explorer):
        """No place yet.

        Args:
            explorer: decides; it is to ``think`` before it is asked for a place.
        """
        self._explorer = explorer
        self._target: Float[ndarray, "3"] | None = None
        self._nearest, self._since, self._told = np.inf, -np.inf, -np.inf

    def target(self, pose: Float[ndarray, "3"], stamp: float) -> Float[ndarray, "3"] | None:
        """Where to send the robot now (m, m, rad); None: it is under way, or there is nothing to be said.

        Args:
            pose: of the robot, m, m, rad.
            stamp: s.
        """
        explorer = self._explorer
        explorer.note_way(pose)
        place = explorer.target()
        if place is None:
            return None
        off = float(np.linalg.norm(place[:2] - pose[:2]))
        if off < NEAR_M:
            explorer.arrived()
            return None
        same = self._target is not None and float(np.linalg.norm(place[:2] - self._target[:2])) < AGAIN_M
        if not same:
            self._target, self._nearest, self._since, self._told = place, off, stamp, stamp
            return place
        if off < self._nearest - NEARER_M:
            self._nearest, self._since, self._told = off, stamp, stamp
        elif stamp - self._since > PATIENCE_S:
            self._target = None
            explorer.give_up()
        elif stamp - self._told > AGAIN_S:
            self._told = stamp
            return place
        return None
