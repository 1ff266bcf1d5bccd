"""A log of odometry in, the log with the poses that ranges and odometry say together out."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.doubts import FASTEST_M_S, LEFT_OUT, STARTS_ANEW
from echogrid.errors import InputError
from echogrid.frame import Frame, Log
from echogrid.geometry import compose, inverse, wrap
from echogrid.mapping.intake import check_robot, cleaned, fitting
from echogrid.position import motion
from echogrid.position.contradictions import Compared
from echogrid.position.odometry import mended
from echogrid.position.slam import Found
from echogrid.position.slam import slam as found_by
from echogrid.robot import Robot

LEAST_SONARS = 4
"""Of fewer no place is told from another."""

LEAST_M = 0.5
"""A robot that gets no farther (diagonal of the box of its places, m) has stood: there is nothing to find."""

UNHEARD_M = 3.0
"""A way without an echo that is longer is told."""

LOOSE_M, ODD_M, ODD_IN_ALL_M = 10.0, 1.0, 2.0
"""A way along which the drive is loose is told if it is longer than the first. Those along which it is at odds with
itself are if each is longer than the second, and all together longer than the third."""

STRETCHED = 0.1
"""It is told if what was seen makes all ways longer or shorter than odometry says by more than this share: hardly any
wheels are so far off, and a corridor without marks that is pulled together is."""

SLIP_OVER_M, SLIP_M = 2.0, 0.45
"""It is told if over such a way (by odometry, less its systematic error) places lie so much other than that says.
Odometry with twice the usual errors comes to 0.35 m at most."""

LONE_M, LONE_MOVED_M = 30.0, 0.5
"""In a drive that is longer, or that was moved farther, it is told if no place was seen twice."""


@dataclass(frozen=True)
class Corrected:
    """Where a robot was."""

    log: Log
    """The frames with the poses that were found; ``Frame.odom`` is what the log said. Its notes say what is doubtful
    about the log and about the poses."""
    stamps: Float[ndarray, "frames"]
    """Of the frames, s."""
    poses: Float[ndarray, "frames 3"]
    """As found, m, m, rad; the first is the log's own."""
    odometry: Float[ndarray, "frames 3"]
    """As the log said."""
    found: Found | None = field(repr=False)
    """The graph of the drive and what the ranges say of the odometry; None where there was nothing to find."""

    @property
    def notes(self) -> dict[str, int]:
        """What is doubtful, and how often; 0 where that says nothing."""
        return self.log.notes

    @property
    def loops(self) -> list[tuple[int, int]]:
        """Frames between which the drive was found to come back to a place."""
        return [] if self.found is None else [tuple(self.found.nodes[[*pair]].tolist()) for pair in self.found.loops]

    @property
    def farthest(self) -> tuple[float, float]:
        """How far the odometry is from what was found at most, m and rad."""
        off = self.odometry - self.poses
        return float(np.hypot(off[:, 0], off[:, 1]).max()), float(np.abs(wrap(off[:, 2])).max())


def slam(log: Iterable[Frame], robot: Robot, progress: Callable[[int, int], object] | None = None) -> Corrected:
    """Find where the robot was in a log whose poses are odometry that drifts.

    What no robot does (jumps, a start anew at 0) is mended first, and told. All frames are kept in memory.

    Args:
        log: frames, as ``build_map`` takes them.
        robot: the robot that drove, with at least LEAST_SONARS rangers.
        progress: called with what is done and what there is in all, now and then.

    Raises:
        UsageError: as of ``Mapper.add``.
        InputError: no frames, too few sonars, or poses that are no odometry.
    """
    check_robot(robot)
    name = log.name if isinstance(log, Log) else "frames"
    if robot.sonars < LEAST_SONARS:
        raise InputError(name, f"{robot.sonars} sonars", f"at least {LEAST_SONARS} to find poses by")
    frames = cleaned(list(fitting(log, robot)), robot)
    if not frames:
        raise InputError(name, "no frames", "at least one")
    stamps, odometry, ranges = (
        np.array(column, dtype=float) for column in zip(*((f.stamp, f.pose, f.ranges) for f in frames), strict=True)
    )
    told = mended(stamps, odometry, ranges)
    if told.impossible:
        share = f"{told.impossible:.0%} of the steps of the odometry faster than {FASTEST_M_S:g} m/s"
        raise InputError(name, share, "poses in m and rad, and stamps in s")
    notes = log.notes if isinstance(log, Log) else {}
    notes.pop(LEFT_OUT, None)  # here such scans stay, with another pose
    notes = {note: count for note, count in notes.items() if STARTS_ANEW not in note}  # that is mended here
    notes |= told.notes
    found = None
    if why := _nothing_to_find(told.poses, ranges):
        notes[why] = 0
    else:
        found = found_by([replace(f, pose=p) for f, p in zip(frames, told.poses, strict=True)], robot, progress)
        notes |= _unheard(stamps, found.poses, ranges) | _alone(found) | _loose(found) | _slipped(found)
        notes |= stretched(found.drift)
        notes |= at_odds(found.poses[found.nodes], found.together)
    poses = told.poses if found is None else found.poses
    posed = Log(name, robot.sonars, log.robot if isinstance(log, Log) else None, _Posed(frames, poses), notes)
    return Corrected(replace(posed, judges=True), stamps, poses, odometry, found)


@dataclass(frozen=True)
class _Posed:
    """Goes through frames with other poses."""

    frames: Sequence[Frame]
    poses: Float[ndarray, "frames 3"]

    def __call__(self) -> Iterator[Frame]:
        for frame, pose in zip(self.frames, self.poses, strict=True):
            yield replace(frame, pose=pose, odom=frame.pose)


