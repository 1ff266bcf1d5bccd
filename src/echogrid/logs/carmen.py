"""The CARMEN log: one message a line, its name first.

Two messages are read, all others are passed over (lengths in m, angles in rad, times in s)::

    SONAR cone n range*n (x y theta)*n t host t
    ODOM x y theta tv rv accel t host t

Of the two times the first, third from the end, is the message's own and is the one used; the last is when
the logger wrote the line. The pose of a SONAR message is the odometry at its time, interpolated between the
ODOM messages before and after it (the heading on the shorter way); for half a second before the first and
after the last ODOM it is that one's pose. A SONAR message farther out, or in a gap of the odometry in which
the robot moved, has no pose and is left out.
"""

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Iterator
from functools import partial
from math import inf, radians, remainder, tau
from pathlib import Path
from re import compile as pattern
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.files import printable
from echogrid.frame import Frame, Log, Progress
from echogrid.logs.lines import numbered, quoted, text_of
from echogrid.logs.rows import Table, number_of, only_numbers
from echogrid.robot import MAX_SONARS, TRANSDUCERS, Robot, surrounded
from echogrid.ros.transforms import JUMP_S, moved

MAX_HELD = 10_000
"""SONAR messages that may wait for an ODOM message; at 10 a second, a quarter of an hour."""

_KEPT_ODOMS = 256
"""A SONAR line may stand this many ODOM lines too late in the file and still find its pose."""

REACH_S = 0.5
"""How far before the first and after the last ODOM message its pose is still taken, s."""

OUTSIDE = (
    f"a SONAR line more than {REACH_S:g} s before the first or after the last ODOM, left out"
    " (log both throughout, by one clock)"
)
GAP = (
    f"a SONAR line in a gap of the odometry of more than {JUMP_S:g} s in which the robot moved, left out"
    " (log ODOM throughout)"
)

_FIRST_WORD = pattern(r"#|[A-Z][A-Z0-9_]*(\s|$)")
_ODOM_FIELDS = 10
_ODOM_TABLE = Table(("x", "y", "theta", "t"))


class _Sonar(NamedTuple):
    stamp: float
    cone: float
    ranges: list[float]
    mounts: list[bytes]
    """The fields of all mounts as they stand in the line. They repeat, so that they are seldom parsed."""


def recognises(first_line: str) -> bool:
    """Whether a file that starts with this line is meant as a CARMEN log: a comment or a message's name."""
    return _FIRST_WORD.match(first_line) is not None


def load(path: Path, robot: Robot | None) -> Log:
    """Open a CARMEN log; the messages are read, and checked, as the log is gone through.

    Opening reads as far as the first SONAR and the first ODOM line. Going through the log holds back the
    SONAR messages since the last ODOM; more than MAX_HELD of them are an error, because they have no pose
    and the memory is bounded.

    Args:
        path: the file.
        robot: taken in place of what the log says of its robot. Without it the log describes one, named
            ``carmen``: mounts and beam width (the cone if between 1 and 90 degrees, else 25) from its first
            SONAR line, a footprint that the mounts surround. The format carries neither the
            transducer nor the limits of the range; polaroid-600, 0.15 m and 5.0 m are taken.

    Raises:
        InputError: not such a file, a wrong first SONAR line, or no SONAR or no ODOM line at all.
    """
    name = printable(path)
    first: tuple[_Sonar, str] | None = None
    has_odom = False
    for number, line in numbered(path):
        fields = _fields(line)
        if fields[:1] == [b"SONAR"] and first is None:
            where = f"{name}:{number}"
            first = _sonar(fields, where, None), where
        has_odom = has_odom or fields[:1] == [b"ODOM"]
        if first and has_odom:
            break
    if first is None or not has_odom:
        raise _lacking("SONAR" if first is None else "ODOM", name)
    sonar, where = first
    described = robot or _robot(sonar, where)
    notes: dict[str, int] = {}
    progress = Progress("scan", lambda: sum(line.startswith(b"SONAR ") for _, line in numbered(path)))
    frames = partial(_frames, path, sonar, described, robot is None, notes, progress)
    return Log(name, len(sonar.ranges), described, frames, notes, progress)


