"""The page of a map: what it holds is what was mapped, and in a real browser it does what it offers, alone."""

import base64
import json
import os
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from echogrid.cli import main
from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.grid import P_MAX, P_MIN, Grid
from echogrid.mapping import build as mapping
from echogrid.output import page
from echogrid.output.mapfile import read_map
from echogrid.output.page import Page, Recording, write_page
from echogrid.robot import Robot, Transducer

HOSTILE = (
    """</title></script><script>broken = 1</script><img src="http://127.0.0.1:9/" onerror="broken=2">{{facts}}"""
)
ROBOT = Robot(
    "</script ><b>duo", 0.2, Transducer("t", 5e4, 0.02), 0.2, 4.0, 0.5, np.array([[0.1, 0, 0], [0, 0.1, 1.5]])
)
P_STEP = (P_MAX - P_MIN) / 254
CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")


def a_grid(rows=60, cols=90, resolution=0.1, origin=(-2.0, 3.0), seed=0):
    rng = np.random.default_rng(seed)
    observed = np.zeros((rows, cols), bool)
    observed[5:-7, 3:-4] = True
    observed[20:25, 30:34] = False
    log_odds = np.where(observed, rng.normal(0, 2, (rows, cols)), 0).astype(np.float32)
    views = np.where(observed, rng.integers(1, 70_000, (rows, cols)), 0).astype(np.int32)
    return Grid(log_odds, observed, resolution, origin, views)


def a_frame(k, mounts=None):
    return Frame(
        100 + 0.25 * k, np.array([0.1 * k, 4 + 0.02 * k, 6.3 * k]), np.array([1 + k / 1000, np.inf]), mounts=mounts
    )


def a_recording(frames=40, grid=None):
    """A drive that was mapped by tens, the map growing to the right, without reading ahead."""
    grid = grid or a_grid()
    recording = Recording(ROBOT)
    for k in range(frames):
        recording.add(a_frame(k))
        if k % 10 == 9:
            recording.keep(part_of(grid, 20 + 2 * k))
    return recording


def part_of(grid, cols):
    """The grid with nothing right of a column, cut there."""
    return Grid(grid.log_odds[:, :cols], grid.observed[:, :cols], grid.resolution, grid.origin)


class Decoded:
    """What a page holds, unpacked by another way than the page does it."""

    def __init__(self, file):
        text = file.read_text(encoding="utf-8")
        (facts,) = re.findall(r'id="facts">(.*?)</script>', text, re.DOTALL)
        (packed,) = re.findall(r'id="packed">(.*?)</script>', text)
        self.facts, packed = json.loads(facts), zlib.decompress(base64.b64decode(packed))
        self.arrays = {
            name: np.frombuffer(packed, "<" + kind, count, first)
            for name, (kind, first, count) in self.facts["arrays"].items()
        }

    def maps(self):
        """Codes after each step."""
        codes, at = np.zeros((self.facts["rows"], self.facts["cols"]), np.uint8), 0
        for step in self.facts["steps"]:
            rows, cols = step["rows"], step["cols"]
            change = self.arrays["steps"][at : at + rows * cols].reshape(rows, cols)
            codes[step["row"] : step["row"] + rows, step["col"] : step["col"] + cols] += change
            at += rows * cols
            yield step["scans"], codes.copy()
        assert at == self.arrays["steps"].size

    def codes_at(self, codes, points):
        """Codes of the cells that hold points of the world; 0 outside."""
        cells = np.floor((points - self.facts["origin"]) / self.facts["resolution"] + 1e-6).astype(int)
        inside = ((cells >= 0) & (cells < [self.facts["cols"], self.facts["rows"]])).all(axis=-1)
        col, row = np.where(inside[..., None], cells, 0).T
        return np.where(inside, codes[row, col], 0)


def centres(grid):
    return grid.centre_of(np.argwhere(np.ones(grid.shape, bool)))


