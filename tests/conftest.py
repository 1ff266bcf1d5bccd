import atexit
import os
import shutil
import tempfile
from pathlib import Path

import jaxtyping
import pytest
from hypothesis import settings

# Array shapes in signatures are checked in all tests but those marked unchecked and those of whole commands, whose
# parts have tests of their own; an int will do where a float is asked for (PEP 484).
jaxtyping.install_import_hook("echogrid", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

# How long an example takes depends on what else the machine does. A change is judged by the same examples each time;
# `pytest --hypothesis-profile=explore` looks for new ones, and for more.
settings.register_profile("echogrid", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("explore", deadline=None)
settings.load_profile("echogrid")

COMMANDS = Path(__file__).parent / "cli"
CHROMIUM, DRIVER = Path("/usr/bin/chromium"), Path("/usr/bin/chromedriver")

# A program that is traced twice in one run is compiled once; nothing is taken from or left for other runs.
compiled = tempfile.mkdtemp(prefix="echogrid-tests-")
atexit.register(shutil.rmtree, compiled, ignore_errors=True)
os.environ |= {
    "JAX_PLATFORMS": "cpu",
    "JAX_COMPILATION_CACHE_DIR": compiled,
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    unchecked = item.get_closest_marker("unchecked") is not None or COMMANDS in item.path.parents
    jaxtyping.config.update("jaxtyping_disable", unchecked)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Where temporary files go; at the end of each test there are none."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A real browser, if there is one."""
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
