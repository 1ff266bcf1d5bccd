"""Maps and truth grids as files: NPZ, a picture for people, and the pair of ROS's map_server."""

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError, UsageError
from echogrid.files import made, replacing
from echogrid.grid import MAX_CELLS, MAX_FILE_BYTES, Grid, logit
from echogrid.metrics import FREE, HIDDEN, SURFACE, Truth
from echogrid.npz import open_npz
from echogrid.output.map_picture import draw_map
from echogrid.output.map_server_file import (
    COORDINATES_M,
    PIXELS,
    RESOLUTIONS_M,
    PgmMode,
    map_yaml,
    pgm,
    read_map_server,
)
from echogrid.yaml_keys import as_number

P_LEAST = 0.001
"""Of a map that is read: it was clipped when it was written, if it was by echogrid."""


def write_map(
    folder: str | Path,
    grid: Grid,
    path_world: Float[ndarray, "poses _"],
    settings: Mapping[str, Any],
    title: str = "",
    mode: PgmMode = "trinary",
    odometry_world: Float[ndarray, "told _"] | None = None,
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
      clipped to the read-out limits (``Grid.p_min``), so that their plain sigmoid is the map that is scored.
    - run.yaml: ``echogrid_version``, then the settings.

    Args:
        folder: where to write.
        grid: the map.
        path_world: the drive: x, y (m, world) in the first two columns, one row a pose; may have no rows.
        settings: what is needed to repeat the run; values that YAML lacks are written as text.
        title: the heading of the picture.
        mode: of map.pgm.
        odometry_world: the drive as the odometry had it, likewise, where poses were corrected; map.png shows both.

    Raises:
        UsageError: the map has no cells or has nan among its log-odds, or the folder cannot be written.
    """
    if not grid.log_odds.size:
        raise UsageError("map: found no cells, expected at least one frame with a reading")
    if np.isnan(grid.log_odds).any():
        raise UsageError("map: found log-odds that are nan, expected numbers from the interpreter")
    # Renamed from the last to the first when all are written; run.yaml, which speaks for the rest, is last.
    writers: dict[str, Callable[[Path], object]] = {
        "run.yaml": lambda new: new.write_text(run_yaml(settings), encoding="utf-8"),
        "map.yaml": lambda new: new.write_text(map_yaml(grid, mode), encoding="utf-8"),
        "map.pgm": lambda new: new.write_bytes(pgm(PIXELS[mode](grid))),
        "map.npz": lambda new: _save_grid(new, grid),
        "map.png": lambda new: draw_map(new, grid, path_world, title, odometry_world),
    }
    folder = Path(folder)
    with made(folder), ExitStack() as stack:
        for name, write in writers.items():
            write(stack.enter_context(replacing(folder / name)))


def write_grid(path: str | Path, grid: Grid) -> None:
    """Write the map.npz of ``write_map`` alone.

    Raises:
        UsageError: the file cannot be written; nothing is left of it.
    """
    with replacing(path) as new:
        _save_grid(new, grid)


def _save_grid(path: Path, grid: Grid) -> None:
    log_odds = np.clip(grid.log_odds, logit(grid.p_min), logit(1 - grid.p_min)).astype(np.float32)
    _save_npz(path, log_odds=log_odds, observed=grid.observed, **_place(grid))


def read_map(path: str | Path) -> Grid:
    """Read a map: the folder that ``write_map`` wrote, its map.npz, or a map_server map.yaml with its PGM.

    A folder is read by its map.npz, or by its map.yaml where it has no map.npz. A map.yaml of any mode
    (trinary, scale, raw) is read by the rules of Nav2's map_server: what it calls unknown is 0.5 and not
    observed, what it calls free or occupied is P_MIN or P_MAX.

    Raises:
        InputError: not there, damaged, or not a map; the message names the file and the array or key.
    """
    return read_map_noted(path)[0]


def read_map_noted(path: str | Path) -> tuple[Grid, str]:
    """Likewise, and what is doubtful about the map, with its remedy, or ""."""
    path = Path(path)
    if os.path.isdir(path):
        names = [name for name in ("map.npz", "map.yaml") if os.path.isfile(path / name)]
        if not names:
            raise InputError(path, "a folder without map.npz and map.yaml", "a folder with a map")
        path /= names[0]
    if path.suffix.lower() in (".yaml", ".yml"):
        return read_map_server(path)
    with open_npz(path, "a map folder, map.npz or map.yaml", MAX_FILE_BYTES) as arrays:
        log_odds = _array(arrays, "log_odds", path, "f", "floats")
        observed = _array(arrays, "observed", path, "b", "bools")
        if observed.shape != log_odds.shape:
            shapes = f"shape {observed.shape} beside log_odds of shape {log_odds.shape}"
            raise InputError(f"{path}: observed", shapes, "one shape")
        with np.errstate(over="ignore"):  # what overflows is caught as not finite
            log_odds = log_odds.astype(np.float32)
        if not np.isfinite(log_odds).all():
            raise InputError(f"{path}: log_odds", "nan or infinity", "finite log-odds")
        return Grid(log_odds, observed, *_read_place(arrays, path), p_min=P_LEAST), ""


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
    with open_npz(path, "a truth grid (NPZ)", MAX_FILE_BYTES) as arrays:
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
    resolution = as_number(values["resolution"][0], *RESOLUTIONS_M, f"{path}: resolution")
    x, y = (as_number(value, *COORDINATES_M, f"{path}: origin") for value in values["origin"])
    return resolution, (x, y)


def _place(where: Grid | Truth) -> dict[str, ndarray]:
    return {
        "resolution": np.array(where.resolution, dtype=float),
        "origin": np.array(where.origin, dtype=float),
    }


def _save_npz(path: Path, **arrays: ndarray) -> None:
    with open(path, "wb") as file:  # by name, numpy would add a suffix of its own
        np.savez_compressed(file, allow_pickle=False, **arrays)


def run_yaml(settings: Mapping[str, Any]) -> str:
    """The text of run.yaml: ``echogrid_version``, then the settings."""
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
