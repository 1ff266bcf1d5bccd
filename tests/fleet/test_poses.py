import numpy as np
import pytest

pytest.importorskip("zarr", reason="found no zarr")

from benchmarks.fleet import tiles
from echogrid.fleet.poses import FilePoses, MapPoses, map_hash
from echogrid.fleet.reading import Reading
from echogrid.fleet.store import Store
from echogrid.geometry import compose
from echogrid.grid import Grid
from echogrid.output.map_file import write_grid
from echogrid.output.trajectory import write_tum
from fleet_samples import FRAMES, PIECES, added, filled, logs


def turned(frames, by):
    """The drive as it looks from another origin."""
    return [type(frame)(frame.stamp, compose(np.array(by, float), frame.pose), frame.ranges) for frame in frames]


def tum(path, frames):
    write_tum(path, np.array([frame.stamp for frame in frames]), np.array([frame.pose for frame in frames]))


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """A store of two drives at their true poses, and the drives in frames of their own."""
    home = tmp_path_factory.mktemp("poses")
    store = filled(home / "store", logs(home, PIECES[:2]))
    (home / "odometry").mkdir()
    return store, logs(home / "odometry", [turned(PIECES[0], [1, 2, 0.5]), turned(PIECES[1], [-3, 0, -1])])


def near(one, other):
    """Whether two stores hold the same but for the digits that files of poses have not."""
    ours, theirs = (Reading.of(store).grid() for store in (one, other))
    assert ours.shape == theirs.shape
    assert np.mean(np.abs(ours.log_odds - theirs.log_odds)) < 0.01


@pytest.mark.parametrize("names", ["drive{}.tum", "drive{}/trajectory.tum"])
def test_poses_come_from_the_file_of_the_logs_name(straight, tmp_path, names):
    store, paths = straight
    for k in (0, 1):
        where = tmp_path / names.format(k)
        where.parent.mkdir(exist_ok=True)
        tum(where, PIECES[k])
    placed = Store.made(tmp_path / "store")
    for path in paths:
        assert added(placed, path, FilePoses(str(tmp_path))).what == "added"
    near(placed, store)


def test_poses_are_found_by_stamp_and_scans_without_one_are_counted(straight, tmp_path):
    _, paths = straight
    tum(tmp_path / "drive0.tum", PIECES[0][5:][::-1])
    placed = Store.made(tmp_path / "store")
    outcome = added(placed, paths[0], FilePoses(str(tmp_path)))
    assert outcome.frames == len(PIECES[0]) - 5
    assert "scans of which the file of poses knows none were left out (5 times)" in outcome.notes


def test_poses_of_another_log_are_refused(straight, tmp_path):
    _, paths = straight
    tum(tmp_path / "drive0.tum", FRAMES[300:400])
    outcome = added(Store.made(tmp_path / "store"), paths[0], FilePoses(str(tmp_path)))
    assert outcome.what == "refused"
    assert "found poses for 0 of the 150 scans of drive0.csv, expected rows with the stamps of 90% of them" in (
        outcome.reason
    )
    outcome = added(Store(tmp_path / "store"), paths[1], FilePoses(str(tmp_path)))
    assert "found no poses for it" in outcome.reason


def test_other_poses_take_the_place_of_the_first(straight, tmp_path):
    _, paths = straight
    placed = Store.made(tmp_path / "store")
    added(placed, paths[0])
    first = tiles(placed)
    tum(tmp_path / "drive0.tum", PIECES[0])
    assert added(placed, paths[0], FilePoses(str(tmp_path))).what == "replaced"
    assert added(placed, paths[0], FilePoses(str(tmp_path))).what == "there"
    assert len(placed.records()) == 1
    assert added(placed, paths[0]).what == "replaced"
    assert tiles(placed) == first


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """The map of the whole drive, to be localised in."""
    home = tmp_path_factory.mktemp("known")
    grid = Reading.of(filled(home / "store", logs(home, [FRAMES]))).grid()
    write_grid(home / "map.npz", grid)
    return str(home / "map.npz"), map_hash(grid)


def test_a_log_is_placed_where_the_map_explains_it(straight, known, tmp_path):
    _, paths = straight
    x, y, theta = PIECES[1][0].pose.tolist()
    placed = Store.made(tmp_path / "store")
    outcome = added(placed, paths[1], MapPoses(known[0], known[1], (x, y, theta)))
    assert outcome.what == "added", outcome.reason
    theirs = Reading.of(filled(tmp_path / "true", logs(tmp_path, [PIECES[1]]))).grid()
    ours = Reading.of(placed).grid()
    ours = ours.part(ours.index_of(theirs.centre_of(np.array([0, 0]))), theirs.shape)
    both = ours.observed & theirs.observed
    agree = np.mean(np.sign(ours.log_odds[both]) == np.sign(theirs.log_odds[both]))
    assert both.sum() > 0.9 * theirs.observed.sum()
    assert agree > 0.9
    # The map so far is another one the next time: who has his place keeps it.
    assert added(placed, paths[1], MapPoses(known[0], "other", (x, y, theta))).what == "there"


def test_a_log_that_is_not_sure_where_it_is_is_not_mapped(known, tmp_path):
    blind = [type(f)(f.stamp, f.pose, np.where(np.arange(24) == 3, f.ranges, np.inf)) for f in FRAMES[:40]]
    (path,) = logs(tmp_path, [blind])
    store = Store.made(tmp_path / "store")
    outcome = added(store, path, MapPoses(known[0], known[1], None))
    assert outcome.what == "refused"
    assert "expected a log that the map explains from end to end: it was not mapped" in outcome.reason
    assert store.records() == []


def test_a_map_is_known_by_what_it_says():
    grid = Grid(np.zeros((2, 2), np.float32), np.ones((2, 2), bool), 0.04, (0.0, 0.0))
    moved = Grid(grid.log_odds, grid.observed, 0.04, (1.0, 0.0))
    other = Grid(grid.log_odds + 1, grid.observed, 0.04, (0.0, 0.0))
    assert len({map_hash(each) for each in (grid, moved, other)}) == 3
