"""The folder that a map is written into, and what of it is ours by name."""

import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from echogrid.files import check_writable, unwritable
from echogrid.temporary import sweep

ALWAYS = ("map.png", "map.npz", "map.pgm", "map.yaml", "run.yaml")
"""What a map is in its folder."""

ASKED_FOR = ("map.html", "map.mcap", "map.rrd", "trajectory.tum", "odometry.tum", "graph.g2o")
"""What is there besides where it was asked for."""


def check_folder(folder: Path, besides: Collection[str] = ()) -> None:
    """Make sure that a map can be written into a folder that is there, and remove what killed runs left in it.

    Args:
        folder: where to.
        besides: which of ASKED_FOR is to be written too.

    Raises:
        UsageError: a file cannot be put there.
    """
    for name in ASKED_FOR:
        sweep(folder / name)
    for name in (*ALWAYS, *besides):
        check_writable(folder / name)


def drop_stale(folder: Path, besides: Collection[str] = (), log: str | None = None) -> list[str]:
    """Remove from the folder of a new map what shows an older one.

    Args:
        folder: where the new map was written.
        besides: which of ASKED_FOR were written with it.
        log: what was mapped, which stays even if it bears such a name.

    Returns:
        Names of what was removed.

    Raises:
        UsageError: the system refuses.
    """
    removed = []
    for name in ASKED_FOR:
        path = folder / name
        if name in besides or not (path.is_file() or path.is_symlink()) or _same(path, log):
            continue
        try:
            path.unlink()
        except OSError as error:
            raise unwritable(path, error.strerror or str(error), "a file that can be removed") from None
        removed.append(name)
    return removed


def _same(path: Path, log: str | None) -> bool:
    with suppress(OSError):
        return log is not None and os.path.samefile(path, log)
    return False
