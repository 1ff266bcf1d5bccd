"""What is in a bag of ROS: its sonars, where they sit, what carries them, and how it is therefore to be read."""

import re
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import degrees, inf, isnan, nan
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.logs.bag_file import BagFile, Message, Topic
from echogrid.robot import MAX_SONARS, Robot, preset_names
from echogrid.ros.messages import (
    CLOUD2,
    ODOMETRY,
    RANGE,
    SONAR_ARRAY,
    SONARS,
    TF,
    TF_OLD,
    Choice,
    Sonar,
    points_of,
    put_odometry,
    put_transforms,
    ranges_of,
    seconds,
)
from echogrid.ros.scans import (
    BEAM_WIDTH_RAD,
    base_of,
    beam_width,
    fixed_of,
    mount,
    reading,
    robot_of,
)
from echogrid.ros.transforms import Transforms

SURVEY_S, SURVEY_MESSAGES = 5.0, 300_000
"""A bag is surveyed until so long after all topics of sonars were heard, and for so many messages at most."""

SHOWN = 6
"""Names that a message lists at most."""

_LONGEST = 100
"""Characters of a name that a message shows at most."""

_TURNED_M, _TURNED_RAD = 0.01, np.deg2rad(1.0)
"""A mount that changes more than this is one that moves."""


class Event(NamedTuple):
    """A reading in a bag."""

    sonar: Sonar
    stamp: float
    """s"""
    range_m: float
    """As it stands in the message."""
    field_of_view: float
    """rad; nan if the type has none."""
    limits: tuple[float, float]
    """Minimum and maximum range, m; nan if the type has none."""


@dataclass
class Heard:
    """What a bag says of one sonar."""

    readings: int = 0
    no_echo: int = 0
    invalid: int = 0
    """Readings that are nan, too close or below the limits."""
    zeros: int = 0
    """Readings of 0."""
    first: float = nan
    """Stamp of the first reading, s."""
    last: float = nan
    field_of_view: float = nan
    """Of the first message, rad, as it stands there; nan if the type has none."""
    limits: tuple[float, float] = (nan, nan)
    """Minimum and maximum range of the first message, m, as they stand there."""
    mount: Float[ndarray, "3"] | None = None
    """Where it sits on the robot: m, m, rad."""
    amiss: str | None = None
    """Why it has no mount."""

    def count(self, event: Event) -> None:
        """Count a reading in."""
        if self.readings == 0:
            self.first, self.field_of_view, self.limits = event.stamp, event.field_of_view, event.limits
        value = reading(event.range_m, *event.limits)
        self.readings += 1
        self.last = event.stamp
        self.no_echo += value == inf
        self.invalid += isnan(value)
        self.zeros += event.range_m == 0

    @property
    def rate(self) -> float:
        """Readings a second; 0 if there is one."""
        return (self.readings - 1) / (self.last - self.first) if self.last > self.first else 0.0


@dataclass(frozen=True)
class Plan:
    """How a bag is to be read."""

    robot: Robot
    numbers: dict[Sonar, int]
    """Place of each sonar among the robot's mounts."""
    topics: frozenset[str]
    """To be read."""
    base: str
    fixed: str
    transforms: Transforms
    """Of the survey; those that are static hold throughout."""
    unstamped: frozenset[str]
    """Topics whose messages never say a time: theirs is when they were recorded."""
    frames: dict[int, str]
    """The frame of each sonar whose mount the bag tells, by its number."""
    free: bool
    """Whether the frame to map in was found, not asked for."""
    notes: dict[str, int]
    """What is known beforehand to be left out or assumed, and how often."""


