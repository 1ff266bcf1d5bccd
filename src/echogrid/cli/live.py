"""The command about a robot that drives now: live."""

import os
import pickle
import re
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated

from jaxtyping import Float
from numpy import ndarray
from tyro.conf import OmitArgPrefixes, arg

from echogrid.cli.arguments import Ros, check_map, drop, open_map, start_pose
from echogrid.cli.driving import Explores
from echogrid.cli.network import domain_of, interface_of, stopped, where
from echogrid.errors import EchogridError, UsageError, escaped
from echogrid.extras import need
from echogrid.files import made
from echogrid.output.folder import check_folder

if TYPE_CHECKING:
    from echogrid.grid import Grid
    from echogrid.live.dds import Network
    from echogrid.live.live_map import Snapshot
    from echogrid.live.session import Live as Mapping

STATUS_S = 10.0
"""How often it is said how it goes."""

DISCOVER_S, SOON_S = 0.5, 0.05
"""How often it is looked for new topics; and before anything is mapped."""

FADES_S = 30.0
"""The half-life of what is mapped by odometry that drifts, for the local map alone."""

WAIT_S = 0.05
"""How long a signal to stop waits at most."""


@dataclass(frozen=True)
class Live:
    """Map what a ROS 2 robot hears now, without ROS: sensor_msgs/Range and tf or odometry in, /map out.

    Publishes /map (nav_msgs/OccupancyGrid, kept for those who come later) once a second if it changed, and
    /local_map, the part round the robot, after each scan. Saves the map like echogrid map, each minute and when it is
    stopped (Ctrl-C, SIGTERM, SIGHUP), which is its ordinary end: exit status 0, or 2 if nothing was mapped.

    It listens on loopback only, unless you name an interface: nobody on a DDS network has to prove who they are.
    """

    slam: bool = False
    """Poses are odometry that drifts: find them with the map. Publishes map -> odom on /tf, and /map in map."""
    map: Annotated[Path | None, arg(metavar="MAP")] = None
    """Find the robot in a map that is known, as localise does: publishes that on /map, map -> odom on /tf and
    /amcl_pose, and takes /initialpose."""
    start: Annotated[str | None, arg(metavar="X,Y,DEG")] = None
    """With --map: about where the robot is. Default: anywhere on its free floor."""
    map_frame: str = "map"
    """With --slam or --map: the frame of the map."""
    transform_tolerance: Annotated[float, arg(metavar="S")] = 1.0
    """With --slam or --map: how long after its scan map -> odom holds, s."""
    explores: Annotated[Explores, OmitArgPrefixes] = field(default_factory=Explores)
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    out: Path = Path("out")
    """Folder for the map."""
    interface: Annotated[str | None, arg(metavar="NAME|any")] = None
    """Network interface: lo, eth0, ... or any. Default: what CYCLONEDDS_URI says if it is set, else lo. Nodes that
    talk on an interface other than lo are heard only if it is named."""
    domain: Annotated[int | None, arg(metavar="ID")] = None
    """DDS domain. Default: ROS_DOMAIN_ID, else 0."""
    map_topic: str = "/map"
    """Where to publish the map."""
    local_map_topic: str = "/local_map"
    """Where to publish the local map."""
    local_side: Annotated[float, arg(metavar="M")] = 6.0
    """Side of the local map, m."""
    resolution: Annotated[float | None, arg(metavar="M")] = None
    """Side of a cell of the map, m. Default: 0.04."""
    interpreter: str = "set-network"
    """set-network, or a file of its weights."""
    half_life: Annotated[float | None, arg(metavar="S")] = None
    """For places that change: time in which what was seen comes to count half, s. Default: it never fades."""
    save_every: Annotated[float, arg(metavar="S")] = 55.0
    """Time from one saving to the next, s. With the time it takes to save, a kill costs a minute at most."""

    def run(self) -> None:
        """Map until stopped."""
        domain, drives = self._check(), self.explores.drives(self.map is not None)
        need("live", "ros2")
        from echogrid.live.dds import Network
        from echogrid.live.live_map import Settings
        from echogrid.live.session import Live as Mapping
        from echogrid.mapping.registry import sensor_model
        from echogrid.models.networks.set_network import SetNetwork

        model = sensor_model(self.interpreter)
        if not isinstance(model, SetNetwork):
            raise UsageError(
                f"--interpreter: found {self.interpreter}, expected set-network or a file of its weights"
            )
        choice = self.ros.choice()
        known, start = self._known()
        fades = self.half_life if known is None or self.half_life else FADES_S
        settings = Settings(
            choice, self.resolution, fades, self.local_side, self.slam, known, start, self.map_frame,
            self.transform_tolerance,
        )  # fmt: skip
        mapping = Mapping(model, settings, drives)
        with made(self.out), stopped() as stop:
            check_folder(self.out)
            interface = interface_of(self.interface)
            topics = self.map_topic, self.local_map_topic
            network = Network(domain, interface, choice, *topics, known is not None, *self.explores.topics())
            _say(f"domain {domain}, {where(interface, network.kept)}; {self.map_topic}, {self.local_map_topic}")
            if drives:
                _say(self.explores.told())
            saver = _Saver(self.out, self.save_every)
            try:
                _map(mapping, network, saver, stop, interface or "the interfaces of CYCLONEDDS_URI")
            finally:  # whatever happens, the robot stops
                for last in mapping.ended():
                    network.send(last)
            _finish(mapping, network)
            saver.last(mapping, network)
        files = f"{self.out}/map.png; {self.out}/map.yaml is for Nav2's map_server"
        print(escaped(f"{mapping.scans} scans, {mapping.readings} readings; map in {files}"))

    def _check(self) -> int:
        check_map(self.resolution, self.half_life)
        if not 1.0 <= self.local_side <= 40.0:
            raise UsageError(f"--local-side: found {self.local_side:g}, expected 1 to 40 m")
        if not 1.0 <= self.save_every <= 86400.0:
            raise UsageError(f"--save-every: found {self.save_every:g}, expected 1 to 86400 s")
        if not 0.0 <= self.transform_tolerance <= 60.0:
            raise UsageError(f"--transform-tolerance: found {self.transform_tolerance:g}, expected 0 to 60 s")
        if not re.fullmatch(r"[A-Za-z_][\w/]{0,199}", self.map_frame, re.ASCII):
            raise UsageError(f"--map-frame: found {self.map_frame!r}, expected a name of a frame such as map")
        return domain_of(self.domain)

    def _known(self) -> "tuple[Grid | None, Float[ndarray, '3'] | None]":
        """The map in which the robot is to be found, and where it is."""
        if self.map is None:
            if self.start is not None:
                raise UsageError("--start: found no --map, expected the map in which that is")
            return None, None
        if self.slam:
            raise UsageError("--slam, --map: found both, expected one of the two")
        from echogrid.position.floor import check_start

        grid, start = open_map(self.map), None if self.start is None else start_pose(self.start)
        check_start(grid, start)
        if os.path.realpath(self.out) == os.path.realpath(self.map if self.map.is_dir() else self.map.parent):
            raise UsageError(f"--out: found {self.out}, the folder of the map, expected another one")
        return grid, start