def _nothing_to_find(poses: Float[ndarray, "frames 3"], ranges: Float[ndarray, "frames sonars"]) -> str:
    """Why the odometry is taken as it is; empty if there is something to find."""
    if not np.isfinite(ranges).any():
        return "no sonar heard an echo: nothing to find the poses by, they are those of the odometry"
    size = float(np.hypot(*np.ptp(poses[:, :2], axis=0)))
    if size < LEAST_M:
        stands = "one scan" if len(poses) == 1 else f"the robot never gets farther than {size:.2f} m"
        return f"{stands}: no poses to find, they are those of the odometry"
    return ""


def _unheard(
    stamps: Float[ndarray, "frames"], poses: Float[ndarray, "frames 3"], ranges: Float[ndarray, "frames sonars"]
) -> dict[str, int]:
    """A note on ways in which no sonar heard an echo, if they are long."""
    heard = np.flatnonzero(np.isfinite(ranges).any(axis=1))
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*motion.steps(poses)[:, :2].T))])
    ends = np.concatenate([[0], heard, [len(poses) - 1]])
    lengths = np.diff(way[ends])
    if not (silent := np.flatnonzero(lengths > UNHEARD_M)).size:
        return {}
    longest = int(np.argmax(lengths))
    since, till = stamps[ends[longest : longest + 2]].tolist()
    where = f"no sonar heard an echo for {lengths[longest]:.1f} m, from {since:.2f} to {till:.2f} s"
    return {f"{where}: there the poses are those of the odometry": len(silent) if len(silent) > 1 else 0}


def _alone(found: Found) -> dict[str, int]:
    """A note, if no place was seen twice in a long drive, or in one that lies elsewhere than odometry says."""
    way, _ = motion.lengths(motion.steps(found.poses[found.nodes]))
    length = float(np.abs(way).sum())
    moved = float(np.hypot(*(found.poses - found.odometry)[:, :2].T).max())
    if found.loops or (length <= LONE_M and moved <= LONE_MOVED_M):
        return {}
    only = f"the map is only as good as odometry and scans are from one to the next over {length:.0f} m"
    return {f"no place was seen twice: {only} (a drive that comes back to where it was tells more)": 0}


def _loose(found: Found) -> dict[str, int]:
    """A note on parts of the drive that lie beside others and that nothing ties to them."""
    if not (where := _ways(found.poses[found.nodes], found.loose, LOOSE_M, LOOSE_M)) or not found.loops:
        return {}
    what = f"{where[0]} of the drive lie beside another part of it and nothing ties them"
    return {f"{what}: walls may be double {where[1]}": 0}


def _slipped(found: Found) -> dict[str, int]:
    """A note on the place where what was seen tells most of another way than odometry does."""
    step = motion.corrected(motion.steps(found.odometry), found.drift)
    told, places = motion.chained(found.odometry[0], step)[found.nodes], found.poses[found.nodes]
    way = np.append(0.0, np.cumsum(np.abs(motion.lengths(motion.steps(told))[0])))
    to = np.searchsorted(way, way + SLIP_OVER_M)
    since = np.flatnonzero(to < len(way))
    to = to[since]
    apart = compose(inverse(told[since]), told[to]) - compose(inverse(places[since]), places[to])
    off = np.hypot(apart[:, 0], apart[:, 1])
    if not np.any(off > SLIP_M):
        return {}
    most = int(np.argmax(off))
    x, y, _ = places[since[most]].tolist()
    where = f"by {off[most]:.1f} m in {SLIP_OVER_M:g} m of way, from x {x:.1f}, y {y:.1f} m on"
    return {f"odometry is off what was seen {where}: wheels slip there, or the map is wrong": 0}


def stretched(drift: Float[ndarray, "3"]) -> dict[str, int]:
    """A note on a map of another size than odometry makes it.

    Args:
        drift: what corrects the odometry, of its scale first.
    """
    if abs(way := float(drift[0])) <= STRETCHED:
        return {}
    longer, large = ("shorter", "small") if way < 0 else ("longer", "large")
    what = f"what was seen makes all ways {abs(way):.0%} {longer} than the odometry says"
    return {f"{what}: drive one that you measured by tape; if the odometry tells it right, the map is too {large}": 0}


def at_odds(nodes: Float[ndarray, "nodes 3"], together: Compared) -> dict[str, int]:
    """A note on parts of a drive that saw walls where others saw free floor.

    Args:
        nodes: its places, m, m, rad.
        together: how what was seen there lies together.
    """
    if not (where := _ways(nodes, together.doubtful, ODD_M, ODD_IN_ALL_M)):
        return {}
    double = f"walls are double {where[1]}, or something was moved meanwhile"
    return {f"along {where[0]} of the drive walls were seen where at other times there was free floor: {double}": 0}


def _ways(
    nodes: Float[ndarray, "nodes 3"], which: Bool[ndarray, "nodes"], least_m: float, in_all_m: float
) -> tuple[str, str] | None:
    """How long those ways through some of the nodes are in all that are not short, and where the longest is; None:
    they are not long.
    """
    ends = np.flatnonzero(np.diff(np.concatenate([[0], which, [0]])))
    step = np.append(np.abs(motion.lengths(motion.steps(nodes))[0]), 0.0)
    runs = [(float(step[a:b].sum()), a) for a, b in zip(ends[::2], ends[1::2], strict=True)]
    runs = [run for run in runs if run[0] > least_m]
    if not runs or sum(run[0] for run in runs) <= in_all_m:
        return None
    length, node = max(runs)
    x, y, _ = nodes[node].tolist()
    return f"{sum(run[0] for run in runs):.1f} m", f"there (longest, {length:.1f} m, from x {x:.1f}, y {y:.1f} m)"