def same_map(decoded, codes, grid, within=0.51 * P_STEP):
    points = centres(grid)
    found = decoded.codes_at(codes, points)
    np.testing.assert_array_equal(found > 0, grid.observed.ravel())
    p = P_MIN + P_STEP * (found - 1.0)
    np.testing.assert_allclose(p[found > 0], grid.probability_at(points)[found > 0], atol=within)


def test_the_page_holds_the_final_map_and_its_views(tmp_path):
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "a map")
    decoded = Decoded(tmp_path / "map.html")
    *_, (scans, codes) = decoded.maps()
    assert scans == 40
    same_map(decoded, codes, grid)
    views = np.cumsum(decoded.arrays["views"].reshape(codes.shape), axis=1, dtype=decoded.arrays["views"].dtype)
    np.testing.assert_array_equal(decoded.codes_at(views, centres(grid)), grid.views.ravel())


def test_the_page_holds_the_map_at_each_time_it_was_kept(tmp_path):
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "a map")
    decoded = Decoded(tmp_path / "map.html")
    maps = list(decoded.maps())
    assert [scans for scans, _ in maps] == [10, 20, 30, 40]
    for scans, codes in maps[:-1]:
        then = part_of(grid, 20 + 2 * (scans - 1))
        same_map(decoded, codes, then, within=(page.TOLERANCE + 0.51) * P_STEP)
        assert np.count_nonzero(codes) == np.count_nonzero(then.observed)


def test_a_map_that_changes_later_is_kept_as_it_was(tmp_path):
    grid, recording = a_grid(), Recording(ROBOT)
    recording.add(a_frame(0))
    then = Grid(grid.log_odds.copy(), grid.observed.copy(), grid.resolution, grid.origin)
    recording.keep(grid)
    recording.add(a_frame(1))
    grid.log_odds[:], grid.observed[:] = -1, True
    write_page(tmp_path / "map.html", grid, recording, "")
    decoded = Decoded(tmp_path / "map.html")
    (_, first), (_, last) = decoded.maps()
    same_map(decoded, first, then)
    same_map(decoded, last, grid)


def test_the_page_holds_the_drive(tmp_path):
    recording = Recording(ROBOT)
    other = np.array([[0.15, 0.01, 0.2], [0.0, -0.1, -3.0]])
    frames = [a_frame(k, other if k == 3 else None) for k in range(9)]
    frames[5] = Frame(frames[5].stamp, frames[5].pose, np.array([np.nan, 3.999]))
    for frame in frames:
        recording.add(frame)
    write_page(tmp_path / "map.html", a_grid(), recording, "")
    decoded = Decoded(tmp_path / "map.html")
    units, arrays = decoded.facts["units"], decoded.arrays
    summed = {name: np.cumsum(arrays[name]) for name in ("number", "time", "x", "y", "theta")}
    np.testing.assert_array_equal(summed["number"], np.arange(1, 10))
    np.testing.assert_allclose(summed["time"] * units["time"], [f.stamp - 100 for f in frames], atol=5.1e-4)
    for k, name in enumerate(("x", "y")):
        place = summed[name] * units["place"] + decoded.facts["first"][k]
        np.testing.assert_allclose(place, [f.pose[k] for f in frames], atol=1e-4)
    turn = summed["theta"] * units["angle"] - [f.pose[2] for f in frames]
    np.testing.assert_allclose(np.cos(turn), 1, atol=1e-8)
    ranges = arrays["ranges"].reshape(9, 2)
    np.testing.assert_array_equal(ranges[:3], [[1000 + k, page.NO_ECHO] for k in range(3)])
    np.testing.assert_array_equal(ranges[5], [page.NOT_FIRED, 3999])
    mounts = arrays["mounts"].reshape(9, 2, 3) * [1e-3, 1e-3, units["angle"]]
    np.testing.assert_allclose(mounts[2], ROBOT.mounts, atol=5.1e-4)
    np.testing.assert_allclose(mounts[3], other, atol=5.1e-4)


