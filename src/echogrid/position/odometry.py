"""Odometry as logs tell it: where it jumps, starts anew or repeats itself, and what it says when that is mended."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.doubts import JUMP_M, LEAST_STEPS, OFTEN, STAYS
from echogrid.geometry import wrap, wrapped
from echogrid.position import motion

SELDOM = 1.3
"""From so many scans a pose on, poses are interpolated."""

_STANDS = 3.0
"""A pose that stays for so many times as long as poses do while the robot moves is one at which it stands."""

_ALIKE_M, _ALIKE, _FEW = 0.25, 0.6, 3
"""The sonars hear the same place if such a share of their ranges differs by less; of fewer nothing is concluded."""

_AROUND = 20
"""Scans before and after a jump, among which each sonar's last and first reading are looked for."""

_ZERO_M, _ZERO_RAD = 0.1, 0.1
"""Odometry that starts anew begins so near to 0."""

_HOPS, _FAST, _POSES, _STOP_M, _APART_M = 5, 0.3, 3, 0.3, 10.0
"""Ways that are not recorded in a log of stops, at least, and the least share of them that is faster than any robot
by the stamps; the poses that a stop has, mostly, and nearly always how large it is and how far from the next."""


class Mended(NamedTuple):
    """Odometry that a robot can have."""

    poses: Float[ndarray, "frames 3"]
    """m, m, rad; the first is the log's own."""
    notes: dict[str, int]
    """What was mended, and how often; 0 where that says nothing."""
    impossible: float
    """Share of the steps faster than any robot, if it is so large that nothing could be mended; else 0."""


def mended(
    stamps: Float[ndarray, "frames"], poses: Float[ndarray, "frames 3"], ranges: Float[ndarray, "frames sonars"]
) -> Mended:
    """The poses without what no robot does.

    A pose that only comes up for a few scans is interpolated. Where the pose jumps, the robot is taken to have stood
    as long as the sonars hear the same place before and after, or cannot tell. Poses that come more seldom than scans
    are interpolated in time.

    Of a log that was recorded at stops alone the stamps say nothing of the way between; it is as the odometry says.

    Args:
        stamps: s.
        poses: of the odometry, m, m, rad.
        ranges: m.
    """
    at = np.concatenate([[0], 1 + np.flatnonzero((poses[1:] != poses[:-1]).any(axis=1))])
    period, ratio = _pace(stamps, at)
    jumps = _jumps(stamps, poses, at, period)
    if _at_stops(poses[at], jumps):
        return Mended(poses, {}, 0.0)
    if jumps.sum() > OFTEN * len(jumps) and len(jumps) >= LEAST_STEPS:
        return Mended(poses, {}, float(jumps.mean()))
    notes: dict[str, int] = {}
    glitches = _glitches(stamps, poses, at, jumps, period)
    if glitches.any():
        ends = np.append(at[1:], len(poses))
        lost = int(np.sum((ends - at)[glitches]))
        notes["a pose that no robot can have got to, interpolated"] = lost
        at = at[~glitches]
        jumps = _jumps(stamps, poses, at, period)
    known = poses[at]
    if jumps.any():
        known, told = _joined(stamps, known, ranges, at, jumps)
        notes |= told
    if ratio >= SELDOM:
        scans = 1 / np.median(np.diff(stamps))
        what = f"the odometry has a new pose {1 / period:.3g} times a second, the sonars {scans:.3g} scans"
        notes[f"{what}: the poses between are interpolated"] = 0
        return Mended(_between(stamps, known, stamps[at], period), notes, 0.0)
    if len(known) == len(poses):
        return Mended(known, notes, 0.0)
    held = known[np.searchsorted(at, np.arange(len(poses)), side="right") - 1]
    if glitches.any():
        # The frames that have lost their pose lie between two that have one; those that repeat a pose keep it.
        lost = (poses != poses[at[np.searchsorted(at, np.arange(len(poses)), side="right") - 1]]).any(axis=1)
        frames = np.arange(len(poses), dtype=float)
        held = np.where(lost[:, None], _between(frames, known, at.astype(float), np.inf), held)
    return Mended(held, notes, 0.0)


def _pace(stamps: Float[ndarray, "frames"], at: Int[ndarray, "changes"]) -> tuple[float, float]:
    """Time from one new pose to the next while the robot moves, s, and scans in that time.

    Args:
        stamps: s.
        at: frames with a new pose.
    """
    gaps = np.diff(stamps[at])
    if not len(gaps) or np.median(gaps) <= 0:
        return 0.0, 1.0
    period = float(np.median(gaps))
    moving = gaps <= _STANDS * period
    return period, float(np.mean(np.diff(at)[moving]))


def _jumps(
    stamps: Float[ndarray, "frames"], poses: Float[ndarray, "frames 3"], at: Int[ndarray, "changes"], period: float
) -> Bool[ndarray, "steps"]:
    """Which steps from one new pose to the next are faster than any robot."""
    step = motion.steps(poses[at])
    # The time for it: since the scan before, or since the last pose, if the robot has not stood there.
    silent = stamps[at[1:]] - stamps[at[1:] - 1]
    took = np.maximum(silent, np.minimum(np.diff(stamps[at]), _STANDS * period))
    return np.asarray(motion.jumped(step, took) | motion.restarted(poses[at[:-1]], poses[at[1:]], silent))


