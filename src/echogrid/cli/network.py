"""What commands on a network of ROS 2 have in common: domain, interface, and how they are stopped."""

import os
import signal
from collections.abc import Generator
from contextlib import contextmanager

from echogrid.errors import UsageError


def domain_of(asked: int | None) -> int:
    """The domain that was asked for, or that of ROS_DOMAIN_ID, else 0."""
    said, domain = "--domain", str(asked)
    if asked is None:
        said, domain = "ROS_DOMAIN_ID", os.environ.get("ROS_DOMAIN_ID") or "0"
    if not domain.isdecimal() or int(domain) > 232:
        raise UsageError(f"{said}: found {domain}, expected 0 to 232")
    return int(domain)


def interface_of(asked: str | None) -> str | None:
    """The interface that was asked for; None leaves it to CYCLONEDDS_URI, where that is set; else loopback."""
    return asked or (None if os.environ.get("CYCLONEDDS_URI") else "lo")


def where(interface: str | None, kept: bool) -> str:
    """On which network it is, and who reaches it there.

    Args:
        interface: as of ``interface_of``.
        kept: whether the kernel lets nothing in but through it.
    """
    if interface is None:
        return "network as CYCLONEDDS_URI says"
    over = " (CYCLONEDDS_URI is passed over)" if os.environ.get("CYCLONEDDS_URI") else ""
    if interface == "any":
        return f"all interfaces{over}: whoever reaches this machine can send to it"
    open_ports = "" if kept else ", but its UDP ports are open on all: shut the others with a firewall"
    return f"interface {interface}{open_ports}{over}"


@contextmanager
def stopped() -> Generator[list[int]]:
    """A list that is empty until a signal to stop comes; a second one stops at once."""
    signals: list[int] = []

    def stop(number: int, _: object) -> None:
        if signals:
            raise KeyboardInterrupt
        signals.append(number)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