def _frames(
    path: Path, first: _Sonar, robot: Robot, keep_mounts: bool, notes: dict[str, int], progress: Progress
) -> Iterator[Frame]:
    """Go through the messages; at the end the notes are those of this time.

    With ``keep_mounts`` every SONAR line must have the mounts of the first.
    """
    name, track, left_out, count, begin = printable(path), _Track(), Counter[str](), 0, inf
    for progress.done, sonar in enumerate(_posed(path, name, first, track, keep_mounts), 1):
        begin = min(begin, sonar.stamp)
        pose = track.pose_at(sonar.stamp)
        if isinstance(pose, str):
            left_out[pose] += 1
            continue
        count += 1
        yield Frame(sonar.stamp, pose, robot.clean(np.array(sonar.ranges)))
    notes.clear()
    notes |= left_out
    if not count:
        raise InputError(
            name,
            f"no SONAR line at a time of odometry (SONAR from {begin:.1f} s, ODOM from {track.begin:.1f} to"
            f" {track.end:.1f} s)",
            "stamps of one clock",
        )


def _posed(path: Path, name: str, first: _Sonar, track: "_Track", keep_mounts: bool) -> Iterator[_Sonar]:
    """The SONAR messages, each as soon as the track has the odometry round it or there is no more."""
    table = Table(("t", *(f"r{i}" for i in range(len(first.ranges)))))
    waiting: deque[_Sonar] = deque()
    last_stamp = -inf
    for number, line in numbered(path):
        fields = _fields(line)
        if not fields:
            continue
        where = f"{name}:{number}"
        if fields[0] == b"ODOM":
            track.add(fields, where)
        else:
            sonar = _sonar(fields, where, len(first.ranges))
            if sonar.mounts != first.mounts:
                moved = not np.allclose(_mounts(sonar, where), _mounts(first, where), atol=1e-3)
                if moved and keep_mounts:
                    raise InputError(where, "other mounts", "those of the first SONAR line")
            _check(table, [sonar.stamp, *sonar.ranges], where, last_stamp)
            last_stamp = sonar.stamp
            if len(waiting) == MAX_HELD:
                raise InputError(where, f"{MAX_HELD} SONAR lines and no ODOM line", "odometry between them")
            waiting.append(sonar)
        while waiting and waiting[0].stamp <= track.end:
            yield waiting.popleft()
    if last_stamp == -inf or track.end == -inf:
        # Opening has seen both: the file has changed since.
        raise _lacking("SONAR" if last_stamp == -inf else "ODOM", name)
    yield from waiting


def _lacking(kind: str, name: str) -> InputError:
    return InputError(name, f"no {kind} line", "a CARMEN log with SONAR and ODOM lines")


