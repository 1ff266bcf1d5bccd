"""Files of maps and truth grids: what is written is read, wrong input is one line, failure leaves nothing."""

import os
import re
from contextlib import suppress
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from scipy.ndimage import maximum_filter

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.files import replacing
from echogrid.grid import P_MAX, P_MIN, Grid, logit, sigmoid
from echogrid.metrics import Truth
from echogrid.output import mapfile
from echogrid.output.map_server import occupancy
from echogrid.output.mapfile import read_map, read_truth, write_map, write_truth

FILES = {"map.pgm", "map.yaml", "map.png", "map.npz", "run.yaml"}
PATH = np.array([[0.1, 0.1, 0.0], [0.4, 0.3, 0.1]])
NO_PATH = np.zeros((0, 3))

many = settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
few = settings(parent=many, max_examples=6)


def a_grid(rows=8, cols=11, resolution=0.12, origin=(-1.5, 2.25), seed=0):
    rng = np.random.default_rng(seed)
    observed = rng.random((rows, cols)) < 0.7
    log_odds = np.where(observed, rng.normal(0, 3, (rows, cols)), 0).astype(np.float32)
    return Grid(log_odds, observed, resolution, origin)


def one_wall(row, col, rows=20, cols=30, resolution=0.1, origin=(-1.0, 5.0)):
    """A grid that is free but for one occupied cell."""
    log_odds = np.full((rows, cols), -3, dtype=np.float32)
    log_odds[row, col] = 3
    return Grid(log_odds, np.ones((rows, cols), bool), resolution, origin)


def plain_pgm(content):
    """The header and the pixels of a PGM as we write it, by another way than the package reads it."""
    magic, size, white, pixels = content.split(b"\n", 3)
    assert (magic, white) == (b"P5", b"255")
    cols, rows = map(int, size.split())
    assert len(pixels) == rows * cols
    return [list(pixels[i * cols : (i + 1) * cols]) for i in range(rows)]


def everything_in(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def map_yaml(folder, content=b"P5\n2 1\n255\n\x00\xff", **changes):
    """A map_server pair, by default of one row of two pixels."""
    fields = {
        "image": "image.pgm",
        "resolution": 0.5,
        "origin": [0, 0, 0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | changes
    (folder / "image.pgm").write_bytes(content)
    (folder / "any.yaml").write_text(yaml.safe_dump({key: v for key, v in fields.items() if v is not None}))
    return folder / "any.yaml"


# What is written is read.


@given(
    arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(-30, 30, width=32)),
    st.floats(0.01, 2.0),
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
    st.data(),
)
@few
def test_a_map_that_is_written_is_read(tmp_path, log_odds, resolution, origin, data):
    observed = data.draw(arrays(bool, log_odds.shape))
    grid = Grid(log_odds, observed, resolution, origin)
    write_map(tmp_path, grid, PATH, {})
    for place in (tmp_path, tmp_path / "map.npz", str(tmp_path)):
        got = read_map(place)
        assert got.log_odds.dtype == np.float32
        np.testing.assert_allclose(got.probability(), grid.probability(), atol=1e-6)
        np.testing.assert_array_equal(got.observed, observed)
        assert (got.resolution, got.origin) == (resolution, origin)


def test_the_plain_sigmoid_of_the_npz_is_the_map_that_is_scored(tmp_path):
    grid = one_wall(3, 4)
    grid.log_odds[:] *= 100
    write_map(tmp_path, grid, PATH, {})
    with np.load(tmp_path / "map.npz") as arrays_:
        assert set(arrays_.files) == {"log_odds", "observed", "resolution", "origin"}
        assert (arrays_["log_odds"].dtype, arrays_["observed"].dtype) == (np.float32, bool)
        p = sigmoid(arrays_["log_odds"].astype(float))
        assert arrays_["resolution"] == 0.1
        assert tuple(arrays_["origin"]) == (-1.0, 5.0)
    np.testing.assert_allclose(p, grid.probability(), atol=1e-7)
    assert (p.min(), p.max()) == pytest.approx((P_MIN, P_MAX), abs=1e-7)


def test_log_odds_are_clipped_to_the_read_out_limits_and_no_further(tmp_path):
    grid = a_grid()
    write_map(tmp_path, grid, PATH, {})
    limit = float(logit(P_MAX))
    np.testing.assert_allclose(read_map(tmp_path).log_odds, np.clip(grid.log_odds, -limit, limit), rtol=1e-6)


@given(
    arrays(np.int8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 2)),
    st.floats(0.01, 2.0),
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)),
)
@many
def test_a_truth_that_is_written_is_read(tmp_path, cells, resolution, origin):
    write_truth(tmp_path / "truth.npz", Truth(cells, resolution, origin))
    got = read_truth(tmp_path / "truth.npz")
    np.testing.assert_array_equal(got.cells, cells)
    assert (got.cells.dtype, got.resolution, got.origin) == (np.int8, resolution, origin)


