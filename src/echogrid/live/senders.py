"""Who sends what is heard: where two programs tell one thing at once, the robot is here and there in turn."""

from collections import Counter, deque
from collections.abc import Hashable

MOST = 512
"""Things that are told apart; a robot has fewer."""

TURNS = 3
"""So often it went back to a sender that had been followed by another; once is one that hands over."""

AT_ONCE_S = 2.0
"""Two that were heard in turn so long ago are one by now."""

_STAMPS = 50
"""What was stamped as one of the last is the same message, repeated by a relay."""


class Senders:
    """The senders of each thing that is told: a topic, or a frame."""

    def __init__(self) -> None:
        """Nothing heard."""
        self._last: dict[str, Hashable] = {}
        self._before: dict[str, Hashable] = {}
        self._stamps: dict[str, deque[float]] = {}
        self._turns: Counter[str] = Counter()
        self._when: dict[str, float] = {}

    def note(self, what: str, source: Hashable, stamp: float, now: float) -> None:
        """Take note of a message.

        Args:
            what: it tells.
            source: who sent it; None: that is not known.
            stamp: s.
            now: the caller's clock, s.
        """
        if source is None or (what not in self._last and len(self._last) >= MOST):
            return
        stamps = self._stamps.setdefault(what, deque(maxlen=_STAMPS))
        last = self._last.setdefault(what, source)
        if source != last:
            if stamp in stamps:
                return
            if source == self._before.get(what):
                self._turns[what] += 1
                self._when[what] = now
            self._before[what], self._last[what] = last, source
        stamps.append(stamp)

    @property
    def contested(self) -> list[str]:
        """What two have told at once."""
        return sorted(what for what, turns in self._turns.items() if turns >= TURNS)

    def at_odds(self, now: float) -> bool:
        """Whether two tell anything at once, by the caller's clock (s)."""
        return any(now - self._when[what] < AT_ONCE_S for what in self.contested)