class _Track:
    """The latest odometry."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[tuple[float, float, float]] = []
        self.begin = inf
        """Stamp of the first ODOM message, s; inf before it."""

    @property
    def end(self) -> float:
        """Stamp of the last ODOM message, s; -inf before the first."""
        return self._stamps[-1] if self._stamps else -inf

    def add(self, fields: list[bytes], where: str) -> None:
        """Take an ODOM line in; InputError where it is wrong or goes back in time."""
        if len(fields) != _ODOM_FIELDS:
            raise InputError(where, f"{len(fields)} fields", f"{_ODOM_FIELDS} in an ODOM line")
        x, y, theta, *_, stamp, _logged = _numbers(fields, where)
        _check(_ODOM_TABLE, [x, y, theta, stamp], where, self.end)
        self.begin = min(self.begin, stamp)
        self._stamps.append(stamp)
        self._poses.append((x, y, theta))
        if len(self._stamps) > 2 * _KEPT_ODOMS:
            del self._stamps[:_KEPT_ODOMS], self._poses[:_KEPT_ODOMS]

    def pose_at(self, stamp: float) -> Float[ndarray, "3"] | str:
        """The pose (m, m, rad in [-pi, pi]) at a time (s), interpolated; near the ends of the track that there.

        Where there is none, why.
        """
        after = bisect_right(self._stamps, stamp)
        if after == 0 or after == len(self._stamps):
            end = 0 if after == 0 else -1
            if abs(self._stamps[end] - stamp) > REACH_S:
                return OUTSIDE
            x, y, theta = self._poses[end]
            return np.array([x, y, remainder(theta, tau)])
        start, end = self._stamps[after - 1], self._stamps[after]
        (x0, y0, theta0), (x1, y1, theta1) = self._poses[after - 1], self._poses[after]
        if end - start > JUMP_S and start < stamp and moved(self._poses[after - 1], self._poses[after]):
            return GAP
        share = (stamp - start) / (end - start)
        theta = theta0 + share * remainder(theta1 - theta0, tau)
        return np.array([x0 + share * (x1 - x0), y0 + share * (y1 - y0), remainder(theta, tau)])


def _fields(line: bytes) -> list[bytes]:
    """The fields of a message that is read, its name first; nothing for any other."""
    if not line.startswith((b"SONAR", b"ODOM")):
        return []
    fields = line.split()
    return fields if fields[0] in (b"SONAR", b"ODOM") else []


def _sonar(fields: list[bytes], where: str, expected: int | None) -> _Sonar:
    """Take a SONAR line apart; ``expected`` is the number of sonars in the lines before."""
    count = fields[2] if len(fields) > 2 else b""
    if not (count.isdigit() and len(count) <= 4 and 0 < int(count) <= MAX_SONARS):
        raise InputError(where, f"n = {quoted(count)}", f"a number of sonars from 1 to {MAX_SONARS}")
    n = int(count)
    if expected is not None and n != expected:
        raise InputError(where, f"{n} sonars", f"{expected}, as in the first SONAR line")
    if len(fields) != 4 * n + 6:
        raise InputError(where, f"{len(fields)} fields", f"{4 * n + 6} in a SONAR line of {n} sonars")
    cone, _, *ranges, stamp, _logged = _numbers([*fields[: 3 + n], *fields[3 + 4 * n :]], where)
    return _Sonar(stamp, cone, ranges, fields[3 + n : 3 + 4 * n])


def _robot(sonar: _Sonar, where: str) -> Robot:
    """The robot as far as a SONAR line describes it."""
    mounts = _mounts(sonar, where)
    limits = (10.0, 10.0, 2 * tau)
    for mount in mounts.tolist():
        if not all(abs(value) <= limit for value, limit in zip(mount, limits, strict=True)):
            raise InputError(where, f"a mount at {mount}", "x and y within 10 m, the axis within two turns")
    cone = sonar.cone if radians(1) <= sonar.cone <= radians(90) else radians(25)
    return Robot(
        name="carmen",
        footprint_radius_m=surrounded(mounts),
        transducer=TRANSDUCERS["polaroid-600"],
        min_range_m=0.15,
        max_range_m=5.0,
        beam_width_rad=cone,
        mounts=mounts,
    )


def _mounts(sonar: _Sonar, where: str) -> Float[ndarray, "sonars 3"]:
    return np.array([number_of(field, "a mount", where) for field in sonar.mounts]).reshape(-1, 3)


def _check(table: Table, row: list[float], where: str, last_stamp: float) -> None:
    if row[table.stamp] >= last_stamp and table.plain(row):
        return
    _, fault = table.check(np.array([row]), last_stamp)
    if fault is not None:
        raise InputError(where, *fault)


def _numbers(fields: list[bytes], where: str) -> list[float]:
    """The numbers of a message: all its fields but its name and its last but one, the host."""
    texts = [*fields[1:-2], fields[-1]]
    if only_numbers(b"".join(texts)):
        try:
            return [float(text) for text in texts]
        except ValueError:
            pass
    text_of(b" ".join(fields), where)
    return [number_of(text, "a field", where) for text in texts]
