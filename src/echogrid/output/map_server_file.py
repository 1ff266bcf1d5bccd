"""The map_server pair of ROS: map.yaml and its PGM, in the modes trinary, scale and raw, and OccupancyGrid's data."""

import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from jaxtyping import Float, Int8, Integer, UInt8
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.files import read_bytes
from echogrid.grid import FREE_THRESH, MAX_FILE_BYTES, OCCUPIED_THRESH, P_MAX, P_MIN, Grid, logit
from echogrid.yaml_keys import Keys, as_number, parse_yaml

YAML_FREE_THRESH = 0.196
"""``free_thresh`` of a trinary map.yaml. It divides *pixels*, not cells: the grey of an unknown cell, 205,
reads as (255 - 205)/255 = 0.1961, so 0.25 here would make every reader take the unknown for free. ROS 1
always wrote 0.196, and Nav2 does since its pull request 5278 (2025)."""

PIXEL_OCCUPIED, PIXEL_UNKNOWN, PIXEL_FREE = 0, 205, 254
"""Grey values of map_saver."""

PgmMode = Literal["trinary", "scale", "raw"]
"""How map_server is to take the pixels of map.pgm."""

_YAML_THRESH: dict[PgmMode, tuple[float, float]] = {
    "trinary": (OCCUPIED_THRESH, YAML_FREE_THRESH),
    "scale": (1.0, 0.0),
    "raw": (OCCUPIED_THRESH, FREE_THRESH),
}
"""``occupied_thresh`` and ``free_thresh`` of map.yaml. In mode scale a reader stretches what lies between them over
0 to 100, and with these it leaves the probability as it is; in mode raw it looks at neither."""

_PERCENT_FREE, _PERCENT_BETWEEN, _PERCENT_OCCUPIED = (0, 24), (26, 65), (67, 100)
"""Percent by which modes scale and raw show a cell of each class. A reader that finds 66 or more occupied and 24 or
less free finds the same classes as in mode trinary, and so it does by ROS 1, which rounds down in mode scale."""

_PERCENT_UNKNOWN = 255
"""The pixel of an unknown cell in mode raw."""

LEAST_UNKNOWN = 0.01
"""Less of a map in the grey of the unknown is no sign of who wrote it."""

RESOLUTIONS_M, COORDINATES_M = (1e-4, 1e3), (-1e9, 1e9)
"""What the numbers of a map can be."""


def occupancy(grid: Grid) -> Int8[ndarray, "rows cols"]:
    """The map as the data of ROS's ``nav_msgs/OccupancyGrid``: 100 occupied, 0 free, -1 unknown; row 0 lowest y.

    Occupied where observed and p > OCCUPIED_THRESH, free where observed and p < FREE_THRESH, else unknown: the
    same three classes as map.pgm. Not the probabilities in percent, though the message could hold them: Nav2's
    static layer and ROS 1's costmap_2d read a map as trinary unless told otherwise, and then take every value
    below ``lethal_cost_threshold`` (100) that is not unknown for free, a wall of 0.9 as well.
    """
    p = grid.probability()
    data = np.full(grid.shape, -1, dtype=np.int8)
    data[grid.observed & (p > OCCUPIED_THRESH)] = 100
    data[grid.observed & (p < FREE_THRESH)] = 0
    return data


def read_map_server(path: Path) -> tuple[Grid, str]:
    """A map.yaml and the PGM that it names, by the rules of Nav2's map_io.cpp; and what is doubtful there, or ""."""
    raw = read_bytes(path, "a map_server file (YAML)", 1_000_000)
    try:
        keys = Keys(str(path), parse_yaml(raw.decode("utf-8"), str(path)))
    except UnicodeDecodeError:
        raise InputError(path, "bytes that are not UTF-8 text", "a map_server file (YAML)") from None
    resolution = keys.number("resolution", *RESOLUTIONS_M)
    x, y, yaw = _origin(keys)
    if abs(yaw) > 1e-6:
        raise InputError(keys.at("origin"), f"a yaw of {yaw:g}", "0: maps are not turned")
    free_thresh = keys.number("free_thresh", 0.0, 1.0)
    occupied_thresh = keys.number("occupied_thresh", 0.0, 1.0)
    if free_thresh >= occupied_thresh:
        limit = f"less than occupied_thresh ({occupied_thresh:g})"
        raise InputError(keys.at("free_thresh"), f"{free_thresh:g}", limit)
    if keys.take("negate") not in (0, 1):
        raise InputError(keys.at("negate"), "something else", "0 or 1")
    mode = keys.text("mode") if "mode" in keys.data else "trinary"
    if mode not in ("trinary", "scale", "raw"):
        raise InputError(keys.at("mode"), mode[:60], "trinary, scale or raw")
    pixels, white = _read_pgm(path.parent / keys.text("image"))
    shade = np.arange(white + 1) / white
    p = _occupancy(shade, mode, bool(keys.take("negate")), free_thresh, occupied_thresh)
    log_odds = np.where(np.isnan(p), 0.0, logit(np.clip(p, P_MIN, P_MAX))).astype(np.float32)
    grid = Grid(log_odds[pixels], ~np.isnan(p)[pixels], resolution, (x, y))
    if white != 255 or keys.data["negate"] or p[PIXEL_UNKNOWN] != 0:
        return grid, ""
    share = float(np.mean(pixels == PIXEL_UNKNOWN))
    if share < LEAST_UNKNOWN:
        return grid, ""
    remedies = (("write 0.196 there", free_thresh > 0.196), ("let mode be trinary", mode == "scale"))
    remedy = " and ".join(what for what, helps in remedies if helps)
    return grid, (
        f"{keys.at('free_thresh')} {free_thresh:g} makes the {share:.0%} of the cells free that are of grey "
        f"{PIXEL_UNKNOWN}, which map_saver writes for unknown, as it does in Nav2; if they are, {remedy}"
    )


