"""Files of weights: arrays by name, their format, and the recipe that made them (NPZ, no pickle)."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from echogrid.errors import InputError, UsageError
from echogrid.files import replacing
from echogrid.npz import open_npz

MAX_BYTES = 2**26
"""Of a weights file, as it lies there and unpacked; those that ship have 22 kB."""


def write_weights(path: str | Path, form: str, recipe: dict[str, Any], arrays: dict[str, ndarray]) -> None:
    """Write a weights file of a format, whole or not at all."""
    with replacing(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, format=form, recipe=json.dumps(recipe), **arrays)


def read_weights(path: str | Path, *formats: str) -> dict[str, ndarray]:
    """The arrays of a weights file of one of some formats, by name; ``format`` among them.

    Raises:
        InputError: not such a file.
        UsageError: there is no file.
    """
    expected = f"a weights file ({' or '.join(formats)}, made by echogrid train)"
    path = Path(path)
    try:
        with open_npz(path, expected, MAX_BYTES) as data:
            arrays = {name: data[name] for name in data.files}
    except InputError as error:
        if os.path.lexists(path):
            raise
        raise UsageError(f"weights: found no file {path}, expected {expected}") from error
    if str(arrays.get("format")) not in formats:
        raise InputError(path, f"format {str(arrays.get('format'))[:40]}", expected)
    return arrays
