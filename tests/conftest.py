import atexit
import os
import shutil
import tempfile

import jaxtyping
import pytest
from hypothesis import settings

# Array shapes in signatures are checked in all tests but those marked far; an int will do where a float is asked for
# (PEP 484).
jaxtyping.install_import_hook("echogrid", "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

# How long an example takes depends on what else the machine does. A change is judged by the same examples each time;
# `pytest --hypothesis-profile=explore` looks for new ones, and for more.
settings.register_profile("echogrid", deadline=None, derandomize=True, max_examples=30)
settings.register_profile("explore", deadline=None)
settings.load_profile("echogrid")

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
    jaxtyping.config.update("jaxtyping_disable", item.get_closest_marker("far") is not None)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Where temporary files go; at the end of each test there are none."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []
