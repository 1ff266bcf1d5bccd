"""A map and its drive as one web page to explore: a file that asks nothing of any network.

The page is ``data/page.html``, in which the places ``{{...}}`` are filled. Numbers travel as integers, deflated and
in base64; what each array means is said where it is packed.
"""

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Integer, UInt8
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.files import replacing
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.grid import P_MAX, P_MIN, Grid, span
from echogrid.output.follower import SILENT_M
from echogrid.output.recording import KeptMap, Recording
from echogrid.robot import Robot

MAX_IMAGE_CELLS, MAX_IMAGE_SIDE = 4096 * 4096, 8192
"""The largest image that all browsers draw; of a larger map the page shows blocks of cells."""

MAX_CHANGES = 64_000_000
"""Cells in all the differences between maps together: what a browser has to unpack."""

TOLERANCE = 3
"""A cell of a map on the way is brought up to date when its code is off by more than this (p by 0.01)."""

NOT_FIRED, NO_ECHO = 65535, 65534
"""Codes of a range; all others count ``units.range`` metres."""

_ANGLE_UNIT = 1e-4


Loops = Sequence[tuple[int, int]]
"""Pairs of frames at which the robot was in one place."""

MAX_LOOPS = 2000
"""Of more the page shows every so many-th."""


class Page(Recording):
    """A recording that becomes a page when the map is finished."""

    def __init__(self, path: Path, robot: Robot, title: str, loops: Loops | None = None):
        super().__init__(robot)
        self.path, self.title, self.loops = path, title, loops

    def finish(self, grid: Grid) -> None:
        """Write the page, see ``write_page``."""
        write_page(self.path, grid, self, self.title, self.loops)


def write_page(path: str | Path, grid: Grid, recording: Recording, title: str, loops: Loops | None = None) -> None:
    """Write the page, whole or not at all.

    Args:
        path: the file (HTML); one that is there is replaced.
        grid: the finished map.
        recording: the drive, and the map on the way.
        title: heading of the page, any text.
        loops: where poses were corrected, the frames between which loops were closed, from 0; the page then shows
            ``Frame.odom`` as the drive of the odometry.

    Raises:
        UsageError: nothing was recorded, the map has no cells or other ones than those on the way, or the file
            cannot be written.
    """
    frames = recording.frames()
    if not frames or not grid.log_odds.size:
        raise UsageError("page: found no frames or no cells, expected at least one frame with a reading")
    facts: dict[str, Any] = {"scans": recording.scans, "stride": recording.stride, "p_min": P_MIN, "p_max": P_MAX}
    arrays: dict[str, ndarray] = {}
    corrected = ({}, {}) if loops is None else _correction(frames, loops)
    for more_facts, more_arrays in (_drive(frames, recording.robot), _maps(grid, recording), corrected):
        facts |= more_facts
        arrays |= more_arrays
    facts["box"] = _box(facts, frames, corrected=loops is not None)
    text = _filled(facts, arrays, title)
    with replacing(path) as new:
        # A name may hold bytes that are no text, which UTF-8 cannot carry.
        new.write_bytes(text.encode("utf-8", "replace"))


def _drive(frames: list[tuple[int, Frame]], robot: Robot) -> tuple[dict[str, Any], dict[str, ndarray]]:
    """Where the robot was and what it heard.

    Columns of differences from scan to scan, so that they deflate well: ``number`` in the log, ``time`` since the
    first scan, ``x``, ``y`` from ``first``, ``theta``; [scan, sonar] ``ranges`` in their unit, and
    ``mounts`` (mm, mm, angle) where a frame has its own.
    """
    poses = np.array([frame.pose for _, frame in frames], dtype=float)
    times = np.array([frame.stamp for _, frame in frames], dtype=float)
    ranges = np.array([frame.ranges for _, frame in frames], dtype=float)
    first = np.round(poses[0, :2], 3)
    places, since = poses[:, :2] - first, times - times[0]
    farthest = np.max(ranges, where=np.isfinite(ranges), initial=0.0)
    units = {
        "place": _unit(places, 1e-4),
        "time": _unit(since, 1e-3),
        "angle": _ANGLE_UNIT,
        "range": 0.001 if farthest < 0.001 * NO_ECHO - 0.001 else 0.002,
    }
    codes = np.where(np.isnan(ranges), NOT_FIRED, NO_ECHO).astype(np.uint16)
    heard = np.isfinite(ranges)
    codes[heard] = np.rint(ranges[heard] / units["range"])
    arrays = {
        "number": _differences(np.array([number for number, _ in frames]), 1),
        "time": _differences(since, units["time"]),
        "x": _differences(places[:, 0], units["place"]),
        "y": _differences(places[:, 1], units["place"]),
        "theta": _differences(wrap(poses[:, 2]), units["angle"]),
        "ranges": codes,
    }
    if any(frame.mounts is not None for _, frame in frames):
        mounts = np.array([robot.mounts if frame.mounts is None else frame.mounts for _, frame in frames])
        arrays["mounts"] = np.rint(_turned(mounts) / [0.001, 0.001, _ANGLE_UNIT]).astype(np.int16)
    shown = {
        "name": robot.name,
        "footprint": robot.footprint_radius_m,
        "beam": robot.beam_width_rad,
        "max_range": robot.max_range_m,
        "silent": min(SILENT_M, robot.max_range_m),
        "mounts": robot.mounts.tolist(),
    }
    return {"first": first.tolist(), "units": units, "robot": shown}, arrays


