"""A map made while the robot drives: messages of ROS in, maps to publish out; no network and no clock of its own.

Whoever may send these messages is a stranger: nothing in them makes ``Live`` raise, and what it keeps of them is
bounded. What is not taken is counted by reason.
"""

import re
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import islice
from math import inf, isfinite, nan
from typing import Any

import numpy as np
from jaxtyping import Float, Int8
from numpy import ndarray

from echogrid.frame import Frame, Track
from echogrid.grid import Grid
from echogrid.mapping.mapper import Mapper
from echogrid.models.set_network import SetNetwork
from echogrid.output.map_server import occupancy
from echogrid.robot import MAX_SONARS, Robot, robot_yaml
from echogrid.ros.messages import Choice, seconds
from echogrid.ros.scans import Scans, base_of, beam_width, fixed_of, mount, reading, robot_of
from echogrid.ros.transforms import Transforms

SETTLE_S, LONGEST_S = 2.0, 10.0
"""Mapping begins when no further sonar was heard for so long, and after so long anyhow, by the readings' stamps."""

REBUILD_S = 10.0
"""Time between two changes of the array, s."""

LEAP_S = 10.0
"""A stamp farther than this from the newest is not of the same clock."""

LEAPS = 20
"""Messages in a row with stamps of another clock, after which that one is taken for the robot's."""

LAG_S = 0.25
"""A pose is waited for until readings are so far ahead of the transforms; then the robot is taken to go on."""

REACH_S = 0.5
"""How far past the newest transform a pose is taken from it at most."""

MAP_EVERY_S = 1.0
"""The map is published no more often."""

CHECK_S = 1.0
"""How often it is looked whether sonars are silent or new."""

GONE_S = 2.0
"""When no sonar at all has been heard for so long, all are silent."""

MAX_CELLS = 16_000_000
"""A map of more cells is refused while live: 160 x 160 m in cells of 4 cm, 0.4 GB."""

_REACH_M = 8.0
"""How much wider than the drive a map is at most."""

MAX_WAITING = 50_000
"""Readings kept until the array is known."""

MAX_MOVES = 200_000
"""Transforms kept until the array is known."""

MAX_READY = 5_000
"""Scans that wait to be mapped."""

AT_ONCE = 10
"""Scans that are mapped before it is looked again what has come."""

MAX_TRANSFORMS = 2_000
"""Transforms that are read from one message."""

MAX_NAME = 200
"""Letters in the name of a frame."""

FAR_STAMP = "a stamp far from those of the others"


class Heard(Enum):
    """Kinds of messages."""

    RANGE = "sensor_msgs/Range"
    TF = "tf2_msgs/TFMessage on /tf"
    STATIC = "tf2_msgs/TFMessage on /tf_static"
    ODOMETRY = "nav_msgs/Odometry"


@dataclass(frozen=True)
class Settings:
    """What the user may choose."""

    choice: Choice = field(default_factory=Choice)
    """Which topics and frames."""
    resolution: float | None = None
    """Side of a cell, m; None: the mapper's own."""
    half_life: float | None = None
    """Time in which evidence comes to count half, s; None: it never fades."""
    local_side: float = 6.0
    """Side of the local map, m."""


@dataclass(frozen=True)
class Picture:
    """A map to publish, as ``nav_msgs/OccupancyGrid`` has it."""

    cells: Int8[ndarray, "rows cols"]
    """100 occupied, 0 free, -1 unknown; row 0 the lowest y."""
    resolution: float
    """Side of a cell, m."""
    origin: tuple[float, float]
    """x, y of the lower left corner of cell [0, 0] in the frame, m."""
    stamp: float
    """Time of the newest scan in it, s."""
    frame: str
    """Frame that it lies in."""
    local: bool
    """Whether it is the part round the robot only."""


@dataclass(frozen=True)
class Snapshot:
    """All that is needed to save a map, apart from what goes on changing."""

    grid: Grid
    """The map, a copy."""
    path: Float[ndarray, "poses 2"]
    """The drive, m."""
    settings: dict[str, Any]
    """How the map was made."""
    title: str
    """Heading of the picture."""


class _Refusal(Exception):  # noqa: N818 - no error of the user's
    """A message is not taken; the text says why."""


@dataclass
class _Sonar:
    """What a sonar's messages say of it."""

    beam: float | None
    limits: tuple[float, float]


