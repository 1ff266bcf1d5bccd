import csv
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("zarr", reason="found no zarr")

from echogrid.errors import UsageError
from echogrid.fleet.changes import ENOUGH, LEAST_CELLS, NEAR, common, compare
from echogrid.fleet.changes_files import COLUMNS, write_changes
from echogrid.fleet.reading import Reading
from echogrid.frame import Frame
from echogrid.grid import Grid
from echogrid.simulation.world import polyline
from fleet_samples import PIECES, ROBOT, filled, logs, shifted

ROOM = polyline([[0, 0], [5, 0], [5, 4], [0, 4]], closed=True)
BOX = polyline([[2.2, 1.7], [2.8, 1.7], [2.8, 2.3], [2.2, 2.3]], closed=True)


def heard(walls, pose):
    """Ranges to the nearest wall in each sonar's cone; walls are rough."""
    cone = np.deg2rad(np.linspace(-8, 8, 9))
    x, y, axis = ROBOT.mounts.T
    c, s = np.cos(pose[2]), np.sin(pose[2])
    at = np.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], axis=-1)[:, None, None]
    bearing = (pose[2] + axis[:, None] + cone)[..., None]
    way = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    a, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    det = way[..., 0] * -along[:, 1] + way[..., 1] * along[:, 0]
    off = a - at
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (off[..., 0] * -along[:, 1] + off[..., 1] * along[:, 0]) / det
        share = (way[..., 0] * off[..., 1] - way[..., 1] * off[..., 0]) / det
    hits = np.where((far > 0) & (share >= 0) & (share <= 1), far, np.inf)
    return ROBOT.clean(hits.min(axis=(1, 2)))


def drive(walls, seed):
    """Round the middle of the room."""
    bearing = np.linspace(0, 2 * np.pi, 160) + seed
    places = np.stack([2.5 + 1.5 * np.cos(bearing), 2 + 1.2 * np.sin(bearing)], axis=-1)
    poses = np.column_stack([places, bearing + np.pi / 2])
    return [Frame(0.2 * k, pose, heard(walls, pose)) for k, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def days(tmp_path_factory):
    """The room on two days, the second time with a box in its middle."""
    home = tmp_path_factory.mktemp("days")
    readings = []
    for day, walls in (("monday", ROOM), ("tuesday", np.concatenate([ROOM, BOX]))):
        (home / f"{day}logs").mkdir()
        paths = logs(home / f"{day}logs", [drive(walls, seed) for seed in (0, 2)])
        readings.append(Reading.of(filled(home / day, paths)))
    return readings


def test_a_box_that_was_put_there_became_occupied_and_nothing_else(days):
    region = common(*days)
    found = compare(*(day.grid(region) for day in days))
    assert found.areas
    assert {area.became for area in found.areas} == {"occupied"}
    for area in found.areas:
        assert 2.0 < area.centre[0] < 3.0
        assert 1.5 < area.centre[1] < 2.5
        assert area.before < -1.1 < 0.6 < area.after
        assert min(area.views) >= ENOUGH


def test_a_box_that_was_taken_away_became_free(days):
    region = common(*days)
    put, taken = (compare(*(day.grid(region) for day in order)) for order in (days, days[::-1]))
    assert {area.became for area in taken.areas} == {"free"}
    assert [area.cells for area in taken.areas] == [area.cells for area in put.areas]
    np.testing.assert_array_equal(taken.free, put.occupied)


def test_a_day_has_not_changed_from_itself(days):
    grid = days[0].grid()
    assert compare(grid, grid).areas == []


def a_map(walls, views=20):
    """A room of 40 x 40 cells, free but for walls."""
    log_odds = np.full((40, 40), -3, np.float32)
    for cell in walls:
        log_odds[cell] = 3
    return Grid(log_odds, np.ones((40, 40), bool), 0.04, (0.0, 0.0), np.full((40, 40), views, np.int32))


WALL = [np.s_[10:30, 20]]


def test_a_wall_that_lies_a_little_aside_has_not_come_nor_gone():
    assert compare(a_map(WALL), a_map([np.s_[10:30, 20 + NEAR]])).areas == []
    assert len(compare(a_map(WALL), a_map([np.s_[10:30, 20 + NEAR + 1]])).areas) == 2


def test_a_speck_is_no_change():
    assert compare(a_map([]), a_map([np.s_[10 : 10 + LEAST_CELLS - 1, 20]])).areas == []
    (area,) = compare(a_map([]), a_map([np.s_[10 : 10 + LEAST_CELLS, 20]])).areas
    assert area.cells == LEAST_CELLS
    assert area.box == pytest.approx((0.8, 0.4, 0.84, 0.4 + 0.04 * LEAST_CELLS))
    assert area.evidence == pytest.approx(6 * LEAST_CELLS)


@pytest.mark.parametrize("side", [0, 1])
def test_what_one_side_hardly_saw_is_not_compared(side):
    pair = [a_map([], views=20), a_map(WALL, views=20)]
    pair[side] = replace(pair[side], views=np.full((40, 40), ENOUGH - 1, np.int32))
    found = compare(*pair)
    assert (found.areas, found.compared) == ([], 0)


def test_the_table_has_a_row_for_each_area(days, tmp_path):
    region = common(*days)
    found = compare(*(day.grid(region) for day in days))
    write_changes(tmp_path, found, "tuesday")
    with open(tmp_path / "changes.csv", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == list(COLUMNS)
    assert [float(row[-1]) for row in rows[1:]] == pytest.approx([area.evidence for area in found.areas], abs=0.06)
    assert (tmp_path / "changes.png").read_bytes().startswith(b"\x89PNG")


def test_stores_of_two_places_are_not_compared(tmp_path):
    pieces = [PIECES[0], shifted(PIECES[0], 500.0, 0.0)]
    paths = logs(tmp_path, pieces)
    here, there = (Reading.of(filled(tmp_path / str(k), [path])) for k, path in enumerate(paths))
    with pytest.raises(UsageError, match="found no place in common"):
        common(here, there)