def test_a_run_that_is_repeated_writes_the_same_bytes(tmp_path):
    for name in "ab":
        write_map(tmp_path / name, a_grid(), PATH, {"seed": 1}, "title")
    assert everything_in(tmp_path / "a") == everything_in(tmp_path / "b")


def test_run_yaml_holds_the_version_and_every_setting(tmp_path):
    plain = {"robot": "b21", "resolution": 0.06, "refine": False, "interpreter": None, "span": [1, 2]}
    odd = {"log": tmp_path / "drive.csv", "seed": np.int64(3), "prior": np.float32(0.5), "mounts": np.eye(2)}
    write_map(tmp_path, a_grid(), PATH, plain | odd | {"nested": {"a": (1, 2)}})
    read = yaml.safe_load((tmp_path / "run.yaml").read_text())
    assert read.pop("echogrid_version")
    odd = {"log": str(tmp_path / "drive.csv"), "seed": 3, "prior": 0.5, "mounts": [[1.0, 0.0], [0.0, 1.0]]}
    assert read == plain | odd | {"nested": {"a": [1, 2]}}


def test_run_yaml_shows_a_text_of_several_lines_as_lines(tmp_path):
    robot = "name: b21\nsonar:\n  max_range_m: 5.0\n"
    write_map(tmp_path, a_grid(), PATH, {"robot": robot})
    assert "\n  name: b21\n" in (tmp_path / "run.yaml").read_text()
    assert yaml.safe_load((tmp_path / "run.yaml").read_text())["robot"] == robot


# The map_server pair.


def test_the_pgm_says_the_same_to_us_to_a_plain_parser_and_to_pillow(tmp_path):
    grid = a_grid()
    grid.log_odds[~grid.observed] = 3  # what no view spoke of is unknown, whatever stands there
    write_map(tmp_path, grid, PATH, {})
    pixels = np.array(plain_pgm((tmp_path / "map.pgm").read_bytes()))
    with Image.open(tmp_path / "map.pgm") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), pixels)
    p = np.where(grid.observed, grid.probability(), 0.5)[::-1]
    np.testing.assert_array_equal(pixels, np.where(p > 0.65, 0, np.where(p < 0.25, 254, 205)))
    assert set(np.unique(pixels)) == {0, 205, 254}
    (tmp_path / "map.npz").unlink()
    read = read_map(tmp_path)
    expected = np.where(p > 0.65, P_MAX, np.where(p < 0.25, P_MIN, 0.5))[::-1]
    np.testing.assert_allclose(read.probability(), expected, atol=1e-6)
    np.testing.assert_array_equal(read.observed, expected != 0.5)
    assert (read.resolution, read.origin) == (grid.resolution, grid.origin)


def test_a_cell_of_high_y_is_near_the_top_of_the_image_and_at_its_place_in_the_world(tmp_path):
    grid = one_wall(row=17, col=4)  # x -0.6 to -0.5, y 6.7 to 6.8
    write_map(tmp_path, grid, NO_PATH, {})
    pixels = plain_pgm((tmp_path / "map.pgm").read_bytes())
    ((row, col),) = [(i, j) for i, line in enumerate(pixels) for j, pixel in enumerate(line) if pixel == 0]
    assert (row, col) == (2, 4)
    info = yaml.safe_load((tmp_path / "map.yaml").read_text())
    x = info["origin"][0] + (col + 0.5) * info["resolution"]
    y = info["origin"][1] + (len(pixels) - row - 0.5) * info["resolution"]
    assert (x, y) == pytest.approx((-0.55, 6.75))
    assert grid.probability_at(np.array([x, y])) > 0.9
    assert read_map(tmp_path / "map.yaml").probability_at(np.array([x, y])) > 0.9


