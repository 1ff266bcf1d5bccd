"""The folder in which a fleet keeps what its logs say.

A log counts if, and as long as, its record is there (``logs/HASH.json``, HASH being that of the log's content); a
record names the file of its sums (``sums/KEY.zip``, KEY being the hash of all that they are made from). Both are
written whole or not at all, the record last: a log counts once however often it is mapped.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from echogrid.errors import InputError, UsageError
from echogrid.files import made, read_text, replacing, unwritable
from echogrid.fleet.lattice import LAYERS, TILE, UNIT, Tile
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.models.networks.set_network import SetNetwork

FORMAT = "echogrid-fleet-1"

_EXPECTED = "a store that echogrid fleet has made"


@dataclass(frozen=True)
class Record:
    """What a store says of a log that counts."""

    log: str
    """Hash of its content."""
    name: str
    """Its file, as it was named."""
    sums: str
    """Key of its sums."""
    settings: str
    """Hash of what it was mapped with, but for its poses."""
    poses: str
    """Where they come from: own, file:HASH, or localised:HASH of the map."""
    robot: str
    """The robot file (YAML)."""
    frames: int
    """Scans that were mapped."""
    tiles: tuple[Tile, ...]
    """Those that its sums touch."""
    notes: tuple[str, ...] = ()
    """What is doubtful about it."""
    path: str = ""
    """Where it was when it was added."""


class Store:
    """A store that is there."""

    def __init__(self, path: str | Path) -> None:
        """Open it.

        Raises:
            InputError: there is none, or one of another kind or of sums of other weights.
        """
        self.path = Path(path)
        if not os.path.isdir(self.path):
            found = "a file" if os.path.lexists(self.path) else "no such folder"
            raise InputError(self.path, found, _EXPECTED)
        where = self.path / "store.json"
        if not os.path.lexists(where):
            raise InputError(self.path, "a folder without store.json", _EXPECTED)
        _compare(where, _object(where))

    @staticmethod
    def can_be_made(path: Path) -> bool:
        """Whether there is nothing at a path, or an empty folder."""
        return not os.path.lexists(path) or (os.path.isdir(path) and not any(path.iterdir()))

    @staticmethod
    def made(path: str | Path) -> "Store":
        """The store at a path, an empty one where there is nothing or an empty folder.

        Raises:
            InputError, UsageError: something else is there, or it cannot be written.
        """
        path = Path(path)
        if Store.can_be_made(path):
            with made(path):
                for name in ("logs", "sums", "merged"):
                    with made(path / name):
                        pass
                with replacing(path / "store.json") as new:
                    new.write_text(json.dumps(facts(), indent=1), encoding="utf-8")
        return Store(path)

    @contextmanager
    def locked(self) -> Generator[None]:
        """Nobody else adds or removes logs while the block lasts.

        Raises:
            UsageError: somebody does.
        """
        try:
            file = os.open(self.path / "store.json", os.O_RDONLY)
        except OSError as error:
            raise unwritable(self.path, error.strerror or str(error), _EXPECTED) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            raise UsageError(
                f"{self.path}: found another echogrid fleet at work in it, expected none: wait for its end"
            ) from None
        except OSError:
            pass  # a file system without locks
        try:
            yield
        finally:
            os.close(file)

    def records(self) -> list[Record]:
        """Of all logs that count, in the order of their hashes.

        Raises:
            InputError: one is damaged.
        """
        with os.scandir(self.path / "logs") as entries:
            names = sorted(entry.name for entry in entries if not entry.name.startswith("."))
        found = (self.record(name.removesuffix(".json")) for name in names if name.endswith(".json"))
        return [record for record in found if record is not None]

    def record(self, log: str) -> Record | None:
        """Of a log by its hash; None: it does not count."""
        path = self._record_at(log)
        if not os.path.lexists(path):
            return None
        told = _object(path)
        try:
            tiles = tuple((int(row), int(col)) for row, col in told.pop("tiles"))
            return Record(tiles=tiles, notes=tuple(told.pop("notes")), **told)
        except (KeyError, TypeError, ValueError):
            raise InputError(path, "a record with other keys", "the record of a log in a store") from None

    def write(self, record: Record) -> None:
        """Have a log count, by the sums that are there; by those that it had before it does not any more."""
        before = self.record(record.log)
        with replacing(self._record_at(record.log)) as new:
            new.write_text(json.dumps(asdict(record)), encoding="utf-8")
        if before is not None and before.sums != record.sums:
            self.sums_at(before.sums).unlink(missing_ok=True)

    def remove(self, record: Record) -> None:
        """Have a log not count any more."""
        try:
            self._record_at(record.log).unlink(missing_ok=True)
            self.sums_at(record.sums).unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(self.path, error.strerror or str(error), "a store that can be written") from None

    def sums_at(self, key: str) -> Path:
        """Where the sums of a key are."""
        return self.path / "sums" / f"{key}.zip"

    def merged_at(self, tile: Tile) -> Path:
        """Where what all logs say of a tile is kept once somebody has looked."""
        return self.path / "merged" / f"{tile[0]}_{tile[1]}.zip"

    def clear_merged(self, used: Iterable[Tile]) -> None:
        """Remove the merged tiles but those used."""
        kept = {self.merged_at(tile).name for tile in used}
        with suppress(OSError), os.scandir(self.path / "merged") as entries:
            for entry in entries:
                if entry.name not in kept and not entry.name.startswith("."):
                    os.unlink(entry.path)

    def _record_at(self, log: str) -> Path:
        return self.path / "logs" / f"{log}.json"


@cache
def facts() -> dict[str, Any]:
    """What a store says of itself: all sums in it are made alike."""
    model = model_of_stores()
    weights = hashlib.sha256()
    for part in (model.weights, model.around or {}):
        for name, value in sorted(part.items()):
            weights.update(f"{name}{np.shape(value)}".encode() + np.ascontiguousarray(value, np.float32).tobytes())
    return {
        "format": FORMAT,
        "cell_m": model.cell_m,
        "tile_cells": TILE,
        "layers": list(LAYERS),
        "unit": UNIT,
        "weights": weights.hexdigest(),
    }


@cache
def model_of_stores() -> SetNetwork:
    """The model whose sums are stored: the default, with the weights that ship with the package."""
    model = sensor_model(DEFAULT)
    assert isinstance(model, SetNetwork)
    return model


def _compare(where: Path, told: dict[str, Any]) -> None:
    """Refuse a store whose sums are made in another way than ours."""
    for name, value in facts().items():
        if told.get(name) != value:
            remedy = "map the logs into a new store" if name == "weights" else "a store of this echogrid"
            raise InputError(f"{where}: {name}", str(told.get(name))[:60], f"{value}: {remedy}")


def _object(path: Path) -> dict[str, Any]:
    try:
        told = json.loads(read_text(path, _EXPECTED))
    except ValueError:
        told = None
    if not isinstance(told, dict):
        raise InputError(path, "something that is no JSON object", _EXPECTED)
    return told
