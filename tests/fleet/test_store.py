import json
from itertools import permutations

import numpy as np
import pytest

pytest.importorskip("zarr", reason="found no zarr")

from benchmarks.fleet import one_process, tiles
from commands import SAMPLE
from echogrid.errors import InputError, UsageError
from echogrid.fleet import job
from echogrid.fleet.job import add
from echogrid.fleet.lattice import LAYERS, TILE, UNIT, Region, counted, cut, joined
from echogrid.fleet.reading import Reading
from echogrid.fleet.store import Store
from echogrid.fleet.sums import Writer, opened
from echogrid.mapping.build import build_map
from fleet_samples import FRAMES, PIECES, ROBOT, added, filled, logs, shifted, task


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A folder with logs, and a store that holds them all."""
    folder = tmp_path_factory.mktemp("fleet")
    filled(folder / "store", logs(folder))
    return folder


@pytest.fixture(scope="module")
def paths(home):
    return sorted(home.glob("*.csv"))


def agree(ours, theirs, most):
    """Two maps of a place, in whatever rectangles."""
    ours, theirs = ours.observed_part(), theirs.observed_part()
    assert ours.origin == pytest.approx(theirs.origin)
    np.testing.assert_array_equal(ours.observed, theirs.observed)
    np.testing.assert_array_equal(ours.views, theirs.views)
    np.testing.assert_allclose(ours.log_odds, theirs.log_odds, atol=most, rtol=0)


def test_a_store_of_one_log_is_read_as_the_map_of_that_log(tmp_path):
    *_, grid = build_map(FRAMES, ROBOT)
    agree(Reading.of(filled(tmp_path / "one", [SAMPLE])).grid(), grid, 1e-3)


def test_a_store_of_many_is_read_as_one_process_that_adds_them_all(home, paths):
    agree(Reading.of(Store(home / "store")).grid(), one_process(paths, ROBOT), 1e-3)


def test_the_order_of_the_logs_changes_no_bit(home, paths, tmp_path):
    whole = tiles(Store(home / "store"))
    for k, order in enumerate((*[*permutations(paths[:3])][1:3], paths[::-1])):
        store = filled(tmp_path / str(k), order)
        tiles(store)  # what was merged of some is brought up to date when others come
        for path in paths:
            added(store, path)
        assert tiles(store) == whole


def test_the_same_log_makes_the_same_file(home, paths, tmp_path):
    store = filled(tmp_path / "again", paths[:1])
    (made,) = (store.path / "sums").iterdir()
    assert made.read_bytes() == (home / "store" / "sums" / made.name).read_bytes()


def test_a_log_counts_once_however_often_and_under_whatever_name(home, paths, tmp_path):
    store = filled(tmp_path / "twice", paths[:2])
    before = tiles(store)
    other = tmp_path / "other.csv"
    other.write_bytes(paths[0].read_bytes())
    assert [added(store, path).what for path in (paths[0], other)] == ["there", "there"]
    assert tiles(store) == before
    assert len(store.records()) == 2


def test_a_log_that_is_taken_out_leaves_no_trace(paths, tmp_path):
    store = filled(tmp_path / "more", paths[:3])
    tiles(store)
    store.remove(next(record for record in store.records() if record.name == "drive1.csv"))
    assert tiles(store) == tiles(filled(tmp_path / "less", [paths[0], paths[2]]))
    assert len([*(store.path / "sums").iterdir()]) == 2


def test_a_log_that_is_mapped_with_another_robot_counts_that_way_alone(paths, tmp_path):
    from dataclasses import replace

    store = filled(tmp_path / "one", paths[:1])
    narrow = replace(ROBOT, name="narrow", beam_width_rad=ROBOT.beam_width_rad / 2)
    assert add(task(store, paths[0], robot=narrow)).what == "replaced"
    (record,) = store.records()
    assert "narrow" in record.robot
    assert [path.stem for path in (store.path / "sums").iterdir()] == [record.sums]


def test_a_part_is_the_cut_of_the_whole(home):
    reading = Reading.of(Store(home / "store"))
    whole = reading.grid()
    rng = np.random.default_rng(0)
    for _ in range(10):
        low = reading.extent.low + rng.integers(0, np.array(reading.extent.shape) - 80)
        region = Region(low, low + rng.integers(1, 80, 2))
        part, cut_ = reading.grid(region), whole.part(low - reading.extent.low, region.shape)
        np.testing.assert_allclose(part.log_odds, cut_.log_odds, atol=2e-5, rtol=0)
        np.testing.assert_array_equal(part.observed, cut_.observed)
        assert part.origin == pytest.approx(cut_.origin)


def test_a_part_asks_for_its_own_tiles_alone(home, paths, tmp_path, monkeypatch):
    store = filled(tmp_path / "far", paths[:1])
    far = logs(tmp_path, [shifted(PIECES[0], 2000.0, 1500.0)])
    added(store, far[0])
    reading = Reading.of(store)
    asked = []
    monkeypatch.setattr(Reading, "_merged", lambda self, tile, keys: asked.append(tile) or np.zeros((7, TILE, TILE)))
    reading.grid(reading.region(2000.0, 1500.0, 2002.0, 1502.0))
    assert 0 < len(asked) <= 4
    assert all(min(tile) > 100 for tile in asked)


def test_what_lies_far_apart_costs_only_what_was_seen(paths, tmp_path):
    """Two ends of 2 km x 2 km."""
    here, there = PIECES[0], shifted(PIECES[0], 2000.0, 2000.0)
    store = filled(tmp_path / "wide", logs(tmp_path, [here, there]))
    reading = Reading.of(store)
    assert len(reading.by_tile) <= 16
    near, far = reading.grid(reading.region(-2, -2, 4, 4)), reading.grid(reading.region(1998, 1998, 2004, 2004))
    np.testing.assert_array_equal(near.observed, far.observed)
    np.testing.assert_allclose(near.log_odds, far.log_odds, atol=0.05)
    with pytest.raises(UsageError, match=r"found a map of 20\d\d\.\d+ x 20\d\d\.\d+ m, expected a part of at most"):
        reading.grid()


def test_a_drive_that_goes_far_is_put_by_on_the_way(paths, tmp_path, monkeypatch):
    whole = tiles(filled(tmp_path / "whole", [SAMPLE]))
    monkeypatch.setattr(job, "MOST_CELLS", 30_000)
    store = filled(tmp_path / "parts", [SAMPLE])
    with opened(next((store.path / "sums").iterdir())) as reader:
        assert len(reader.facts["tiles"]) > len(set(map(tuple, reader.facts["tiles"])))
    parts = tiles(store)
    assert parts.keys() == whole.keys()
    for tile, kept in parts.items():
        ours, theirs = (np.frombuffer(each, np.int64).reshape(len(LAYERS), -1) for each in (kept, whole[tile]))
        stood = LAYERS.index("stood")
        np.testing.assert_array_equal(ours[stood] > 0, theirs[stood] > 0)  # it is asked for no more than that
        ours, theirs = (np.delete(each, stood, axis=0) * UNIT for each in (ours, theirs))
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=10 * UNIT)


def test_tiles_are_cut_and_joined_without_loss():
    rng = np.random.default_rng(1)
    corner, shape = np.array([-300, 100]), (700, 400)
    cells = {name: np.where(rng.random(shape) < 0.3, rng.integers(0, 900, shape), 0) for name in LAYERS}
    cells = {name: v.astype(np.int32 if name == "views" else np.float32) for name, v in cells.items()}
    back = joined(Region(corner, corner + np.array(shape)), list(cut(corner, cells)))
    for name in LAYERS:
        np.testing.assert_array_equal(back[name], cells[name])


def test_what_was_seen_at_all_is_one_unit_at_least():
    assert counted(np.array([0.0, 1e-9, UNIT, 2.6 * UNIT])).tolist() == [0, 1, 1, 3]


def test_sums_too_large_for_a_number_become_two(tmp_path):
    writer = Writer("int32")
    kept = np.zeros((len(LAYERS), TILE, TILE), np.int64)
    kept[0, 3, 4], kept[1, 0, 0] = 2**31 + 5, 7
    writer.add((0, 0), kept)
    writer.add((0, 1), np.ones_like(kept))
    writer.write(tmp_path / "sums.zip")
    with opened(tmp_path / "sums.zip") as reader:
        assert len(reader.facts["tiles"]) == 3
        np.testing.assert_array_equal(reader.tile((0, 0)), kept)
        assert reader.tile((0, 1)).min() == 1
        assert reader.tile((5, 5)).max() == 0


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda store: (store / "store.json").write_text("{}"), "store.json: format: found None"),
        (lambda store: (store / "store.json").unlink(), "found a folder without store.json"),
        (lambda store: next((store / "logs").iterdir()).write_text("["), "found something that is no JSON object"),
        (lambda store: next((store / "logs").iterdir()).write_text("{}"), "found a record with other keys"),
        (lambda store: next((store / "sums").iterdir()).write_bytes(b"PK"), "found sums that cannot be read"),
        (lambda store: next((store / "sums").iterdir()).unlink(), "found sums that cannot be read (No such file"),
    ],
    ids=["kind", "no store", "text", "record", "sums", "no sums"],
)
def test_damage_is_told_in_a_line(paths, tmp_path, damage, told):
    store = filled(tmp_path / "store", paths[:1])
    damage(store.path)
    with pytest.raises(InputError) as caught:
        Reading.of(Store(store.path)).grid()
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_sums_of_other_weights_are_not_added(paths, tmp_path):
    store = filled(tmp_path / "store", paths[:1])
    where = store.path / "store.json"
    where.write_text(json.dumps(json.loads(where.read_text()) | {"weights": "other"}))
    outcome = added(store, paths[1])
    assert outcome.what == "refused"
    assert "map the logs into a new store" in outcome.reason


def test_a_merged_tile_that_is_damaged_is_made_anew(paths, tmp_path):
    store = filled(tmp_path / "store", paths[:1])
    before = tiles(store)
    for merged in (store.path / "merged").iterdir():
        merged.write_bytes(merged.read_bytes()[:200])
    assert tiles(store) == before


def test_two_commands_do_not_work_in_one_store(tmp_path):
    store = Store.made(tmp_path / "store")
    with store.locked(), pytest.raises(UsageError, match="found another echogrid fleet at work"), store.locked():
        pass


def test_a_folder_that_is_something_else_is_left_alone(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(InputError, match=r"a folder without store\.json"):
        Store.made(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("t,x,y,theta,r0\n0,0,0,0,1\n", "found 1 sonars, expected --robot"),
        ("garbage\n", "found 'garbage', expected"),
    ],
    ids=["no robot", "no log"],
)
def test_a_log_that_cannot_be_mapped_says_why(tmp_path, content, told):
    (tmp_path / "log.csv").write_text(content)
    store = Store.made(tmp_path / "store")
    outcome = add(task(store, tmp_path / "log.csv", robot=None))
    assert outcome.what == "refused"
    assert told in outcome.reason
    assert store.records() == []
