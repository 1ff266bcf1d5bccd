"""Maps and truth grids as files: the ROS map_server pair, a picture for people, and NPZ."""

import os
import re
import zipfile
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np
import yaml
from jaxtyping import Float, Int8, Integer, UInt8
from numpy import ndarray

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.files import made, replacing
from echogrid.grid import MAX_CELLS, P_MAX, P_MIN, Grid, logit
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.picture import draw_map
from echogrid.robot import Keys, as_number, parse_yaml

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.25
"""A cell above the first is drawn occupied, one below the second free: the defaults of Nav2's map_saver."""

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

MAX_FILE_BYTES = 10 * MAX_CELLS
"""No map or truth of MAX_CELLS cells needs more; a longer file is something else."""

_RESOLUTIONS_M, _COORDINATES_M = (1e-4, 1e3), (-1e9, 1e9)


def write_map(
    folder: str | Path,
    grid: Grid,
    path_world: Float[ndarray, "poses _"],
    settings: Mapping[str, Any],
    title: str = "",
    mode: PgmMode = "trinary",
) -> None:
    """Write a map into a folder (made if need be): map.pgm, map.yaml, map.png, map.npz and run.yaml.

    Each file is complete under a temporary name before the first takes its place; when anything fails before
    that, the folder is as it was. Files of the same names are replaced.

    - map.pgm + map.yaml: the pair of ROS's map_server. In mode trinary occupied where p > 0.65, free where
      p < 0.25, unknown elsewhere and where no view spoke. In modes scale and raw the probability in percent (2 off
      at most), the same three classes apart at 25 and 66; where no view spoke it is unknown in mode raw and 50 in
      mode scale, for there only a transparent pixel is unknown and a PGM has none.
    - map.png: the map with the drive, for people; cut to what was observed.
    - map.npz: ``log_odds`` float32 and ``observed`` bool, both [row, col] with row 0 the lowest y,
      ``resolution`` (m) and ``origin`` (x, y of the lower left corner of cell [0, 0], m). The log-odds are
      clipped to the read-out limits P_MIN and P_MAX, so that their plain sigmoid is the map that is scored.
    - run.yaml: ``echogrid_version``, then the settings.

    Args:
        folder: where to write.
        grid: the map.
        path_world: the drive: x, y (m, world) in the first two columns, one row a pose; may have no rows.
        settings: what is needed to repeat the run; values that YAML lacks are written as text.
        title: the heading of the picture.
        mode: of map.pgm.

    Raises:
        UsageError: the map has no cells or has nan among its log-odds, or the folder cannot be written.
    """
    if not grid.log_odds.size:
        raise UsageError("map: found no cells, expected at least one frame with a reading")
    if np.isnan(grid.log_odds).any():
        raise UsageError("map: found log-odds that are nan, expected numbers from the interpreter")
    log_odds = np.clip(grid.log_odds, logit(P_MIN), logit(P_MAX)).astype(np.float32)
    # Renamed from the last to the first when all are written; run.yaml, which speaks for the rest, is last.
    writers: dict[str, Callable[[Path], object]] = {
        "run.yaml": lambda new: new.write_text(_run_yaml(settings), encoding="utf-8"),
        "map.yaml": lambda new: new.write_text(_map_yaml(grid, mode), encoding="utf-8"),
        "map.pgm": lambda new: new.write_bytes(_pgm(_PIXELS[mode](grid))),
        "map.npz": lambda new: _save_npz(new, log_odds=log_odds, observed=grid.observed, **_place(grid)),
        "map.png": lambda new: draw_map(new, grid, path_world, title),
    }
    folder = Path(folder)
    with made(folder), ExitStack() as stack:
        for name, write in writers.items():
            write(stack.enter_context(replacing(folder / name)))


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


