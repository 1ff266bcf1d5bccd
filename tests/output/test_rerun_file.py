"""What Rerun is given of a drive."""

from importlib import import_module
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.geometry import wrap
from echogrid.grid import Grid
from echogrid.output import rerun_file
from echogrid.output.follower import SILENT_M
from echogrid.output.rerun_file import LOCAL_M, Viewing, around
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
    assert rerun_file._greys(grid).tolist() == [[128, 128], [250, 5]]


@given(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-9, 9)), st.booleans())
@settings(max_examples=50)
def test_a_cone_begins_at_its_sonar_and_ends_at_its_reading(pose, elsewhere):
    ranges = np.linspace(0.5, 4.5, ROBOT.sonars)
    ranges[[3, 5]] = np.nan, np.inf
    mounts = ROBOT.mounts + 0.05 if elsewhere else ROBOT.mounts
    frame = Frame(0.0, np.array(pose), ranges, mounts=mounts if elsewhere else None)
    cones = rerun_file._cones(frame, ROBOT)
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
    np.testing.assert_array_equal(np.array(data).reshape(grid.shape), rerun_file._greys(grid))
    assert cell == pytest.approx(0.2)
    assert place == pytest.approx([*grid.origin, 0])
    rows = columns(recording, "/local/map")
    assert [row["scan"] for row in rows] == [11, 14, 17, 20, 23, 26, 29, 32, 35, 38, 40]
    pose = list(a_drive())[10].pose
    (data,), (place,) = (rows[0][f"GridMap:{name}"] for name in ("data", "translation"))
    assert np.array(place[:2]) + LOCAL_M / 2 == pytest.approx(pose[:2], abs=0.12)
    np.testing.assert_array_equal(data, rerun_file._greys(around(a_grid(), pose[:2], LOCAL_M)).ravel())


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
