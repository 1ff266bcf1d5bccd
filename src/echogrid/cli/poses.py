"""What ``map --slam`` does besides mapping: the poses found, under a bar, and their files."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.cli.arguments import shown, steps
from echogrid.errors import escaped
from echogrid.frame import Log
from echogrid.output.graph_file import write_g2o
from echogrid.output.trajectory import write_tum
from echogrid.robot import Robot

if TYPE_CHECKING:
    from echogrid.position.corrected import Corrected

TRAJECTORIES = ("trajectory.tum", "odometry.tum")
POSE_FILES = (*TRAJECTORIES, "graph.g2o")


def corrected(log: Log, robot: Robot) -> "Corrected":
    """The log with the poses that are found, under progress bars; with a note if mounts or clocks are wrong."""
    from echogrid.position.corrected import slam

    read = replace(log, open=lambda: shown(log, "reading"), judges=True)
    with steps("finding poses", "node") as progress:
        drive = slam(read, robot, progress)
    if drive.found is not None:
        drive.log.notes.update(_mistake(drive, robot))
    return drive


def _mistake(drive: "Corrected", robot: Robot) -> dict[str, int]:
    """A note, if walls are sharper beyond doubt with mounts, or clocks, other than given: no poses mend that."""
    from echogrid.calibration.readings import gather
    from echogrid.calibration.variants import AS_GIVEN, ranked, taken

    frames = (replace(frame, pose=frame.odom) for frame in drive.log if frame.odom is not None)
    name = taken(ranked(gather(frames, robot, drive.log.name), robot, hasty=True)).variant.name
    if name == AS_GIVEN:
        return {}
    return {f"{name}? walls are sharper so; `echogrid doctor` says how much": 0}


def pose_files(drive: "Corrected") -> list[str]:
    """Those of POSE_FILES that there are; where nothing was to be found there is no graph."""
    return list(POSE_FILES if drive.found is not None else TRAJECTORIES)


def write_trajectories(
    folder: Path, stamps: Float[ndarray, "n"], poses: Float[ndarray, "n 3"], odometry: Float[ndarray, "n 3"]
) -> None:
    """Write TRAJECTORIES: stamps in s, poses as found and by odometry, m, m, rad."""
    for name, each in zip(TRAJECTORIES, (poses, odometry), strict=True):
        write_tum(folder / name, stamps, each)


def write_poses(folder: Path, drive: "Corrected") -> None:
    """Write the files of poses."""
    write_trajectories(folder, drive.stamps, drive.poses, drive.odometry)
    if (found := drive.found) is not None:
        edges = found.edges
        nodes = drive.poses[found.nodes]
        write_g2o(folder / "graph.g2o", nodes, edges.first, edges.second, edges.measured, edges.information)


def pose_settings(drive: "Corrected") -> dict[str, Any]:
    """What run.yaml says of them: loops, and by what the odometry is to be multiplied or turned to be right."""
    if drive.found is None:
        return {"loops": 0, "odometry": None}
    way, bias, turn = drive.found.drift.tolist()
    right = {"way_times": 1 + way, "turns_times": 1 + turn, "heading_deg_m": np.rad2deg(bias).item()}
    return {"loops": len(drive.loops), "odometry": {name: round(value, 5) for name, value in right.items()}}


def report(folder: Path, drive: "Corrected") -> None:
    """Say what was found."""
    if drive.found is None:
        return  # a note says so
    far, turned = drive.farthest
    off = f"the odometry is up to {far:.2f} m and {np.rad2deg(turned):.1f} degrees from them"
    count = len(drive.loops)
    loops = f"{count or 'no'} {'loop' if count == 1 else 'loops'}"
    print(escaped(f"{folder}/trajectory.tum: the poses, with {loops} closed; {off}"))