def read_map(path: str | Path) -> Grid:
    """Read a map: the folder that ``write_map`` wrote, its map.npz, or a map_server map.yaml with its PGM.

    A folder is read by its map.npz, or by its map.yaml where it has no map.npz. A map.yaml of any mode
    (trinary, scale, raw) is read by the rules of Nav2's map_server: what it calls unknown is 0.5 and not
    observed, what it calls free or occupied is P_MIN or P_MAX.

    Raises:
        InputError: not there, damaged, or not a map; the message names the file and the array or key.
    """
    path = Path(path)
    if os.path.isdir(path):
        names = [name for name in ("map.npz", "map.yaml") if os.path.isfile(path / name)]
        if not names:
            raise InputError(path, "a folder without map.npz and map.yaml", "a folder with a map")
        path /= names[0]
    if path.suffix.lower() in (".yaml", ".yml"):
        return _read_map_server(path)
    with _open_npz(path, "a map folder, map.npz or map.yaml") as arrays:
        log_odds = _array(arrays, "log_odds", path, "f", "floats")
        observed = _array(arrays, "observed", path, "b", "bools")
        if observed.shape != log_odds.shape:
            shapes = f"shape {observed.shape} beside log_odds of shape {log_odds.shape}"
            raise InputError(f"{path}: observed", shapes, "one shape")
        with np.errstate(over="ignore"):  # what overflows is caught as not finite
            log_odds = log_odds.astype(np.float32)
        if not np.isfinite(log_odds).all():
            raise InputError(f"{path}: log_odds", "nan or infinity", "finite log-odds")
        return Grid(log_odds, observed, *_read_place(arrays, path))


def write_truth(path: str | Path, truth: Truth) -> None:
    """Write a truth grid as NPZ.

    The arrays are ``truth`` (int8, [row, col], row 0 lowest y), ``resolution`` (m) and ``origin`` (x, y of
    the lower left corner of cell [0, 0], m).

    Raises:
        UsageError: the file cannot be written; nothing is left of it.
    """
    with replacing(path) as new:
        _save_npz(new, truth=truth.cells.astype(np.int8), **_place(truth))


def read_truth(path: str | Path) -> Truth:
    """Read a truth grid from NPZ: the array ``truth``, with ``resolution`` and ``origin`` (m).

    In a file of another tool the array may have another name, as long as it is the only two-dimensional one
    of integers or, where there is none of integers, the only one of floats that are all 0, 1 or 2.

    Raises:
        InputError: not there, damaged, or not a truth grid; the message names the file and the array.
    """
    path = Path(path)
    with _open_npz(path, "a truth grid (NPZ)") as arrays:
        name = "truth" if "truth" in arrays.files else _only_labels(arrays, path)
        cells = _array(arrays, name, path, "biuf", "integers")
        if not _are_labels(cells):
            wrong = cells[~np.isin(cells, _LABELS)].flat[0]
            raise InputError(f"{path}: {name}", f"the value {wrong}", "0 (free), 1 (surface) or 2 (hidden)")
        return Truth(cells.astype(np.int8), *_read_place(arrays, path))


_LABELS = (FREE, SURFACE, HIDDEN)


def _are_labels(cells: ndarray) -> bool:
    return bool(np.isin(cells, _LABELS).all())


def _only_labels(arrays: np.lib.npyio.NpzFile, path: Path) -> str:
    """The name of the one array that can be a truth grid."""
    planes: dict[str, ndarray] = {}
    for name in arrays.files:
        with suppress(ValueError):  # an array of objects, which is not ours to unpickle and not the truth
            if np.ndim(array := arrays[name]) == 2:
                planes[name] = array
    integers = [name for name, array in planes.items() if array.dtype.kind in "iu"]
    floats = [name for name, array in planes.items() if array.dtype.kind == "f" and _are_labels(array)]
    names = integers or floats
    if len(names) != 1:
        found = f"the arrays {', '.join(names)}" if names else "none"
        raise InputError(path, found, "one two-dimensional array of integers, or one that is called truth")
    return names[0]


@contextmanager
def _open_npz(path: Path, expected: str) -> Generator[np.lib.npyio.NpzFile]:
    """The arrays of an NPZ file, read as they are asked for; any damage met on the way is an InputError."""
    try:
        with open(_plain_file(path, expected, MAX_FILE_BYTES), "rb") as file:
            _check_archive(file, path, expected)
            with np.load(file, allow_pickle=False) as arrays:
                yield arrays
    except EchogridError:
        raise
    except OSError as error:
        raise InputError(path, error.strerror or str(error), expected) from None
    except Exception as error:  # zipfile, zlib and numpy raise a dozen kinds for a damaged file
        reason = str(error) or type(error).__name__
        raise InputError(path, f"an archive that cannot be read ({reason})", expected) from None


def _check_archive(file: BinaryIO, path: Path, expected: str) -> None:
    """Refuse what is no archive at all, and one that would fill the memory; leaves the file at its start."""
    if not zipfile.is_zipfile(file):
        raise InputError(path, "a file that is not an NPZ archive", expected)
    with zipfile.ZipFile(file) as archive:
        if sum(member.file_size for member in archive.infolist()) > MAX_FILE_BYTES:
            raise InputError(path, f"more than {MAX_FILE_BYTES:.0e} bytes when unpacked", expected)
    file.seek(0)