def test_map_yaml_holds_what_map_server_asks_for(tmp_path):
    write_map(tmp_path, a_grid(), PATH, {})
    assert yaml.safe_load((tmp_path / "map.yaml").read_text()) == {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": 0.12,
        "origin": [-1.5, 2.25, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


def test_map_server_takes_each_of_our_pixels_for_what_it_stands_for(tmp_path):
    write_map(tmp_path, a_grid(), PATH, {})
    info = yaml.safe_load((tmp_path / "map.yaml").read_text())
    occupied, free = (255 - 0) / 255, (255 - 254) / 255
    assert occupied > info["occupied_thresh"]
    assert free < info["free_thresh"]
    for unknown in ((255 - 205) / 255, 1 - 205 / 255):  # ROS 1 and Nav2 round differently
        assert info["free_thresh"] <= unknown <= info["occupied_thresh"]


CAUTION = "# Probabilities: Nav2 sees walls only with lethal_cost_threshold: 66"


@pytest.mark.parametrize(("mode", "occupied_thresh", "free_thresh"), [("scale", 1.0, 0.0), ("raw", 0.65, 0.25)])
def test_map_yaml_names_the_mode_and_says_what_nav2_needs_for_it(tmp_path, mode, occupied_thresh, free_thresh):
    write_map(tmp_path, a_grid(), PATH, {}, mode=mode)
    text = (tmp_path / "map.yaml").read_text()
    info = yaml.safe_load(text)
    assert text.splitlines()[0] == CAUTION
    assert (info["mode"], info["negate"]) == (mode, 0)
    assert (info["occupied_thresh"], info["free_thresh"]) == (occupied_thresh, free_thresh)


# What map_server makes of the pixels, as its pages and sources state it: Nav2 (docs.nav2.org and map_io.cpp), ROS 1
# as it is (1 + 98 ratio, cut off) and ROS 1 as its wiki says (99 ratio). A PGM has no alpha, so all is opaque.


def grey_of(image):
    """Rows of pixels from the lowest y up, and the settings beside them."""
    info = yaml.safe_load((image.parent / "map.yaml").read_text())
    return plain_pgm(image.read_bytes())[::-1], info


def nav2_cell(pixel, info):
    shade = pixel / 255
    if info["mode"] == "raw":
        return round(shade * 255) if round(shade * 255) <= 100 else -1
    occ = shade if info["negate"] else 1 - shade
    if occ > info["occupied_thresh"]:
        return 100
    if occ < info["free_thresh"]:
        return 0
    if info["mode"] == "trinary":
        return -1
    return round((occ - info["free_thresh"]) / (info["occupied_thresh"] - info["free_thresh"]) * 100)


def ros1_cell(pixel, info, stretch):
    value = 255 - pixel if info["negate"] else pixel
    if info["mode"] == "raw":
        return value if value < 128 else value - 256  # an unsigned byte into one with a sign
    occ = (255 - value) / 255
    if occ > info["occupied_thresh"]:
        return 100
    if occ < info["free_thresh"]:
        return 0
    if info["mode"] == "trinary":
        return -1
    return int(stretch((occ - info["free_thresh"]) / (info["occupied_thresh"] - info["free_thresh"])))


READERS = {
    "nav2": nav2_cell,
    "ros1": lambda pixel, info: ros1_cell(pixel, info, lambda ratio: 1 + 98 * ratio),
    "ros1-wiki": lambda pixel, info: ros1_cell(pixel, info, lambda ratio: 99 * ratio),
}


@given(
    arrays(float, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(0, 1)),
    st.sampled_from(["trinary", "scale", "raw"]),
    st.data(),
)
@many
def test_every_reader_of_the_pair_finds_what_the_map_says(tmp_path, p, mode, data):
    edges = st.sampled_from([0.2499, 0.25, 0.2501, 0.2549, 0.6499, 0.65, 0.6501, 0.6549])
    p[0, 0] = data.draw(edges)
    observed = data.draw(arrays(bool, p.shape))
    grid = Grid(logit(np.clip(p, 0.001, 0.999)).astype(np.float32), observed, 0.1, (0.0, 0.0))
    check_every_reader(tmp_path, grid, mode)


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_every_reader_agrees_at_a_thousand_probabilities(tmp_path, mode):
    p = np.linspace(0.0005, 0.9995, 1000).reshape(2, -1).repeat(2, axis=0)
    observed = np.arange(4) % 2 == 0
    grid = Grid(logit(p).astype(np.float32), np.broadcast_to(observed[:, None], p.shape).copy(), 0.1, (0.0, 0.0))
    check_every_reader(tmp_path, grid, mode)


def check_every_reader(folder, grid, mode):
    with patch.object(mapfile, "draw_map"):  # the picture takes longer than all the rest
        write_map(folder, grid, NO_PATH, {}, mode=mode)
    pixels, info = grey_of(folder / "map.pgm")
    expected = occupancy(grid)
    p = grid.probability()
    for cell_of in READERS.values():
        cells = np.array([[cell_of(pixel, info) for pixel in row] for row in pixels])
        if mode == "trinary":
            np.testing.assert_array_equal(cells, expected)
            continue
        lost = 50 if mode == "scale" else -1  # scale calls only transparent pixels unknown
        classes = np.where(cells < 0, -1, np.where(cells >= 66, 100, np.where(cells <= 24, 0, -1)))
        np.testing.assert_array_equal(classes, expected)
        percent = np.where(grid.observed, 100 * p, lost)
        assert np.max(np.abs(cells - percent)) <= (2.5 if mode == "scale" else 2)
    ours = read_map(folder / "map.yaml")
    nav2 = np.array([[nav2_cell(pixel, info) for pixel in row] for row in pixels])
    np.testing.assert_array_equal(ours.observed, nav2 >= 0)
    shown = np.where(nav2 >= 0, np.clip(nav2 / 100, P_MIN, P_MAX), 0.5)
    np.testing.assert_allclose(ours.probability(), shown, atol=1e-6)


@given(arrays(float, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.floats(0, 1)), st.data())
@many
def test_the_occupancy_message_says_what_the_map_says(p, data):
    observed = data.draw(arrays(bool, p.shape))
    grid = Grid(logit(np.clip(p, 0.001, 0.999)).astype(np.float32), observed, 0.1, (0.0, 0.0))
    cells = occupancy(grid)
    assert cells.dtype == np.int8
    for cell, probability, seen in zip(cells.flat, grid.probability().flat, observed.flat, strict=True):
        assert cell == (-1 if not seen else 100 if probability > 0.65 else 0 if probability < 0.25 else -1)


EDGES = {"free_thresh": 0.25, "occupied_thresh": 0.75}
SCALE = {"mode": "scale", "free_thresh": 0.2, "occupied_thresh": 0.6}


# The rules of Nav2's map_io.cpp, pixel by pixel; None = unknown. A probability past the read-out limits is
# shown as the limit.
@pytest.mark.parametrize(
    ("fields", "white", "pixels", "expected"),
    [
        ({}, 255, [0, 88, 90, 205, 206, 255], [P_MAX, P_MAX, None, None, P_MIN, P_MIN]),
        ({"mode": "trinary", "negate": 1}, 255, [0, 49, 50, 165, 166], [P_MIN, P_MIN, None, None, P_MAX]),
        ({"negate": True}, 100, [0, 19, 20, 65, 66], [P_MIN, P_MIN, None, None, P_MAX]),
        ({"free_thresh": 0.25}, 255, [205], [P_MIN]),
        (EDGES, 4, [0, 1, 2, 3, 4], [P_MAX, None, None, None, P_MIN]),
        (SCALE, 100, [100, 60, 50, 30, 0], [P_MIN, 0.5, 0.75, P_MAX, P_MAX]),
        ({"mode": "raw"}, 255, [0, 30, 100, 101, 255], [P_MIN, 0.3, P_MAX, None, None]),
        ({"mode": "raw", "negate": 1}, 255, [30], [0.3]),
        ({}, 65535, [0, 50000, 65535], [P_MAX, None, P_MIN]),
    ],
)  # fmt: skip
def test_the_modes_of_map_server(tmp_path, fields, white, pixels, expected):
    data = np.array(pixels, dtype=">u2" if white > 255 else np.uint8).tobytes()
    content = b"P5 # a comment\n#another\n%d 1\n%d\n" % (len(pixels), white) + data
    grid = read_map(map_yaml(tmp_path, content, **fields))
    assert grid.observed[0].tolist() == [p is not None for p in expected]
    assert grid.probability()[0] == pytest.approx([0.5 if p is None else p for p in expected], abs=1e-6)


def test_a_number_that_map_saver_writes_without_a_dot_is_a_number(tmp_path):
    file = map_yaml(tmp_path)
    file.write_text(re.sub(r"(?s)origin:.*?(?=\w+:)", "origin: [-1.5, 2, -1e-17]\n", file.read_text()))
    assert read_map(file).origin == (-1.5, 2.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"image": None},
        {"image": "none.pgm"},
        {"image": "."},
        {"image": "any.yaml"},
        {"image": 3},
        {"resolution": 0},
        {"resolution": -0.1},
        {"resolution": float("nan")},
        {"resolution": "fine"},
        {"origin": None},
        {"origin": [0, 0]},
        {"origin": [0, "a", 0]},
        {"origin": [0, 0, 0.5]},
        {"origin": [float("inf"), 0, 0]},
        {"negate": 2},
        {"negate": None},
        {"mode": "colour"},
        {"free_thresh": 0.7},
        {"occupied_thresh": 2},
        {"content": b""},
        {"content": b"P2\n1 1\n255\n0\n"},
        {"content": b"P5\n2 2\n255\n\x00\xff"},
        {"content": b"P5\n0 2\n255\n\x00\xff"},
        {"content": b"P5\n2 1\n70000\n\x00\xff\x00\xff"},
        {"content": b"P5\n2 1\n100\n\x00\xff"},
        {"content": b"P5\n999999999 999999999\n255\n\x00\xff"},
    ],
)
def test_a_wrong_map_server_pair_is_one_line_that_names_the_file(tmp_path, changes):
    with pytest.raises(InputError) as error:
        read_map(map_yaml(tmp_path, **changes))
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


