"""How bags of ROS look from outside. Any log is looked at so; it should not pay for what opens a bag."""

import os
from pathlib import Path

from echogrid.errors import InputError
from echogrid.packed import opened

MAGIC = {b"#ROSBAG V": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
"""How the files begin, and how their names must end."""

METADATA = "metadata.yaml"
"""What the folder of a ROS 2 bag holds beside the files with the messages."""


def recognises(path: Path) -> bool:
    """Whether there is a bag: a file that begins or ends like one, or a folder with the metadata or files of one."""
    if os.path.isdir(path):
        return os.path.isfile(path / METADATA) or bool(files_of(path))
    return ending_of(path) is not None or (path.suffix in MAGIC.values() and os.path.isfile(path))


def files_of(folder: Path) -> list[Path]:
    """The bags in a folder."""
    try:
        return sorted(each for each in folder.iterdir() if each.suffix in MAGIC.values())
    except OSError:
        return []


def ending_of(path: Path) -> str | None:
    """How the name of a file must end that begins like this one, unpacked; None: it does not begin like a bag."""
    head = _head(path)
    return next((ending for magic, ending in MAGIC.items() if head.startswith(magic)), None)


def _head(path: Path) -> bytes:
    """How the bag in a file begins, once it is unpacked; nothing if it cannot be read or is no plain file."""
    try:
        if not os.path.isfile(path):
            return b""  # to open a pipe is to wait for whoever writes to it
        with opened(path) as file:
            return file.read(16)
    except (OSError, ValueError, InputError):  # told by whoever takes it for a text
        return b""
