"""``echogrid plan``: a map and two places in, a path or one line out."""

import numpy as np
import pytest
import yaml

from commands import assert_refused, call, put
from echogrid.robot import TRANSDUCERS, Robot, robot_yaml, surrounded


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """The sample's own map."""
    folder = tmp_path_factory.mktemp("house")
    assert call("map", "--out", folder) == 0
    return folder


def table(path):
    assert path.read_text().startswith("x,y,s,clearance\n")
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


def test_a_path_is_written_and_told(run, house, tmp_path):
    out = tmp_path / "way"
    status, said, noted = run("plan", house, "--from", "1,1", "--to", "4,4", "--out", out)
    assert (status, noted) == (0, "")
    assert {path.name for path in out.iterdir()} == {"path.csv", "path.png"}
    x, y, s, clearance = table(out / "path.csv").T
    np.testing.assert_allclose([x[0], y[0], x[-1], y[-1]], [1, 1, 4, 4], atol=0.03)
    np.testing.assert_allclose(s, np.append(0, np.cumsum(np.hypot(np.diff(x), np.diff(y)))), atol=0.005)
    assert np.min(clearance) >= 0
    assert f"{s[-1]:.2f} m" in said
    assert (out / "path.png").read_bytes().startswith(b"\x89PNG")


def test_the_robot_of_the_map_is_that_which_made_it_unless_another_is_named(run, house, tmp_path):
    lengths = []
    for robot in ([], ["--robot", "b21"], ["--robot", "robuter2"]):
        assert run("plan", house, "--from", "1,1", "--to", "2.2,1", *robot, "--out", tmp_path)[0] == 0
        lengths.append(table(tmp_path / "path.csv")[:, 3].min())
    assert lengths[0] == lengths[1]
    assert lengths[2] < lengths[0]


def test_a_footprint_that_nobody_told_is_told_of(run, house, place):
    """As in the maps of bags and of live: the disc that the sonars surround."""
    put(place / "map.npz", (house / "map.npz").read_bytes())
    ring = [[round(0.136 * float(np.cos(t)), 6), round(0.136 * float(np.sin(t)), 6), 0.0]
            for t in np.arange(0, 2 * np.pi, np.pi / 8)]  # fmt: skip
    for radius, told in ((surrounded(np.array(ring)), True), (0.28, False)):
        robot = Robot("base_link", radius, TRANSDUCERS["polaroid-600"], 0.2, 4.0, 0.4, np.array(ring))
        put(place / "run.yaml", yaml.safe_dump({"robot": robot_yaml(robot)}))
        status, _, noted = run("plan", place, "--from", "1,1", "--to", "2.2,1", "--out", "way")
        assert status == 0
        assert ("note: base_link is taken for a disc of 0.13 m, which its sonars surround" in noted) == told