def test_far_places_and_long_times_fit_their_integers(tmp_path):
    recording = Recording(ROBOT)
    for stamp, x in ((0.0, -9e6), (9e10, 9e6)):
        recording.add(Frame(stamp, np.array([x, 0.0, 0.0]), np.array([99.0, 0.3])))
    write_page(tmp_path / "map.html", a_grid(origin=(9e6, 0.0)), recording, "")
    decoded = Decoded(tmp_path / "map.html")
    units, arrays = decoded.facts["units"], decoded.arrays
    np.testing.assert_allclose(np.cumsum(arrays["time"])[-1] * units["time"], 9e10, rtol=1e-8)
    np.testing.assert_allclose(np.cumsum(arrays["x"])[-1] * units["place"], 18e6, rtol=1e-8)
    np.testing.assert_allclose(arrays["ranges"] * units["range"], [99, 0.3, 99, 0.3], atol=1e-3)


def test_a_recording_stays_bounded_and_keeps_the_last_scan():
    recording, grid = Recording(ROBOT), a_grid(20, 20)
    frame = a_frame(0)
    for k in range(16_003):
        recording.add(frame)
        assert len(recording._frames) <= page.MAX_SCANS
        if k % 20 == 0:
            recording.keep(grid)
            assert len(recording._maps) <= page.MAX_MAPS
    numbers = [number for number, _ in recording.frames()]
    assert recording.stride == 8
    assert numbers == [*range(1, 16_003, 8), 16_003]
    steps = np.diff([kept.read for kept in recording.maps()])
    assert len(steps) >= page.MAX_MAPS // 2 - 1
    assert len(set(steps)) == 1


def test_a_map_that_lags_behind_the_reading_is_given_its_time():
    """As ``build_map`` does it: batches of 64 and a frame ahead, two batches waiting."""
    assert page.AHEAD == mapping.WORKERS
    recording, grid = Recording(ROBOT), a_grid(20, 20)
    read = [64 * k + 1 for k in range(1, 8)] + [500]
    seen = [*read[2:], 500, 500]
    for scans in seen:
        while recording.scans < scans:
            recording.add(a_frame(0))
        recording.keep(grid)
    assert [kept.scans for kept in recording.maps()] == [64, 128, *read[2:-1]]


def test_a_thousand_scans_in_a_room_stay_below_a_megabyte(tmp_path):
    """A map of 10 x 8 m in cells of 4 cm, kept as often as can be, all of it changing each time."""
    robot = Robot.load("b21")
    recording, rng = Recording(robot), np.random.default_rng(0)
    y, x = np.mgrid[0:200, 0:250] * 0.04
    walls = np.minimum.reduce([abs(x - 1.5), abs(x - 8.5), abs(y - 1.5), abs(y - 6.5)])
    wanted = np.where(walls < 0.1, 3, np.where((abs(x - 5) < 3.5) & (abs(y - 4) < 2.5), -3, 0.3 * np.sin(5 * x * y)))
    log_odds, observed, views = (
        np.zeros_like(wanted, np.float32),
        np.zeros(wanted.shape, bool),
        np.zeros(wanted.shape, int),
    )
    for k in range(1000):
        pose = np.array([5 + 2.4 * np.sin(k / 80), 4 + 1.5 * np.cos(k / 50), rng.normal()])
        ranges = np.where(rng.random(24) < 0.4, np.inf, rng.uniform(0.2, 5, 24))
        recording.add(Frame(0.2 * k, pose, ranges))
        near = np.hypot(x - pose[0], y - pose[1]) < 2.5
        observed |= near
        views += near
        log_odds[near] += (0.02 * wanted[near] * rng.uniform(0.5, 1.5, np.count_nonzero(near))).astype(np.float32)
        if k % 17 == 16:
            recording.keep(Grid(log_odds, observed, 0.04, (0.0, 0.0)))
    write_page(tmp_path / "map.html", Grid(log_odds, observed, 0.04, (0.0, 0.0), views), recording, "")
    assert len(recording.maps()) == 58
    assert (tmp_path / "map.html").stat().st_size < 1_000_000


