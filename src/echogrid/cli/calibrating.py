"""Commands that judge a log and the robot that drove: calibrate, doctor."""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.cli.arguments import Ros, open_log, print_notes, robot_arg, shown
from echogrid.cli.poses import corrected, pose_settings
from echogrid.doubts import NEVER_HEAR, NO_ECHO_IS_LONGEST, POSES_MISREAD, RANGES_MISREAD, first_of
from echogrid.errors import InputError, escaped
from echogrid.files import made
from echogrid.frame import Frame, Log
from echogrid.geometry import wrap
from echogrid.logs.contents import LogInfo, describe
from echogrid.robot import Robot

if TYPE_CHECKING:
    from echogrid.calibration.calibrate import Calibration
    from echogrid.position.corrected import Corrected


def _frames(log: Log) -> list[Frame]:
    """All frames of a log, which are needed again and again; its notes are told when all were read."""
    frames = list(shown(log, "reading"))
    if not frames:
        raise InputError(log.name, "no frames", "at least one")
    return frames


@dataclass(frozen=True)
class Calibrate:
    """Say what a log tells of the robot that drove: mounts, beam, range scale, and what is amiss with its sonars.

    Writes robot.yaml (a robot file for --robot, with the mounts and the beam that were found), calibration.csv (a
    row a sonar, with intervals of 95 %) and calibration.png (what they are told by). The poses of the log are trusted
    over some metres; the robot is to be known to some centimetres and degrees, or wrong in a plausible way: mirrored,
    turned, numbered the other way round or from another sonar on.
    """

    log: Annotated[Positional[str], arg(metavar="LOG")]
    """CSV or CARMEN log, or a bag of ROS 1 or ROS 2."""
    robot: Annotated[
        str | None, robot_arg(". Default: the robot that the log describes, else b21 if the log has 24 sonars")
    ] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)
    slam: bool = False
    """The poses of the log are odometry: find the true ones first, and say how the odometry is off."""
    out: Path = Path("calibrated")
    """Folder to write into."""

    def run(self) -> None:
        """Look at the log and write the folder."""
        from echogrid.calibration.calibrate import calibrate
        from echogrid.output.calibration_files import check_calibration_folder, write_calibration

        log, robot, named = open_log(self.log, self.robot, self.ros.choice(odometry=self.slam))
        with made(self.out):  # a folder that cannot be made is found now, not after the work
            check_calibration_folder(self.out)
            drive = corrected(log, robot) if self.slam else None
            frames = _frames(drive.log if drive else log)
            _check_read(log, poses=drive is None)
            found = calibrate(Log.of(frames, log.name), robot)
            write_calibration(self.out, found, escaped(f"{Path(log.name).name}, {robot.name}"))
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        print_notes(drive.log if drive else log)
        _print_table(found)
        _print_findings(found, drive)
        files = f"{self.out}/robot.yaml for --robot, {self.out}/calibration.png"
        print(escaped(f"{log.name}: {len(frames)} scans of {robot.name}; {files}"))


def _check_read(log: Log, poses: bool) -> None:
    """Refuse a log whose numbers are not what it says, once it was read."""
    bad = RANGES_MISREAD + (POSES_MISREAD if poses else ())
    if doubt := first_of(log.notes, bad):
        raise InputError(log.name, doubt, "a log in m, s and radians: of another nothing can be told")


def _print_table(found: "Calibration") -> None:
    from echogrid.calibration.calibrate import SURE
    from echogrid.output.calibration_files import state

    print("sonar       x, m           y, m        axis, degrees    turned   echoes  state")
    there = found.given.mounts + found.moved
    there[:, 2] = wrap(there[:, 2])
    sd = SURE * found.moved_sd
    for i in range(found.robot.sonars):
        (x, y, axis), (dx, dy, turn) = there[i], sd[i]
        place = f"{x:7.3f} +-{dx:.3f} {y:7.3f} +-{dy:.3f}"
        turned = f"{np.rad2deg(axis):7.1f} +-{np.rad2deg(turn):4.1f}   {np.rad2deg(found.moved[i, 2]):6.1f}"
        print(f"r{i:<4} {place} {turned}  {found.health.echoes[i]:6.0%}  {state(found, i)}")