# Wrong NPZ files.


def right_map():
    return {"log_odds": np.zeros((2, 3), np.float32), "observed": np.ones((2, 3), bool)} | place()


def place():
    return {"resolution": np.array(0.1), "origin": np.array([1.0, 2.0])}


@pytest.mark.parametrize(
    "changes",
    [
        {"log_odds": None},
        {"observed": None},
        {"resolution": None},
        {"origin": None},
        {"log_odds": np.zeros((2, 3, 1), np.float32)},
        {"log_odds": np.zeros((0, 3), np.float32), "observed": np.ones((0, 3), bool)},
        {"log_odds": np.zeros((2, 3), int)},
        {"log_odds": np.full((2, 3), np.nan, np.float32)},
        {"log_odds": np.full((2, 3), np.inf)},
        {"log_odds": np.full((2, 3), 1e300)},
        {"log_odds": np.array([["a"]]), "observed": np.ones((1, 1), bool)},
        {"log_odds": np.array([[{}]]), "observed": np.ones((1, 1), bool)},
        {"observed": np.ones((3, 2), bool)},
        {"observed": np.ones((2, 3))},
        {"resolution": np.array(0.0)},
        {"resolution": np.array(-0.1)},
        {"resolution": np.array(np.nan)},
        {"resolution": np.array([0.1, 0.2])},
        {"resolution": np.array("0.1")},
        {"origin": np.array([1.0])},
        {"origin": np.array([1.0, np.inf])},
    ],
)
def test_a_wrong_map_npz_is_one_line_that_names_the_file(tmp_path, changes):
    contents = {key: value for key, value in (right_map() | changes).items() if value is not None}
    np.savez(tmp_path / "map.npz", **contents)
    with pytest.raises(InputError, match=re.escape(str(tmp_path / "map.npz"))) as error:
        read_map(tmp_path)
    assert "\n" not in str(error.value)


