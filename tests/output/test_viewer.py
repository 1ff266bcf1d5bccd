"""What Rerun is given of a drive, and that it is shown to nobody but this machine."""

import http.client
import http.server
import json
import os
import threading
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.grid import Grid
from echogrid.output import viewer
from echogrid.output.viewer import LOCAL_M, SILENT_M, Viewing, around, served
from echogrid.robot import Robot

ROBOT = Robot.load("b21")
with_rerun = pytest.mark.skipif(find_spec("rerun") is None, reason="needs the extra viewer")


def a_grid(rows=50, cols=70, resolution=0.12, origin=(-1.5, 2.25)):
    rng = np.random.default_rng(0)
    observed = rng.random((rows, cols)) < 0.7
    log_odds = np.where(observed, rng.normal(0, 3, (rows, cols)), 0).astype(np.float32)
    return Grid(log_odds, observed, resolution, origin)


def a_drive(count=40):
    rng = np.random.default_rng(0)
    for i in range(count):
        ranges = rng.uniform(0.3, 4.0, ROBOT.sonars)
        ranges[i % ROBOT.sonars] = np.inf
        ranges[(i + 5) % ROBOT.sonars] = np.nan
        yield Frame(100.0 + 0.2 * i, np.array([0.1 * i, 3.0, 0.05 * i]), ranges)


# What is drawn.


@given(
    st.tuples(st.floats(-12, 12), st.floats(-12, 12)),
    st.floats(0.1, 9.0),
    st.tuples(st.integers(1, 40), st.integers(1, 40)),
)
@settings(max_examples=100)
def test_the_map_round_a_point_says_what_the_map_says_there(point, side, shape):
    grid = a_grid(*shape)
    part = around(grid, np.array(point), side)
    assert part.shape[0] * part.resolution == pytest.approx(side, abs=part.resolution)
    rows, cols = part.shape
    middle = np.array([[row, col] for row in range(rows) for col in range(cols)])
    np.testing.assert_allclose(part.probability().ravel(), grid.probability_at(part.centre_of(middle)), atol=1e-6)
    low, high = part.origin, np.array(part.origin) + side
    assert (np.abs((np.array(low) + high) / 2 - point) <= part.resolution).all()
    assert np.count_nonzero(part.observed) <= np.count_nonzero(grid.observed)


def test_the_first_row_of_the_picture_is_the_highest_y_and_black_is_occupied():
    log_odds = np.array([[-9.0, 9.0], [0.0, 9.0]], dtype=np.float32)
    grid = Grid(log_odds, np.array([[True, True], [True, False]]), 1.0, (0.0, 0.0))
    assert viewer._greys(grid).tolist() == [[128, 128], [250, 5]]


@given(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)), st.booleans())
@settings(max_examples=50)
def test_a_cone_begins_at_its_sonar_and_ends_at_its_reading(pose, elsewhere):
    ranges = np.linspace(0.5, 4.5, ROBOT.sonars)
    ranges[[3, 5]] = np.nan, np.inf
    mounts = ROBOT.mounts + 0.05 if elsewhere else ROBOT.mounts
    frame = Frame(0.0, np.array(pose), ranges, mounts=mounts if elsewhere else None)
    cones = viewer._cones(frame, ROBOT)
    fired = np.flatnonzero(~np.isnan(ranges))
    assert len(cones) == len(fired)
    x, y, theta = pose
    for line, i in zip(cones, fired, strict=True):
        mx, my, axis = mounts[i]
        sonar = np.array([x + np.cos(theta) * mx - np.sin(theta) * my, y + np.sin(theta) * mx + np.cos(theta) * my])
        np.testing.assert_allclose(line[[0, -1]], [sonar, sonar], atol=1e-9)
        arc = line[1:-1] - sonar
        np.testing.assert_allclose(np.hypot(*arc.T), SILENT_M if i == 5 else ranges[i], rtol=1e-9)
        off = wrap(np.arctan2(arc[:, 1], arc[:, 0]) - theta - axis)
        assert (off.min(), off.max()) == pytest.approx((-ROBOT.beam_width_rad / 2, ROBOT.beam_width_rad / 2))


# Without Rerun, and with one that we do not know.


def test_without_rerun_the_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "find_spec", lambda _: None)
    with pytest.raises(UsageError, match=r"--rerun: found no rerun, expected .*pip install 'echogrid\[viewer\]'"):
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
    assert viewer._analytics_are_off(tmp_path) is off


