"""Trajectories as text files that evo reads (``evo_ape tum``): one pose a line, ``stamp x y z qx qy qz qw``."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.files import replacing

_UNIT = 0.01
"""The squared norm of a quaternion is 1 within this; files hold few digits."""


def write_tum(path: str | Path, stamps: Float[ndarray, "n"], poses: Float[ndarray, "n 3"]) -> None:
    """Write poses (m, m, rad) at times (s), with z = 0; ``read_tum`` reads them back, the stamps to the last bit.

    Raises:
        UsageError: the file cannot be written.
    """
    half = poses[:, 2] / 2
    rows = np.column_stack([stamps, poses[:, :2], np.zeros((len(poses), 3)), np.sin(half), np.cos(half)])
    lines = [f"{t!r} {x:.6f} {y:.6f} 0 0 0 {z:.9f} {w:.9f}\n" for t, x, y, *_, z, w in rows.tolist()]
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="ascii", newline="\n")


def read_tum(path: str | Path) -> tuple[Float[ndarray, "n"], Float[ndarray, "n 3"]]:
    """Stamps (s) and poses (m, m, rad) of a trajectory; of turns in space their heading.

    Raises:
        InputError: not such a file.
    """
    expected = "rows of 8 finite numbers: stamp x y z qx qy qz qw"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there are no rows is told below
            rows = np.loadtxt(path, ndmin=2, dtype=float)
    except (OSError, ValueError) as error:
        raise InputError(path, str(error).splitlines()[0], expected) from None
    if not rows.size or rows.shape[1] != 8:
        raise InputError(path, f"{len(rows)} rows of {rows.shape[1]} numbers", expected)
    qx, qy, qz, qw = rows[:, 4:].T
    wrong = ~np.all(np.isfinite(rows), axis=1) | (np.abs(np.sum(rows[:, 4:] ** 2, axis=1) - 1) > _UNIT)
    if wrong.any():
        raise InputError(path, f"{np.sum(wrong)} rows that are no poses", f"{expected}, the last four of norm 1")
    theta = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
    return rows[:, 0], np.column_stack([rows[:, 1:3], theta])