def test_the_map_npz_that_the_wrong_ones_are_made_of_is_right(tmp_path):
    np.savez(tmp_path / "map.npz", **right_map())
    assert read_map(tmp_path).shape == (2, 3)


@pytest.mark.parametrize("read", [read_map, read_truth])
def test_what_is_no_map_at_all_is_an_input_error(tmp_path, read):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.npz").write_text("x,y\n1,2\n")
    (tmp_path / "nothing.npz").write_bytes(b"")
    np.save(tmp_path / "one.npy", np.zeros((2, 2)))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez_compressed(tmp_path / "right.npz", **right_map(), truth=np.zeros((50, 50), int))
    whole = (tmp_path / "right.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    os.mkfifo(tmp_path / "pipe.npz")
    names = ["empty", "text.npz", "nothing.npz", "one.npy", "other.npz", "cut.npz", "pipe.npz", "none.npz"]
    for name in [*names, "none/map.npz", "text.npz/map.npz", "n" * 300]:
        with pytest.raises(InputError) as error:
            read(tmp_path / name)
        assert str(tmp_path / name) in str(error.value)
    with pytest.raises(InputError, match="not an NPZ archive"):
        read(tmp_path / "text.npz")


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, place):
        self.place = place

    def __reduce__(self):
        return os.mkdir, (str(self.place),)