def _origin(keys: Keys) -> tuple[float, float, float]:
    """x, y (m) and yaw (rad) of the lower left corner of the map."""
    values = keys.take("origin")
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(keys.at("origin"), "something else", "a list of x, y and yaw")
    numbers = []
    for i, value in enumerate(values):
        if isinstance(value, str):  # PyYAML takes 1e-05 for a text, and map_saver writes a yaw of zero so
            with suppress(ValueError):
                value = float(value)
        numbers.append(as_number(value, *COORDINATES_M, f"{keys.at('origin')}[{i}]"))
    return numbers[0], numbers[1], numbers[2]


def _occupancy(
    shade: Float[ndarray, "n"], mode: str, negate: bool, free_thresh: float, occupied_thresh: float
) -> Float[ndarray, "n"]:
    """Probability of occupied for each brightness in [0, 1]; nan = unknown. A PGM has no alpha channel."""
    if mode == "raw":
        percent = np.rint(shade * 255)
        return np.where(percent <= 100, percent / 100, np.nan)
    occupied = shade if negate else 1.0 - shade
    between = np.full_like(occupied, np.nan)
    if mode == "scale":
        between = np.rint((occupied - free_thresh) / (occupied_thresh - free_thresh) * 100) / 100
    return np.where(occupied > occupied_thresh, 1.0, np.where(occupied < free_thresh, 0.0, between))


_PGM_HEADER = re.compile(rb"P5" + 3 * rb"(?:\s|#[^\n]*\n)+0*(\d{1,9})" + rb"\s")


def _read_pgm(path: Path) -> tuple[Integer[ndarray, "rows cols"], int]:
    """The pixels of a binary PGM, row 0 at the lower edge of the image, and the value of white."""
    expected = "a binary PGM image (P5)"
    content = read_bytes(path, expected, MAX_FILE_BYTES)
    header = _PGM_HEADER.match(content)
    if header is None:
        raise InputError(path, "another format", expected)
    cols, rows, white = (int(number) for number in header.groups())
    if not cols or not rows or not 0 < white < 65536:
        raise InputError(path, f"{cols} x {rows} pixels up to {white}", expected)
    dtype = np.dtype("u1" if white < 256 else ">u2")
    if len(content) - header.end() < rows * cols * dtype.itemsize:
        raise InputError(path, f"{len(content)} bytes", f"{cols} x {rows} pixels of {dtype.itemsize} byte(s)")
    pixels = np.frombuffer(content, dtype, rows * cols, header.end()).reshape(rows, cols)
    brightest = int(np.max(pixels))
    if brightest > white:
        raise InputError(path, f"a pixel of {brightest}", f"at most {white}, as the header says")
    return np.flipud(pixels), white


def pgm(pixels: UInt8[ndarray, "rows cols"]) -> bytes:
    """A binary PGM of pixels whose row 0 is the lowest y: the image begins with its top row."""
    rows, cols = pixels.shape
    return b"P5\n%d %d\n255\n" % (cols, rows) + np.flipud(pixels).tobytes()


def _trinary(grid: Grid) -> UInt8[ndarray, "rows cols"]:
    return np.array([PIXEL_FREE, PIXEL_OCCUPIED, PIXEL_UNKNOWN], dtype=np.uint8)[np.sign(occupancy(grid))]


def _raw(grid: Grid) -> UInt8[ndarray, "rows cols"]:
    """The probability in percent, on the same side of both thresholds as it was."""
    p = grid.probability()
    classes = [p > OCCUPIED_THRESH, p < FREE_THRESH]
    low, high = (
        np.select(classes, [_PERCENT_OCCUPIED[end], _PERCENT_FREE[end]], _PERCENT_BETWEEN[end]) for end in (0, 1)
    )
    percent = np.clip(np.rint(100 * p), low, high)
    return np.where(grid.observed, percent, _PERCENT_UNKNOWN).astype(np.uint8)


def _scale(grid: Grid) -> UInt8[ndarray, "rows cols"]:
    percent = np.where(grid.observed, _raw(grid), 50).astype(float)
    return np.rint((100 - percent) * 2.55).astype(np.uint8)


PIXELS: dict[PgmMode, Callable[[Grid], UInt8[ndarray, "rows cols"]]] = {
    "trinary": _trinary,
    "scale": _scale,
    "raw": _raw,
}
"""The pixels of map.pgm, row 0 the lowest y."""


def map_yaml(grid: Grid, mode: PgmMode) -> str:
    """The text of map.yaml."""
    occupied_thresh, free_thresh = _YAML_THRESH[mode]
    fields = {
        "image": "map.pgm",
        "mode": mode,
        "resolution": float(grid.resolution),
        "origin": [float(grid.origin[0]), float(grid.origin[1]), 0.0],
        "negate": 0,
        "occupied_thresh": occupied_thresh,
        "free_thresh": free_thresh,
    }
    # The file travels to the robot without our pages.
    caution = "" if mode == "trinary" else "# Probabilities: Nav2 sees walls only with lethal_cost_threshold: 66\n"
    return caution + yaml.safe_dump(fields, sort_keys=False, default_flow_style=None)
