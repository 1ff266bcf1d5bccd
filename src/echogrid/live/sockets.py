"""Sockets that others have opened in this process: the kernel is told through which interface they may be reached."""

import ctypes
import os
import socket
import stat
import struct
import sys
from contextlib import suppress

_SO_ATTACH_FILTER = 26
"""Not among the constants of Python's socket module."""


def open_sockets() -> set[int]:
    """Descriptors of this process's sockets; empty elsewhere than on Linux."""
    found = set()
    with suppress(FileNotFoundError):
        for name in os.listdir("/proc/self/fd"):
            with suppress(OSError):
                if stat.S_ISSOCK(os.fstat(int(name)).st_mode):
                    found.add(int(name))
    return found


def keep_to(interface: str, descriptors: set[int]) -> bool:
    """Let nothing into sockets but through an interface; whether that could be done for all."""
    if sys.platform != "linux" or not descriptors:
        return False
    for descriptor in descriptors:
        try:
            with socket.socket(fileno=os.dup(descriptor)) as each:
                if each.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                if interface == "lo":
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
                else:
                    _only_from(each, [socket.if_nametoindex(name) for name in ("lo", interface)])
        except OSError:  # a kernel before 5.7 lets only root do so
            return False
    return True


def _only_from(each: socket.socket, indices: list[int]) -> None:
    """Attach a classic BPF program that drops what came in through any other interface."""
    load, equal, answer, index = 0x20, 0x15, 0x06, 0xFFFFF000 + 8  # SKF_AD_OFF + SKF_AD_IFINDEX
    tests = [struct.pack("HBBI", equal, len(indices) - i, 0, number) for i, number in enumerate(indices)]
    program = b"".join(
        [struct.pack("HBBI", load, 0, 0, index), *tests]
        + [struct.pack("HBBI", answer, 0, 0, length) for length in (0, 0xFFFFFFFF)]
    )
    memory = ctypes.create_string_buffer(program, len(program))
    fprog = struct.pack("HL", len(program) // 8, ctypes.addressof(memory))
    each.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, fprog)