def test_reading_runs_no_code_from_the_file(tmp_path):
    trap = np.array([[Trap(tmp_path / "sprung")]])
    np.savez(tmp_path / "map.npz", **(right_map() | {"log_odds": trap, "truth": trap}))
    for read in (read_map, read_truth):
        with pytest.raises(InputError):
            read(tmp_path / "map.npz")
    assert not (tmp_path / "sprung").exists()


@given(st.binary(max_size=300))
@many
def test_random_bytes_raise_nothing_but_our_errors(tmp_path, content):
    for name in ("map.npz", "map.yaml", "map.pgm"):
        (tmp_path / name).write_bytes(content)
    for read, name in [
        (read_map, "map.npz"),
        (read_map, "map.yaml"),
        (read_map, ""),
        (read_truth, "map.npz"),
    ]:
        with pytest.raises(EchogridError):
            read(tmp_path / name)


@given(st.integers(0, 10_000), st.binary(min_size=1, max_size=8), st.booleans())
@many
def test_damaged_files_are_read_or_raise_our_errors(tmp_path, place_, patch, cut):
    np.savez(tmp_path / "whole.npz", **right_map(), truth=np.zeros((4, 4), np.int8))
    whole = (tmp_path / "whole.npz").read_bytes()
    i = place_ % len(whole)
    damaged = whole[:i] if cut else whole[:i] + patch + whole[i + len(patch) :]
    (tmp_path / "damaged.npz").write_bytes(damaged)
    for read in (read_map, read_truth):
        with suppress(InputError):
            assert read(tmp_path / "damaged.npz").resolution > 0


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
FIELDS = st.sampled_from(["image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh"])
HEADERS = st.builds(
    b"P5\n%d %d\n%d\n".__mod__, st.tuples(st.integers(0, 5), st.integers(0, 5), st.integers(0, 70_000))
)


@given(
    st.dictionaries(FIELDS, SCALARS | st.lists(SCALARS, max_size=3), max_size=2),
    HEADERS,
    st.binary(max_size=60),
)
@many
def test_random_map_server_pairs_are_read_or_raise_our_errors(tmp_path, changes, header, pixels):
    try:
        grid = read_map(map_yaml(tmp_path, header + pixels, **changes))
    except InputError:
        return
    assert np.isfinite(grid.log_odds).all()
    assert grid.log_odds.size


# Truth grids of others.


@pytest.mark.parametrize(
    "contents",
    [
        {"truth": np.array([[0, 1, 2]]), "other": np.zeros((2, 2), int)},
        {"truth": np.array([[0.0, 1.0, 2.0]])},
        {"labels": np.array([[0, 1, 2]], dtype=np.uint8), "height": np.zeros((2, 2)), "count": np.array(3)},
        {"cells": np.array([[0.0, 1.0, 2.0]]), "height": np.full((2, 2), 0.5), "seen": np.ones((2, 2), bool)},
        {"grid": np.array([[0, 1, 2]]), "notes": np.array([{"by": "others"}])},
    ],
)
def test_the_truth_is_found_under_another_name(tmp_path, contents):
    np.savez(tmp_path / "truth.npz", **contents, **place())
    truth = read_truth(tmp_path / "truth.npz")
    assert truth.cells.tolist() == [[0, 1, 2]]
    assert (truth.resolution, truth.origin) == (0.1, (1.0, 2.0))


