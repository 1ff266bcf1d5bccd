"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP); no ROS is needed.

A bag is gone through twice: its beginning, to find which sonars there are, where they sit and what carries them; then
the whole of it. Stamps are those of the messages' headers, or the time of recording where a header has none.
"""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from echogrid.bags.bag_file import BagFile, Message
from echogrid.bags.events import BEGIN_S, NO_STAMP, events
from echogrid.bags.mounts import turned
from echogrid.bags.reading_plan import Plan, planned
from echogrid.bags.survey import Survey
from echogrid.errors import InputError
from echogrid.frame import Frame, Log, Progress
from echogrid.robot import Robot
from echogrid.ros.gathering import BACK, BACK_S, Scans
from echogrid.ros.messages import RANGE, Choice, short
from echogrid.ros.sonars import fixed_of, mount, reading
from echogrid.ros.transforms import Transforms

_LAST_S = 0.1
"""How far past the last pose of a bag readings are still taken from it."""


def load(path: Path, robot: Robot | None, choice: Choice) -> Log:
    """Open a bag; its beginning is read now, the rest as the log is gone through.

    Args:
        path: a .bag, .mcap or .db3 file, or the folder of a ROS 2 bag.
        robot: taken in place of what the bag says of its robot: its mounts are those of the sonars in the order of
            their names. It is needed where the bag does not say where the sonars sit: for point clouds and
            SonarArray, or without tf.
        choice: what to listen to.

    Raises:
        InputError: not a whole bag, no sonars or no poses in it, more than one robot, or places that are not known.
    """
    beginning = Survey(path, robot, choice, whole=False)
    try:
        plan = planned(beginning)
    except InputError:
        # Poses, or the places of the sonars, may come later than the sonars themselves.
        plan = planned(Survey(path, robot, choice, whole=True))
    notes: dict[str, int] = {}
    total = sum(topic.messages for topic in beginning.topics if topic.name in plan.topics)
    progress = Progress("message", lambda: total)
    frames = partial(_frames, path, plan, notes, progress)
    return Log(beginning.name, plan.robot.sonars, plan.robot, frames, notes, progress)


def survey(path: Path, robot: Robot | None, choice: Choice) -> Survey:
    """Go through a whole bag and say what is in it; arguments and errors as for ``load``."""
    found = Survey(path, robot, choice, whole=True)
    planned(found)
    return found


def _frames(path: Path, plan: Plan, notes: dict[str, int], progress: Progress) -> Iterator[Frame]:
    """Go through a bag; at its end the notes are those of this time.

    Raises:
        InputError: the bag is damaged, its clock jumps back, or there was no frame or no valid reading in any.
    """
    transforms = plan.transforms.still()
    scans = Scans(plan.robot, transforms, plan.fixed, plan.base)
    refused: Counter[str] = Counter()
    count, valid = 0, False
    with BagFile(path) as bag:
        for frame in _gathered(bag, plan, transforms, scans, refused, progress):
            count += 1
            valid = valid or not np.isnan(frame.ranges).all()
            yield frame
    notes.clear()
    notes |= plan.notes | dict(refused + scans.dropped) | _changes(plan, transforms, scans.newest)
    if not count:
        known = transforms.known(plan.fixed, plan.base)
        poses = "none" if known is None else f"{known[0]:.1f} to {known[1]:.1f} s"
        found = f"no reading at a time of a pose (last reading {scans.newest:.1f} s, poses {poses})"
        because = next(iter(_in_turn(plan, transforms)), "")
        raise InputError(bag.name, because or found, "one parent" if because else "stamps of one clock")
    if not valid:
        found = "no valid reading of any sonar: all are 0 m, nan or below min_range"
        raise InputError(bag.name, found, "ranges in m, or +inf where there is no echo")


def _gathered(
    bag: BagFile, plan: Plan, transforms: Transforms, scans: Scans, refused: Counter[str], progress: Progress
) -> Iterator[Frame]:
    """The frames that the messages of a bag become, through its transforms and scans; counts what is refused."""
    numbers, robot, fixes, scales = plan.numbers, plan.robot, plan.fixes, plan.scales

    def take(sonar: tuple[str, str], stamp: float, range_m: float, low: float, high: float) -> None:
        number = numbers.get(sonar)
        if scales and number in scales:
            low, high = low / scales[number], high / scales[number]
        if number is None:
            if sonar in plan.left_out:
                return
            refused["a reading of a sonar without a place, or that was not heard in the beginning"] += 1
        elif scans.add(number, stamp, robot.clean_one(reading(range_m, low, high), number)) == BACK:
            found = f"a clock that jumps back by more than {BACK_S:g} s at {stamp:.3f} s"
            raise InputError(f"{bag.name}: {short(sonar[0])}", found, "time that goes on: cut the bag there in two")

    for progress.done, (topic, kind, received, content) in enumerate(bag.messages(plan.topics), 1):
        if kind == RANGE:  # nearly all of them
            stamp, frame, _, low, high, range_m = content
            if fixes and (fix := fixes.get((topic, frame))):
                stamp = fix.of(stamp, received)
            if stamp or plan.from_zero or received < BEGIN_S or topic in plan.unstamped:
                own = stamp or (plan.from_zero and topic not in plan.unstamped)
                take((topic, frame), stamp if own else received, range_m, low, high)
            else:
                refused[NO_STAMP] += 1
        else:
            message, fix = Message(topic, kind, received, content), fixes.get((topic, ""))
            for sonar, stamp, range_m, _, limits in events(
                message, transforms, robot, refused, plan.unstamped, plan.from_zero
            ):
                take(sonar, fix.of(stamp, received) if fix else stamp, range_m, *limits)
        if scans.pending:
            yield from scans.frames()
    yield from scans.frames(reach=_LAST_S, final=True)


def _changes(plan: Plan, transforms: Transforms, end: float) -> dict[str, int]:
    """What turned out otherwise after the beginning of a bag than it was taken to be."""
    notes = _in_turn(plan, transforms)
    later = fixed_of(transforms, plan.base)
    if plan.free and later is not None and later != plan.fixed:
        notes[f"mapped in {plan.fixed}; {later} came later, --fixed-frame {later} maps in it"] = 0
    for number, frame in plan.frames.items():
        now = mount(transforms, plan.base, frame, end)
        if isinstance(now, np.ndarray) and turned(now, plan.robot.mounts[number]):
            notes[f"{frame} moved on the robot, but is taken to sit where it did in the beginning"] = 0
    return notes


def _in_turn(plan: Plan, transforms: Transforms) -> dict[str, int]:
    """Notes on the frames of the robot, and above it, that have two parents in turn."""
    frames = {name for frame in (plan.base, *plan.frames.values()) for name in transforms.line(frame)}
    return {
        f"{child} is told in two frames in turn, {one} and {other}, and known in neither for long: stop one of those"
        " who publish it (two localisers, or a driver beside one)": count
        for child, (one, other, count) in transforms.in_turn.items()
        if child in frames
    }
