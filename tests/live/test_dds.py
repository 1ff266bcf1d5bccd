import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from echogrid.errors import UsageError
from peers.fastdds import peer

participant = pytest.importorskip("echogrid.live.participant", reason="found no cyclonedds")

LISTEN = Path(__file__).parents[1] / "peers" / "listen.py"
needs_peer = pytest.mark.skipif(peer.missing() is not None, reason=f"Fast DDS peer: {peer.missing()}")


@pytest.mark.parametrize("name", ["", "map", "/", "/a//b", "/1a", "/a b", "/a/", "/ä", "/" + "a" * 300])
def test_a_name_that_is_none_of_ros_is_an_error(name):
    with pytest.raises(UsageError, match=r"live: found the topic .*, expected a name such as"):
        participant.dds_topic(name)


def test_an_interface_that_is_not_there_is_an_error():
    with pytest.raises(UsageError, match=r"live: found no interface 'wlan77', expected any or one of .*lo"):
        participant.configuration("wlan77")


def test_loopback_is_the_only_interface_in_its_configuration():
    text = participant.configuration("lo")
    assert text.count("<NetworkInterface ") == 1
    assert 'name="lo"' in text


def test_any_means_all_interfaces_and_loopback_where_there_is_none_else(monkeypatch):
    for names, expected in ((["lo", "eth0", "wlan0"], ["eth0", "wlan0"]), (["lo"], ["lo"])):
        monkeypatch.setattr("socket.if_nameindex", lambda names=names: list(enumerate(names)))
        text = participant.configuration("any")
        assert re.findall(r'name="(\w+)"', text) == expected


@pytest.fixture(scope="module")
def robot_program():
    return peer.build()


@pytest.fixture(scope="module")
def network():
    with peer.namespace() as made:
        yield made


@needs_peer
def test_ranges_of_both_releases_and_of_both_reliabilities_are_heard_and_other_types_are_not(network, robot_program):
    listener = network.start(sys.executable, LISTEN, 7, "lo", stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert listener.stdout is not None
    assert listener.stdout.readline() == "ready\n"
    robots = []
    for name, options in (("old", []), ("new", ["variance"]), ("sure", ["reliable"])):
        lines = ["static 0.0 base_link s 1 0 0 0 0 0 1"] if name == "old" else []
        lines += [f"range {name} 5.0 s 0.4 0.1 4 nan", "matched 1"]
        lines += [f"range {name} {5 + i}.5 s 0.4 0.1 4 1.25" for i in range(5)]
        lines += [f"text {name}_text hello"]
        robot = network.start(robot_program, 7, *options, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        assert robot.stdin is not None
        robot.stdin.write("\n".join([*lines, "at 0", "at 2"]) + "\n")
        robot.stdin.close()
        robots.append(robot)
    for robot in robots:
        assert robot.wait(60) == 0
    said, _ = listener.communicate(timeout=30)
    said = json.loads(said)
    heard = [tuple(one) for one in said["heard"]]
    for name in ("old", "new", "sure"):
        assert heard.count((f"/{name}", "Range", 1.25)) == 5
    assert ("/tf_static", "TFMessage", None) in heard
    assert {topic for topic, _, _ in heard} == {"/old", "/new", "/sure", "/tf_static"}
    assert said["senders"] == said["sources"] == 4  # writers are told apart, each stays the same
    assert said["refused"] == {}
    assert said["kept"]


@needs_peer
@pytest.mark.parametrize(("interface", "expected"), [("named", {"/named"}), ("any", {"/named", "/other"})])
def test_robots_on_other_machines_are_heard_through_the_interface_that_is_named(
    machines, robot_program, interface, expected
):
    here, behind = machines
    listener = here.start(sys.executable, LISTEN, 7, interface, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert listener.stdout.readline() == "ready\n"
    robots = {}
    for number, (name, there) in enumerate(behind.items(), 1):
        # Who is not to be heard does not wait to be.
        lines = [f"range {name} 5.0 s 0.4 0.1 4 nan", *(["matched 1"] if f"/{name}" in expected else [])]
        lines += [f"range {name} {5 + i}.5 s 0.4 0.1 4 1.25" for i in range(5)]
        words = (robot_program, 7, f"on=10.1.{number}.2")
        robots[name] = here.start(*there, *words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        robots[name].stdin.write("\n".join([*lines, "at 0", "at 1.5"]) + "\n")
        robots[name].stdin.close()
    for robot in robots.values():
        assert robot.wait(30) == 0
    said, _ = listener.communicate(timeout=20)
    said = json.loads(said)
    assert {topic for topic, _, value in said["heard"] if value == 1.25} == expected
    assert said["kept"] == (interface == "named")
