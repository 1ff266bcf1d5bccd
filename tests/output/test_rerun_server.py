"""Rerun is shown to nobody but this machine."""

import http.client
import http.server
import json
import os
import sys
import threading
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.output import rerun_server
from echogrid.output.rerun_file import Viewing
from echogrid.output.rerun_server import served
from echogrid.robot import Robot
from map_samples import a_grid

ROBOT = Robot.load("b21")
with_rerun = pytest.mark.skipif(find_spec("rerun") is None, reason="needs the extra viewer")


# Without Rerun, and with one that we do not know.


def test_without_rerun_the_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=r"^--rerun: found no rerun, expected it: pip install 'echogrid\[viewer\]'$"):
        Viewing(tmp_path / "map.rrd", ROBOT)
    with pytest.raises(UsageError, match="found no rerun"), served(tmp_path / "map.rrd"):
        pytest.fail("the block must not run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "off"),
    [
        ('{"analytics_enabled": false}', True),
        ('{"analytics_enabled": true}', False),
        ("{}", False),
        ("[]", False),
        ("not JSON", False),
        (None, False),
    ],
)
def test_analytics_count_as_off_only_where_their_file_says_so(tmp_path, content, off):
    if content is not None:
        (tmp_path / "rerun").mkdir()
        (tmp_path / "rerun" / "analytics.json").write_text(content)
    assert rerun_server._analytics_are_off(tmp_path) is off


def test_an_rerun_whose_analytics_cannot_be_turned_off_is_not_started(tmp_path, monkeypatch):
    monkeypatch.setattr("echogrid.extras.find_spec", lambda _: True)
    monkeypatch.setattr(rerun_server.sys, "executable", "/bin/true")
    monkeypatch.setattr(rerun_server.subprocess, "Popen", lambda *_, **__: pytest.fail("must not start"))
    monkeypatch.setattr(rerun_server.subprocess, "run", lambda *_, **__: None)
    with pytest.raises(UsageError, match="no way to turn off the analytics"), served(tmp_path / "map.rrd"):
        pytest.fail("the block must not run")


# The page that is passed on.


class Behind(http.server.BaseHTTPRequestHandler):
    """A page that asks strangers for things, as Rerun's does."""

    PAGES = {  # noqa: RUF012
        "/": (
            "text/html",
            b'<link rel="preconnect" href="https://strange.example" /><link\n href="https://a.b">ours',
        ),
        "/code.wasm": ("application/wasm", bytes(range(256)) * 1000),
    }

    def do_GET(self):
        kind, body = self.PAGES.get(self.path, ("text/plain", b"none"))
        self.send_response(200 if self.path in self.PAGES else 404)
        self.send_header("Content-Type", kind)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format, *args):  # noqa: A002
        pass


@pytest.fixture(scope="module")
def page():
    """Ports of the page behind, and of ours that passes it on."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Behind) as behind:
        handler = rerun_server._handler(behind.server_port, 5555)
        with rerun_server._Page(("127.0.0.1", 0), handler) as ours:
            for server in (behind, ours):
                threading.Thread(target=server.serve_forever, daemon=True).start()
            yield ours.server_port
            ours.shutdown()
            behind.shutdown()


def get(port, path):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_the_page_is_passed_on_without_links_to_strangers(page):
    answer, body = get(page, "/")
    assert (answer.status, body) == (200, b"ours")
    answer, body = get(page, "/code.wasm")
    assert (answer.headers["Content-Type"], body) == ("application/wasm", bytes(range(256)) * 1000)
    assert get(page, "/none")[0].status == 404


@pytest.mark.parametrize("path", ["/", "/code.wasm", "/none"])
def test_the_page_may_speak_to_this_machine_alone(page, path):
    policy = get(page, path)[0].headers["Content-Security-Policy"]
    rules = {name: set(sources) for name, *sources in (rule.split() for rule in policy.split(";"))}
    assert rules["connect-src"] == {"'self'", "blob:", "data:", "http://127.0.0.1:5555"}
    assert not {source for source in rules["default-src"] if "/" in source or "*" in source or "http" in source}
    assert set(rules) == {"default-src", "connect-src", "form-action", "base-uri"}


def test_a_page_that_has_gone_is_a_bad_gateway():
    with rerun_server._Page(("127.0.0.1", 0), rerun_server._handler(rerun_server._free_port(0), 1)) as ours:
        threading.Thread(target=ours.serve_forever, daemon=True).start()
        assert get(ours.server_port, "/")[0].status == 502
        ours.shutdown()


def test_a_port_in_use_is_passed_over():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Behind) as taken:
        assert rerun_server._free_port(taken.server_port) != taken.server_port
    assert rerun_server._free_port(0) > 0


# With Rerun itself.


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("rerun") / "map.rrd"
    with Viewing(path, ROBOT) as viewing:
        viewing.add(Frame(0.0, np.zeros(3), np.ones(ROBOT.sonars)))
        viewing.finish(a_grid())
    return path


def listening(group):
    """Address and port, as the kernel writes them, of all on which this process or a group of processes listens."""
    sockets = set()
    for process in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            pid = int(process.name)
            if pid == os.getpid() or os.getpgid(pid) == group:
                for file in (process / "fd").iterdir():
                    with suppress(FileNotFoundError):
                        sockets.add(os.readlink(file))
    places = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *_, inode = line.split()[:10]
            if state == "0A" and f"socket:[{inode}]" in sockets:
                address, port = local.split(":")
                places.add((address, int(port, 16)))
    return places


@with_rerun
def test_rerun_listens_on_this_machine_alone_and_ends_with_the_block(recording, tmp_path, monkeypatch):
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "TMPDIR"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setattr(rerun_server, "TemporaryDirectory", lambda prefix: _Folder(tmp_path / "own"))
    before = listening(None)
    with served(recording) as shown:
        group = shown._process.pid
        new = listening(group) - before
        assert {address for address, _ in new} == {"0100007F"}  # 127.0.0.1
        port = int(shown.address.removeprefix("http://127.0.0.1:").split("/")[0])
        data = int(shown.address.split("%3A")[-1].removesuffix("%2Fproxy"))
        assert len(new) == 3  # the page, the page behind it, and the recording
        assert {port, data} < {port for _, port in new}
        answer, body = get(port, "/")
        assert answer.status == 200
        assert b"re_viewer.js" in body
        assert get(port, "/re_viewer.js")[0].headers["Content-Type"] == "text/javascript"
        settings_ = json.loads((tmp_path / "own" / "rerun" / "analytics.json").read_text())
        assert settings_["analytics_enabled"] is False
    assert listening(group) == before
    assert os.listdir(tmp_path) == ["own"]


class _Folder:
    """A temporary folder that stays to be looked at."""

    def __init__(self, path):
        self.path = path

    def __enter__(self):
        self.path.mkdir()
        return str(self.path)

    def __exit__(self, *_):
        pass


@with_rerun
def test_a_recording_that_is_none_is_one_clear_line(tmp_path):
    with pytest.raises(UsageError, match="rerun does not start") as error, served(tmp_path / "none.rrd"):
        pytest.fail("the block must not run")
    assert "\n" not in str(error.value)