def _print_findings(found: "Calibration", drive: "Corrected | None") -> None:
    from echogrid.calibration import findings
    from echogrid.calibration.calibrate import SURE

    beams, places = found.beams, found.places
    width, off = np.rad2deg(2 * beams.half), SURE * np.rad2deg(2 * beams.half_sd)
    print(f"beam          {width:.1f} +-{off:.1f} degrees, edge soft by {np.rad2deg(beams.soft):.1f}")
    print(f"range scale   {places.scale:.4f} +-{SURE * found.scale_sd:.4f}, read of a metre of the poses")
    print(f"walls         {found.share:.0%} of the echoes touch {len(places.walls.place)} walls and corners", end="")
    print(f", {places.miss_m:.3f} m off them")
    if drive is not None and (odometry := pose_settings(drive)["odometry"]):
        said = f"way x {odometry['way_times']:.4f}, turns x {odometry['turns_times']:.4f}"
        print(f"odometry      right if {said}, heading + {odometry['heading_deg_m']:.2f} degrees a metre")
    lines = [*findings.of_order(found.ranks), *findings.of_swaps(found)]
    for line in (*lines, *findings.of_health(found.health), *findings.of_ranges(found)):
        print(f"found: {escaped(line)}")
    for line in findings.untold(found):
        print(f"cannot be told: {line}")
    if drive is None:
        print("cannot be told: the scale and heading bias of the odometry: --slam tells, where poses are odometry")


@dataclass(frozen=True)
class Doctor:
    """Say what is wrong with a log that maps badly: the first command to try.

    Looks at units, limits, clocks, jumps, single sonars, how much of the drive can be mapped, and whether walls
    become sharper if the mounts are mirrored, turned or in another order. A line for each finding: what, where, how
    much, and what to do. Exit status 0 whether or not something was found; 2 if the log cannot be read, and why.
    """

    log: Annotated[Positional[str], arg(metavar="LOG")]
    """CSV or CARMEN log, or a bag of ROS 1 or ROS 2."""
    robot: Annotated[
        str | None, robot_arg(". Default: the robot that the log describes, else b21 if the log has 24 sonars")
    ] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)

    def run(self) -> None:
        """Print the findings."""
        log, robot, named = open_log(self.log, self.robot, self.ros.choice())
        frames = _frames(log)
        # Which sonars are dead is told below, of each; variants are tried without them.
        told = {what: count for what, count in log.notes.items() if NEVER_HEAR not in what}
        notes = [what + (f" ({count} times)" if count else "") for what, count in told.items()]
        info = describe(Log.of(frames, log.name))
        found = [*notes, *_of_contents(info, robot), *_of_walls(frames, robot, notes)]
        if not named:
            print(f"robot: {robot.name}, as none was named", file=sys.stderr)
        for line in found:
            print(escaped(f"found: {line}"))
        what = f"{len(found)} finding{'s' if len(found) > 1 else ''}" if found else "nothing amiss found"
        print(escaped(f"{log.name}: {what} in {info.frames} scans of {robot.name} over {info.length_m:.1f} m"))


_STOOD_M, _SHORT_M, _DEAF, _FAR = 0.3, 3.0, 0.9, 0.9


def _of_contents(info: LogInfo, robot: Robot) -> list[str]:
    """Whether there is enough to map by: the way driven, and echoes."""
    x0, y0, x1, y1 = info.box_m
    out, across = [], float(np.hypot(x1 - x0, y1 - y0))
    if across < _STOOD_M:
        what = f"the robot stays within {across:.2f} m"
        out.append(f"{what}: a map needs a drive; are the poses those of this robot, and in m?")
    elif info.length_m < _SHORT_M:
        out.append(f"a drive of {info.length_m:.1f} m only: what is behind a corner stays unknown; drive on")
    if info.no_echo > _DEAF and not np.isnan(info.median_m):
        what = f"{info.no_echo:.0%} of the readings are no echo, with max_range {robot.max_range_m:g} m"
        out.append(f"{what}: walls are out of reach or mirror the sound; drive nearer to them, or mend max_range")
    if info.not_fired > _FAR:
        what = f"{info.not_fired:.0%} of the readings are not fired or not valid"
        out.append(f"{what}: is min_range right, do the sonars run?")
    return out


def _of_walls(frames: list[Frame], robot: Robot, notes: list[str]) -> list[str]:
    """Single sonars, and the order and mounts of all; these only where nothing worse was noted."""
    from echogrid.calibration import findings
    from echogrid.calibration.health import examine
    from echogrid.calibration.readings import gather
    from echogrid.calibration.variants import ranked

    if not any(np.isfinite(frame.ranges).any() for frame in frames):
        return []  # a note says so
    readings = gather(frames, robot)
    if first_of(notes, [NO_ECHO_IS_LONGEST]):  # one cause, one line: what sonars say then is no echo
        longest = np.max(readings.ranges, where=np.isfinite(readings.ranges), initial=0.0)
        readings = replace(readings, ranges=np.where(readings.ranges >= longest, np.inf, readings.ranges))
    health = examine(readings)
    out = list(findings.of_health(health))
    if notes:
        return out
    ranks = ranked(readings.without(health.useless), robot)
    return [*out, *findings.of_order(ranks)]
