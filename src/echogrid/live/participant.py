"""A participant of DDS (Cyclone DDS) in a domain of ROS 2, which keeps to the interface that was named.

What DDS exposes. A participant of DDS opens UDP ports: 7400 + 250 * domain for multicast discovery, the next but one
or so for unicast discovery and data. Nothing of what comes in is authenticated and nothing that goes out is
encrypted: whoever can send to these ports can publish whatever is listened to, and whoever listens can read what is
sent. So it keeps to loopback unless another interface is named.

Cyclone DDS binds its sockets to the address 0.0.0.0 whatever interface its configuration names. On Linux they are
therefore tied to loopback here (SO_BINDTODEVICE), or, where another interface is named, the kernel is let drop what
comes in through any but that and loopback (SO_ATTACH_FILTER), for the robot's own programs talk through both.
Elsewhere than on Linux a firewall has to do this, and ``Joined.kept`` is False.

The names are those by which ROS 2 puts its topics on DDS: ``/map`` is ``rt/map``.
"""

import re
import socket
from typing import NamedTuple

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.internal import DDS

from echogrid.errors import UsageError
from echogrid.live.sockets import keep_to, open_sockets

_MAX_SAMPLE_BYTES = 64 * 1024 * 1024
"""What Cyclone DDS takes or sends at most, a map among it."""

_LOG_FATAL, _MULTICAST = 1, ' multicast="true"'


STREAM_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=0), Policy.Durability.Volatile, Policy.History.KeepLast(100)
)
"""To send what goes on being sent, as tf2 sends /tf; readers that ask for less match as well."""

KEPT_QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=100_000_000),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
)
"""To send /map, /amcl_pose and /tf_static: who comes late gets the last one."""


class Joined(NamedTuple):
    """A domain that was joined."""

    participant: DomainParticipant
    kept: bool
    """Whether the kernel lets nothing in but through the interface that was named."""
    domain: Domain
    """It lives as long as it is held."""


def dds_topic(name: str, who: str = "live") -> str:
    """The name on DDS of a topic of ROS 2; ``who`` speaks where it is none.

    Raises:
        UsageError: no such name is allowed.
    """
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", name) or len(name) > 200:
        raise UsageError(f"{who}: found the topic {name!r}, expected a name such as /sonar/front")
    return f"rt{name}"


def configuration(interface: str, who: str = "live") -> str:
    """The configuration of Cyclone DDS (XML) that keeps to an interface; ``any``: all that are there.

    Raises:
        UsageError: no such interface.
    """
    names = [name for _, name in socket.if_nameindex()]
    if interface == "any":
        # Whatever is up; its own programs are reached through any of them, and through loopback where it is alone.
        chosen = [name for name in names if name != "lo"] or names
    elif interface in names:
        chosen = [interface]
    else:
        raise UsageError(f"{who}: found no interface {interface!r}, expected any or one of {', '.join(names)}")
    required = "false" if interface == "any" else "true"
    listed = "".join(
        # Loopback can multicast, though its flags do not say so.
        f'<NetworkInterface name="{name}" presence_required="{required}"{_MULTICAST if name == "lo" else ""}/>'
        for name in chosen
    )
    return (
        f'<CycloneDDS><Domain Id="any"><General><Interfaces>{listed}</Interfaces></General>'
        f"<Internal><MaxSampleSize>{_MAX_SAMPLE_BYTES}B</MaxSampleSize></Internal></Domain></CycloneDDS>"
    )


def joined(domain: int, interface: str | None, who: str = "live") -> Joined:
    """Join a domain.

    Args:
        domain: its number.
        interface: name of a network interface, or ``any``; None: what the configuration in CYCLONEDDS_URI says.
        who: speaks where that cannot be.

    Raises:
        UsageError: there is no such interface, or DDS cannot be started.
    """
    before, kept = open_sockets(), False
    try:
        # None leaves it to Cyclone DDS, which looks at CYCLONEDDS_URI.
        held = Domain(domain, None if interface is None else configuration(interface, who))
        if interface is not None and interface != "any":
            kept = keep_to(interface, open_sockets() - before)
        participant = DomainParticipant(domain)
        if interface is not None:
            # Each message of a stranger that Cyclone DDS cannot read would be a line on stderr.
            DDS._dll_handle.dds_set_log_mask(_LOG_FATAL)
    except DDSException as error:
        found = f"DDS that does not start ({error})"
        raise UsageError(f"{who}: found {found}, expected a domain of 0 to 232 and an interface that is up") from None
    return Joined(participant, kept, held)
