"""A map made while the robot drives: messages of ROS in, maps to publish out; no network and no clock of its own."""

from collections import Counter, deque
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import replace
from math import degrees, inf
from typing import Any

import numpy as np

from echogrid.geometry import compose, inverse
from echogrid.live.driving import Drives, Driving, Goal, Velocity
from echogrid.live.hearing import SETTLE_S, Heard, Hearing
from echogrid.live.known import Known
from echogrid.live.live_map import LiveMap, Picture, Settings, Snapshot, picture_of
from echogrid.live.placing import Correction, RobotPose, Slam
from echogrid.live.sonar_array import Mounts, SonarArray, frames_of, lack, listed, mounts_of
from echogrid.live.telling import Telling, doubts, kind_of
from echogrid.models.networks.set_network import SetNetwork
from echogrid.position.corrected import LEAST_SONARS
from echogrid.ros.sonars import fixed_of

Sent = Picture | Correction | RobotPose | Goal | Velocity
"""What is to be published."""

DRIFTS = (
    "explores by poses in {}: where that odometry drifts the map is wrong, and the robot hits what it lacks: --slam"
)
"""What is said where nobody corrects the odometry."""

REBUILD_S = 10.0
"""Time between two changes of the array, s."""

LAG_S = 0.25
"""A pose is waited for until readings are so far ahead of the transforms; then the robot is taken to go on."""

REACH_S = 0.5
"""How far past the newest transform a pose is taken from it at most."""

CHECK_S, SOON_S = 1.0, 0.05
"""How often it is looked whether sonars are silent or new; and, before there is a map, whether it can begin."""

JUDGE_S, JUDGE_EVERY_S = 15.0, 10.0
"""Scans are judged when they have been mapped for so long, and how often then."""

ANEW_S = SETTLE_S + CHECK_S
"""So soon after it began a map begins anew where what came since says how it should have begun: hardly anything is
lost."""

GONE_S = 2.0
"""When no sonar at all has been heard for so long, all are silent."""


