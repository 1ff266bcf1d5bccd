"""Files of maps and truth grids: what is written is read, wrong input is one line, failure leaves nothing."""

import os
import re
from contextlib import suppress

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.grid import P_MAX, P_MIN, Grid, logit, sigmoid
from echogrid.metrics import Truth
from echogrid.output import map_file as mapfile
from echogrid.output.map_file import read_map, read_truth, write_map, write_truth
from map_samples import PATH, a_grid, one_wall

FILES = {"map.pgm", "map.yaml", "map.png", "map.npz", "run.yaml"}

many = settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
few = settings(parent=many, max_examples=6)


def everything_in(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


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