class Survey:
    """Goes through a bag, or its beginning, and finds out what is in it."""

    def __init__(self, path: Path, robot: Robot | None, choice: Choice):
        """See ``load``."""
        self.robot, self.choice, self.transforms = robot, choice, Transforms()
        self.heard: dict[Sonar, Heard] = {}
        self.base = self.fixed = ""
        """The frame of the robot, and the one to map in, once ``plan`` has found them."""
        self._path, self._refused = path, Counter[str]()
        with BagFile(path) as bag:
            self.name, self.topics = bag.name, bag.topics()
        self.sonars = self._chosen()
        odometry = [topic for topic in self.topics if topic.type == ODOMETRY]
        self.odometry = [topic for topic in odometry if choice.takes(topic.name)] or odometry
        self.odometry = self._beside(self.odometry) or self.odometry
        self.tf = self._tf()
        self._links: dict[str, set[str]] = {}
        self._stamped: set[str] = set()
        self._seen: set[str] = set()

    def _beside(self, topics: list[Topic]) -> list[Topic]:
        """Those in the namespace of all sonars, or above it."""
        names = [sonar.name for sonar in self.sonars]
        spaces = {topic: topic.name.rsplit("/", 1)[0] + "/" for topic in topics}
        return [topic for topic in topics if all(name.startswith(spaces[topic]) for name in names)]

    def _tf(self) -> list[Topic]:
        """The topics of transforms: of one robot, where each has its own."""
        there = [topic for topic in self.topics if topic.type in (TF, TF_OLD)]
        spaces = {topic.name.rsplit("/", 1)[0] for topic in there}
        if len(spaces) < 2:
            return there
        near = self._beside(there)
        if not near:
            names = _few(sorted(topic.name for topic in there))
            raise InputError(self.name, f"transforms of {len(spaces)} robots ({names})", "sonars of one, by --topics")
        return near

    def _chosen(self) -> list[Topic]:
        """The topics of sonars to be read: of the best type that is there."""
        there = [topic for topic in self.topics if topic.type in SONARS and topic.messages]
        odometry = [topic for topic in self.topics if topic.type == ODOMETRY]
        for pattern in self.choice.topics:
            if not any(fnmatchcase(topic.name, pattern) for topic in (*there, *odometry)):
                wanted = f"one of {_listed((*there, *odometry))}" if there else f"one of {', '.join(SONARS)}"
                raise InputError(self.name, f"no topic of sonars or odometry that fits {short(pattern)}", wanted)
        taken = [topic for topic in there if self.choice.takes(topic.name)]
        named = bool(taken) and bool(self.choice.topics)
        if not named:  # or odometry alone is
            taken = there
            # Point clouds are seldom sonars.
            taken = [topic for topic in taken if topic.type != CLOUD2 or "sonar" in topic.name.lower()]
        if not taken:
            found, wanted = f"no topic of sonars among {_listed(self.topics)}", f"one of {', '.join(SONARS)}"
            if there:
                found, wanted = "only point clouds that may not be sonars", f"--topics with one of {_listed(there)}"
            elif not any(topic.messages for topic in self.topics):
                found = "a bag without messages"
            raise InputError(self.name, found, wanted)
        best = min((topic.type for topic in taken), key=SONARS.index)
        taken = [topic for topic in taken if topic.type == best]
        if best != RANGE and len(taken) > 1:
            raise InputError(self.name, f"{len(taken)} topics of {best}", f"--topics with one of {_listed(taken)}")
        return taken

    def go(self, whole: bool) -> None:
        """Read the bag: all of it, or until the sonars are known."""
        topics = {topic.name for topic in (*self.sonars, *self.odometry, *self.tf)}
        silent, until, count = {topic.name for topic in self.sonars}, inf, 0
        with BagFile(self._path) as bag:
            for message in bag.messages(topics):
                count += 1
                self._seen.add(message.topic)
                if message.topic not in self._stamped and (stamp_of(message) or message.received < BEGIN_S):
                    self._stamped.add(message.topic)
                if message.type == ODOMETRY:
                    child = message.content.child_frame_id.lstrip("/") or "base_link"
                    self._links.setdefault(child, set()).add(message.topic)
                for event in events(message, self.transforms, self.robot, self._refused):
                    if event.sonar not in self.heard and len(self.heard) >= MAX_SONARS:
                        raise InputError(self.name, f"more than {MAX_SONARS} sonars", f"{MAX_SONARS} at most")
                    self.heard.setdefault(event.sonar, Heard()).count(event)
                if message.topic in silent:
                    silent.discard(message.topic)
                    until = inf if silent else message.received + SURVEY_S
                if not whole and (message.received > until or count > SURVEY_MESSAGES):
                    return

    def plan(self) -> Plan:
        """How to read the bag.

        Raises:
            InputError: see ``load``.
        """
        if not self.heard:
            because = "".join(f": {reason} ({n} times)" for reason, n in self._refused.most_common(1))
            raise InputError(self.name, f"nothing to read in {_listed(self.sonars)}{because}", "readings of sonars")
        sonars = sorted(self.heard, key=lambda sonar: sonar.order)
        if self.robot is None and self.sonars[0].type != RANGE:
            raise self._no_places(len(sonars))
        base = self._base(sonars)
        fixed = self.choice.fixed.lstrip("/") if self.choice.fixed else fixed_of(self.transforms, base)
        if fixed is None or self.transforms.known(fixed, base) is None:
            raise self._no_pose(base, fixed)
        if base in self.transforms.line(fixed):
            above = _few(self.transforms.line(base)[1:])
            wanted = f"--fixed-frame with {above}" if above != "nothing" else "--base-frame with the robot's own"
            raise InputError(self.name, f"{fixed} to map in, which moves with {base}", wanted)
        self._one_pose(base, fixed)
        self.base, self.fixed = base, fixed
        notes: dict[str, int] = {}
        if self.robot is None:
            sonars = self._place(sonars, base, notes)
            robot = self._described(base, sonars, notes)
        else:
            robot = self.robot
            if len(sonars) != robot.sonars:
                found = f"{len(sonars)} sonars ({_names(sonars)})"
                raise InputError(self.name, found, f"{robot.sonars}, as robot {robot.name} has")
        zeros = [sonar for sonar in sonars if self.heard[sonar].zeros == self.heard[sonar].readings]
        if zeros:
            count = sum(self.heard[sonar].zeros for sonar in zeros)
            notes[f"nothing but 0 m, which is no range, from {_names(zeros)} in the beginning"] = count
        topics = frozenset(topic.name for topic in (*self.sonars, *self.odometry, *self.tf))
        numbers = {sonar: number for number, sonar in enumerate(sonars)}
        frames = {} if self.robot else {number: sonar.frame for sonar, number in numbers.items()}
        unstamped = frozenset(self._seen - self._stamped)
        free = self.choice.fixed is None
        return Plan(robot, numbers, topics, base, fixed, self.transforms, unstamped, frames, free, notes)

    def _base(self, sonars: list[Sonar]) -> str:
        """The frame of the robot that carries the sonars."""
        if self.choice.base:
            return self.choice.base.lstrip("/")
        carried: dict[str, list[Sonar]] = {}
        for sonar in sonars:
            if sonar.frame.lstrip("/") in self.transforms:
                carried.setdefault(base_of(self.transforms, sonar.frame), []).append(sonar)
        moving = {base_of(self.transforms, child) for child in self.transforms.children()}
        above = {base: fixed_of(self.transforms, base) for base in moving}
        # What stands still in the room, such as a dock, is no robot.
        moving = {base for base, fixed in above.items() if fixed and self.transforms.moves(fixed, base)}
        bases = [base for base in carried if base in moving] or (sorted(moving) if self.robot else list(carried))
        if len(bases) > 1:
            found = "; ".join(f"{base} ({_names(carried.get(base, []))})" for base in sorted(bases))
            raise InputError(self.name, f"{len(bases)} robots: {found}", "one, by --topics or --base-frame")
        if bases:
            return bases[0]
        if moving and not self.robot:
            frames = _few(list(dict.fromkeys(sonar.frame or "without a name" for sonar in sonars)))
            raise InputError(
                self.name,
                f"no transform from the robot ({_few(sorted(moving))}) to the frames of the sonars ({frames})",
                "tf, or --robot with the places of the sonars",
            )
        raise self._no_pose("the robot", None)

    def _no_places(self, count: int) -> InputError:
        fits = ", ".join(name for name in preset_names() if Robot.load(name).sonars == count)
        known = f" (presets with {count}: {fits})" if fits else ""
        return InputError(
            self.name,
            f"{count} sonars in {self.sonars[0].name} ({self.sonars[0].type}), which does not say where they sit",
            f"--robot with their places{known}",
        )

    def _no_pose(self, base: str, fixed: str | None) -> InputError:
        roots = {self.transforms.line(child)[-1] for child in self.transforms.children()}
        frames = sorted({*self.transforms.children(), *roots})
        for option, name in (("--base-frame", self.choice.base), ("--fixed-frame", self.choice.fixed)):
            if name and name.lstrip("/") not in frames:
                return InputError(self.name, f"no frame {short(name)}", f"{option} with one of {_few(frames)}")
        posing = [topic for topic in self.topics if topic.type in (TF, TF_OLD, ODOMETRY)]
        there = f" in {_listed(posing)} (frames: {_few(frames)})" if posing else ": neither tf nor odometry"
        return InputError(
            self.name,
            f"no pose of {base}{f' in {fixed}' if fixed else ''}{there}",
            f"tf from map or odom to the robot, or nav_msgs/Odometry (or --base-frame, if {base} is not the robot)",
        )

    def _one_pose(self, base: str, fixed: str) -> None:
        """Refuse several topics of odometry between which nothing decides; drop them where tf has the pose."""
        line = self.transforms.line(base)
        above = line[: line.index(fixed)] if fixed in line else []
        weak = [child for child in above if self.transforms.is_weak(child)]
        if not weak:
            self.odometry = []
        topics = {topic for child in weak for topic in self._links.get(child, ())}
        if len(topics) > 1:
            found = f"the pose of {base} in {len(topics)} topics"
            raise InputError(self.name, found, f"--topics with one of {_few(sorted(topics))}")

    def _place(self, sonars: list[Sonar], base: str, notes: dict[str, int]) -> list[Sonar]:
        """Find the mounts; those that have one."""
        frames: dict[str, Sonar] = {}
        for sonar in sonars:
            heard = self.heard[sonar]
            heard.mount, heard.amiss = self._mount(base, sonar, heard)
            other = frames.setdefault(sonar.frame, sonar)
            if other != sonar and heard.mount is not None:
                raise InputError(
                    self.name,
                    f"{other.topic} and {sonar.topic} in one frame, {sonar.frame}",
                    "a frame for each sonar, or --robot with their places in the order of the topics",
                )
        placed = [sonar for sonar in sonars if self.heard[sonar].mount is not None]
        if not placed:
            raise InputError(
                self.name,
                f"no sonar with a place: {_names(sonars)}: {self.heard[sonars[0]].amiss}",
                "tf, or --robot with the places of the sonars",
            )
        amiss: dict[str, list[Sonar]] = {}
        for sonar in sonars:
            if reason := self.heard[sonar].amiss:
                amiss.setdefault(reason, []).append(sonar)
        notes |= {f"{_names(left)} left out: {reason}": 0 for reason, left in amiss.items()}
        return placed

    def _mount(self, base: str, sonar: Sonar, heard: Heard) -> tuple[Float[ndarray, "3"] | None, str | None]:
        if not sonar.frame:
            return None, "no name of a frame"
        first, last = (mount(self.transforms, base, sonar.frame, stamp) for stamp in (heard.first, heard.last))
        if first is None or last is None:
            return None, f"no transform to {base}"
        if isinstance(first, str) or isinstance(last, str):
            return None, str(first if isinstance(first, str) else last)
        if turned(first, last):
            return None, "one that moves on the robot"
        return last, None

    def _described(self, base: str, sonars: list[Sonar], notes: dict[str, int]) -> Robot:
        told = [self.heard[sonar] for sonar in sonars]
        widths = [width for heard in told if (width := beam_width(heard.field_of_view)) is not None]
        if len(widths) < len(told):
            odd = next(sonar for sonar in sonars if beam_width(self.heard[sonar].field_of_view) is None)
            width = degrees(np.median(widths) if widths else BEAM_WIDTH_RAD)
            field = f"field_of_view {self.heard[odd].field_of_view:g} of {_name(odd)}"
            more = f" and {len(told) - len(widths) - 1} more" if len(told) - len(widths) > 1 else ""
            notes[f"{field}{more}: no beam width, {width:.0f} degrees taken"] = 0
        mounts = np.array([heard.mount for heard in told], dtype=float)
        return robot_of(base, mounts, widths, [heard.limits for heard in told])