class Live:
    """The map of a robot that drives now."""

    def __init__(self, network: SetNetwork, settings: Settings, drives: Drives | None = None):
        """Nothing heard yet.

        Args:
            network: the sensor model.
            settings: what the user chose.
            drives: how the robot explores; None: it does not.
        """
        self.settings = settings
        self._network = network
        self._refused: Counter[str] = Counter()
        self._notices: deque[str] = deque(maxlen=100)
        self._said: set[str] = set()
        self._hearing = Hearing(self._refused)
        self._map: LiveMap | None = None
        self._begin_due = self._check_due = self._rebuilt = -inf
        self._rebuild_due = self._judge_due = self._began = inf
        self._known_due = settings.known is not None
        self._telling = Telling()
        self._driving = Driving(drives) if drives else None
        self._doubts: list[str] = []

    @property
    def scans(self) -> int:
        """How many scans are in the map."""
        return self._map.scans if self._map else 0

    @property
    def readings(self) -> int:
        """How many readings were taken."""
        return self._hearing.readings

    @property
    def refused(self) -> Counter[str]:
        """How many messages, readings and scans were not taken, by reason."""
        return self._refused + (self._map.array.scans.dropped if self._map else Counter())

    @property
    def busy(self) -> bool:
        """Whether scans wait to be mapped."""
        return self._map is not None and self._map.busy

    def take(self, heard: Heard, topic: str, message: Any, now: float, source: Hashable = None) -> None:
        """Take a message: as ``Hearing.take``."""
        self._hearing.take(heard, topic, message, now, source)

    def notices(self) -> list[str]:
        """What the user should know and was not told yet."""
        told = list(self._notices)
        self._notices.clear()
        return told

    def _say_once(self, texts: Iterable[str]) -> None:
        for text in texts:
            if text not in self._said and len(self._said) < 1000:
                self._said.add(text)
                self._notices.append(text)

    def step(self, now: float) -> Iterator[Sent]:
        """Map what has come, and say what is to be published: to be gone through to its end.

        Args:
            now: as for ``take``, s.
        """
        hearing = self._hearing
        if self._map is None and now >= self._begin_due and hearing.settled(now):
            self._begin_due = now + SOON_S
            self._settle()
            if self._map is not None:
                self._began = min(self._began, now)
        yield from self._known()
        if self._map is not None:
            self._be_put(self._map)
            known = hearing.transforms.known(self._map.array.fixed, self._map.array.base)
            behind = known is not None and hearing.newest - known[1] > LAG_S
            yield from self._map.step(now, REACH_S if behind else 0.0)
            said = list(self._map.placing.notices()) if self._map.placing else []
            self._notices += said
            if isinstance(self._map.placing, Slam):
                self._doubts += self._telling.told([(kind_of(note), note) for note in said], now=True)
            yield from self._drive(self._map, now)
        if now >= self._check_due:
            self._check_due = now + CHECK_S
            self._check(now)

    def _drive(self, live_map: LiveMap, now: float) -> list[Goal | Velocity]:
        """Where to go, or how fast to drive, where the robot explores."""
        if self._driving is None:
            return []
        sent = self._driving.step(live_map, self._hearing, now)
        self._notices += self._driving.notices
        self._driving.notices.clear()
        return sent

    def ended(self) -> list[Goal | Velocity]:
        """What is to be published last, before anything that takes long."""
        return self._driving.ended() if self._driving else []

    def _check(self, now: float) -> None:
        """Look what was heard, and tell what is to be told."""
        hearing = self._hearing
        hearing.bring_together()
        if self._map is not None:
            if now - self._began > ANEW_S:
                hearing.forget()
            self._watch(self._map.array, now)
        if self._map is not None:
            self._admit(self._map, now)
            self._judge_due = min(self._judge_due, now + JUDGE_S)
        hearing.tidy()
        if hearing.settled(now):
            self._doubt()
        if now >= self._judge_due:
            self._judge_due = now + JUDGE_EVERY_S
            self._judge()

    def _known(self) -> list[Picture | Correction | RobotPose]:
        """The map that is known, once, as a map server sends it."""
        if not self._known_due or self.settings.known is None:
            return []
        self._known_due = False
        return [picture_of(self.settings.known, 0.0, self.settings.map_frame, local=False)]

    def _be_put(self, live_map: LiveMap) -> None:
        """Hand on where somebody says that the robot is."""
        said, self._hearing.initial = self._hearing.initial, None
        if said is None or not isinstance(live_map.placing, Known):
            return
        if said.frame != self.settings.map_frame:
            self._notices.append(f"initial pose not taken: it is in {said.frame}, expected {self.settings.map_frame}")
            return
        transforms, array = self._hearing.transforms, live_map.array
        at = transforms.pose(array.fixed, array.base, said.stamp, REACH_S) if said.stamp else None
        if at is None:  # of no time that is known: it is meant for now
            known = transforms.known(array.fixed, array.base)
            at = transforms.pose(array.fixed, array.base, known[1]) if known else None
        if at is not None:
            x, y, theta = said.pose
            self._notices.append(f"initial pose: {x:.2f}, {y:.2f} m, {degrees(theta):.0f} degrees")
            live_map.placing.put(compose(np.array(said.pose), inverse(at)), np.array(said.spread))

    def finish(self) -> None:
        """Map what was gathered and is not yet a whole scan: nothing comes any more."""
        if self._map is None:
            self._settle()
        if self._map is not None:
            self._map.catch_up(REACH_S, final=True)
        self._doubt(final=True)
        self._judge()

    def _doubt(self, final: bool = False) -> None:
        """Tell what is doubtful about what was heard."""
        told = self._telling.told(doubts(self._hearing, self._map.array if self._map else None), final)
        self._doubts += told
        self._notices += told

    def _judge(self) -> None:
        """Tell what is doubtful about the scans."""
        for note, count in self._map.notes().items() if self._map else ():
            said = f"{count} x {note}" if count else note
            self._notices += self._telling.told([(kind_of(note), said)], now=True)

    def refuse_nothing(self) -> None:
        """Raise an InputError if there were scans, but no reading that can be used."""
        if self._map is not None:
            self._map.refuse_nothing()

    def snapshot(self) -> Snapshot | None:
        """The map to be saved; None if there is none yet."""
        if self._map is None or (taken := self._map.snapshot(self.refused, self._doubts)) is None:
            return None
        return replace(taken, settings=taken.settings | self._driving.settings()) if self._driving else taken

    def status(self) -> str:
        """How it goes, in one line."""
        if self._map is None:
            parts = [self._lack()]
        else:
            array = self._map.array
            parts = [f"{self.scans} scans of {len(array.numbers)} sonars in {self._map.frame}"]
            parts += [self._map.placing.status()] if self._map.placing else []
            parts += [self._driving.status()] if self._driving else []
            if array.silent:
                parts.append(f"silent: {listed(array.silent)}")
        if refused := self.refused.most_common(3):
            parts.append("not taken: " + ", ".join(f"{n} x {reason}" for reason, n in refused))
        return "; ".join(parts)

    def _lack(self) -> str:
        hearing = self._hearing
        if hearing.sonars and not hearing.apart:
            return f"heard {listed(hearing.sonars)}, but no sonar that has a frame of its own"
        return lack(hearing.transforms, hearing.apart, self.settings.choice)

    def _settle(self) -> None:
        """Begin to map, if it is known what with."""
        hearing = self._hearing
        frames = frames_of(hearing.transforms, hearing.apart, self.settings.choice, self._finds)
        mounts = self._mounts(hearing.apart, frames[1]) if frames else {}
        if not frames or not mounts or not self._is_odometry(*frames, len(mounts)):
            return
        array = SonarArray(*frames, mounts, hearing.sonars, hearing.transforms)
        self._map = LiveMap(array, self._network, self.settings, self._refused)
        fixed, base = frames
        where = f"mapping in {self._map.frame}"
        if self.settings.known is not None:
            where = f"looking for the robot in {self.settings.map_frame}, by odometry in {fixed},"
        elif self.settings.slam:
            where += f", with odometry in {fixed},"
        self._notices.append(f"{where} with {len(mounts)} sonars of {base}: {listed(mounts)}")
        if self._driving and not self._finds and "odom" in fixed.split("/")[-1]:
            self._say_once([DRIFTS.format(fixed)])
        hearing.begin(array)

    @property
    def _finds(self) -> bool:
        """Whether it is to be found where the robot is."""
        return self.settings.slam or self.settings.known is not None

    def _is_odometry(self, fixed: str, base: str, sonars: int) -> bool:
        """Whether the robot can be found by its sonars and its odometry in a frame, where that is wanted; else it is
        said why not.
        """
        if not self._finds:
            return True
        if fixed == self.settings.map_frame:
            self._say_once([f"{base} is told in {fixed} itself, not in a frame of odometry: stop who tells that"])
            return False
        if sonars < LEAST_SONARS:
            few = f"{sonars} {'sonar' if sonars == 1 else 'sonars'}, expected {LEAST_SONARS} at least"
            self._say_once(
                [f"found {few}: of fewer no place is told from another, so the odometry is hardly corrected"]
            )
        return True

    def _mounts(self, sonars: Iterable[str], base: str) -> Mounts:
        """Where sonars sit; of those whose place is of no use it is said."""
        mounts, left_out = mounts_of(self._hearing.transforms, sonars, base, self._hearing.newest)
        self._say_once(left_out)
        return mounts

    def _watch(self, array: SonarArray, now: float) -> None:
        """Tell of sonars that went silent and of those that came back; begin in a better frame, or tell of it."""
        transforms = self._hearing.transforms
        array.look_up(transforms)
        fixed = fixed_of(transforms, array.base)
        if self._finds:
            if self.settings.map_frame in transforms.line(array.base):
                frame = self.settings.map_frame
                self._say_once([f"{array.fixed} is told in {frame} by another program as well: stop it"])
        elif fixed not in (None, array.fixed) and self.settings.choice.fixed is None:
            if now - self._began <= ANEW_S:
                self._hearing.forget()  # of before it there are no poses in it
                self._anew(f"there is {fixed} now: the map begins anew in it, not in {array.fixed}")
                return
            self._say_once([f"there is {fixed} now; to map in it rather than in {array.fixed}, start again"])
        self._notices += array.watch(gone=now - self._hearing.last_range > GONE_S)

    def _anew(self, why: str) -> None:
        """Begin the map anew, and tell why."""
        self._map = None
        self._hearing.halt()
        self._notices.append(why)

    def _admit(self, live_map: LiveMap, now: float) -> None:
        """Take sonars into the array that were first heard, or whose place became known, while mapping."""
        array, hearing = live_map.array, self._hearing
        new = self._mounts([name for name in hearing.apart if name not in array.numbers], array.base)
        if not new:
            self._rebuild_due = inf
            return
        if now - self._began <= ANEW_S and self.settings.known is None:
            self._anew(f"new: {listed(new)}; the map begins anew with what all heard")
            return
        if self._rebuild_due == inf:  # others may come with it
            self._rebuild_due = max(now + SETTLE_S, self._rebuilt + REBUILD_S)
        if now < self._rebuild_due:
            return
        self._rebuild_due, self._rebuilt = inf, now
        live_map.catch_up(REACH_S)  # they are scans of the array as it was
        self._refused.update(array.scans.dropped)
        array.grow(new, hearing.sonars, hearing.transforms)
        live_map.equip()
        self._notices.append(f"new: {listed(new)}")