def test_a_large_map_is_shown_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_IMAGE_CELLS", 1000)
    grid = a_grid()
    write_page(tmp_path / "map.html", grid, a_recording(), "")
    decoded = Decoded(tmp_path / "map.html")
    block = decoded.facts["block"]
    *_, (_, codes) = decoded.maps()
    assert block == 3
    assert codes.size <= 1000
    for row, col in ((0, 0), (4, 7), (10, 20)):
        cells = np.s_[5 + block * row : 5 + block * (row + 1), 3 + block * col : 3 + block * (col + 1)]
        p = np.where(grid.observed, grid.probability(), 0)[cells].max()
        assert P_MIN + P_STEP * (codes[row, col] - 1) == pytest.approx(p, abs=0.51 * P_STEP)
        views = np.cumsum(decoded.arrays["views"].reshape(codes.shape), axis=1, dtype=np.uint32)
        assert views[row, col] == grid.views[cells].max()


def test_too_many_changes_cost_maps_on_the_way_not_the_last(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_CHANGES", 6000)
    grid, recording = a_grid(), Recording(ROBOT)
    for k in range(8):
        recording.add(a_frame(k))
        recording.keep(a_grid(seed=k + 1))
    recording.add(a_frame(9))
    write_page(tmp_path / "map.html", grid, recording, "")
    decoded = Decoded(tmp_path / "map.html")
    maps = list(decoded.maps())
    assert len(maps) == 2
    same_map(decoded, maps[-1][1], grid)


def test_a_page_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "map.html"
    file.write_text("old")
    with pytest.raises(UsageError, match="page: found no frames"):
        write_page(file, a_grid(), Recording(ROBOT), "")
    other = a_recording(12, a_grid(resolution=0.2))
    with pytest.raises(UsageError, match=r"page: found maps of other cells than 0\.1 m, expected one size"):
        write_page(file, a_grid(), other, "")
    assert [each.read_text() for each in tmp_path.iterdir()] == ["old"]
    Page(file, ROBOT, "new").add(a_frame(0))
    write_page(file, a_grid(), a_recording(), "new")
    assert "<h1>new</h1>" in file.read_text()
    assert os.listdir(tmp_path) == ["map.html"]


def test_nothing_observed_and_a_name_that_is_no_text_make_a_page(tmp_path):
    grid = a_grid(4, 5)
    blank = Grid(np.zeros_like(grid.log_odds), np.zeros_like(grid.observed), grid.resolution, grid.origin)
    write_page(tmp_path / "map.html", blank, a_recording(3), "log \udcff.csv")
    decoded = Decoded(tmp_path / "map.html")
    ((_, codes),) = decoded.maps()
    assert not codes.any()
    assert "views" not in decoded.arrays


def test_the_command_writes_the_page(tmp_path):
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text("t,x,y,theta," + ",".join(f"r{k}" for k in range(24)) + "\n" + "1,0,0,0" + ",1.5" * 24 + "\n")
    main(["map", str(log), "--robot", "b21", "--interpreter", "cone", "--out", str(out), "--view"])
    decoded, grid = Decoded(out / "map.html"), read_map(out)
    *_, (scans, codes) = decoded.maps()
    assert scans == 1
    same_map(decoded, codes, grid)
    assert "<h1>log.csv, b21, cone</h1>" in (out / "map.html").read_text()


def test_the_page_names_no_other_place(tmp_path):
    write_page(tmp_path / "map.html", a_grid(), a_recording(), "a map")
    text = re.sub(r"""id="packed">[^<]*|'sha256-[^']*'""", "", (tmp_path / "map.html").read_text())
    assert (
        re.findall(r"(?i)https?:|//[a-z]|@import|url\(|sourceMappingURL|<link(?! rel=.icon. href=.data:)", text) == []
    )
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy == "default-src 'none'; script-src ; style-src ; img-src data:; base-uri 'none'; form-action 'none'"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if not (CHROMIUM.exists() and DRIVER.exists()):
        pytest.skip("no chromium with its driver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = str(CHROMIUM)
    profile = tmp_path_factory.mktemp("profile")
    for flag in ("headless=new", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync"):
        options.add_argument(f"--{flag}")
    for flag in ("disable-background-networking", "disable-component-update", f"user-data-dir={profile}"):
        options.add_argument(f"--{flag}")
    # Nor does the browser itself look for anybody.
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1")
    options.add_argument("--window-size=1200,800")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(DRIVER)))
    driver.set_page_load_timeout(30)
    driver.set_script_timeout(15)
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "map.html"
    write_page(file, a_grid(), a_recording(), HOSTILE)
    return file


@pytest.fixture
def opened(browser, page_file):
    """The page, freshly loaded, without a word in the console by the end of the test."""
    opened_page(browser, page_file)
    yield browser
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []


def opened_page(browser, file):
    browser.get_log("browser"), browser.get_log("performance")
    browser.get(file.as_uri())
    wait(browser, "return document.body.getAttribute('aria-busy') === 'false'")


def wait(browser, script):
    """Until a script says so."""
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 20, 0.05).until(lambda driver: driver.execute_script(script))


