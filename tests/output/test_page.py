"""The page of a map: what it holds is what was mapped."""

import base64
import json
import os
import re
import zlib

import numpy as np
import pytest

from echogrid.cli import main
from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.grid import P_MIN, Grid
from echogrid.output import page
from echogrid.output.map_file import read_map
from echogrid.output.page import Page, write_page
from echogrid.output.recording import Recording
from echogrid.robot import Robot
from page_samples import P_STEP, ROBOT, a_frame, a_grid, a_recording, part_of


class Decoded:
    """What a page holds, unpacked by another way than the page does it."""

    def __init__(self, file):
        text = file.read_text(encoding="utf-8")
        (facts,) = re.findall(r'id="facts">(.*?)</script>', text, re.DOTALL)
        (packed,) = re.findall(r'id="packed">(.*?)</script>', text)
        self.facts, packed = json.loads(facts), zlib.decompress(base64.b64decode(packed))
        self.arrays = {
            name: np.frombuffer(packed, "<" + kind, count, first)
            for name, (kind, first, count) in self.facts["arrays"].items()
        }

    def maps(self):
        """Codes after each step."""
        codes, at = np.zeros((self.facts["rows"], self.facts["cols"]), np.uint8), 0
        for step in self.facts["steps"]:
            rows, cols = step["rows"], step["cols"]
            change = self.arrays["steps"][at : at + rows * cols].reshape(rows, cols)
            codes[step["row"] : step["row"] + rows, step["col"] : step["col"] + cols] += change
            at += rows * cols
            yield step["scans"], codes.copy()
        assert at == self.arrays["steps"].size

    def codes_at(self, codes, points):
        """Codes of the cells that hold points of the world; 0 outside."""
        cells = np.floor((points - self.facts["origin"]) / self.facts["resolution"] + 1e-6).astype(int)
        inside = ((cells >= 0) & (cells < [self.facts["cols"], self.facts["rows"]])).all(axis=-1)
        col, row = np.where(inside[..., None], cells, 0).T
        return np.where(inside, codes[row, col], 0)


def centres(grid):
    return grid.centre_of(np.argwhere(np.ones(grid.shape, bool)))


def same_map(decoded, codes, grid, within=0.51 * P_STEP):
    points = centres(grid)
    found = decoded.codes_at(codes, points)
    np.testing.assert_array_equal(found > 0, grid.observed.ravel())
    p = P_MIN + P_STEP * (found - 1.0)
    np.testing.assert_allclose(p[found > 0], grid.probability_at(points)[found > 0], atol=within)


def test_the_page_holds_the_final_map_and_its_views(tmp_path):
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "a map")
    decoded = Decoded(tmp_path / "map.html")
    *_, (scans, codes) = decoded.maps()
    assert scans == 40
    same_map(decoded, codes, grid)
    views = np.cumsum(decoded.arrays["views"].reshape(codes.shape), axis=1, dtype=decoded.arrays["views"].dtype)
    np.testing.assert_array_equal(decoded.codes_at(views, centres(grid)), grid.views.ravel())


def test_the_page_holds_the_map_at_each_time_it_was_kept(tmp_path):
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "a map")
    decoded = Decoded(tmp_path / "map.html")
    maps = list(decoded.maps())
    assert [scans for scans, _ in maps] == [10, 20, 30, 40]
    for scans, codes in maps[:-1]:
        then = part_of(grid, 20 + 2 * (scans - 1))
        same_map(decoded, codes, then, within=(page.TOLERANCE + 0.51) * P_STEP)
        assert np.count_nonzero(codes) == np.count_nonzero(then.observed)


def test_a_map_that_changes_later_is_kept_as_it_was(tmp_path):
    grid, recording = a_grid(), Recording(ROBOT)
    recording.add(a_frame(0))
    then = Grid(grid.log_odds.copy(), grid.observed.copy(), grid.resolution, grid.origin)
    recording.keep(grid)
    recording.add(a_frame(1))
    grid.log_odds[:], grid.observed[:] = -1, True
    write_page(tmp_path / "map.html", grid, recording, "")
    decoded = Decoded(tmp_path / "map.html")
    (_, first), (_, last) = decoded.maps()
    same_map(decoded, first, then)
    same_map(decoded, last, grid)


