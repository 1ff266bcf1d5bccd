"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP); no ROS is needed.

A bag is gone through twice: its beginning, to find which sonars there are, where they sit and what carries them; then
the whole of it. Stamps are those of the messages' headers, or the time of recording where a header has none.
"""

from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from echogrid.errors import InputError
from echogrid.frame import Frame, Log
from echogrid.logs.bag_file import BagFile, Message, recognises
from echogrid.logs.bag_survey import BEGIN_S, NO_STAMP, Plan, Survey, events, short, turned
from echogrid.robot import Robot
from echogrid.ros.messages import RANGE, Choice
from echogrid.ros.scans import BACK, BACK_S, Scans, fixed_of, mount, reading
from echogrid.ros.transforms import Transforms

__all__ = ["load", "recognises", "survey"]


def load(path: Path, robot: Robot | None, choice: Choice | None = None) -> Log:
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
    beginning = Survey(path, robot, choice or Choice())
    beginning.go(whole=False)
    try:
        plan = beginning.plan()
    except InputError:
        # Poses, or the places of the sonars, may come later than the sonars themselves.
        beginning = Survey(path, robot, choice or Choice())
        beginning.go(whole=True)
        plan = beginning.plan()
    notes: dict[str, int] = {}
    frames = partial(_frames, path, plan, notes)
    return Log(beginning.name, plan.robot.sonars, plan.robot, lambda: _telling(beginning.name, frames()), notes)


def _telling(name: str, frames: Iterator[Frame]) -> Iterator[Frame]:
    """Frames, at the end of which it is an error if no reading in them was valid."""
    told = False
    for frame in frames:
        told = told or not np.isnan(frame.ranges).all()
        yield frame
    if not told:
        found = "no valid reading of any sonar: all are 0 m, nan or below min_range"
        raise InputError(name, found, "ranges in m, or +inf where there is no echo")


def survey(path: Path, robot: Robot | None, choice: Choice) -> Survey:
    """Go through a whole bag and say what is in it; arguments and errors as for ``load``."""
    found = Survey(path, robot, choice)
    found.go(whole=True)
    found.plan()
    return found


def _frames(path: Path, plan: Plan, notes: dict[str, int]) -> Iterator[Frame]:
    transforms = plan.transforms.still()
    scans = Scans(plan.robot, transforms, plan.fixed, plan.base)
    refused: Counter[str] = Counter()
    numbers, robot = plan.numbers, plan.robot
    count = 0

    def take(sonar: tuple[str, str], stamp: float, range_m: float, low: float, high: float) -> None:
        number = numbers.get(sonar)
        if number is None:
            refused["a reading of a sonar without a place, or that was not heard in the beginning"] += 1
        elif scans.add(number, stamp, robot.clean_one(reading(range_m, low, high))) == BACK:
            found = f"a clock that jumps back by more than {BACK_S:g} s at {stamp:.3f} s"
            raise InputError(f"{bag.name}: {short(sonar[0])}", found, "time that goes on: cut the bag there in two")

    with BagFile(path) as bag:
        for topic, kind, received, content in bag.messages(plan.topics):
            if kind == RANGE:  # nearly all of them
                stamp, frame, _, low, high, range_m = content
                if stamp or received < BEGIN_S or topic in plan.unstamped:
                    take((topic, frame), stamp or received, range_m, low, high)
                else:
                    refused[NO_STAMP] += 1
            else:
                message = Message(topic, kind, received, content)
                for sonar, stamp, range_m, _, limits in events(message, transforms, robot, refused, plan.unstamped):
                    take(sonar, stamp, range_m, *limits)
            if scans.pending:
                for frame in scans.frames():
                    count += 1
                    yield frame
        for frame in scans.frames(reach=_LAST_S, final=True):
            count += 1
            yield frame
    notes.clear()
    notes |= plan.notes | dict(refused + scans.dropped) | _changes(plan, transforms, scans.newest)
    if not count:
        known = transforms.known(plan.fixed, plan.base)
        poses = "none" if known is None else f"{known[0]:.1f} to {known[1]:.1f} s"
        raise InputError(
            bag.name,
            f"no reading at a time of a pose (last reading {scans.newest:.1f} s, poses {poses})",
            "stamps of one clock",
        )


def _changes(plan: Plan, transforms: Transforms, end: float) -> dict[str, int]:
    """What turned out otherwise after the beginning of a bag than it was taken to be."""
    notes: dict[str, int] = {}
    later = fixed_of(transforms, plan.base)
    if plan.free and later is not None and later != plan.fixed:
        notes[f"mapped in {plan.fixed}; {later} came later, --fixed-frame {later} maps in it"] = 0
    for number, frame in plan.frames.items():
        now = mount(transforms, plan.base, frame, end)
        if isinstance(now, np.ndarray) and turned(now, plan.robot.mounts[number]):
            notes[f"{frame} moved on the robot, but is taken to sit where it did in the beginning"] = 0
    return notes


_LAST_S = 0.1
"""How far past the last pose of a bag readings are still taken from it."""