def by_id(browser, name):
    return browser.find_element("id", name)


def now(browser):
    return by_id(browser, "now").text


def picture(browser):
    return browser.execute_script("drawNow(); return canvas.toDataURL()")


def hover(browser, x, y):
    """Point at a place of the world, m; what the page reads there."""
    from selenium.webdriver import ActionChains

    left, top, width, height = browser.execute_script(
        "const b = canvas.getBoundingClientRect(); return [toX(arguments[0]), toY(arguments[1]), b.width, b.height]",
        x,
        y,
    )
    assert 0 < left < width
    assert 0 < top < height
    # Whole pixels from the middle of the map.
    away = round(left - width / 2), round(top - height / 2)
    ActionChains(browser, duration=0).move_to_element_with_offset(by_id(browser, "map"), *away).perform()
    browser.execute_script("drawNow()")
    return by_id(browser, "cell").text


def test_it_opens_alone_and_quiet(opened):
    sent = [json.loads(entry["message"])["message"] for entry in opened.get_log("performance")]
    asked = [each["params"] for each in sent if each["method"] == "Network.requestWillBeSent"]
    # The browser's own start page asks for parts of itself.
    urls = [each["request"]["url"] for each in asked if not each["documentURL"].startswith("chrome:")]
    assert [url for url in urls if not url.startswith("data:")] == [opened.current_url]
    assert opened.execute_script("return performance.getEntriesByType('resource').length") == 0
    assert now(opened) == "9.8 s, scan 40 of 40"
    assert "40 scans of </script ><b>duo (2 sonars) in 9.8 s." in by_id(opened, "summary").text


def test_a_hostile_title_is_a_title(opened):
    assert opened.title == HOSTILE
    assert opened.find_element("tag name", "h1").text == HOSTILE
    assert opened.execute_script("return typeof broken") == "undefined"
    assert opened.find_elements("tag name", "img") == []


def test_the_policy_stops_what_would_leave(browser, page_file):
    opened_page(browser, page_file)
    script = """
    const done = arguments[0], stopped = [];
    document.addEventListener("securitypolicyviolation", (event) => stopped.push(event.effectiveDirective));
    new Image().src = "http://127.0.0.1:9/x.png";
    document.body.append(Object.assign(document.createElement("script"), { textContent: "broken = 1" }));
    fetch("http://127.0.0.1:9/").catch(() => setTimeout(() => done(stopped), 100));
    """
    assert set(browser.execute_async_script(script)) == {"img-src", "script-src-elem", "connect-src"}
    assert browser.execute_script("return typeof broken") == "undefined"
    browser.get_log("browser")