def test_the_page_holds_the_drive(tmp_path):
    recording = Recording(ROBOT)
    other = np.array([[0.15, 0.01, 0.2], [0.0, -0.1, -3.0]])
    frames = [a_frame(k, other if k == 3 else None) for k in range(9)]
    frames[5] = Frame(frames[5].stamp, frames[5].pose, np.array([np.nan, 3.999]))
    for frame in frames:
        recording.add(frame)
    write_page(tmp_path / "map.html", a_grid(), recording, "")
    decoded = Decoded(tmp_path / "map.html")
    units, arrays = decoded.facts["units"], decoded.arrays
    summed = {name: np.cumsum(arrays[name]) for name in ("number", "time", "x", "y", "theta")}
    np.testing.assert_array_equal(summed["number"], np.arange(1, 10))
    np.testing.assert_allclose(summed["time"] * units["time"], [f.stamp - 100 for f in frames], atol=5.1e-4)
    for k, name in enumerate(("x", "y")):
        place = summed[name] * units["place"] + decoded.facts["first"][k]
        np.testing.assert_allclose(place, [f.pose[k] for f in frames], atol=1e-4)
    turn = summed["theta"] * units["angle"] - [f.pose[2] for f in frames]
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-8)
    ranges = arrays["ranges"].reshape(9, 2)
    np.testing.assert_array_equal(ranges[:3], [[1000 + k, page.NO_ECHO] for k in range(3)])
    np.testing.assert_array_equal(ranges[5], [page.NOT_FIRED, 3999])
    mounts = arrays["mounts"].reshape(9, 2, 3) * [1e-3, 1e-3, units["angle"]]
    np.testing.assert_allclose(mounts[2], ROBOT.mounts, atol=5.1e-4)
    np.testing.assert_allclose(mounts[3], other, atol=5.1e-4)


def test_far_places_and_long_times_fit_their_integers(tmp_path):
    recording = Recording(ROBOT)
    for stamp, x in ((0.0, -9e6), (9e10, 9e6)):
        recording.add(Frame(stamp, np.array([x, 0.0, 0.0]), np.array([99.0, 0.3])))
    write_page(tmp_path / "map.html", a_grid(origin=(9e6, 0.0)), recording, "")
    decoded = Decoded(tmp_path / "map.html")
    units, arrays = decoded.facts["units"], decoded.arrays
    np.testing.assert_allclose(np.cumsum(arrays["time"])[-1] * units["time"], 9e10, rtol=1e-8)
    np.testing.assert_allclose(np.cumsum(arrays["x"])[-1] * units["place"], 18e6, rtol=1e-8)
    np.testing.assert_allclose(arrays["ranges"] * units["range"], [99, 0.3, 99, 0.3], atol=1e-3)


def test_a_thousand_scans_in_a_room_stay_below_a_megabyte(tmp_path):
    """A map of 10 x 8 m in cells of 4 cm, kept as often as can be, all of it changing each time."""
    robot = Robot.load("b21")
    recording, rng = Recording(robot), np.random.default_rng(0)
    y, x = np.mgrid[0:200, 0:250] * 0.04
    walls = np.minimum.reduce([abs(x - 1.5), abs(x - 8.5), abs(y - 1.5), abs(y - 6.5)])
    wanted = np.where(walls < 0.1, 3, np.where((abs(x - 5) < 3.5) & (abs(y - 4) < 2.5), -3, 0.3 * np.sin(5 * x * y)))
    log_odds, observed, views = (
        np.zeros_like(wanted, np.float32),
        np.zeros(wanted.shape, bool),
        np.zeros(wanted.shape, int),
    )
    for k in range(1000):
        pose = np.array([5 + 2.4 * np.sin(k / 80), 4 + 1.5 * np.cos(k / 50), rng.normal()])
        ranges = np.where(rng.random(24) < 0.4, np.inf, rng.uniform(0.2, 5, 24))
        recording.add(Frame(0.2 * k, pose, ranges))
        near = np.hypot(x - pose[0], y - pose[1]) < 2.5
        observed |= near
        views += near
        log_odds[near] += (0.02 * wanted[near] * rng.uniform(0.5, 1.5, np.count_nonzero(near))).astype(np.float32)
        if k % 17 == 16:
            recording.keep(Grid(log_odds, observed, 0.04, (0.0, 0.0)))
    write_page(tmp_path / "map.html", Grid(log_odds, observed, 0.04, (0.0, 0.0), views), recording, "")
    assert len(recording.maps()) == 58
    assert (tmp_path / "map.html").stat().st_size < 1_000_000


