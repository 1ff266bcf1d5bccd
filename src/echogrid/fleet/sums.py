"""Files of sums: an array of zarr with a tile a chunk, in one ZIP file that zarr opens as a ``ZipStore``.

The same sums make the same file, byte by byte, whoever writes it and when.
"""

import json
import zipfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import zarr
from jaxtyping import Int
from numpy import ndarray
from zarr.codecs import BloscCodec
from zarr.storage import MemoryStore, ZipStore

from echogrid.errors import InputError
from echogrid.files import replacing
from echogrid.fleet.lattice import LAYERS, TILE, Tile

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The time of all members of the ZIP file."""

_MOST_PARTS = 2**31
"""Of an array that is being gathered; those that come are what it has in the end."""

_SHAPE = (len(LAYERS), TILE, TILE)


class Writer:
    """Gathers tiles, packed, and writes them; of one tile there may be several parts, which count together."""

    def __init__(self, dtype: str) -> None:
        """``dtype``: of the numbers; int32 holds those of most logs, int64 those of all."""
        self._files: dict[str, Any] = {}
        self.tiles: list[Tile] = []
        self._array = zarr.create_array(
            MemoryStore(self._files),
            shape=(_MOST_PARTS, *_SHAPE),
            chunks=(1, *_SHAPE),
            dtype=dtype,
            compressors=BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle"),
            fill_value=0,
        )

    def add(self, tile: Tile, kept: Int[ndarray, "layers side side"]) -> None:
        """Add what cells of a tile hold, none of it below 0; what is more than a number holds becomes a part more."""
        most = np.iinfo(self._array.dtype).max
        while (largest := int(kept.max())) > most:
            self._add(tile, np.minimum(kept, most))
            kept = np.maximum(kept - most, 0)
        if largest or tile not in self.tiles[-1:]:
            self._add(tile, kept)

    def _add(self, tile: Tile, part: Int[ndarray, "layers side side"]) -> None:
        self._array[len(self.tiles)] = part.astype(self._array.dtype)
        self.tiles.append(tile)

    def write(self, path: Path, **facts: Any) -> None:
        """Write the file, whole or not at all; ``facts`` go along as attributes beside ``tiles``.

        Raises:
            UsageError: it cannot be written.
        """
        files = {name: buffer.to_bytes() for name, buffer in sorted(self._files.items())}
        # Zarr itself would write all of it anew for each tile by which the array grows.
        about = json.loads(files["zarr.json"])
        about["shape"][0] = len(self.tiles)
        about["attributes"] = {"tiles": self.tiles, **facts}
        files["zarr.json"] = json.dumps(about).encode()
        with replacing(path) as new, zipfile.ZipFile(new, "w") as archive:
            for name, content in files.items():
                archive.writestr(zipfile.ZipInfo(name, _EPOCH), content)


class Reader:
    """Tiles of a file of sums, each read as it is asked for."""

    def __init__(self, array: Any, path: Path) -> None:
        self._array, self._path = array, path
        self.facts: dict[str, Any] = dict(array.attrs)
        self._at: dict[Tile, list[int]] = {}
        for i, (row, col) in enumerate(self.facts.get("tiles", [])):
            self._at.setdefault((row, col), []).append(i)
        if array.shape != (sum(map(len, self._at.values())), *_SHAPE) or array.dtype.kind != "i":
            raise InputError(path, f"{array.dtype} of shape {array.shape}", "sums of a store, a tile a chunk")

    @property
    def tiles(self) -> Iterable[Tile]:
        """Those that it has."""
        return self._at

    def tile(self, tile: Tile) -> Int[ndarray, "layers side side"]:
        """What the cells of a tile hold; nothing of one that it has not."""
        total = np.zeros(_SHAPE, dtype=np.int64)
        for i in self._at.get(tile, ()):
            try:
                total += cast(ndarray, self._array[i])
            except Exception as error:  # zipfile, zarr and blosc raise a dozen kinds for a damaged file
                raise damaged(self._path, error) from None
        return total


@contextmanager
def opened(path: Path) -> Generator[Reader]:
    """A file of sums.

    Raises:
        InputError: not there, damaged, or none.
    """
    try:
        store = ZipStore(path, mode="r")
        array = zarr.open_array(store, mode="r")
    except Exception as error:
        raise damaged(path, error) from None
    try:
        yield Reader(array, path)
    finally:
        store.close()


def damaged(path: Path, error: Exception) -> InputError:
    """The error for a file of sums that cannot be read."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or type(error).__name__
    return InputError(path, f"sums that cannot be read ({reason})", "a file of the store")