def _array(arrays: np.lib.npyio.NpzFile, name: str, path: Path, kinds: str, expected: str) -> ndarray:
    """A two-dimensional array with cells, of one of numpy's kinds of dtype."""
    array = _take(arrays, name, path)
    if array.ndim != 2 or not array.size or array.dtype.kind not in kinds:
        found = f"{array.dtype} of shape {array.shape}"
        raise InputError(f"{path}: {name}", found, f"{expected} in rows and columns")
    if array.size > MAX_CELLS:
        raise InputError(f"{path}: {name}", f"{array.size} cells", f"at most {MAX_CELLS:.0e}")
    return array


def _take(arrays: np.lib.npyio.NpzFile, name: str, path: Path) -> ndarray:
    if name not in arrays.files:
        raise InputError(path, f"the arrays {', '.join(arrays.files) or '(none)'}", f"{name} among them")
    return np.asarray(arrays[name])


def _read_place(arrays: np.lib.npyio.NpzFile, path: Path) -> tuple[float, tuple[float, float]]:
    """Resolution and origin."""
    values = {}
    for name, size in (("resolution", 1), ("origin", 2)):
        array = _take(arrays, name, path)
        if array.size != size or array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name}", f"{array.dtype} of shape {array.shape}", f"{size} number(s)")
        values[name] = [float(value) for value in array.flat]
    resolution = as_number(values["resolution"][0], *_RESOLUTIONS_M, f"{path}: resolution")
    x, y = (as_number(value, *_COORDINATES_M, f"{path}: origin") for value in values["origin"])
    return resolution, (x, y)


def _place(where: Grid | Truth) -> dict[str, ndarray]:
    return {
        "resolution": np.array(where.resolution, dtype=float),
        "origin": np.array(where.origin, dtype=float),
    }


def _save_npz(path: Path, **arrays: ndarray) -> None:
    with open(path, "wb") as file:  # by name, numpy would add a suffix of its own
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _plain_file(path: Path, expected: str, limit: int) -> Path:
    """The path, once it is known to be a plain file of at most ``limit`` bytes (a pipe would never end)."""
    if os.path.isdir(path):
        raise InputError(path, "a folder", expected)
    if not os.path.lexists(path):
        raise InputError(path, "no such file", expected)
    if not os.path.isfile(path):
        raise InputError(path, "something that is not a plain file", expected)
    if os.path.getsize(path) > limit:
        raise InputError(path, f"more than {limit} bytes", expected)
    return path


def _read_bytes(path: Path, expected: str, limit: int) -> bytes:
    try:
        return _plain_file(path, expected, limit).read_bytes()
    except OSError as error:
        raise InputError(path, error.strerror or str(error), expected) from None


def _read_map_server(path: Path) -> Grid:
    """A map.yaml and the PGM that it names, by the rules of Nav2's map_io.cpp."""
    raw = _read_bytes(path, "a map_server file (YAML)", 1_000_000)
    try:
        keys = Keys(str(path), parse_yaml(raw.decode("utf-8"), str(path)))
    except UnicodeDecodeError:
        raise InputError(path, "bytes that are not UTF-8 text", "a map_server file (YAML)") from None
    resolution = keys.number("resolution", *_RESOLUTIONS_M)
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
    return Grid(log_odds[pixels], ~np.isnan(p)[pixels], resolution, (x, y))


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
        numbers.append(as_number(value, *_COORDINATES_M, f"{keys.at('origin')}[{i}]"))
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
    content = _read_bytes(path, expected, MAX_FILE_BYTES)
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


def _pgm(pixels: UInt8[ndarray, "rows cols"]) -> bytes:
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


_PIXELS: dict[PgmMode, Callable[[Grid], UInt8[ndarray, "rows cols"]]] = {
    "trinary": _trinary,
    "scale": _scale,
    "raw": _raw,
}
"""The pixels of map.pgm, row 0 the lowest y."""


def _map_yaml(grid: Grid, mode: PgmMode) -> str:
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


def _run_yaml(settings: Mapping[str, Any]) -> str:
    try:
        version = metadata.version("echogrid")
    except metadata.PackageNotFoundError:  # run from a source tree that was never installed
        version = "unknown"
    fields = {"echogrid_version": version, **_plain(settings)}
    return yaml.dump(fields, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


class _Dumper(yaml.SafeDumper):
    """Writes a text of several lines, such as a robot file, as several lines."""


_Dumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None),
)


def _plain(value: Any) -> Any:
    """The value in the types of YAML; what has none becomes its text."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or type(value) in (bool, int, float, str) else str(value)