def _correction(frames: list[tuple[int, Frame]], loops: Loops) -> tuple[dict[str, Any], dict[str, ndarray]]:
    """The drive as the odometry had it, and where loops were closed.

    Columns of differences as of ``_drive``: ``told_x``, ``told_y`` from ``told`` in their unit; ``loops``: pairs of
    scans of the page, those kept that are nearest.
    """
    told = np.array([frame.pose if frame.odom is None else frame.odom for _, frame in frames])[:, :2]
    first = np.round(told[0], 3)
    unit = _unit(told - first, 1e-4)
    arrays: dict[str, ndarray] = {
        f"told_{axis}": _differences(told[:, i] - first[i], unit) for i, axis in enumerate("xy")
    }
    numbers = np.array([number for number, _ in frames])
    pairs = np.array(loops, dtype=int).reshape(-1, 2)[:: -(-len(loops) // MAX_LOOPS) or 1] + 1
    after = np.clip(np.searchsorted(numbers, pairs), 1, max(len(numbers) - 1, 1)).clip(max=len(numbers) - 1)
    nearer = np.where(pairs - numbers[after - 1] <= numbers[after] - pairs, after - 1, after)
    return {"told": {"first": first.tolist(), "unit": unit}, "loops": nearer.tolist(), "closed": len(loops)}, arrays


def _turned(mounts: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    return np.concatenate([mounts[..., :2], wrap(mounts[..., 2:])], axis=-1)


def _unit(values: Float[ndarray, "*n"], finest: float) -> float:
    """A unit in which the values, as far as they reach, are numbers of 32 bits."""
    return max(finest, float(np.max(np.abs(values))) / 2**29)


def _differences(values: Float[ndarray, "n"] | Integer[ndarray, "n"], unit: float) -> Int[ndarray, "n"]:
    return np.diff(np.rint(values / unit).astype(np.int64), prepend=0).astype(np.int32)


def _box(facts: dict[str, Any], frames: list[tuple[int, Frame]], corrected: bool) -> list[float]:
    """Lowest x, y and highest x, y of the map and the robot's places, those of the odometry too, m, world."""
    poses = [frame.pose for _, frame in frames]
    if corrected:
        poses += [frame.odom for _, frame in frames if frame.odom is not None]
    places = np.array(poses)[:, :2]
    cell, reach = facts["resolution"], facts["robot"]["footprint"]
    low = np.array(facts["origin"])
    high = low + np.array([facts["cols"], facts["rows"]]) * cell
    low, high = np.minimum(low, places.min(axis=0) - reach), np.maximum(high, places.max(axis=0) + reach)
    return [*low.tolist(), *high.tolist()]


@dataclass(frozen=True)
class _Lattice:
    """The cells of the page: blocks of cells of the map."""

    first: Int[ndarray, "2"]
    """Cell [row, col] of the map at which the first block begins."""
    shape: tuple[int, int]
    """Rows and columns of blocks."""
    block: int
    """Cells of the map to a side of a block."""

    @staticmethod
    def holding(low: Int[ndarray, "2"], high: Int[ndarray, "2"]) -> "_Lattice":
        """The finest that holds ``low <= [row, col] < high`` and makes an image that browsers draw."""
        rows, cols = (int(n) for n in high - low)
        block = 1
        while (-(-rows // block)) * (-(-cols // block)) > MAX_IMAGE_CELLS or max(rows, cols) > block * MAX_IMAGE_SIDE:
            block += 1
        return _Lattice(low, (-(-rows // block), -(-cols // block)), block)

    def largest(self, values: Integer[ndarray, "rows cols"], at: Int[ndarray, "2"]) -> Integer[ndarray, "_ _"]:
        """The largest value in each block of an array that begins at a cell [row, col] of the map, 0 outside it.

        What is not observed has the lowest code, so a block is as occupied as the most occupied of its cells.
        """
        rows, cols = self.shape
        whole = np.zeros((rows * self.block, cols * self.block), dtype=values.dtype)
        row, col = at - self.first
        whole[row : row + values.shape[0], col : col + values.shape[1]] = values
        if self.block == 1:
            return whole
        return whole.reshape(rows, self.block, cols, self.block).max(axis=(1, 3))


def _maps(grid: Grid, recording: Recording) -> tuple[dict[str, Any], dict[str, ndarray]]:
    """The map at each kept time and at the end, as differences from one to the next, and the finished map's views.

    ``steps``: for each of the facts' steps its rectangle of differences of codes, modulo 256, one after the other;
    the first from a map that is not observed. ``views``: differences along each row, modulo the type.
    """
    if any(kept.resolution != grid.resolution for kept in recording.maps()):
        raise UsageError(f"page: found maps of other cells than {grid.resolution:g} m, expected one size of cells")
    final = grid.observed_part() or Grid(grid.log_odds[:1, :1], grid.observed[:1, :1], grid.resolution, grid.origin)
    kept = [*recording.maps(), KeptMap.of(final, recording.scans, recording.scans)]
    corners = [_cell_at(grid, part.origin) for part in kept]
    ends = [corner + part.shape for corner, part in zip(corners, kept, strict=True)]
    lattice = _Lattice.holding(np.min(corners, axis=0), np.max(ends, axis=0))
    steps, changes = _chain(list(zip(corners, kept, strict=True)), lattice)
    x, y = (lattice.first[::-1] * grid.resolution + grid.origin).tolist()
    facts = {
        "rows": lattice.shape[0],
        "cols": lattice.shape[1],
        "resolution": grid.resolution * lattice.block,
        "block": lattice.block,
        "origin": [x, y],
        "size": [final.shape[1] * grid.resolution, final.shape[0] * grid.resolution],
        "steps": steps,
    }
    arrays: dict[str, ndarray] = {"steps": changes}
    if final.views is not None:
        views = lattice.largest(final.views, corners[-1])
        views = views.astype(np.min_scalar_type(int(views.max())))
        arrays["views"] = np.diff(views, axis=1, prepend=views.dtype.type(0))
    return facts, arrays


def _cell_at(grid: Grid, origin: tuple[float, float]) -> Int[ndarray, "2"]:
    """Cell [row, col] of a grid, maybe outside it, whose lower left corner is a point of the world (m)."""
    return np.rint((np.array(origin[::-1]) - grid.origin[::-1]) / grid.resolution).astype(np.int64)


def _chain(
    kept: list[tuple[Int[ndarray, "2"], KeptMap]], lattice: _Lattice
) -> tuple[list[dict[str, int]], UInt8[ndarray, "_"]]:
    """Steps and differences of maps, each with the cell [row, col] at which it begins; see ``_maps``."""
    shown = np.zeros(lattice.shape, dtype=np.uint8)
    steps, changes, total = [], [], 0
    for corner, part in kept:
        codes = lattice.largest(part.codes(), corner)
        changed = codes != shown
        if part is not kept[-1][1]:
            # A step says nothing of what hardly changed; the next one sees what the page shows, so nothing adds up.
            far = np.abs(codes.astype(np.int16) - shown) > TOLERANCE
            changed &= far | (codes == 0) | (shown == 0)
        rows, cols = span(changed.any(axis=1)), span(changed.any(axis=0))
        change = np.where(changed, codes - shown, np.uint8(0))[rows, cols]
        shown[rows, cols] += change
        steps.append({"scans": part.scans, "row": rows.start, "col": cols.start})
        steps[-1] |= {"rows": change.shape[0], "cols": change.shape[1]}
        changes.append(change.ravel())
        total += change.size
        if total > MAX_CHANGES and len(kept) > 2:
            return _chain([*kept[:-1][1::2], kept[-1]], lattice)
    return steps, np.concatenate(changes)


def _filled(facts: dict[str, Any], arrays: dict[str, ndarray], title: str) -> str:
    """The page with all its places filled."""
    placed, packed = {}, bytearray()
    for name, array in arrays.items():
        placed[name] = [array.dtype.str[1:], len(packed), array.size]
        packed += np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
    told = base64.b64encode(zlib.compress(packed, 9)).decode()
    return filled_page("page.html", facts | {"arrays": placed}, title, packed=told)


def filled_page(name: str, facts: dict[str, Any], title: str, images: str = "data:", **others: str) -> str:
    """A template of a page with all its places filled, each by text that cannot end the place it stands in.

    Args:
        name: of the template among the data of the package.
        facts: what its script is to know, as JSON has it.
        title: any text.
        images: where the browser may take images from.
        others: of further places, taken as they are.
    """
    template = (resources.files("echogrid") / "data" / name).read_text(encoding="utf-8")
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False)
    places = others | {
        "policy": _policy(template, images),
        "title": html.escape(title),
        "facts": text.replace("<", "\\u003c").replace(">", "\\u003e"),
    }
    # In one pass, so that nothing is filled into what was filled in.
    return re.sub(r"\{\{(\w+)\}\}", lambda place: places[place[1]], template)


def _policy(template: str, images: str) -> str:
    """What the browser may do: run the page's own script and style, known by their hashes, and connect to nothing."""
    hashes = {}
    for kind in ("script", "style"):
        (content,) = re.findall(rf"<{kind}>(.*?)</{kind}>", template, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        hashes[kind] = f"{kind}-src 'sha256-{digest}'"
    return f"default-src 'none'; {'; '.join(hashes.values())}; img-src {images}; base-uri 'none'; form-action 'none'"