def test_a_pair_that_anybody_drew(run, place):
    pixels = np.full((40, 60), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    pixels[:, 30] = 205
    pixels[10:30, 30] = 254
    put(place / "plan.pgm", b"P5\n60 40\n255\n" + pixels.tobytes())
    put(place / "plan.yaml", "image: plan.pgm\nresolution: 0.1\norigin: [-3, -2, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n")  # fmt: skip
    status, said, _ = run("plan", "plan.yaml", "--robot", "duo.yaml", "--from=-2,-1", "--to", "2,1", "--out", "way")
    assert status == 0, said
    assert table(place / "way" / "path.csv")[-1, 2] == pytest.approx(np.hypot(4, 2), rel=0.03)


@pytest.mark.parametrize(
    ("free_thresh", "negate", "mode", "remedy"),
    [
        (0.25, 0, "trinary", "write 0.196 there"),
        (0.25, 0, "scale", "write 0.196 there and let mode be trinary"),
        (0.196, 0, "scale", "let mode be trinary"),
        (0.196, 0, "trinary", ""),
        (0.25, 1, "trinary", ""),
    ],
)
def test_a_pair_whose_unknown_reads_as_free_is_told(run, place, free_thresh, negate, mode, remedy):
    """Nav2 saves the unknown as 205 beside a free_thresh of 0.25, by which it is free when it is loaded."""
    pixels = np.full((40, 60), 0 if negate else 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 254 if negate else 0
    pixels[:, 50:58] = 205
    put(place / "saved.pgm", b"P5\n60 40\n255\n" + pixels.tobytes())
    put(place / "saved.yaml", f"image: saved.pgm\nresolution: 0.1\norigin: [-3, -2, 0]\nnegate: {negate}\n"
        f"occupied_thresh: 0.65\nfree_thresh: {free_thresh}\nmode: {mode}\n")  # fmt: skip
    status, _, noted = run("plan", "saved.yaml", "--robot", "duo.yaml", "--from=-2,-1", "--to", "1,1", "--out", "way")
    assert status == 0
    assert ("makes the 13% of the cells free that are of grey 205" in noted) == bool(remedy)
    assert remedy in noted


def test_a_door_that_is_hardly_wide_enough_is_told(run, place):
    pixels = np.full((60, 80), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    pixels[:, 40] = 0
    pixels[30:41, 40] = 254  # 0.55 m; the robot is 0.525 m wide
    put(place / "plan.pgm", b"P5\n80 60\n255\n" + pixels.tobytes())
    put(place / "plan.yaml", "image: plan.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n")  # fmt: skip
    status, _, noted = run("plan", "plan.yaml", "--robot", "b21", "--from", "1,1.2", "--to", "3,1.2", "--out", "way")
    assert status == 0
    assert noted.startswith("note: at (2.0")
    assert "hardly wide enough" in noted
    assert noted.count("\n") == 1


def test_what_it_drives_over_and_where_it_begins_is_told_as_it_is(run, place):
    pixels = np.full((40, 80), 254, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    pixels[1:-1, 30:50] = 205  # 2 m that nobody saw
    put(place / "plan.pgm", b"P5\n80 40\n255\n" + pixels.tobytes())
    put(place / "plan.yaml", "image: plan.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n")  # fmt: skip
    words = ("plan", "plan.yaml", "--robot", "b21", "--from", "0.3,2", "--to", "7,2", "--unknown", "--out", "way")
    status, said, noted = run(*words)
    assert status == 0
    assert noted.startswith("note: the start was moved by 0.")
    assert noted.count("\n") == 1
    x, _, s, clearance = table(place / "way" / "path.csv").T
    along = np.diff(s)[(clearance[1:] < -0.005) | (clearance[:-1] < -0.005)].sum()
    assert (
        f"{along:.2f} m of it over what is not surely free, which b21 covers by up to {-clearance.min():.2f} m"
        in said
    )
    assert 2.4 < along < 2.8
    assert x[0] > 0.35


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--from", "1"], "--from: found 1, expected X,Y in metres"),
        (["--from", "1,nan"], "--from: found 1,nan, expected"),
        (["--to", "a,b"], "--to: found a,b, expected"),
        (["--to", "3,2"], "plan: goal (3.00, 2.00) m: found what is occupied"),
        (["--to", "90,2"], "plan: goal (90.00, 2.00) m: found a place outside of what was mapped"),
        (["--robot", "b22"], "robot: found b22"),
        (["--out", "file"], "file: found a file, expected a folder"),
        (["MAP", "nowhere"], "nowhere: found no such file"),
        (["MAP", "duo.yaml", "--robot", "b21"], "duo.yaml: resolution: found nothing"),
    ],
)
def test_what_cannot_be_is_one_line(run, house, place, arguments, line):
    given = dict(zip(arguments[::2], arguments[1::2], strict=True))
    options = {"--from": "1,1", "--to": "2,1", "--out": "way"} | {k: v for k, v in given.items() if k != "MAP"}
    words = [word for pair in options.items() for word in pair]
    assert line in assert_refused(run, place, "plan", given.get("MAP", house), *words)


def test_a_robot_wider_than_every_door_and_a_map_without_its_robot(run, house, place):
    put(place / "wide.yaml", "name: wide\nfootprint_radius_m: 0.9\nmounts: [[0.1, 0, 0]]\n"
        "sonar: {transducer: polaroid-600, min_range_m: 0.2, max_range_m: 4.0, beam_width_deg: 25}\n")  # fmt: skip
    line = assert_refused(run, place, "plan", house, "--robot", "wide.yaml", "--from", "1,1", "--to", "4,4")
    assert "the nearest place to stand is " in line
    alone = place / "alone.npz"
    put(alone, (house / "map.npz").read_bytes())
    line = assert_refused(run, place, "plan", alone, "--from", "1,1", "--to", "2,1")
    assert "--robot: found none, and no robot in " in line
    assert "run.yaml, expected a preset or a robot file" in line