@dataclass
class _Clock:
    """Tells stamps of the robot's clock from others."""

    newest: float = nan
    _other: float = nan
    _apart: int = 0

    def admit(self, stamp: float) -> bool:
        """Whether a stamp (s) is of a clock that has jumped.

        Raises:
            _Refusal: it is far from the others.
        """
        if not isfinite(self.newest) or abs(stamp - self.newest) <= LEAP_S:
            self.newest = stamp if not isfinite(self.newest) else max(self.newest, stamp)
            self._apart = 0
            return False
        self._apart = self._apart + 1 if abs(stamp - self._other) <= LEAP_S else 1
        self._other = stamp
        if self._apart < LEAPS:
            raise _Refusal(FAR_STAMP)
        self.newest, self._apart = stamp, 0
        return True


class Live:
    """The map of a robot that drives now."""

    def __init__(self, network: SetNetwork, settings: Settings):
        """Nothing heard yet.

        Args:
            network: the sensor model.
            settings: what the user chose.
        """
        self.settings = settings
        self.scans = self.readings = 0
        """How many scans are in the map, and how many readings were taken."""
        self._network = network
        self._refused: Counter[str] = Counter()
        self._notices: deque[str] = deque(maxlen=100)
        self._said: set[str] = set()
        self._transforms, self._moves = Transforms(), 0
        self._clock = _Clock()
        self._odometry: dict[str, str] = {}
        self._sonars: dict[str, _Sonar] = {}
        self._waiting: deque[tuple[str, float, float]] = deque(maxlen=MAX_WAITING)
        self._array: _Array | None = None
        self._mapper: Mapper | None = None
        self._newest_reading = self._grew = -inf
        self._first = inf
        self._low, self._high = np.full(2, inf), np.full(2, -inf)
        self._path = Track()
        self._ready: deque[Frame] = deque()
        self._last: Frame | None = None
        self._changed = False
        self._map_due = self._check_due = self._rebuilt = -inf
        self._rebuild_due = inf
        self._last_range = -inf
        self._quiet: set[str] = set()
        self._silent: set[str] = set()

    # Messages in.

    def take(self, heard: Heard, topic: str, message: Any, now: float) -> None:
        """Take a message; one that cannot be used is counted and does no harm.

        Args:
            heard: of which kind.
            topic: on which it came.
            message: it has the attributes of that kind, but anything may be in them.
            now: the caller's clock, s, which only has to go on.
        """
        try:
            if heard is Heard.RANGE:
                self._take_range(message, now)
            elif heard is Heard.ODOMETRY:
                self._take_odometry(topic, message)
            else:
                self._take_transforms(message, heard is Heard.STATIC)
        except _Refusal as refusal:
            self._refused[str(refusal)] += 1
        except Exception:  # strangers decide what is in it
            self._refused[f"a message that is no {heard.value}"] += 1

    @property
    def refused(self) -> Counter[str]:
        """How many messages, readings and scans were not taken, by reason."""
        return self._refused + (self._array.scans.dropped if self._array else Counter())

    def notices(self) -> list[str]:
        """What the user should know and was not told yet."""
        told = list(self._notices)
        self._notices.clear()
        return told

    def _say_once(self, text: str) -> None:
        if text not in self._said and len(self._said) < 1000:
            self._said.add(text)
            self._notices.append(text)

    def _take_transforms(self, message: Any, static: bool) -> None:
        for each in islice(message.transforms, MAX_TRANSFORMS):
            try:
                parent, child = _name(each.header.frame_id), _name(each.child_frame_id)
                place, turn = each.transform.translation, each.transform.rotation
                self._put(parent, child, each.header, place, turn, static=static)
            except _Refusal as refusal:
                self._refused[str(refusal)] += 1

    def _take_odometry(self, topic: str, message: Any) -> None:
        parent, child = _name(message.header.frame_id or "odom"), _name(message.child_frame_id or "base_link")
        # Two that know better than each other would make the robot jump to and fro.
        if len(self._odometry) >= MAX_SONARS or topic != self._odometry.setdefault(child, topic):
            raise _Refusal("odometry on a second topic")
        pose = message.pose.pose
        self._put(parent, child, message.header, pose.position, pose.orientation, weak=True)

    def _put(self, parent: str, child: str, header: Any, place: Any, turn: Any, **kind: bool) -> None:
        stamp = 0.0
        if not kind.get("static"):
            if self._array is not None and child not in self._array.line:
                return  # of a joint or of somebody else
            stamp = _stamp(header)
            if self._clock.admit(stamp):
                self._leap(stamp)
            self._moves += 1
            if self._array is None and self._moves > MAX_MOVES:
                self._transforms, self._moves = self._transforms.still(), 0
        numbers = [[float(getattr(part, axis)) for axis in axes] for part, axes in ((place, "xyz"), (turn, "xyzw"))]
        reason = self._transforms.put(parent, child, stamp, numbers[0], numbers[1], **kind)
        if reason is not None:
            raise _Refusal(reason)

    def _take_range(self, message: Any, now: float) -> None:
        frame = _name(message.header.frame_id)
        limits = float(message.min_range), float(message.max_range)
        value = reading(float(message.range), *limits)
        stamp = _stamp(message.header)
        if stamp == 0.0:
            if not isfinite(self._clock.newest):
                raise _Refusal("a reading without a stamp before any transform")
            stamp = self._clock.newest
        if self._clock.admit(stamp):
            self._leap(stamp)
        self._last_range = now
        self._newest_reading, self._first = max(self._newest_reading, stamp), min(self._first, stamp)
        if frame not in self._sonars:
            if len(self._sonars) >= MAX_SONARS:
                raise _Refusal(f"a reading of sonar number {MAX_SONARS + 1}")
            self._sonars[frame] = _Sonar(beam_width(float(message.field_of_view)), limits)
            self._grew = stamp
        if self._array is None:
            self._waiting.append((frame, stamp, value))
        elif frame in self._array.numbers:
            if self._array.scans.add(self._array.numbers[frame], stamp, value) is None:
                self.readings += 1
        else:
            raise _Refusal("a reading of a sonar that is new, or whose place is not known")

    def _leap(self, stamp: float) -> None:
        """The robot's clock has jumped to a stamp: nothing waits for what was before."""
        self._refused["a clock that jumped"] += 1
        self._transforms, self._moves = self._transforms.still(), 0
        self._waiting.clear()
        self._newest_reading = self._grew = self._first = stamp
        if self._array is not None:
            self._refused += self._array.scans.dropped
            self._array.begin(self._transforms)

    # Time goes on.

    @property
    def busy(self) -> bool:
        """Whether scans wait to be mapped."""
        return bool(self._ready)

    def step(self, now: float) -> list[Picture]:
        """Map what has come, and say what is to be published.

        Args:
            now: as for ``take``, s.
        """
        if now >= self._check_due:
            self._check_due = now + CHECK_S
            if self._array is not None:
                self._watch(now)
                self._admit(now)
            elif self._newest_reading - self._grew >= SETTLE_S or self._newest_reading - self._first >= LONGEST_S:
                self._settle()
            if len(self._sonars) >= MAX_SONARS:  # made-up names must not keep others out
                self._sonars = {name: each for name, each in self._sonars.items() if name in self._transforms}
        if self._array is None or self._mapper is None:
            return []
        known = self._transforms.known(self._array.fixed, self._array.base)
        behind = known is not None and self._newest_reading - known[1] > LAG_S
        self._gather(REACH_S if behind else 0.0)
        pictures = []
        if self._map_some(AT_ONCE):
            pictures.append(self._picture(local=True))
        if self._changed and now >= self._map_due:
            self._changed, self._map_due = False, now + MAP_EVERY_S
            pictures.append(self._picture(local=False))
        return pictures

    def finish(self) -> None:
        """Map what was gathered and is not yet a whole scan: nothing comes any more."""
        if self._array is None:
            self._settle()
        if self._array is not None:
            self._gather(REACH_S, final=True)
            self._map_some(len(self._ready))

    def snapshot(self) -> Snapshot | None:
        """The map to be saved; None if there is none yet."""
        if self._mapper is None or self._array is None or not self.scans:
            return None
        grid = self._mapper.grid()
        copy = Grid(
            grid.log_odds.copy(),
            grid.observed.copy(),
            grid.resolution,
            grid.origin,
            None if grid.views is None else grid.views.copy(),
        )
        robot = self._mapper.robot
        settings = {
            "log": "live",
            "robot": robot_yaml(robot),
            "sonars": list(self._array.numbers),
            "fixed_frame": self._array.fixed,
            "robot_frame": self._array.base,
            "frames": self.scans,
            "resolution": grid.resolution,
            "half_life": self.settings.half_life,
            "refused": dict(self.refused),
            "weights": self._network.recipe,
        }
        return Snapshot(copy, self._path.points(), settings, f"live, {robot.sonars} sonars, {self._network.name}")

    def status(self) -> str:
        """How it goes, in one line."""
        if self._array is None:
            return self._lack()
        parts = [f"{self.scans} scans of {len(self._array.numbers)} sonars in {self._array.fixed}"]
        if self._silent:
            parts.append(f"silent: {_listed(self._silent)}")
        refused = self.refused
        if refused:
            parts.append("not taken: " + ", ".join(f"{n} x {reason}" for reason, n in refused.most_common(3)))
        return "; ".join(parts)

    def _lack(self) -> str:
        """Why there is no map yet."""
        if not self._sonars:
            lack = "heard no sensor_msgs/Range yet"
        elif not any(frame in self._transforms for frame in self._sonars):
            lack = f"heard {_listed(self._sonars)}, but no transform of them (/tf_static)"
        elif self._frames() is None:
            lack = f"heard {_listed(self._sonars)}, but no pose of the robot that carries them (/tf or odometry)"
        else:
            lack = f"heard {_listed(self._sonars)}, waiting for more"
        refused = ", ".join(f"{n} x {reason}" for reason, n in self.refused.most_common(3))
        return lack + (f"; not taken: {refused}" if refused else "")

    # The array.

    def _frames(self) -> tuple[str, str] | None:
        """The frame to map in and the robot's, as soon as both are known."""
        bases = Counter(base_of(self._transforms, frame) for frame in self._sonars if frame in self._transforms)
        for base, _ in bases.most_common():
            base = (self.settings.choice.base or base).lstrip("/")
            fixed = (self.settings.choice.fixed or fixed_of(self._transforms, base) or "").lstrip("/")
            if fixed and fixed != base and self._transforms.known(fixed, base) is not None:
                return fixed, base
        return None

    def _settle(self) -> None:
        """Begin to map, if it is known what with."""
        frames = self._frames()
        if frames is None:
            return
        mounts = self._mounts(self._sonars, frames[1])
        if not mounts:
            return
        self._array = _Array(*frames, mounts, self._robot(mounts), self._transforms)
        self._mapper = Mapper(self._array.robot, self._network, self.settings.resolution, self.settings.half_life)
        _compile(self._mapper, self._newest_reading)
        self._notices.append(
            f"mapping in {frames[0]} with {len(mounts)} sonars of {frames[1]}: {_listed(self._array.numbers)}"
        )
        for frame, stamp, value in self._waiting:
            if frame not in mounts:
                self._refused["a reading of a sonar that is new, or whose place is not known"] += 1
            elif self._array.scans.add(self._array.numbers[frame], stamp, value) is None:
                self.readings += 1
        self._waiting.clear()

    def _mounts(self, names: Sequence[str] | dict[str, Any], base: str) -> dict[str, Float[ndarray, "3"]]:
        found = {}
        for name in names:
            if name != base and self._transforms.moves(base, name):
                if self._transforms.known(base, name) is not None:
                    self._say_once(f"sonar {name}: found a place on the robot that moves, so it is left out")
                continue
            place = mount(self._transforms, base, name, self._newest_reading)
            if isinstance(place, str):
                self._say_once(f"sonar {name}: found {place}, so it is left out")
            elif place is not None:
                found[name] = place
        return dict(sorted(found.items(), key=lambda item: _natural(item[0])))

    def _robot(self, mounts: dict[str, Float[ndarray, "3"]]) -> Robot:
        beams = [beam for name in mounts if (beam := self._sonars[name].beam) is not None]
        limits = [self._sonars[name].limits for name in mounts]
        return robot_of("live", np.array(list(mounts.values())), beams, limits)

    def _admit(self, now: float) -> None:
        """Take sonars into the array that were first heard, or whose place became known, while mapping."""
        array = self._array
        if array is None or self._mapper is None:
            return
        new = self._mounts([name for name in self._sonars if name not in array.numbers], array.base)
        if not new:
            self._rebuild_due = inf
            return
        if self._rebuild_due == inf:  # others may come with it
            self._rebuild_due = max(now + SETTLE_S, self._rebuilt + REBUILD_S)
        if now < self._rebuild_due:
            return
        self._rebuild_due, self._rebuilt = inf, now
        self._gather(REACH_S)
        self._map_some(len(self._ready))  # they are scans of the array as it was
        self._refused += array.scans.dropped
        mounts = array.mounts | new
        self._array = _Array(array.fixed, array.base, mounts, self._robot(mounts), self._transforms)
        self._mapper.equip(self._array.robot)
        _compile(self._mapper, self._newest_reading)
        self._notices.append(f"new: {_listed(new)}")

    def _watch(self, now: float) -> None:
        """Tell of sonars that went silent, and of those that came back."""
        if self._array is None:
            return
        self._array.look_up(self._transforms)
        fixed = fixed_of(self._transforms, self._array.base)
        if fixed not in (None, self._array.fixed) and self.settings.choice.fixed is None:
            self._say_once(f"there is {fixed} now; to map in it rather than in {self._array.fixed}, start again")
        names = list(self._array.numbers)
        gone = now - self._last_range > GONE_S
        quiet = set(names) if gone else {names[number] for number in self._array.scans.silent()}
        # Twice in a row, so that one late scan raises no alarm.
        silent = quiet & self._quiet | quiet & self._silent
        if fresh := silent - self._silent:
            self._notices.append(f"silent: {_listed(fresh)}; what they look at is left as it is")
        if back := self._silent - quiet:
            self._notices.append(f"back: {_listed(back)}")
        self._quiet, self._silent = quiet, silent

    # Maps out.

    def _gather(self, reach: float, final: bool = False) -> None:
        """Take the scans that are complete."""
        if self._array is None:
            return
        for frame in self._array.scans.frames(reach, final):
            if len(self._ready) >= MAX_READY:
                self._refused["a scan too many to keep up with"] += 1
            elif self._fits(frame.pose):
                self._ready.append(frame)

    def _map_some(self, most: int) -> bool:
        """Put scans into the map; whether there was one."""
        if not self._ready or self._mapper is None:
            return False
        for _ in range(min(most, len(self._ready))):
            frame = self._last = self._ready.popleft()
            # Always one scan, always with mounts: that is one program to compile, which takes seconds.
            mounts = self._mapper.robot.mounts if frame.mounts is None else frame.mounts
            self._mapper.add([replace(frame, mounts=mounts)])
            self._path.add(frame)
            self.scans += 1
        self._changed = True
        return True

    def _fits(self, pose: Float[ndarray, "3"]) -> bool:
        low, high = np.minimum(self._low, pose[:2]), np.maximum(self._high, pose[:2])
        resolution = self._mapper.resolution if self._mapper else 1.0
        if np.prod((high - low + _REACH_M) / resolution) > MAX_CELLS:
            self._refused["a pose so far off that the map would become too large"] += 1
            return False
        self._low, self._high = low, high
        return True

    def _picture(self, local: bool) -> Picture:
        assert self._mapper is not None
        assert self._array is not None
        assert self._last is not None
        x, y = (float(v) for v in self._last.pose[:2])
        grid = self._mapper.around(x, y, self.settings.local_side) if local else self._mapper.grid()
        return Picture(occupancy(grid), grid.resolution, grid.origin, self._last.stamp, self._array.fixed, local)


class _Array:
    """The sonars that map, and their scans."""

    def __init__(
        self,
        fixed: str,
        base: str,
        mounts: dict[str, Float[ndarray, "3"]],
        robot: Robot,
        transforms: Transforms,
    ):
        self.fixed, self.base, self.mounts, self.robot = fixed, base, mounts, robot
        self.numbers = {name: number for number, name in enumerate(mounts)}
        self.line: set[str] = set()
        """Frames whose transforms matter."""
        self.look_up(transforms)
        self.begin(transforms)

    def look_up(self, transforms: Transforms) -> None:
        """See which frames the robot hangs on: a localiser that starts late puts one above the others."""
        self.line = {name for frame in (self.base, self.fixed, *self.mounts) for name in transforms.line(frame)}

    def begin(self, transforms: Transforms) -> None:
        """Wait for a new scan."""
        self.scans = Scans(self.robot, transforms, self.fixed, self.base)


def _compile(mapper: Mapper, stamp: float) -> None:
    """Have the network compiled now, not when the first scan waits for it."""
    far = np.array([1e6, 1e6, 0.0])
    mapper.prepare([Frame(stamp, far, np.full(mapper.robot.sonars, nan), mounts=mapper.robot.mounts)])()


def _stamp(header: Any) -> float:
    sec, nanosec = int(header.stamp.sec), int(header.stamp.nanosec)
    if sec < 0 or not 0 <= nanosec < 10**9 or sec > 2**32:
        raise _Refusal("a stamp that cannot be")
    return seconds(header.stamp)


def _name(name: str) -> str:
    if not isinstance(name, str) or not name.isprintable() or len(name) > MAX_NAME or not name.strip(" /"):
        raise _Refusal("a name of a frame that cannot be")
    return name.lstrip("/")


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts sonar_2 before sonar_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _listed(names: Sequence[str] | set[str] | dict[str, Any]) -> str:
    """A few names, and how many more."""
    ordered = sorted(names, key=_natural)
    more = f" and {len(ordered) - 4} more" if len(ordered) > 4 else ""
    return ", ".join(ordered[:4]) + more