def test_an_rerun_whose_analytics_cannot_be_turned_off_is_not_started(tmp_path, monkeypatch):
    monkeypatch.setattr(viewer, "find_spec", lambda _: True)
    monkeypatch.setattr(viewer.sys, "executable", "/bin/true")
    monkeypatch.setattr(viewer.subprocess, "Popen", lambda *_, **__: pytest.fail("must not start"))
    monkeypatch.setattr(viewer.subprocess, "run", lambda *_, **__: None)
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
        handler = viewer._handler(behind.server_port, 5555)
        with viewer._Page(("127.0.0.1", 0), handler) as ours:
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
    with viewer._Page(("127.0.0.1", 0), viewer._handler(viewer._free_port(0), 1)) as ours:
        threading.Thread(target=ours.serve_forever, daemon=True).start()
        assert get(ours.server_port, "/")[0].status == 502
        ours.shutdown()


def test_a_port_in_use_is_passed_over():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Behind) as taken:
        assert viewer._free_port(taken.server_port) != taken.server_port
    assert viewer._free_port(0) > 0


# With Rerun itself.


def record(path, frames):
    with Viewing(path, ROBOT) as viewing:
        for i, frame in enumerate(frames):
            viewing.add(frame)
            if i % 10 == 9:
                viewing.keep(a_grid())
        viewing.finish(a_grid(resolution=0.2))
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return record(tmp_path_factory.mktemp("rerun") / "map.rrd", a_drive())


def columns(path, entity):
    """All rows of an entity, each a mapping of columns, by Rerun's own reader."""
    rows = []
    for chunk in import_module("rerun.chunk").RrdReader(path).stream():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            names = [name for name in batch.schema.names if name != "log_time"]
            # Python has no nanoseconds.
            values = (batch[name].cast("int64") if name == "drive" else batch[name] for name in names)
            rows += [dict(zip(names, row, strict=True)) for row in zip(*(v.to_pylist() for v in values), strict=True)]
    return rows


@with_rerun
def test_each_frame_is_in_the_recording(recording):
    frames = list(a_drive())
    for view in ("world", "local"):
        rows = columns(recording, f"/{view}/robot")
        assert [row["scan"] for row in rows] == list(range(1, len(frames) + 1))
        assert [row["drive"] * 1e-9 for row in rows] == pytest.approx(0.2 * np.arange(len(frames)), abs=1e-6)
        for row, frame in zip(rows, frames, strict=True):
            _, (start, front) = row["LineStrips3D:strips"]
            assert start[:2] == pytest.approx(frame.pose[:2], abs=1e-5)
            ahead = frame.pose[:2] + ROBOT.footprint_radius_m * np.array(
                [np.cos(frame.pose[2]), np.sin(frame.pose[2])]
            )
            assert front[:2] == pytest.approx(ahead, abs=1e-5)
        rows = columns(recording, f"/{view}/cones")
        assert [len(row["LineStrips3D:strips"]) for row in rows] == [ROBOT.sonars - 1] * len(frames)
    (row,) = columns(recording, "/world/drive")
    assert len(row["LineStrips3D:strips"][0]) == len(frames)


@with_rerun
def test_both_maps_are_in_the_recording(recording):
    rows = columns(recording, "/world/map")
    assert [row["scan"] for row in rows] == [30, 40]  # the first at 5 s or later, and the finished one
    grid = a_grid(resolution=0.2)
    (data,), (cell,), (place,) = (rows[-1][f"GridMap:{name}"] for name in ("data", "cell_size", "translation"))
    np.testing.assert_array_equal(np.array(data).reshape(grid.shape), viewer._greys(grid))
    assert cell == pytest.approx(0.2)
    assert place == pytest.approx([*grid.origin, 0])
    rows = columns(recording, "/local/map")
    assert [row["scan"] for row in rows] == [11, 14, 17, 20, 23, 26, 29, 32, 35, 38, 40]
    pose = list(a_drive())[10].pose
    (data,), (place,) = (rows[0][f"GridMap:{name}"] for name in ("data", "translation"))
    assert np.array(place[:2]) + LOCAL_M / 2 == pytest.approx(pose[:2], abs=0.12)
    np.testing.assert_array_equal(data, viewer._greys(around(a_grid(), pose[:2], LOCAL_M)).ravel())


@with_rerun
def test_a_block_that_raises_leaves_no_recording(tmp_path):
    def frames():
        yield from a_drive(3)
        raise ZeroDivisionError

    (tmp_path / "map.rrd").write_bytes(b"old")
    with pytest.raises(ZeroDivisionError):
        record(tmp_path / "map.rrd", frames())
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"map.rrd": b"old"}
    with pytest.raises(UsageError, match=r"none/map\.rrd: found No such file"):
        record(tmp_path / "none" / "map.rrd", a_drive(1))


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
    monkeypatch.setattr(viewer, "TemporaryDirectory", lambda prefix: _Folder(tmp_path / "own"))
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
