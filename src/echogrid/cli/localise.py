"""The command that says where a robot was in a map that is known: localise."""

import os
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, check_seed, open_log, open_map, print_notes, robot_arg, shown, start_pose
from echogrid.errors import InputError, UsageError, escaped
from echogrid.files import check_writable, made, replacing
from echogrid.frame import Log
from echogrid.robot import Robot, robot_yaml

if TYPE_CHECKING:
    from echogrid.position.localise import Localised

_FILES = ("trajectory.tum", "map.png", "run.yaml")

_OFF_FLOOR_M = 0.5
"""A way off the free floor that is longer is told."""

_SAID = {
    "sure": "one place remained",
    "lost": "the place did not explain what was heard: looked for it anywhere again",
    "anew": "time goes back and the poses of the log jump: the drive begins again where it began",
    "jump": "the poses of the log jump, or start anew; the robot is taken to have stayed where it was",
}


@dataclass(frozen=True)
class Localise:
    """Find where a robot was in a map that is known: a log of ranges and odometry in, its true poses out.

    Writes trajectory.tum (a pose a frame, in the frame of the map, for evo), map.png (the drive on the map) and
    run.yaml (what was done). The poses of the log are odometry, which may drift and may begin anywhere.
    """

    log: Annotated[Positional[str], arg(metavar="LOG")]
    """CSV or CARMEN log, or a bag of ROS 1 or ROS 2."""
    map: Annotated[Path, arg(metavar="MAP")]
    """A map folder or map.npz of echogrid, or the YAML of a map_server pair, drawn by anybody."""
    start: Annotated[str | None, arg(metavar="X,Y,DEG")] = None
    """About where the robot began, in the map: m, m, degrees; right within some 0.3 m and 15 degrees."""
    anywhere: bool = False
    """The robot began anywhere on the free floor of the map."""
    robot: Annotated[
        str | None, robot_arg(". Default: the robot that the log describes, else b21 if the log has 24 sonars")
    ] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    out: Path = Path("localised")
    """Folder to write into; not that of MAP."""
    seed: int = 0
    """The same seed gives the same poses."""

    def run(self) -> None:
        """Localise the log and write the folder."""
        from echogrid.output.map_file import run_yaml
        from echogrid.output.map_picture import draw_map
        from echogrid.output.trajectory import write_tum
        from echogrid.position.localise import localise

        check_seed(self.seed)
        start = self._start()
        grid = open_map(self.map)
        self._check_out()
        log, robot, named = open_log(self.log, self.robot, self.ros.choice())
        with made(self.out):
            for name in _FILES:
                check_writable(self.out / name)
            begin = time.perf_counter()
            heard = _Heard()
            found = localise(heard.of(log), grid, robot, start, self.seed)
            seconds = time.perf_counter() - begin
            heard.check(log, len(found.poses))
            text = run_yaml(self._settings(log, robot, found))
            title = escaped(f"{Path(log.name).name}, {robot.name}, in {self.map.name}")
            with (
                replacing(self.out / "run.yaml") as record,
                replacing(self.out / "map.png") as picture,
                replacing(self.out / "trajectory.tum") as poses,
            ):
                write_tum(poses, found.stamps, found.poses)
                draw_map(picture, grid, found.poses, title)
                record.write_text(text, encoding="utf-8")
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        print_notes(log)
        self._report(log, robot, found, seconds)

    def _start(self) -> Float[ndarray, "3"] | None:
        """Where the robot began, m, m, rad; None: anywhere."""
        if (self.start is None) != self.anywhere:
            found = "both" if self.anywhere else "neither"
            raise UsageError(f"--start, --anywhere: found {found}, expected one of the two")
        if self.start is None:
            return None
        return start_pose(self.start)

    def _check_out(self) -> None:
        """Make sure that the map's own files stay."""
        home = self.map if self.map.is_dir() else self.map.parent
        if os.path.realpath(self.out) == os.path.realpath(home):
            raise UsageError(f"--out: found {self.out}, the folder of the map, expected another one")

    def _settings(self, log: Log, robot: Robot, found: "Localised") -> dict[str, Any]:
        """What run.yaml holds: what is needed to repeat the run, and what happened."""
        settings = asdict(self) | {"log": log.name, "robot": robot_yaml(robot), "frames": len(found.poses)}
        events = [event._asdict() | {"place": found.poses[event.frame].round(4)} for event in found.events]
        settings |= {"frames_not_sure": int(np.sum(~found.sure)), "events": events}
        return settings | {"notes": log.notes | self._doubts(found)}

    def _doubts(self, found: "Localised") -> dict[str, int]:
        """Notes on ways where no robot can have been, and on a start where the map hardly explains what was heard."""
        from echogrid.position.localiser import FAIR

        if self.anywhere or not found.agreement < FAIR:
            return _off_floor(found)
        little = f"({found.agreement:.2f} of {FAIR:.2f})"
        what = f"what is heard agrees little with the map where the robot is laid {little}"
        return _off_floor(found) | {
            f"{what}: is the map of this place, whole, and with its furniture, is the start right?": 0
        }

    def _report(self, log: Log, robot: Robot, found: "Localised", seconds: float) -> None:
        for event in found.events:
            at = f"at {event.stamp:.2f} s, after {event.driven_m:.1f} m"
            x, y, theta = found.poses[event.frame]
            where = f": {x:.2f}, {y:.2f} m, {np.rad2deg(theta):.0f} degrees" if event.what == "sure" else ""
            print(f"note: {at}: {_SAID[event.what]}{where}", file=sys.stderr)
        unsure = int(np.sum(~found.sure))
        if not found.sure[-1]:
            print("note: at the end the robot can be at several places, or at none of the map", file=sys.stderr)
        for note in self._doubts(found):
            print(f"note: {note}", file=sys.stderr)
        if unsure:
            print(f"note: {unsure} of {len(found.sure)} poses are the likeliest of several", file=sys.stderr)
        what = f"{log.name}: {len(found.poses)} scans of {robot.name} in {seconds:.1f} s"
        print(escaped(f"{what}; poses in {self.out}/trajectory.tum, picture in {self.out}/map.png"))


def _off_floor(found: "Localised") -> dict[str, int]:
    """A note on ways where no robot can have been."""
    step = np.hypot(*np.diff(found.poses[:, :2], axis=0).T)
    way = float(np.sum(step[found.off_floor[1:]]))
    if way < _OFF_FLOOR_M:
        return {}
    first = int(np.argmax(found.off_floor))
    x, y, _ = found.poses[first]
    where = f"along {way:.1f} m, from {found.stamps[first]:.2f} s at {x:.2f}, {y:.2f} m on"
    return {
        f"{where}, the robot is where the map has walls or nothing: is the map of this place, is the start right?": 0
    }


class _Heard:
    """Whether the frames of a log, which pass, have any echo."""

    def __init__(self) -> None:
        self._echo = False

    def of(self, log: Log):
        for frame in shown(log, "localising"):
            self._echo = self._echo or bool(np.isfinite(frame.ranges).any())
            yield frame

    def check(self, log: Log, frames: int) -> None:
        """Raise an InputError where there is nothing to localise by."""
        if not frames:
            raise InputError(log.name, "no frames", "at least one")
        if not self._echo:
            raise InputError(log.name, "no echo of any sonar", "ranges in m to find the place by")