def turned(first: Float[ndarray, "3"], last: Float[ndarray, "3"]) -> bool:
    """Whether a mount (m, m, rad) has changed."""
    apart = np.abs(first - last)
    return bool(max(apart[:2]) > _TURNED_M or _TURNED_RAD < apart[2] < 2 * np.pi - _TURNED_RAD)


def stamp_of(message: Message) -> float:
    """The time that a message says, s; 0 if it says none."""
    content = message.content
    if message.type == RANGE:
        return content.stamp
    if message.type in (TF, TF_OLD):
        return max((seconds(each.header.stamp) for each in content.transforms), default=0.0)
    return seconds(content.header.stamp)


BEGIN_S = 1.0
"""Of a bag whose time begins before this, 0 is a time as any other, s."""

NO_STAMP = "a reading without a time on a topic of others that have one"


def events(
    message: Message,
    transforms: Transforms,
    robot: Robot | None,
    refused: Counter[str],
    unstamped: Collection[str] | None = None,
) -> Iterator[Event]:
    """The readings in a message; its transforms and poses are put where they belong.

    ``unstamped``: topics whose messages have the time when they were recorded; None: each that says no other.
    """
    content, kind = message.content, message.type
    late = message.received if unstamped is not None and message.topic in unstamped else None
    silent = late is None and message.received >= BEGIN_S and not stamp_of(message)
    if kind in SONARS and unstamped is not None and silent:
        refused[NO_STAMP] += 1
        return
    if kind == RANGE:
        stamp, frame, field_of_view, low, high, range_m = content
        yield Event(Sonar(message.topic, frame), stamp or message.received, range_m, field_of_view, (low, high))
    elif kind in (TF, TF_OLD):
        refused.update(put_transforms(transforms, content, message.topic.rsplit("/", 1)[-1] == "tf_static", late))
    elif kind == ODOMETRY:
        reason = put_odometry(transforms, content, late)
        if reason:
            refused[reason] += 1
    else:
        stamp = seconds(content.header.stamp) or message.received
        ranges = ranges_of(content) if kind == SONAR_ARRAY else _of_points(message, transforms, robot)
        if ranges is None or (robot is not None and len(ranges) != robot.sonars):
            count = "no" if ranges is None else len(ranges)
            wanted = f", where robot {robot.name} has {robot.sonars}" if robot else ""
            refused[f"a message of {count} sonars{wanted}"] += 1
            return
        limits = (nan, nan) if robot is None else (robot.min_range_m, robot.max_range_m)
        for number, range_m in enumerate(ranges.tolist()):
            yield Event(Sonar(message.topic, str(number)), stamp, range_m, nan, limits)


