"""The poses of a drive from its ranges and from odometry that drifts.

docs/position.md tells how it works and what it reaches.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.frame import Frame
from echogrid.geometry import compose, inverse
from echogrid.position.contradictions import Compared
from echogrid.position.drive import UNFAIR, Drive
from echogrid.position.graph import Edges
from echogrid.position.pieces import spread_over
from echogrid.robot import Robot

NEARLY, SHARPER, MOST_AGAIN = 0.8, 1.1, 2
"""A drive that may be wrong is placed once more with UNFAIR for loops that are looked for widely, and that is kept
whose places lie together best. Matches of a drive are made again if it lies together nearly as well as the other, and
those of the one that is kept as long as its places lie together so much better each time, so often at most."""


@dataclass(frozen=True)
class Found:
    """Where a robot was, as its ranges and its odometry say together."""

    poses: Float[ndarray, "frames 3"]
    """m, m, rad; the first is the log's own first pose."""
    odometry: Float[ndarray, "frames 3"]
    """The log's poses."""
    nodes: Int[ndarray, "nodes"]
    """Frames at which the graph has poses."""
    edges: Edges
    """What is known of the nodes as seen from others: odometry, matches and loops. Those from a node behind the last
    are headings by the direction of walls."""
    loops: list[tuple[int, int]]
    """Nodes between which a loop was closed."""
    drift: Float[ndarray, "3"]
    """What corrects the odometry: of its scale, of its heading (rad/m) and of its turning."""
    together: Compared
    """How what was seen round each node lies to what was seen at other times."""
    loose: Bool[ndarray, "nodes"]
    """Nodes that lie beside others and that nothing ties to them."""


def slam(frames: Iterable[Frame], robot: Robot, progress: Callable[[int, int], object] | None = None) -> Found:
    """Find the poses of a log whose poses are odometry that drifts.

    Args:
        frames: the log, at least one frame.
        robot: the robot that drove.
        progress: called now and then with the pieces of the drive that are placed, and those in all.
    """
    frames = list(frames)
    odometry = np.array([frame.pose for frame in frames], dtype=float)
    drive = _placed(Drive(frames, odometry, robot), progress)
    if drive.unsure(drive.reconcile()):
        drive = _sharper(drive, _placed(Drive(frames, odometry, robot, UNFAIR, drive), progress))
        drive.reconcile()
    drive.trust()
    poses = spread_over(drive.cut, drive.poses, drive.by_odometry)
    poses = compose(odometry[0], compose(inverse(poses[0]), poses))
    loops = [(edge.first, edge.second) for edge in drive.matches if edge.loop]
    together = drive.compared()
    nodes = np.array([piece.middle for piece in drive.cut])
    return Found(
        poses, odometry, nodes, drive.edges(drive.count), loops, drive.drift, together, drive.loose(together)
    )


def _placed(drive: Drive, progress: Callable[[int, int], object] | None) -> Drive:
    """A drive with all of its pieces placed."""
    for k in range(1, drive.count):
        drive.place(k)
        if progress:
            progress(k + 1, drive.count)
    return drive


def _sharper(*drives: Drive) -> Drive:
    """The drive whose places lie together best, its matches made again as long as that brings them nearer."""
    before = [drive.sharpness() for drive in drives]
    for drive, sharp in zip(drives, before, strict=True):
        if sharp > NEARLY * max(before):
            drive.again()
    now = [drive.sharpness() for drive in drives]
    best = int(np.argmax(now))
    drive, was, sharp = drives[best], before[best], now[best]
    for _ in range(MOST_AGAIN):
        if sharp < SHARPER * was:
            break
        drive.again()
        was, sharp = sharp, drive.sharpness()
    return drive
