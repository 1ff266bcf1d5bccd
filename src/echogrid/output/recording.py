"""A drive while it is mapped, and the map on the way, kept in memory that does not grow without end."""

import zlib
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.grid import P_MAX, P_MIN, Grid, sigmoid
from echogrid.robot import Robot

MAX_SCANS, MAX_MAPS = 4000, 60
"""A longer drive is thinned to at most so many scans, and as many maps of it on the way."""

AHEAD = 2
"""Batches of frames that ``build_map`` reads before it has fused the one whose map it yields: its WORKERS."""

_BAND_CELLS = 4_000_000


@dataclass(frozen=True)
class KeptMap:
    """The observed part of the map at one time."""

    scans: int
    """How many scans had been fused, or about as many."""
    read: int
    """How many scans had been read."""
    origin: tuple[float, float]
    """World x, y of the lower left corner of its first cell, m."""
    resolution: float
    """Side of a cell, m."""
    shape: tuple[int, int]
    """Rows and columns."""
    packed: bytes
    """Its codes, see ``_codes``, deflated."""

    @staticmethod
    def of(part: Grid, scans: int, read: int) -> "KeptMap":
        """What is kept of a map; later changes of its arrays do not matter."""
        packed = zlib.compress(_codes(part).tobytes(), 1)
        return KeptMap(scans, read, part.origin, part.resolution, part.shape, packed)

    def codes(self) -> UInt8[ndarray, "rows cols"]:
        """The probability of each cell in a byte: 0 not observed, else 1 (P_MIN) to 255 (P_MAX)."""
        return np.frombuffer(zlib.decompress(self.packed), dtype=np.uint8).reshape(self.shape)


class Recording:
    """A drive while it is mapped: its scans, and the map at some times, in memory that does not grow without end.

    Past MAX_SCANS scans every other one is dropped, and from then on only every second is kept, and so on; likewise
    past MAX_MAPS maps.
    """

    def __init__(self, robot: Robot):
        self.robot = robot
        self.scans = 0
        """Number of frames added."""
        self.stride = 1
        """Every how many-th of them is kept; the last is kept besides."""
        self._frames: list[tuple[int, Frame]] = []
        self._last: Frame | None = None
        self._maps: list[KeptMap] = []
        self._calls, self._map_stride, self._again = 0, 1, 0
        self._read: deque[int] = deque(maxlen=AHEAD + 1)

    def add(self, frame: Frame) -> None:
        """Take the next frame of the log."""
        self._last = frame
        if self.scans % self.stride == 0:
            self._frames.append((self.scans + 1, _copied(frame)))
        self.scans += 1
        if len(self._frames) > MAX_SCANS:
            self._frames = self._frames[::2]
            self.stride *= 2

    def keep(self, grid: Grid) -> None:
        """Keep a copy of the map so far.

        Args:
            grid: what ``build_map`` has just yielded; all maps of a recording have cells of one size on one lattice.
        """
        self._again = self._again + 1 if self._read and self._read[-1] == self.scans else 0
        self._read.append(self.scans)
        self._calls += 1
        if (self._calls - 1) % self._map_stride:
            return
        part = grid.observed_part()
        if part is None:
            return
        # Of the first batches only the sum is known.
        scans = self._read[0] if self._calls > AHEAD else self._read[0] * self._calls // (AHEAD + 1)
        self._maps.append(KeptMap.of(part, scans, self.scans))
        if len(self._maps) > MAX_MAPS:
            self._maps = self._maps[::2]
            self._map_stride *= 2

    def frames(self) -> list[tuple[int, Frame]]:
        """The kept frames, each with its number in the log, counted from 1; the last frame is always among them."""
        if self._last is None or self._frames[-1][0] == self.scans:
            return list(self._frames)
        return [*self._frames, (self.scans, self._last)]

    def maps(self) -> list[KeptMap]:
        """The kept maps that lack some of the scans, from the first to the last."""
        # Who reads ahead yields the last maps after the last frame; one who reads a frame ahead yields two so.
        maps = self._maps if self._again >= AHEAD else [replace(kept, scans=kept.read) for kept in self._maps]
        return [kept for kept in maps if kept.scans < self.scans]


def _codes(grid: Grid) -> UInt8[ndarray, "rows cols"]:
    """As of ``KeptMap.codes``; in bands of rows, so that a large map needs little besides."""
    codes = np.zeros(grid.shape, dtype=np.uint8)
    band = max(1, _BAND_CELLS // max(1, grid.shape[1]))
    for row in range(0, grid.shape[0], band):
        rows = np.s_[row : row + band]
        p = np.clip(sigmoid(grid.log_odds[rows]), P_MIN, P_MAX)
        codes[rows] = np.where(grid.observed[rows], np.rint(1 + 254 * (p - P_MIN) / (P_MAX - P_MIN)), 0)
    return codes


def _copied(frame: Frame) -> Frame:
    # A reader's arrays may be rows of a large one, which would stay in memory for each of them.
    mounts = None if frame.mounts is None else frame.mounts.astype(np.float32)
    return replace(frame, pose=frame.pose.copy(), ranges=frame.ranges.astype(np.float32), mounts=mounts)