def _of_points(message: Message, transforms: Transforms, robot: Robot | None) -> Float[ndarray, "sonars"] | None:
    """Ranges (m) of the points that sonars saw, in the order of the sonars; nan where the places are not known."""
    points = points_of(message.content)
    if points is None or robot is None or len(points) != robot.sonars:
        return None if points is None else np.full(len(points), nan)
    frame = message.content.header.frame_id
    base = base_of(transforms, frame)
    pose = transforms.pose(base, frame, seconds(message.content.header.stamp), reach=inf) if frame != base else None
    if pose is not None:
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        points = points @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
    # The points are of single precision: what was 5 m must not fall below it, and be an echo.
    return np.round(np.hypot(*(points - robot.mounts[:, :2]).T), 5)


def _name(sonar: Sonar) -> str:
    return f"{sonar.frame} on {sonar.topic}"


def _names(sonars: Collection[Sonar]) -> str:
    return _few([_name(sonar) for sonar in sonars])


def _listed(topics: Collection[Topic]) -> str:
    return _few([f"{topic.name} ({topic.type if topic.messages else 'without messages'})" for topic in topics])


def _few(names: Collection[str]) -> str:
    """Names for a message, in short: those that differ by numbers alone are one, as a pattern of --topics."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        alike.setdefault(tuple(re.split(r"\d+", name)), []).append(name)
    parts: list[str] = []
    for each in alike.values():
        pieces = zip(*(re.split(r"(\d+)", name) for name in each), strict=True)
        pattern = "".join(piece[0] if len(set(piece)) == 1 else "*" for piece in pieces)
        parts += [f"{short(pattern)} ({len(each)} of them)"] if len(each) > 2 else map(short, each)
    shown = ", ".join(parts[:SHOWN]) or "nothing"
    return f"{shown} and {len(parts) - SHOWN} more" if len(parts) > SHOWN else shown


def short(name: str) -> str:
    """A name as a message shows it."""
    return name if len(name) <= _LONGEST else name[:_LONGEST] + "..."
