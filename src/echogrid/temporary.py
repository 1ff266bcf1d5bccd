"""Temporary files and folders that a run holds while it writes, and what runs that were killed left of theirs."""

import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def beside(target: Path, folder: bool = False) -> Generator[Path]:
    """A new, empty file (or folder) beside ``target``, gone when the block ends unless it was renamed.

    Who makes it keeps it locked, so that ``sweep`` can tell it from what a killed run left; that is swept first. The
    name begins with a point and keeps stem and suffix of ``target``.

    Raises:
        OSError: the system refuses.
    """
    sweep(target)
    temporary, lock = _locked(target, folder)
    try:
        yield temporary
    finally:
        _remove(temporary)
        os.close(lock)


def sweep(target: Path) -> None:
    """Remove what killed runs left of their temporary files for ``target``; what a live run holds stays."""
    # One that was written whole or not at all in its turn bears the points and numbers of both.
    name = re.compile(rf"\.+{re.escape(target.stem)}(\.[0-9a-f]{{8}})+{re.escape(target.suffix)}")
    with suppress(OSError), os.scandir(target.parent) as entries:
        left = [Path(entry.path) for entry in entries if name.fullmatch(entry.name)]
        for path in left:
            with suppress(OSError), _opened(path) as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # refused while its run lives
                _remove(path)


def _locked(target: Path, folder: bool) -> tuple[Path, int]:
    """A new file or folder beside ``target``, and the descriptor that holds its lock until it is closed."""
    while True:
        temporary = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")
        if folder:
            temporary.mkdir()
        else:
            temporary.touch(exist_ok=False)
        if (lock := _lock(temporary)) is not None:
            return temporary, lock
        # Another run swept it away before it was locked.


def _lock(path: Path) -> int | None:
    """Lock a new file or folder; None if another run is about to remove it, or has."""
    try:
        lock = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return None
    except OSError:
        pass  # a file system without locks, where nothing is swept either
    if path.exists():
        return lock
    os.close(lock)
    return None


@contextmanager
def _opened(path: Path) -> Generator[int]:
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    """Remove a file, or a folder with all in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    with suppress(OSError):
        path.unlink()
