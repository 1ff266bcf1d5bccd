import subprocess
import time

import pytest

from echogrid.live import live_map
from echogrid.live.live_map import Settings
from echogrid.live.session import Live
from live_drive import NETWORK, Drive, Recorder
from peers.fastdds import peer


@pytest.fixture
def recorded(monkeypatch):
    monkeypatch.setattr(live_map, "Mapper", Recorder)


@pytest.fixture
def live(recorded):
    return Live(NETWORK, Settings())


@pytest.fixture
def drive(live):
    return Drive(live)


@pytest.fixture
def machines():
    """A machine with two cables, ``named`` and ``other``, and how to run a command on the machine behind each."""
    with peer.namespace() as here:
        behind = {}
        for number, name in enumerate(("named", "other"), 1):
            # A network inside of the first one's user namespace, which may then join the two.
            script = "ip link set lo up; echo ready; exec sleep 600"
            holder = here.start("unshare", "-n", "sh", "-c", script, stdout=subprocess.PIPE)
            assert holder.stdout is not None
            assert holder.stdout.readline() == "ready\n"
            there = behind[name] = ("nsenter", f"--target={holder.pid}", "--net")
            here.output("ip", "link", "add", name, "type", "veth", "peer", "name", "cable", "netns", holder.pid)
            for where, end, host in (((), name, 1), (there, "cable", 2)):
                here.output(*where, "ip", "addr", "add", f"10.1.{number}.{host}/24", "dev", end)
                here.output(*where, "ip", "link", "set", end, "up")
            # DDS passes over an interface on which the kernel has not yet noticed the other end.
            for where, end in (((), name), (there, "cable")):
                wait_until(lambda where=where, end=end: "state UP" in here.output(*where, "ip", "link", "show", end))
        yield here, behind


def wait_until(done, seconds=10):
    limit = time.monotonic() + seconds
    while not done():
        assert time.monotonic() < limit
        time.sleep(0.02)
