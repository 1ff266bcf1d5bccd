"""Exports for microcontrollers, compiled for this machine, and the mapper that they are compared with."""

import ctypes
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from commands import SOURCE
from echogrid.frame import Frame
from echogrid.mapping.mapper import Mapper
from echogrid.microcontroller.constants import POLAR_SCALE
from echogrid.microcontroller.source import Source, write
from echogrid.models.networks.set_core import BEARINGS, RINGS
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import TRANSDUCERS, Robot

WARNINGS = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion", "-Werror"]
UNKNOWN, PER_LOG_ODDS = -128, 16

SIZES = """\
#include "echogrid.h"
#include <stddef.h>
extern const unsigned long size, polar_at, reach_at;
const unsigned long size = sizeof(struct echogrid);
const unsigned long polar_at = offsetof(struct echogrid, polar), reach_at = offsetof(struct echogrid, reach);
"""


@cache
def network():
    """The network that ships, without surroundings."""
    weights = SetNetwork.load(SOURCE / "echogrid" / "weights" / "set.npz")
    return replace(weights, around=None)


def told(found):
    """A command that must succeed; what it wrote."""
    done = subprocess.run(found, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(map(str, found))}\n{done.stdout}{done.stderr}"
    return done.stdout


class Window:
    """An export at work on a drive, called as C."""

    def __init__(self, folder: Path, source: Source, *flags: str):
        write(folder, source)
        (folder / "sizes.c").write_text(SIZES, encoding="ascii")
        library = folder / "echogrid.so"
        files = [folder / "echogrid.c", folder / "sizes.c"]
        told([shutil.which("gcc"), *WARNINGS, *(flags or ["-O2"]), "-shared", "-fPIC", *files, "-o", library])
        self.c, self.side, self.cell_m = ctypes.CDLL(str(library)), source.side, source.cell_m
        self.c.echogrid_cell.restype = ctypes.c_int8
        self.size = self._constant("size")
        self.state = (ctypes.c_uint32 * (self.size // 4 + 1))(*[0xA5A5A5A5] * (self.size // 4 + 1))
        self.start()

    def _constant(self, name):
        return ctypes.c_ulong.in_dll(self.c, name).value

    def start(self):
        self.c.echogrid_start(self.state)

    def scan(self, frame: Frame) -> int:
        ranges = (ctypes.c_float * len(frame.ranges))(*frame.ranges.tolist())
        x, y, theta = (ctypes.c_float(value) for value in frame.pose.tolist())
        return self.c.echogrid_scan(
            self.state, ranges, x, y, theta, ctypes.c_uint32(round(1000 * frame.stamp) % 2**32)
        )

    def corner(self):
        x, y = ctypes.c_float(), ctypes.c_float()
        self.c.echogrid_corner(self.state, ctypes.byref(x), ctypes.byref(y))
        return x.value, y.value

    def read(self):
        cells = np.zeros((self.side, self.side), np.int8)
        self.c.echogrid_read(self.state, cells.ctypes.data_as(ctypes.c_void_p))
        return cells

    def local_map(self):
        """Of the last scan, as the core has it: log-odds at bearings and rings, and how far each bearing tells, m."""
        state = bytes(self.state)
        polar = np.frombuffer(state, np.int16, BEARINGS * RINGS, self._constant("polar_at"))
        return polar.reshape(BEARINGS, RINGS) / POLAR_SCALE, np.frombuffer(
            state, np.float32, BEARINGS, self._constant("reach_at")
        )


def packed(frames):
    """Scans as ``drive.c`` takes them."""
    rows = [
        np.concatenate([frame.ranges, frame.pose]).astype("<f4").tobytes()
        + np.uint32(round(1000 * frame.stamp) % 2**32).tobytes()
        for frame in frames
    ]
    return b"".join(rows)


class Oracle:
    """The mapper, alone with each cell, in cells of another side than its own."""

    def __init__(self, robot: Robot, cell_m: float, network: SetNetwork):
        kind = type("Coarse", (SetNetwork,), {"cell_m": cell_m})
        self.mapper = Mapper(robot, kind(network.weights, None, network.recipe))
        self.cell_m = cell_m

    def scan(self, frame: Frame):
        self.mapper.add([frame])

    def window(self, corner, side):
        """Log-odds and whether anything is known, of the square of cells from a corner (m) on."""
        first = np.rint(np.array(corner[::-1]) / self.cell_m).astype(int)
        grid = self.mapper.grid()
        part = grid.part(first - np.rint(np.array(grid.origin[::-1]) / self.cell_m).astype(int), (side, side))
        return part.log_odds, part.observed


def random_array(rng, sonars=None, reach=None, any_way=False):
    """A robot of 4 to 24 sonars; reach: of the sonars (m), the same for all; any_way: some look across the robot."""
    n = int(sonars or rng.integers(4, 25))
    radius = rng.uniform(0.05, 0.35)
    around = rng.uniform(-np.pi, np.pi, n) if rng.random() < 0.5 else 0.3 + np.arange(n) * 2 * np.pi / n
    off = around + rng.normal(0, 0.3, n) * (rng.random() < 0.5)
    off = rng.uniform(-np.pi, np.pi, n) if any_way else off
    mounts = np.column_stack([radius * np.cos(around), radius * np.sin(around), off])
    own = rng.uniform(1.0, 5.0, n) if reach is None and rng.random() < 0.5 else None
    reach = float(np.max(own)) if own is not None else reach or float(rng.uniform(1.5, 6.0))
    beam = np.deg2rad(rng.uniform(8, 60))
    return Robot("random", radius * rng.uniform(0, 1.2), TRANSDUCERS["polaroid-600"], 0.1, reach, beam, mounts, own)


def in_a_room(rng, robot, poses, half=(2.0, 1.6), in_turn=False, silent=0.0):
    """Frames as in a rectangular room: ranges to its walls, some without echo, some of any length.

    in_turn: sonars fire one half after the other; silent: share of readings that are missing besides.
    """
    half = np.array(half)
    for k, pose in enumerate(poses):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        p = pose[:2] + robot.mounts[:, :2] @ np.array([[c, s], [-s, c]])
        axis = pose[2] + robot.mounts[:, 2]
        d = np.stack([np.cos(axis), np.sin(axis)], axis=1)
        with np.errstate(divide="ignore"):
            ranges = np.min((np.sign(d) * half - p) / d, axis=1) + rng.normal(0, 0.01, len(d))
        odd = rng.random(len(d))
        ranges = np.where(odd < 0.15, np.inf, np.where(odd < 0.25, rng.uniform(0.3, 6, len(d)), ranges))
        ranges = np.where((odd > 1 - silent) | (in_turn & (np.arange(len(d)) % 2 != k % 2)), np.nan, ranges)
        yield Frame(0.1 * k, pose, np.maximum(ranges, 0.0))


def walk(rng, scans, step=0.05, box=1.0):
    """Poses that wander, within a box round the origin."""
    pose, poses = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]), []
    for _ in range(scans):
        pose = pose + np.array([step * np.cos(pose[2]), step * np.sin(pose[2]), rng.normal(0, 0.06)])
        if np.max(np.abs(pose[:2])) > box:
            pose[2] = np.arctan2(-pose[1], -pose[0])
        poses.append(pose.copy())
    return np.array(poses)
