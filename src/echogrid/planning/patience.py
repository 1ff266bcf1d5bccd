"""How long an explorer goes on though it sees nothing new."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

STUCK_M, STUCK_PER_M2, STUCK_S_PER_M, FAITH = (20.0, 60.0), 1.2, 6.0, 0.2
"""A robot that has looked at walls for so many metres for each m2 that it knows to be free, within these limits, or
for so many seconds for each of these metres, and has seen nothing new, has seen what it can. On the way to likelier
places each metre and second counts so much: in a large building they are far."""

NEW_M2 = 0.2
"""Less than this is nothing new: a robot that stands about hears a little more of what it knows for ever."""


class Patience:
    """What has been spent since something new was seen."""

    def __init__(self, at: Float[ndarray, "2"]) -> None:
        """Nothing is known yet.

        Args:
            at: way (m) and time (s) so far.
        """
        self._counted, self._vain = at, np.zeros(2)
        self._known_m2: float | None = 0.0

    def note(self, known_m2: float, at: Float[ndarray, "2"], counts: float) -> None:
        """Take down how much floor is known to be free.

        Args:
            known_m2: that.
            at: way (m) and time (s) so far.
            counts: so much each metre and second counts that was spent since it was told last.
        """
        self._vain += (at - self._counted) * counts
        self._counted = at
        if self._known_m2 is None:  # made anew: what is known of it is nothing new, nor did it become less
            self._known_m2 = known_m2
        elif known_m2 > self._known_m2 + NEW_M2:
            self._known_m2, self._vain = known_m2, np.zeros(2)

    def remapped(self) -> None:
        """The map was made anew, by other poses."""
        self._known_m2 = None

    @property
    def over(self) -> bool:
        """Whether it has seen what it can."""
        most = np.array([1.0, STUCK_S_PER_M]) * np.clip(STUCK_PER_M2 * (self._known_m2 or 0.0), *STUCK_M)
        return bool(np.any(self._vain > most))
