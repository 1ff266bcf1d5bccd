"""The pair of ROS's map_server: it says what the map says to every reader, and wrong pairs are one line."""

import re
from unittest.mock import patch

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from echogrid.errors import InputError
from echogrid.grid import P_MAX, P_MIN, Grid, logit
from echogrid.output import map_file as mapfile
from echogrid.output.map_file import read_map, write_map
from echogrid.output.map_server_file import occupancy
from map_samples import NO_PATH, PATH, a_grid, one_wall

many = settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def plain_pgm(content):
    """The header and the pixels of a PGM as we write it, by another way than the package reads it."""
    magic, size, white, pixels = content.split(b"\n", 3)
    assert (magic, white) == (b"P5", b"255")
    cols, rows = map(int, size.split())
    assert len(pixels) == rows * cols
    return [list(pixels[i * cols : (i + 1) * cols]) for i in range(rows)]


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
