import subprocess
import sys

import pytest

from peers.fastdds import peer

needs_peer = pytest.mark.skipif(peer.missing() is not None, reason=f"Fast DDS peer: {peer.missing()}")


@needs_peer
def test_the_kernel_drops_what_comes_through_an_interface_that_was_not_named(machines, tmp_path):
    here, behind = machines
    script = tmp_path / "filter.py"
    script.write_text(
        "import socket, sys\n"
        "from echogrid.live.sockets import _only_from\n"
        "s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\n"
        "s.bind(('0.0.0.0', 7777))\n"
        "_only_from(s, [socket.if_nametoindex(name) for name in ('lo', 'named')])\n"
        "print('ready', flush=True)\n"
        "socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'own', ('127.0.0.1', 7777))\n"
        "sys.stdin.readline()\n"
        "s.settimeout(0.5)\n"
        "try:\n"
        "    while True:\n"
        "        print(s.recv(100).decode(), flush=True)\n"
        "except TimeoutError:\n"
        "    pass\n"
    )
    send = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b'{}', ('{}', 7777))"
    listener = here.start(sys.executable, script, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert listener.stdout.readline() == "ready\n"
    for name, address in (("other", "10.1.2.1"), ("named", "10.1.1.1")):
        here.output(*behind[name], sys.executable, "-c", send.format(name, address))
    said, _ = listener.communicate("go\n", timeout=20)
    assert said.split() == ["own", "named"]