def test_a_large_map_is_shown_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_IMAGE_CELLS", 1000)
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "")
    decoded = Decoded(tmp_path / "map.html")
    block = decoded.facts["block"]
    *_, (_, codes) = decoded.maps()
    assert block == 3
    assert codes.size <= 1000
    for row, col in ((0, 0), (4, 7), (10, 20)):
        cells = np.s_[5 + block * row : 5 + block * (row + 1), 3 + block * col : 3 + block * (col + 1)]
        p = np.where(grid.observed, grid.probability(), 0)[cells].max()
        assert P_MIN + P_STEP * (codes[row, col] - 1) == pytest.approx(p, abs=0.51 * P_STEP)
        views = np.cumsum(decoded.arrays["views"].reshape(codes.shape), axis=1, dtype=np.uint32)
        assert views[row, col] == grid.views[cells].max()


def test_too_many_changes_cost_maps_on_the_way_not_the_last(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_CHANGES", 6000)
    grid, recording = a_grid(), Recording(ROBOT)
    for k in range(8):
        recording.add(a_frame(k))
        recording.keep(a_grid(seed=k + 1))
    recording.add(a_frame(9))
    write_page(tmp_path / "map.html", grid, recording, "")
    decoded = Decoded(tmp_path / "map.html")
    maps = list(decoded.maps())
    assert len(maps) == 2
    same_map(decoded, maps[-1][1], grid)


def test_a_page_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "map.html"
    file.write_text("old")
    with pytest.raises(UsageError, match="page: found no frames"):
        write_page(file, a_grid(), Recording(ROBOT), "")
    other = a_recording(12, a_grid(resolution=0.2))
    with pytest.raises(UsageError, match=r"page: found maps of other cells than 0\.1 m, expected one size"):
        write_page(file, a_grid(), other, "")
    assert [each.read_text() for each in tmp_path.iterdir()] == ["old"]
    Page(file, ROBOT, "new").add(a_frame(0))
    write_page(file, a_grid(), a_recording(), "new")
    assert "<h1>new</h1>" in file.read_text()
    assert os.listdir(tmp_path) == ["map.html"]


def test_nothing_observed_and_a_name_that_is_no_text_make_a_page(tmp_path):
    grid = a_grid(4, 5)
    blank = Grid(np.zeros_like(grid.log_odds), np.zeros_like(grid.observed), grid.resolution, grid.origin)
    write_page(tmp_path / "map.html", blank, a_recording(3), "log \udcff.csv")
    decoded = Decoded(tmp_path / "map.html")
    ((_, codes),) = decoded.maps()
    assert not codes.any()
    assert "views" not in decoded.arrays


def test_the_command_writes_the_page(tmp_path):
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text("t,x,y,theta," + ",".join(f"r{k}" for k in range(24)) + "\n" + "1,0,0,0" + ",1.5" * 24 + "\n")
    main(["map", str(log), "--robot", "b21", "--interpreter", "cone", "--out", str(out), "--view"])
    decoded, grid = Decoded(out / "map.html"), read_map(out)
    *_, (scans, codes) = decoded.maps()
    assert scans == 1
    same_map(decoded, codes, grid)
    assert "<h1>log.csv, b21, cone</h1>" in (out / "map.html").read_text()


def test_the_page_names_no_other_place(tmp_path):
    write_page(tmp_path / "map.html", a_grid(), a_recording(), "a map")
    text = re.sub(r"""id="packed">[^<]*|'sha256-[^']*'""", "", (tmp_path / "map.html").read_text())
    assert (
        re.findall(r"(?i)https?:|//[a-z]|@import|url\(|sourceMappingURL|<link(?! rel=.icon. href=.data:)", text) == []
    )
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy == "default-src 'none'; script-src ; style-src ; img-src data:; base-uri 'none'; form-action 'none'"
