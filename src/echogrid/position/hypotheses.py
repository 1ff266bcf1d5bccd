"""Ways that a drive may have taken in a map, where what was heard left several: each judged by the whole of it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.position.localiser import FAIR, HEAP_M, HEAP_RAD, START_SPREAD, Localiser
from echogrid.position.particles import Place, near_to

_HEAPS, _LEAST_SHARE = 6, 0.003
"""Places that are noted after a piece, at most, and the least share of one."""

_MOST = 12
"""Ways that are judged."""

_AHEAD, _COVERED = 130.0, 0.5
"""A way is sure that explains the drive so much better than all others, if those judged hold so much of the weight.
As a log-likelihood, in which no piece is independent of the last: 145 and more where it is right."""


class Way(NamedTuple):
    """A way that a drive may have taken."""

    poses: Float[ndarray, "frames 3"]
    """m, m, rad."""
    fair: bool
    """Whether what was heard agrees with the map along it."""
    alone: bool
    """Whether no other explains nearly as much."""


class _Place(NamedTuple):
    """Where the robot may have been."""

    frame: int
    pose: Float[ndarray, "3"]
    spread: Float[ndarray, "3"]
    share: float


class _Followed(NamedTuple):
    """The way through a place, as far as it was followed."""

    poses: Float[ndarray, "frames 3"]
    """nan: where it led no farther."""
    explained: float
    """As of ``Localiser``, forwards and back; -inf: it explains less than the drive."""
    agreement: float
    """As of ``Localiser``, the lower one."""


class Hypotheses:
    """Places that a localiser thought possible while it was not sure."""

    def __init__(self) -> None:
        self._places: list[_Place] = []
        self._last: tuple[list[Place], int] = [], 0
        """Heaps after the last piece, and its frame."""

    def note(self, localiser: Localiser, frame: int) -> None:
        """Note the places that are possible after a piece.

        Args:
            localiser: it has just weighed what was seen.
            frame: number of the last frame of the piece.
        """
        self._last = localiser.particles.places((HEAP_M, HEAP_RAD), 4 * _HEAPS, _LEAST_SHARE), frame
        for heap in self._last[0][:_HEAPS]:
            spread = np.maximum(START_SPREAD, np.sqrt(np.diag(heap.covariance)))
            self._places.append(_Place(frame, heap.pose, spread, heap.share))

    def likeliest(
        self, localiser: Localiser, frames: Sequence[Frame], sure: tuple[int, Float[ndarray, "3"]] | None = None
    ) -> Way | None:
        """The way that explains all that was seen best; None where none does.

        Args:
            localiser: in the same map.
            frames: of the drive, as they were numbered.
            sure: number of a frame, and a pose (m, m, rad) there that the localiser thought to be the only one.
        """
        if not self._places:
            return None
        places = sorted(self._places, key=lambda each: -each.share)
        if sure is not None:
            places.insert(0, _Place(*sure, START_SPREAD, 1.0))
        ways: list[_Followed] = []
        for place in places:
            if len(ways) == _MOST:
                break
            if not any(same_place(way.poses[place.frame], place.pose) for way in ways):
                ways.append(_followed(localiser, frames, place))
        best = max(ways, key=lambda way: way.explained)
        if not np.isfinite(best.explained):
            return None
        others = [way.explained for way in ways if not same_place(way.poses[-1], best.poses[-1])]
        ahead = best.explained - max(others, default=-np.inf)
        return Way(best.poses, best.agreement >= FAIR, ahead >= _AHEAD and self._covered(ways) >= _COVERED)

    def _covered(self, ways: list[_Followed]) -> float:
        """Share of the last places noted that ways lead through."""
        heaps, frame = self._last
        return sum(heap.share for heap in heaps if any(same_place(way.poses[frame], heap.pose) for way in ways))


def _followed(localiser: Localiser, frames: Sequence[Frame], place: _Place) -> _Followed:
    """Follow the way through a place, back to the begin of a drive and on to its end."""
    poses, explained, agreement = np.full((len(frames), 3), np.nan), 0.0, np.inf
    for part in (range(place.frame, -1, -1), range(place.frame, len(frames))):
        one = localiser.at(place.pose, place.spread)
        for k in part:
            poses[k] = one.add(frames[k]).pose
            if any(event.what == "lost" for event in one.events):
                return _Followed(poses, -np.inf, 0.0)
        explained += one.explained
        agreement = float(np.fmin(agreement, one.agreement))
    return _Followed(poses, explained, agreement)


def same_place(one: Float[ndarray, "3"], other: Float[ndarray, "3"]) -> bool:
    """Whether two poses (m, m, rad) are of one heap of particles."""
    return bool(near_to(one[None], other, (HEAP_M, HEAP_RAD))[0])
