"""``echogrid localise``: a log and a map in, a trajectory out."""

import numpy as np
import pytest
import yaml

from commands import SAMPLE, assert_refused, everything, put
from echogrid import Grid, load_log, read_map, write_map
from echogrid.logs.csv_log import write_csv
from echogrid.output.trajectory import read_tum

LOG = "t,x,y,theta,r0,r1\n0,0,0,0,1.0,1.0\n1,0.1,0,0,0.9,1.0\n"


@pytest.fixture(scope="module")
def house(tmp_path_factory):
    """The sample's own map."""
    from commands import call

    folder = tmp_path_factory.mktemp("house")
    assert call("map", "--out", folder) == 0
    return folder


def test_the_sample_is_found_in_its_own_map(run, house, tmp_path):
    poses = np.array([frame.pose for frame in load_log(str(SAMPLE))])
    x, y, theta = poses[0]
    start = f"--start={x + 0.1:.2f},{y - 0.1:.2f},{np.rad2deg(theta) + 4:.1f}"
    before = everything(house)
    out = tmp_path / "found"
    status, said, noted = run("localise", SAMPLE, "--robot", "b21", "--map", house, start, "--out", out)
    assert (status, noted) == (0, "")
    assert "trajectory.tum" in said
    assert everything(house) == before
    assert {path.name for path in out.iterdir()} == {"trajectory.tum", "map.png", "run.yaml"}
    stamps, found = read_tum(out / "trajectory.tum")
    np.testing.assert_array_equal(stamps, [frame.stamp for frame in load_log(str(SAMPLE))])
    assert np.sqrt(np.mean(np.sum((found - poses)[:, :2] ** 2, axis=1))) < 0.1
    assert yaml.safe_load((out / "run.yaml").read_text())["frames_not_sure"] == 0


def test_one_frame_from_anywhere_is_not_sure(run, house, place):
    log = put(place / "one.csv", LOG.rsplit("\n", 2)[0] + "\n")
    status, _, noted = run("localise", log, "--robot", "duo.yaml", "--map", house, "--anywhere", "--out", "there")
    assert status == 0
    assert "note: 1 of 1 poses are the likeliest of several" in noted
    assert len(read_tum(place / "there" / "trajectory.tum")[0]) == 1


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "--start, --anywhere: found neither, expected one of the two"),
        (["--start", "0,0,0", "--anywhere"], "--start, --anywhere: found both"),
        (["--start", "0,0"], "--start: found 0,0, expected X,Y,DEG"),
        (["--start", "0,nan,0"], "--start: found 0,nan,0, expected finite numbers"),
        (["--start", "900,0,0"], "start: found 900, 0 m, outside of the map"),
        (["--anywhere", "--seed", "-1"], "--seed: found -1"),
        (["--anywhere", "--robot", "b21"], "found 2 sonars, expected 24"),
        (["--anywhere", "--map", "nowhere"], "nowhere: found no such file"),
        (["--anywhere", "--out", "HOUSE"], "the folder of the map, expected another one"),
    ],
)
def test_what_cannot_be_is_one_line(run, house, place, arguments, line):
    put(place / "drive.csv", LOG)
    given = [str(house) if word == "HOUSE" else word for word in arguments]
    defaults = [word for name, value in (("--map", house), ("--robot", "duo.yaml"), ("--out", "new"))
                if name not in given for word in (name, value)]  # fmt: skip
    assert line in assert_refused(run, place, "localise", "drive.csv", *defaults, *given)


def test_a_log_without_any_echo_is_refused(run, house, place):
    put(place / "drive.csv", "t,x,y,theta,r0,r1\n0,0,0,0,inf,inf\n1,0.1,0,0,inf,\n")
    line = assert_refused(run, place, "localise", "drive.csv", "--robot", "duo.yaml", "--map", house, "--anywhere")
    assert "drive.csv: found no echo of any sonar" in line


def test_a_start_in_a_wall_is_refused(run, house, place):
    put(place / "drive.csv", LOG)
    grid = read_map(house)
    x, y = grid.centre_of(np.argwhere(grid.observed & (grid.probability() > 0.9))[0])
    line = assert_refused(
        run, place, "localise", "drive.csv", "--robot", "duo.yaml", "--map", house, f"--start={x},{y},0"
    )
    assert "in a wall, expected free floor" in line


def test_a_drive_through_walls_is_told(run, house, tmp_path):
    """The map of another place: the sample's own with all of its lower half forgotten."""
    known = read_map(house)
    part = known.part(np.array([known.shape[0] // 2, 0]), (known.shape[0] // 2, known.shape[1]))
    write_map(tmp_path / "half", part, np.zeros((1, 2)), {}, "half")
    frames = list(load_log(str(SAMPLE)))
    high = part.origin[1] + 1.0
    begin = next(i for i, each in enumerate(frames) if each.pose[1] > high)
    x, y, theta = frames[begin].pose
    write_csv(tmp_path / "drive.csv", frames[begin:], len(frames[0].ranges))
    places = ["--map", tmp_path / "half", f"--start={x:.2f},{y:.2f},{np.rad2deg(theta):.1f}"]
    status, _, noted = run("localise", tmp_path / "drive.csv", "--robot", "b21", *places, "--out", tmp_path / "found")
    assert status == 0
    (note,) = [line for line in noted.splitlines() if "where the map has walls or nothing" in line]
    assert note.startswith("note: along ")
    assert any(
        "where the map has walls" in told
        for told in yaml.safe_load((tmp_path / "found" / "run.yaml").read_text())["notes"]
    )


def test_a_map_that_hardly_explains_what_is_heard_is_told(run, house, tmp_path):
    """A room of the same size as the sample's, but empty."""
    cells = np.ones((120, 120), dtype=bool)
    cells[10:-10, 10:-10] = False
    grid = Grid(np.where(cells, 3.0, -3.0).astype(np.float32), np.ones_like(cells), 0.05, (-3.0, -3.0))
    write_map(tmp_path / "room", grid, np.zeros((1, 2)), {}, "room")
    for place, told in ((tmp_path / "room", 1), (house, 0)):
        x, y, theta = next(iter(load_log(str(SAMPLE)))).pose if place == house else (0.0, 0.0, 0.0)
        start = f"--start={x:.2f},{y:.2f},{np.rad2deg(theta):.1f}"
        _, _, noted = run("localise", SAMPLE, "--robot", "b21", "--map", place, start, "--out", tmp_path / "found")
        assert noted.count("note: what is heard agrees little with the map") == told