def _at_stops(known: Float[ndarray, "changes 3"], jumps: Bool[ndarray, "steps"]) -> bool:
    """Whether a log that jumps goes from stop to stop: on from each, not to and fro as glitches do."""
    hops = np.flatnonzero(np.hypot(*np.diff(known[:, :2], axis=0).T) > _STOP_M) + 1
    if len(hops) < _HOPS or jumps.sum() < _FAST * len(hops):
        return False
    begins, ends = np.append(0, hops), np.append(hops, len(known))
    size = [np.hypot(*np.ptp(known[a:b, :2], axis=0)) for a, b in zip(begins, ends, strict=True)]
    stops = known[begins, :2]
    way = np.hypot(*(stops[1:] - stops[:-1]).T)
    on = np.hypot(*(stops[2:] - stops[:-2]).T)
    if np.median(ends - begins) < _POSES:
        return False
    return bool(np.quantile(size, 0.9) < _STOP_M and np.quantile(way, 0.9) < _APART_M and np.median(on) > JUMP_M)


def _glitches(
    stamps: Float[ndarray, "frames"],
    poses: Float[ndarray, "frames 3"],
    at: Int[ndarray, "changes"],
    jumps: Bool[ndarray, "steps"],
    period: float,
) -> Bool[ndarray, "changes"]:
    """Which new poses are left again, after a few scans, by a jump back to where the robot can have got to."""
    glitch = np.zeros(len(at), dtype=bool)
    away = -1
    for back in np.flatnonzero(jumps):
        if away >= 0 and at[back + 1] - at[away + 1] <= STAYS:
            ends = np.array([at[away], at[back + 1]])
            if not _jumps(stamps, poses, ends, max(period, float(np.diff(stamps[ends])[0]))).any():
                glitch[away + 1 : back + 1] = True
                away = -1
                continue
        away = int(back)
    return glitch


def _joined(
    stamps: Float[ndarray, "frames"],
    known: Float[ndarray, "changes 3"],
    ranges: Float[ndarray, "frames sonars"],
    at: Int[ndarray, "changes"],
    jumps: Bool[ndarray, "steps"],
) -> tuple[Float[ndarray, "changes 3"], dict[str, int]]:
    """Poses in which the robot stands where they jump, unless the sonars say that it does not; and notes on that."""
    step, notes = motion.steps(known), {}
    for jump in np.flatnonzero(jumps):
        (x, y, _), (x1, y1, theta1) = known[jump], known[jump + 1]
        anew = np.hypot(x1, y1) < _ZERO_M and abs(wrap(theta1)) < _ZERO_RAD
        how = "starts anew at 0" if anew else f"jumps to x {x1:.2f}, y {y1:.2f} m"
        what = f"the odometry {how} at {stamps[at[jump + 1]]:.2f} s, from x {x:.2f}, y {y:.2f} m"
        if _alike(ranges, int(at[jump + 1])) is False:
            notes[f"{what}, and the sonars hear another place: taken as it says, which no robot can have driven"] = 0
        else:
            step[jump] = 0.0
            notes[f"{what}: the drive goes on from where it was"] = 0
    first = known[:1]
    return np.concatenate([first, wrapped(motion.chained(first[0], step))[1:]]), notes


def _alike(ranges: Float[ndarray, "frames sonars"], frame: int) -> bool | None:
    """Whether the sonars hear the same from a frame on as before it; None: they hear too little to tell."""
    before, after = ranges[max(frame - _AROUND, 0) : frame][::-1], ranges[frame : frame + _AROUND]
    last, first = (part[np.argmax(~np.isnan(part), axis=0), np.arange(part.shape[1])] for part in (before, after))
    both = np.isfinite(last) & np.isfinite(first)
    if both.sum() < _FEW:
        return None
    return bool(np.mean(np.abs(last[both] - first[both]) < _ALIKE_M) >= _ALIKE)


def _between(
    times: Float[ndarray, "frames"],
    known: Float[ndarray, "changes 3"],
    when: Float[ndarray, "changes"],
    period: float,
) -> Float[ndarray, "frames 3"]:
    """Poses at all times, of which some are known.

    Args:
        times: of the frames; of no unit here.
        known: poses, m, m, rad.
        when: they are known.
        period: in which a robot that moves has a new pose; it stood until so long before one that came later.
    """
    stood = np.flatnonzero(np.diff(when) > _STANDS * period)
    when = np.insert(when, stood + 1, when[stood + 1] - period)
    known = np.insert(known, stood + 1, known[stood], axis=0)
    known = np.column_stack([known[:, :2], np.unwrap(known[:, 2])])
    return wrapped(np.column_stack([np.interp(times, when, column) for column in known.T]))