@pytest.mark.parametrize(
    "contents",
    [
        {"truth": np.array([[0, 1, 3]])},
        {"truth": np.array([[0, -1]])},
        {"truth": np.array([[0, 257]])},
        {"truth": np.array([[0.5]])},
        {"truth": np.array([[np.nan]])},
        {"truth": np.array([0, 1])},
        {"truth": np.zeros((0, 3), int)},
        {"truth": np.array([[0, 1]]), "resolution": np.array(0.0)},
        {"a": np.zeros((2, 2), int), "b": np.zeros((2, 2), int)},
        {"a": np.array([[0.5]])},
        {"a": np.array([[True]])},
        right_map(),
    ],
)
def test_a_wrong_truth_is_one_line_that_names_the_file(tmp_path, contents):
    if contents.keys() == right_map().keys():
        contents["log_odds"] = contents["log_odds"] + 0.5
    np.savez(tmp_path / "truth.npz", **(place() | contents))
    with pytest.raises(InputError, match=re.escape(str(tmp_path / "truth.npz"))):
        read_truth(tmp_path / "truth.npz")


# All or nothing.


def test_a_map_is_written_into_a_folder_that_is_made(tmp_path):
    write_map(tmp_path / "a" / "b", a_grid(), PATH, {})
    assert {file.name for file in (tmp_path / "a" / "b").iterdir()} == FILES


@pytest.mark.parametrize(
    "failure", [OSError(28, "No space left on device"), RuntimeError("bug"), KeyboardInterrupt()]
)
@pytest.mark.parametrize("step", ["draw_map", "_save_npz", "pgm"])
def test_a_write_that_fails_leaves_nothing_behind(tmp_path, monkeypatch, failure, step):
    write_map(tmp_path / "old", one_wall(1, 1), PATH, {"run": "old"})
    before = everything_in(tmp_path / "old")

    def fail(*_args, **_more):
        raise failure

    monkeypatch.setattr(mapfile, step, fail)
    expected = UsageError if isinstance(failure, OSError) else type(failure)
    for folder in (tmp_path / "old", tmp_path / "new" / "folder"):
        with pytest.raises(expected) as error:
            write_map(folder, a_grid(), PATH, {})
        if expected is UsageError:
            name = {"draw_map": "map.png", "_save_npz": "map.npz", "pgm": "map.pgm"}[step]
            assert str(error.value).startswith(f"{folder / name}: found No space left on device")
    assert everything_in(tmp_path / "old") == before
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "taken" / "map.pgm").mkdir(parents=True)
    for folder in (
        tmp_path / "file",
        tmp_path / "file" / "below",
        tmp_path / "taken",
        "/proc/none",
        "/dev/null",
    ):
        with pytest.raises(UsageError) as error:
            write_map(folder, a_grid(), PATH, {})
        assert str(folder) in str(error.value)
        assert "\n" not in str(error.value)
    assert [file.name for file in (tmp_path / "taken").iterdir()] == ["map.pgm"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_the_right_to_write_is_one_clear_line(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UsageError, match="Permission denied"):
        write_map(tmp_path, a_grid(), PATH, {})
    with pytest.raises(UsageError, match="Permission denied"):
        write_truth(tmp_path / "truth.npz", Truth(np.zeros((1, 1), np.int8), 1.0, (0.0, 0.0)))


def test_a_map_that_cannot_be_a_map_is_refused(tmp_path):
    for log_odds in (np.zeros((0, 0), np.float32), np.full((2, 2), np.nan, np.float32)):
        with pytest.raises(UsageError):
            write_map(tmp_path / "map", Grid(log_odds, log_odds == 0, 0.1, (0.0, 0.0)), PATH, {})
    assert not (tmp_path / "map").exists()


def test_replacing_swaps_the_file_when_the_block_ends_and_not_before(tmp_path):
    target = tmp_path / "a.csv"
    target.write_text("old")
    with replacing(target) as new:
        assert (new.parent, new.suffix) == (tmp_path, ".csv")
        new.write_text("new")
        assert target.read_text() == "old"
    assert everything_in(tmp_path) == {"a.csv": b"new"}


def test_replacing_leaves_the_old_file_when_the_block_raises(tmp_path):
    target = tmp_path / "a.csv"
    target.write_text("old")

    def fail_half_way():
        with replacing(target) as new:
            new.write_text("ne")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    assert everything_in(tmp_path) == {"a.csv": b"old"}


def test_replacing_follows_a_link_and_gives_the_rights_of_any_new_file(tmp_path):
    (tmp_path / "plain").touch()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with replacing(tmp_path / "link") as new:
        new.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"
    assert (tmp_path / "target").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("place_", ["", "none/a.csv", "pipe", "file/a.csv", "n" * 300])
def test_replacing_refuses_what_is_not_a_place_for_a_file(tmp_path, place_):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "file").touch()
    with pytest.raises(UsageError), replacing(tmp_path / place_):
        pytest.fail("the block must not run")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file", "pipe"]
    assert (tmp_path / "pipe").is_fifo()


