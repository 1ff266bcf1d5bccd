"""What is in a log: its size and span, the drive, and what the readings are like."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import batched

import numpy as np
from jaxtyping import Float
from numpy import inf, nan, ndarray

from echogrid.doubts import speeds
from echogrid.errors import InputError
from echogrid.frame import Frame, Log


@dataclass(frozen=True)
class LogInfo:
    """What is in a log. A share is a fraction of all readings, in [0, 1], unless its field says otherwise."""

    name: str
    """Where the log comes from."""
    frames: int
    """Number of frames."""
    sonars: int
    """Readings in a frame."""
    start_s: float
    """Stamp of the first frame, s."""
    end_s: float
    """Stamp of the last frame, s."""
    length_m: float
    """Length of the line through the poses, m; the jitter of a pose that stands still counts in."""
    box_m: tuple[float, float, float, float]
    """Lowest x, lowest y, highest x, highest y of the poses in the world, m."""
    fastest_m_s: float
    """Highest speed between two frames that is no jump of the pose, m/s."""
    fastest_rad_s: float
    """Highest turn rate, likewise, rad/s."""
    no_echo: float
    """Share of readings that are no echo."""
    not_fired: float
    """Share of readings that are not fired or not valid."""
    stale: float
    """Share of the finite readings (from the second frame on) that equal the same sonar's reading in the
    frame before to the last bit: most likely the old value, sent again. A repeated no echo is not counted,
    for nothing tells it from a fresh one."""
    nearest_m: float
    """Shortest finite reading, m; nan if there is none."""
    median_m: float
    """Median of the finite readings, each rounded to 1 cm, m; nan if there is none."""
    farthest_m: float
    """Longest finite reading, m; nan if there is none."""
    no_echo_by_sonar: tuple[float, ...]
    """For each sonar, the share of its readings that are no echo."""

    @property
    def span_s(self) -> float:
        """Time from the first frame to the last, s."""
        return self.end_s - self.start_s


def describe(log: Log) -> LogInfo:
    """Go through a log once, in bounded memory, and say what is in it.

    Raises:
        InputError: the log has no frames, or a wrong row.
    """
    tally = _Tally(log.sonars)
    for batch in batched(log, 256):
        tally.add(batch)
    if tally.frames == 0:
        raise InputError(log.name, "no frames", "at least one")
    return tally.info(log.name)


class _Tally:
    """Sums over the frames seen so far."""

    _CM_BINS = 10_001

    def __init__(self, sonars: int):
        self.frames = 0
        self._start = self._end = nan
        self._length = 0.0
        self._box = (inf, inf, -inf, -inf)
        self._last_pose: Float[ndarray, "4"] | None = None
        self._fastest = np.zeros(2)
        self._last_ranges = np.full(sonars, nan)
        self._no_echo = np.zeros(sonars, dtype=np.int64)
        self._not_fired = self._finite = self._finite_later = self._stale = 0
        self._nearest, self._farthest = inf, -inf
        self._histogram = np.zeros(self._CM_BINS, dtype=np.int64)

    def add(self, batch: Sequence[Frame]) -> None:
        """Count one or more frames in."""
        if self.frames == 0:
            self._start = batch[0].stamp
        self._end = batch[-1].stamp
        self._add_poses(np.array([frame.stamp for frame in batch]), np.array([frame.pose for frame in batch]))
        self._add_ranges(np.array([frame.ranges for frame in batch]))
        self.frames += len(batch)

    def _add_poses(self, stamps: Float[ndarray, "frames"], poses: Float[ndarray, "frames 3"]) -> None:
        low, high = poses[:, :2].min(axis=0).tolist(), poses[:, :2].max(axis=0).tolist()
        x0, y0, x1, y1 = self._box
        self._box = (min(x0, low[0]), min(y0, low[1]), max(x1, high[0]), max(y1, high[1]))
        path = np.column_stack([stamps, poses])
        path = path if self._last_pose is None else np.vstack([self._last_pose, path])
        self._last_pose = path[-1]
        found = speeds(path)
        self._length += float(found.way.sum())
        self._fastest = np.fmax(self._fastest, (found.fastest_m_s, found.fastest_rad_s))

    def _add_ranges(self, ranges: Float[ndarray, "frames sonars"]) -> None:
        finite = np.isfinite(ranges)
        later = finite if self.frames else finite[1:]
        repeated = ranges == np.vstack([self._last_ranges, ranges[:-1]])
        self._stale += int((repeated & finite).sum())
        self._finite_later += int(later.sum())
        self._finite += int(finite.sum())
        self._no_echo += (ranges == inf).sum(axis=0)
        self._not_fired += int(np.isnan(ranges).sum())
        self._last_ranges = ranges[-1]
        readings = ranges[finite]
        if readings.size:
            self._nearest = min(self._nearest, float(readings.min()))
            self._farthest = max(self._farthest, float(readings.max()))
            bins = np.clip(np.rint(readings * 100), 0, self._CM_BINS - 1).astype(np.int64)
            self._histogram += np.bincount(bins, minlength=self._CM_BINS)

    def info(self, name: str) -> LogInfo:
        """The result."""
        readings = max(self.frames * len(self._no_echo), 1)
        middle = [(self._finite - 1) // 2, self._finite // 2]
        median = float(np.searchsorted(np.cumsum(self._histogram), middle, side="right").mean()) / 100
        return LogInfo(
            name=name,
            frames=self.frames,
            sonars=len(self._no_echo),
            start_s=self._start,
            end_s=self._end,
            length_m=self._length,
            box_m=self._box,
            fastest_m_s=float(self._fastest[0]),
            fastest_rad_s=float(self._fastest[1]),
            no_echo=int(self._no_echo.sum()) / readings,
            not_fired=self._not_fired / readings,
            stale=self._stale / max(self._finite_later, 1),
            nearest_m=self._nearest if self._finite else nan,
            median_m=median if self._finite else nan,
            farthest_m=self._farthest if self._finite else nan,
            no_echo_by_sonar=tuple((self._no_echo / self.frames).tolist()),
        )