def _map(mapping: "Mapping", network: "Network", saver: "_Saver", stop: list[int], where: str) -> None:
    status_due, discover_due, told = time.monotonic() + STATUS_S, 0.0, ""
    while not stop:
        network.wait(0.0 if mapping.busy else WAIT_S)
        now = time.monotonic()
        if now >= discover_due:
            discover_due = now + (DISCOVER_S if mapping.scans else SOON_S)
            network.discover()
        for heard, topic, message, source in network.take():
            mapping.take(heard, topic, message, now, source)
        for picture in mapping.step(now):
            network.send(picture)
        _tell(mapping)
        saver.step(mapping, now)
        if now >= status_due:
            status_due = now + STATUS_S
            status = _status(mapping, network, where)
            if status != told:
                _say(status)
            told = status


def _finish(mapping: "Mapping", network: "Network") -> None:
    """Map what has come and was not mapped yet."""
    for heard, topic, message, source in network.take():
        mapping.take(heard, topic, message, time.monotonic(), source)
    mapping.finish()
    _tell(mapping)


def _tell(mapping: "Mapping") -> None:
    for notice in mapping.notices():
        _say(notice)


def _status(mapping: "Mapping", network: "Network", where: str) -> str:
    if not network.ranges:
        return f"no topic of sensor_msgs/Range on {where} (--interface, --domain, --topics choose others)"
    lack = [] if mapping.scans else network.lack()
    return "; ".join([mapping.status(), *lack]) + "".join(
        f"; {n} x {reason}" for reason, n in network.refused.most_common(3)
    )


class _Saver:
    """Saves the map now and then, beside the mapping, and at the end."""

    def __init__(self, folder: Path, every: float):
        self._folder, self._every = folder, every
        self._due: float | None = None
        self._scans = 0
        self._thread: Thread | None = None

    def step(self, mapping: "Mapping", now: float) -> None:
        """Save if it is time."""
        if self._due is None:
            self._due = now + self._every if mapping.scans else None
        elif now >= self._due and (self._thread is None or not self._thread.is_alive()):
            self._due = now + self._every
            snapshot = mapping.snapshot()
            if snapshot is not None and mapping.scans > self._scans:
                self._scans = mapping.scans
                self._thread = Thread(target=self._save, args=(snapshot,))
                self._thread.start()

    def _save(self, snapshot: "Snapshot") -> None:
        # In a process of its own: what draws would stay in this one, and take turns with what maps. A Ctrl-C is for
        # this one alone.
        words = [sys.executable, "-P", "-c", f"from {__name__} import save; save()"]
        with (
            suppress(BrokenPipeError),
            subprocess.Popen(words, stdin=subprocess.PIPE, start_new_session=True) as process,
        ):
            assert process.stdin is not None
            pickle.dump((self._folder, snapshot), process.stdin)

    def last(self, mapping: "Mapping", network: "Network") -> None:
        """Save the finished map."""
        if self._thread is not None:
            self._thread.join()
        snapshot = mapping.snapshot()
        if snapshot is None:
            because = "; ".join([mapping.status(), *network.lack()])
            raise UsageError(
                f"live: found no scan to map ({because}), expected sensor_msgs/Range with tf or odometry"
            )
        mapping.refuse_nothing()
        _write(self._folder, snapshot)


def save() -> None:
    """Save the map that comes on stdin."""
    if hasattr(os, "nice"):
        os.nice(10)
    try:
        folder, snapshot = pickle.load(sys.stdin.buffer)
    except (EOFError, pickle.UnpicklingError):  # who sent it was killed
        return
    try:
        _write(folder, snapshot)
    except EchogridError as error:
        _say(f"not saved: {error}")


def _write(folder: Path, snapshot: "Snapshot") -> None:
    from echogrid.output.map_file import write_map

    write_map(folder, snapshot.grid, snapshot.path, snapshot.settings, snapshot.title)
    drop(folder)


def _say(text: str) -> None:
    print(f"live: {escaped(text)}", file=sys.stderr, flush=True)