# The picture.


def picture(folder, grid, path=NO_PATH, title=""):
    write_map(folder, grid, path, {}, title)
    with Image.open(folder / "map.png") as image:
        return np.asarray(image.convert("RGB")).astype(int)


def near_colour(pixels, colour):
    return np.argwhere(np.abs(pixels - colour).max(axis=-1) < 40)


GREEN, RED, BLUE = (44, 160, 44), (214, 39, 40), (31, 119, 180)


def test_the_picture_shows_high_y_at_the_top_and_marks_start_and_end(tmp_path):
    path = np.array([[-0.5, 5.3, 0.0], [0.5, 6.7, 0.0], [1.5, 5.3, 0.0]])
    pixels = picture(tmp_path, one_wall(row=17, col=4), path)
    map_part = pixels[: pixels.shape[0] * 3 // 4]  # the key lies below
    start, end, drive = (near_colour(map_part, colour) for colour in (GREEN, RED, BLUE))
    per_m = (end[:, 1].mean() - start[:, 1].mean()) / 2.0
    assert end[:, 0].mean() == pytest.approx(start[:, 0].mean(), abs=5)
    assert drive[:, 0].min() == pytest.approx(start[:, 0].mean() - 1.4 * per_m, abs=10)
    # The occupied cell is the only dark patch; it is 0.05 m left of the start and 1.45 m above it.
    dark = np.argwhere(maximum_filter(map_part.max(axis=-1), size=15) < 60).mean(axis=0)
    assert dark == pytest.approx(start.mean(axis=0) - [1.45 * per_m, 0.05 * per_m], abs=10)


def test_the_picture_is_cut_to_what_was_observed(tmp_path):
    grid = a_grid(40, 40)
    grid.observed[:] = False
    grid.observed[10:20, 5:35] = True
    wide = picture(tmp_path, grid)
    grid.observed[:] = grid.observed.T.copy()
    tall = picture(tmp_path, grid)
    assert wide.shape[1] > 1.5 * wide.shape[0]
    assert tall.shape[0] > tall.shape[1]


def test_a_thin_wall_survives_when_a_large_map_is_coarsened(tmp_path):
    grid = one_wall(0, 0, 2500, 100, 0.05)
    grid.log_odds[1001, :] = 5
    pixels = picture(tmp_path, grid)
    # A column of pixels through the map, without the frame above and below it.
    column = pixels[100 : pixels.shape[0] * 3 // 4, pixels.shape[1] // 2 + 30].max(axis=-1)
    assert column.max() > 240
    assert column.min() < 90
    assert max(pixels.shape) < 2000


@pytest.mark.parametrize("shape", [(1, 1), (1, 400), (400, 1)])
def test_a_picture_of_any_shape_any_title_and_any_path_is_drawn(tmp_path, shape):
    grid = Grid(np.ones(shape, np.float32), np.zeros(shape, bool), 0.1, (0.0, 0.0))
    path = np.array([[np.nan, 0.0], [0.0, 0.0]])
    pixels = picture(tmp_path, grid, path, r"$\frac{$ 東京 %s {} " + "long" * 50)
    assert min(pixels.shape[:2]) > 300
