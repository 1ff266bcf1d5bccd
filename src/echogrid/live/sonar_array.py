"""The sonars that map: where they sit on the robot, their scans, and which of them are silent."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.ros.gathering import Scans
from echogrid.ros.messages import Choice, natural
from echogrid.ros.sonars import MAX_RANGE_M, base_of, fixed_of, mount, robot_of
from echogrid.ros.transforms import Transforms

Mounts = dict[str, Float[ndarray, "3"]]
"""Where sonars sit on the robot, by their frames: x, y (m), axis (rad)."""


@dataclass(frozen=True)
class SonarSaid:
    """What a sonar's messages say of it."""

    beam: float | None
    """Beam width, rad; None: they say none."""
    limits: tuple[float, float]
    """Minimum and maximum range, m."""
    topic: str
    """Where they come."""


def frames_of(
    transforms: Transforms, sonars: Iterable[str], choice: Choice, odometry: bool = False
) -> tuple[str, str] | None:
    """The frame to map in, or that of odometry, and the robot's that carries sonars, as soon as both are known."""
    bases = Counter(base_of(transforms, name) for name in sonars if name in transforms)
    for base, _ in bases.most_common():
        base = (choice.base or base).lstrip("/")
        fixed = (choice.fixed or fixed_of(transforms, base, odometry) or "").lstrip("/")
        if fixed and fixed != base and transforms.known(fixed, base) is not None:
            return fixed, base
    return None


def mounts_of(transforms: Transforms, sonars: Iterable[str], base: str, stamp: float) -> tuple[Mounts, list[str]]:
    """Where sonars sit on the robot at a time (s), in the order of their names, and what to say of those left out.

    Left out are those whose place is of no use. Of those whose place is not known yet there is nothing to say.
    """
    found, left_out = {}, []
    for name in sonars:
        place = None
        if name == base or not transforms.moves(base, name):
            place = mount(transforms, base, name, stamp)
        elif transforms.known(base, name) is not None:
            place = "a place on the robot that moves"
        if isinstance(place, str):
            left_out.append(f"sonar {name}: found {place}, so it is left out")
        elif place is not None:
            found[name] = place
    return dict(sorted(found.items(), key=lambda item: natural(item[0]))), left_out


def lack(transforms: Transforms, sonars: Collection[str], choice: Choice) -> str:
    """Why sonars that were heard do not map yet."""
    if not sonars:
        return "heard no sensor_msgs/Range yet"
    if not any(name in transforms for name in sonars):
        return f"heard {listed(sonars)}, but no transform of them (/tf_static)"
    if frames_of(transforms, sonars, choice) is None:
        return f"heard {listed(sonars)}, but no pose of the robot that carries them (/tf or odometry)"
    return f"heard {listed(sonars)}, waiting for more"


class SonarArray:
    """The sonars that map, and their scans."""

    def __init__(
        self, fixed: str, base: str, mounts: Mounts, sonars: Mapping[str, SonarSaid], transforms: Transforms
    ):
        """An array that waits for its first scan.

        Args:
            fixed: frame to map in.
            base: frame of the robot.
            mounts: of the sonars by their frames, in the order that they get in the scans.
            sonars: what the messages of these (and others) say of them.
            transforms: where poses come from.
        """
        self.fixed, self.base = fixed, base
        self.silent: set[str] = set()
        """Sonars that it was told of that they are silent."""
        self._quiet: set[str] = set()
        self._mounts: Mounts = {}
        self.grow(mounts, sonars, transforms)

    def grow(self, mounts: Mounts, sonars: Mapping[str, SonarSaid], transforms: Transforms) -> None:
        """Take more sonars in, behind those that are there, and wait for a new scan."""
        self._mounts = self._mounts | mounts
        self.numbers = {name: number for number, name in enumerate(self._mounts)}
        """Number of each sonar in the scans, by its frame."""
        beams = [beam for name in self._mounts if (beam := sonars[name].beam) is not None]
        limits = [sonars[name].limits for name in self._mounts]
        self._lows = np.array([low if isfinite(low) else 0.0 for low, _ in limits])
        self._highs = np.array([min(high, MAX_RANGE_M) if high > 0 else MAX_RANGE_M for _, high in limits])
        self.robot = robot_of("live", np.array(list(self._mounts.values())), beams, limits)
        self.look_up(transforms)
        self.begin(transforms)

    def clean(self, ranges: Float[ndarray, "sonars"]) -> Float[ndarray, "sonars"]:
        """Ranges (m) by the limits of each sonar: +inf no echo, nan not valid."""
        ranges = np.where(ranges > self._highs, np.inf, ranges)
        return np.where(ranges < self._lows, np.nan, ranges)

    def look_up(self, transforms: Transforms) -> None:
        """See which frames the robot hangs on: a localiser that starts late puts one above the others."""
        self.line = {name for frame in (self.base, self.fixed, *self.numbers) for name in transforms.line(frame)}
        """Frames whose transforms matter."""

    def begin(self, transforms: Transforms) -> None:
        """Wait for a new scan."""
        self.scans = Scans(self.robot, transforms, self.fixed, self.base)

    def watch(self, gone: bool) -> list[str]:
        """Look which sonars went silent and which came back; what is to be said of it.

        Args:
            gone: no sonar at all was heard lately.
        """
        names = list(self.numbers)
        quiet = set(names) if gone else {names[number] for number in self.scans.silent()}
        # Twice in a row, so that one late scan raises no alarm.
        silent = quiet & self._quiet | quiet & self.silent
        said = []
        if fresh := silent - self.silent:
            said.append(f"silent: {listed(fresh)}; what they look at is left as it is")
        if back := self.silent - quiet:
            said.append(f"back: {listed(back)}")
        self._quiet, self.silent = quiet, silent
        return said


def listed(names: Iterable[str]) -> str:
    """A few names, and how many more."""
    ordered = sorted(names, key=natural)
    more = f" and {len(ordered) - 4} more" if len(ordered) > 4 else ""
    return ", ".join(ordered[:4]) + more
