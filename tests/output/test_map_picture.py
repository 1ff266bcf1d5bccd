"""The picture of a map, as it is looked at."""

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree

from echogrid.grid import Grid
from echogrid.output.map_file import write_map
from map_samples import NO_PATH, a_grid, one_wall


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


def test_a_drive_of_two_hours_is_drawn_where_it_went(tmp_path):
    # Round and round through a corridor about a block that no straight line may cross.
    s = np.arange(72_000) * 0.05
    side, along = np.divmod(s % 40.0, 10.0)
    x = np.select([side == 0, side == 1, side == 2], [along, 10.0, 10.0 - along], 0.0)
    y = np.select([side == 0, side == 1, side == 2], [0.0, along, 10.0], 10.0 - along)
    grid = one_wall(0, 0, 140, 140, 0.1)
    path = np.column_stack([x, y])
    whole = picture(tmp_path, Grid(grid.log_odds, grid.observed, 0.1, (-2.0, -2.0)), path)
    once = picture(tmp_path, Grid(grid.log_odds, grid.observed, 0.1, (-2.0, -2.0)), path[:801])
    map_part = np.s_[: whole.shape[0] * 3 // 4]
    drawn, expected = (near_colour(pixels[map_part], BLUE) for pixels in (whole, once))
    # Lines that lie on each other have darker edges.
    assert max(KDTree(expected).query(drawn)[0].max(), KDTree(drawn).query(expected)[0].max()) < 2.5