def test_the_pointer_reads_the_cell(opened):
    grid = a_grid()
    for row, col in ((30, 50), (5, 3), (52, 85), (40, 20)):
        x, y = grid.centre_of(np.array([row, col])).tolist()
        text = hover(opened, x, y)
        numbers = re.fullmatch(r"x (\S+) m, y (\S+) m: occupied with probability (\S+), from (\S+) scans?", text)
        assert numbers, text
        px, py, p, views = (float(each.replace(",", "").replace("\u2212", "-")) for each in numbers.groups())
        assert (px, py) == pytest.approx((x, y), abs=0.05)
        assert p == pytest.approx(float(grid.probability_at(np.array([x, y]))), abs=0.5 * P_STEP + 0.0051)
        assert views == grid.views[row, col]
    for row, col in ((22, 32), (2, 40)):
        assert hover(opened, *grid.centre_of(np.array([row, col])).tolist()).endswith(": not observed")


def test_the_slider_changes_the_time_and_the_picture(opened):
    from selenium.webdriver import ActionChains

    before, slider = picture(opened), by_id(opened, "time")
    width = slider.size["width"]
    ActionChains(opened).move_to_element_with_offset(slider, width // 2 - 8, 0).click_and_hold().move_by_offset(
        -width // 2, 0
    ).release().perform()
    scan = int(slider.get_attribute("value"))
    assert 10 < scan < 30
    assert now(opened) == f"{scan / 4:.1f} s, scan {scan + 1} of 40".replace(".25", ".3")
    assert slider.get_attribute("aria-valuetext") == now(opened)
    assert picture(opened) != before


def test_the_map_at_a_time(opened):
    grid = a_grid()
    left, right = (grid.centre_of(np.array([30, col])).tolist() for col in (10, 70))
    opened.execute_script("show(14)")
    assert "probability" in hover(opened, *right)
    by_id(opened, "sofar").click()
    assert by_id(opened, "age").text.startswith("The map after about 10 of 40 scans")
    assert hover(opened, *right).endswith("not observed so far")
    assert "probability" in hover(opened, *left)
    opened.execute_script("show(3)")
    assert by_id(opened, "age").text.startswith("Nothing is mapped yet")
    assert hover(opened, *left).endswith("not observed so far")
    opened.execute_script("show(39)")
    p = float(grid.probability_at(np.array(right)))
    assert f"probability {p:.1f}"[:-1] in hover(opened, *right)


def test_play_and_the_keys(opened):
    from selenium.webdriver import ActionChains, Keys

    def press(key):
        ActionChains(opened, duration=0).send_keys(key).perform()

    press(Keys.HOME)
    assert now(opened) == "0.0 s, scan 1 of 40"
    press(Keys.ARROW_RIGHT)
    press(Keys.ARROW_RIGHT)
    press(Keys.ARROW_LEFT)
    assert "scan 2 of" in now(opened)
    opened.execute_script("element('speed').value = '5'")
    press(" ")
    assert by_id(opened, "play").text == "Pause"
    wait(opened, "return state.scan > 4")
    press(" ")
    stood = now(opened)
    assert by_id(opened, "play").text == "Play"
    opened.execute_async_script("setTimeout(arguments[0], 200)")
    assert now(opened) == stood
    by_id(opened, "play").click()
    wait(opened, "return !state.playing")
    assert now(opened) == "9.8 s, scan 40 of 40"


def test_the_wheel_zooms_towards_the_pointer_and_a_drag_pans(opened):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    canvas = by_id(opened, "map")
    before = opened.execute_script("return [view.scale, ...toWorld(view.width / 2 + 90, view.height / 2 - 40)]")
    bar = canvas.get_attribute("data-scale-bar")
    scroll = ScrollOrigin.from_element(canvas, 90, -40)
    ActionChains(opened).scroll_from_origin(scroll, 0, -300).scroll_from_origin(scroll, 0, -300).perform()
    wait(opened, f"return view.scale > 2.5 * {before[0]}")
    after = opened.execute_script("drawNow(); return toWorld(view.width / 2 + 90, view.height / 2 - 40)")
    # The pointer stands on a whole pixel.
    assert after == pytest.approx(before[1:], abs=1.5 / before[0])
    assert canvas.get_attribute("data-scale-bar") != bar
    scale, x, y = opened.execute_script("return [view.scale, view.x, view.y]")
    ActionChains(opened).move_to_element(canvas).click_and_hold().move_by_offset(60, 30).release().perform()
    assert opened.execute_script("return [view.scale, view.x, view.y]") == pytest.approx(
        [scale, x - 60 / scale, y + 30 / scale]
    )
    by_id(opened, "fit").click()
    assert opened.execute_script("return view.scale") == pytest.approx(before[0])


def test_light_and_dark(opened):
    def colour():
        return opened.execute_script("return getComputedStyle(document.body).backgroundColor")

    light, before, toggle = colour(), picture(opened), by_id(opened, "theme")
    toggle.click()
    assert colour() != light
    assert toggle.get_attribute("aria-pressed") == "true"
    assert picture(opened) != before
    toggle.click()
    assert (colour(), picture(opened)) == (light, before)
    media = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    try:
        opened.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        opened.refresh()
        wait(opened, "return document.body.getAttribute('aria-busy') === 'false'")
        assert colour() != light
    finally:
        opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_cones_are_drawn_at_their_ranges_and_what_did_not_fire_is_not(browser, tmp_path):
    """One sonar ahead hears 1 m on an empty map; the picture differs from one without cones up to its arc alone."""
    grid, recording = a_grid(), Recording(ROBOT)
    grid.log_odds[:], grid.observed[:] = -3, True
    recording.add(Frame(0.0, np.array([2.0, 6.0, 0.0]), np.array([1.0, np.nan])))
    write_page(tmp_path / "map.html", grid, recording, "")
    opened_page(browser, tmp_path / "map.html")
    script = """
    const read = (x, y) => [...context.getImageData(Math.round(toX(x)), Math.round(toY(y)), 1, 1).data];
    const places = arguments[0], get = () => { drawNow(); return places.map(([x, y]) => read(x, y).join()); };
    element("cones").checked = true; const on = get(); element("cones").checked = false; const off = get();
    return on.map((each, i) => each !== off[i]);
    """
    # Within the cone, on its arc, past it, beside it, and where the second sonar would look.
    places = [[2.7, 6.0], [3.1, 6.0], [3.3, 6.0], [2.6, 6.4], [2.05, 7.0]]
    assert browser.execute_script(script, places) == [True, True, False, False, False]


def test_at_400_pixels_everything_is_within_reach(opened):
    size = {"width": 400, "height": 800, "deviceScaleFactor": 2, "mobile": True}
    try:
        opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        wait(opened, "return view.width <= 400")
        script = """
        const parts = document.querySelectorAll("#map, button, input, select, aside");
        const boxes = [...parts].map((part) => part.getBoundingClientRect());
        return boxes.filter((box) => box.right > 400 || box.left < 0).length;
        """
        assert opened.execute_script(script) == 0
        assert opened.execute_script("return document.documentElement.scrollWidth") <= 400
    finally:
        opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_every_control_has_a_name(opened):
    controls = opened.find_elements("css selector", "button, input, select, canvas")
    assert len(controls) == 11
    assert [control.get_attribute("id") for control in controls if not control.accessible_name] == []
