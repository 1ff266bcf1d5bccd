"""Builds that take minutes, on copies of the repository; `make builds` runs them."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
COMPILERS = re.compile(r"(.*-)?(c\+\+|g\+\+|gcc|cc|clang|clang\+\+)(-[\d.]+)?$|c[89]9(-gcc)?$")


def run(*command, cwd, **environment):
    """Both streams of a command that must go well."""
    alone = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "MFLAGS", "PYTHON"))}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env=alone | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-4000:]
    return done.stdout


@pytest.fixture
def copy(tmp_path):
    """The repository as git would commit it."""
    listed = run("git", "ls-files", "--cached", "--others", "--exclude-standard", "-z", cwd=ROOT)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (tmp_path / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tmp_path / "copy" / name)
    return tmp_path / "copy"


@pytest.fixture
def without_compiler(tmp_path):
    """A PATH with every program of this machine but its compilers."""
    folder = tmp_path / "programs"
    folder.mkdir()
    for place in os.environ["PATH"].split(":"):
        for program in Path(place).iterdir() if Path(place).is_dir() else ():
            if not COMPILERS.match(program.name) and not os.path.lexists(folder / program.name):
                (folder / program.name).symlink_to(program)
    assert not any(shutil.which(name, path=folder) for name in ("c++", "g++", "clang++", "cc"))
    return str(folder)


def test_the_sdist_builds_without_a_network_into_a_wheel_of_the_stable_abi(copy, tmp_path):
    run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path / "dist", cwd=copy)
    [sdist] = (tmp_path / "dist").iterdir()
    with tarfile.open(sdist) as held:
        names = {"/".join(name.split("/")[1:]) for name in held.getnames()}
    sources = [path for path in (copy / "core").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert {path.relative_to(copy).as_posix() for path in sources} <= names
    offline = ["unshare", "-n"] if shutil.which("unshare") and os.geteuid() == 0 else []
    pip = [sys.executable, "-m", "pip", "wheel", "--no-index", "--no-build-isolation", "--no-deps"]
    run(*offline, *pip, "--wheel-dir", tmp_path / "wheel", sdist, cwd=tmp_path)
    [wheel] = (tmp_path / "wheel").iterdir()
    assert "-cp312-abi3-" in wheel.name
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as held:
        held.extractall(site)
    assert sorted(path.name for path in site.glob("echogrid/_core*")) == ["_core.abi3.so", "_core.pyi"]
    assert not list(site.glob("**/*.cpp"))
    exported = [sorted(c.name for c in part.glob("echogrid/microcontroller/c/*")) for part in (copy / "src", site)]
    assert exported[0] == exported[1] != []
    code = "from echogrid import _core; print(_core.__file__, _core.instructions())"
    # Not the Python of .venv: an editable install comes before PYTHONPATH.
    told = run(Path(sys.executable).resolve(), "-c", code, cwd=tmp_path, PYTHONPATH=str(site))
    assert told.startswith(str(site))
    print(f"sdist {sdist.stat().st_size / 1e6:.1f} MB, wheel {wheel.stat().st_size / 1e6:.2f} MB")


def test_without_a_compiler_make_map_takes_zig_and_says_so(copy, without_compiler):
    said = run("make", f"PYTHON={Path(sys.executable).resolve()}", "map", cwd=copy, PATH=without_compiler)
    assert len(re.findall(r"^make: found no C\+\+ compiler .* zig builds the core", said, re.MULTILINE)) == 1
    assert (copy / "out" / "map.png").exists()
    cache = (copy / "core" / "editable" / "CMakeCache.txt").read_text()
    assert re.search(r"^ECHOGRID_ZIG:FILEPATH=.*/ziglang/zig$", cache, re.MULTILINE)
    run(copy / ".venv/bin/python", "-m", "pytest", "-n", "0", "tests/core", cwd=copy, PATH=without_compiler)


def test_pip_alone_installs_for_editing_and_does_so_again(copy, tmp_path):
    run(sys.executable, "-m", "venv", tmp_path / "venv", cwd=tmp_path)
    for _ in range(2):  # what the first one left does not disturb the second, whose build environment is another
        run(tmp_path / "venv/bin/pip", "install", "--no-deps", "--editable", ".", cwd=copy)
        (copy / "core" / "pool.cpp").touch()
    told = run(tmp_path / "venv/bin/python", "-c", "from echogrid import _core; print(_core.__file__)", cwd=tmp_path)
    assert told.strip() == str(copy / "src/echogrid/_core.abi3.so")
