import io
import json
import re

import numpy as np
import pytest

pytest.importorskip("zarr", reason="found no zarr")

from PIL import Image

from echogrid.fleet.lattice import TILE
from echogrid.fleet.page import write_tile_page
from echogrid.fleet.reading import Reading
from fleet_samples import PIECES, filled, logs, shifted

LEVEL = "return document.documentElement.dataset.level"
HOSTILE = "</script><script>broken = 1</script>{{facts}}"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A page of two rooms 30 m apart, one of them below 0."""
    home = tmp_path_factory.mktemp("page")
    reading = Reading.of(filled(home / "store", logs(home, [PIECES[0], shifted(PIECES[0], -30.0, 4.0)])))
    (home / "out" / "map_tiles" / "0").mkdir(parents=True)
    (home / "out" / "map_tiles" / "0" / "9_9.png").write_bytes(b"old")
    write_tile_page(home / "out", reading, HOSTILE)
    return home / "out", reading


def codes(folder, level, row, col):
    """Pixels with the lowest y first: 0 not seen, else the more the more occupied."""
    with Image.open(folder / "map_tiles" / str(level) / f"{row}_{col}.png") as picture:
        assert picture.size == (TILE, TILE)
        assert picture.info["transparency"] == 0
        return np.array(picture)[::-1]


def facts(folder):
    found = re.search(r'id="facts">(.*?)</script>', (folder / "map.html").read_text())
    assert found
    return json.loads(found[1])


def test_the_lowest_level_is_the_map(page):
    folder, reading = page
    grid = reading.grid()
    expected = np.where(grid.observed, 1 + np.rint(254 * grid.probability()), 0)
    rows, cols = (n // TILE for n in grid.shape)
    shown = np.zeros(grid.shape, np.uint8)
    for name in facts(folder)["levels"][0]:
        row, col = map(int, name.split("_"))
        assert row < rows
        assert col < cols
        shown[row * TILE : (row + 1) * TILE, col * TILE : (col + 1) * TILE] = codes(folder, 0, row, col)
    assert np.abs(shown - expected).max() <= 1


def test_a_pixel_of_a_higher_level_is_as_occupied_as_the_most_occupied_below(page):
    folder, _ = page
    levels = facts(folder)["levels"]
    assert len(levels[-1]) == 1
    for level in range(1, len(levels)):
        for name in levels[level]:
            row, col = map(int, name.split("_"))
            below = np.zeros((2 * TILE, 2 * TILE), np.uint8)
            for i, j in np.ndindex(2, 2):
                if f"{2 * row + i}_{2 * col + j}" in levels[level - 1]:
                    part = codes(folder, level - 1, 2 * row + i, 2 * col + j)
                    below[i * TILE : (i + 1) * TILE, j * TILE : (j + 1) * TILE] = part
            most = below.reshape(TILE, 2, TILE, 2).max(axis=(1, 3))
            np.testing.assert_array_equal(codes(folder, level, row, col), most)


def test_the_page_names_the_pictures_that_are_there_and_no_others(page):
    folder, _ = page
    named = {f"{level}/{name}.png" for level, names in enumerate(facts(folder)["levels"]) for name in names}
    assert {str(path.relative_to(folder / "map_tiles")) for path in (folder / "map_tiles").glob("*/*")} == named


def test_a_title_is_text_and_nothing_else(page):
    text = (page[0] / "map.html").read_text()
    assert "<h1>&lt;/script&gt;&lt;script&gt;broken = 1&lt;/script&gt;{{facts}}</h1>" in text
    assert "connect-src" not in text
    assert "default-src 'none'" in text


def test_what_was_seen_is_told(page):
    folder, reading = page
    grid = reading.grid()
    seen = np.argwhere(grid.observed)
    low, high = grid.centre_of(seen.min(axis=0)), grid.centre_of(seen.max(axis=0))
    half = grid.resolution / 2
    np.testing.assert_allclose(facts(folder)["seen"], [*(low - half), *(high + half)], atol=1e-9)


def test_in_a_browser_it_shows_all_that_was_seen_moves_and_says_where(browser, page):
    from selenium.webdriver import ActionChains, Keys
    from selenium.webdriver.support.ui import WebDriverWait

    def dark():
        """How many pixels are as dark as walls."""
        with Image.open(io.BytesIO(browser.get_screenshot_as_png())) as picture:
            return np.count_nonzero(np.array(picture.convert("L")) < 60)

    def wait(shown):
        WebDriverWait(browser, 20, 0.05).until(lambda _: shown())

    folder, _ = page
    browser.get_log("browser")
    browser.get((folder / "map.html").as_uri())
    wait(lambda: dark() > 2000)  # more than its texts have
    left, low, right, high = facts(folder)["seen"]
    wide, tall = browser.execute_script("return [canvas.clientWidth, canvas.clientHeight]")
    scale = browser.execute_script("return scale")
    assert 0.5 < max((right - left) * scale / wide, (high - low) * scale / tall) < 1
    told = browser.find_element("id", "told")
    assert told.text == f"x {(left + right) / 2:.2f} m, y {(low + high) / 2:.2f} m"
    canvas = browser.find_element("id", "map")
    canvas.send_keys(Keys.ARROW_RIGHT)
    WebDriverWait(browser, 20, 0.05).until(
        lambda _: told.text.startswith(f"x {(left + right) / 2 + 80 / scale:.2f} m")
    )
    for keys, coarse in (("-" * 5, True), ("+" * 8, False)):
        canvas.send_keys(keys)
        wait(lambda coarse=coarse: (browser.execute_script(LEVEL) != "0") is coarse)
    browser.find_element("id", "all").click()
    before = browser.execute_script("return [x, y]")
    ActionChains(browser, duration=0).drag_and_drop_by_offset(canvas, 100, 0).perform()
    assert browser.execute_script("return x") < before[0]
    assert browser.find_element("tag name", "h1").text == HOSTILE
    assert browser.execute_script("return typeof broken") == "undefined"
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []
