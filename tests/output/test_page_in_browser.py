"""The page of a map: in a real browser it does what it offers, alone."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from echogrid.frame import Frame
from echogrid.output.page import write_page
from echogrid.output.recording import Recording
from page_samples import P_STEP, ROBOT, a_grid, a_recording

HOSTILE = (
    """</title></script><script>broken = 1</script><img src="http://127.0.0.1:9/" onerror="broken=2">{{facts}}"""
)


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
    assert now(opened) == "0.0 s, scan 1 of 40"
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
    controls = [control for control in controls if control.is_displayed()]
    assert len(controls) == 11
    assert [control.get_attribute("id") for control in controls if not control.accessible_name] == []


def test_a_corrected_drive_shows_what_the_odometry_said_and_the_loops(browser, tmp_path):
    recording = Recording(ROBOT)
    for number, frame in a_recording().frames():
        recording.add(replace(frame, odom=frame.pose + number * np.array([0.02, 0.01, 0.0])))
    write_page(tmp_path / "map.html", a_grid(), recording, "corrected", [(3, 30), (5, 39)])
    opened_page(browser, tmp_path / "map.html")
    assert by_id(browser, "closed").text == "2 loops closed: found to be near, by their ranges"
    assert browser.execute_script("return facts.loops") == [[3, 30], [5, 39]]
    first = recording.frames()[0][1].odom
    told = browser.execute_script("return [scans.toldX[0], scans.toldY[0], scans.toldX[39] - scans.x[39]]")
    assert first is not None
    assert told == pytest.approx([*first[:2], 0.02 * 40], abs=1e-3)
    both = picture(browser)
    by_id(browser, "odometry").click()
    assert picture(browser) != both
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []


def test_a_drive_of_good_poses_shows_neither(opened):
    assert not by_id(opened, "odometry").is_displayed()
    assert not by_id(opened, "closed").is_displayed()
