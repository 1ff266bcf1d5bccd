"""How the core is built. What takes minutes is run by `make test-builds`."""

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from echogrid import _core

ROOT = Path(__file__).parents[2]
CORE = ROOT / "core"
OBJECTS = sorted((CORE / "editable").rglob("kernels_*/kernels.cpp.o"))
FROM_LIBRARIES = {"cos", "fmaxf", "fminf", "log", "logf", "memcpy", "memset", "sin", "sincos"}
"""All that kernels may call: no heap, no file, no lock."""


def symbols(path):
    """Kind, as nm names it, and name."""
    lines = subprocess.run(["nm", path], capture_output=True, text=True, check=True).stdout.splitlines()
    return [tuple(line.split()[-2:]) for line in lines]


def built_here():
    """Whether the module that these tests use was built from these sources."""
    return Path(_core.__file__).is_relative_to(ROOT / "src")


def test_kernels_are_built_for_each_set_of_instructions():
    if not built_here():
        pytest.skip("the core was not built in this folder")
    assert {path.parent.name.split(".")[0].removeprefix("kernels_") for path in OBJECTS} >= {_core.instructions()}


@pytest.mark.skipif(not shutil.which("nm"), reason="needs nm (binutils)")
@pytest.mark.parametrize("path", OBJECTS, ids=lambda path: path.parent.name)
def test_an_object_of_kernels_exports_its_table_alone_and_calls_next_to_nothing(path):
    # A weak symbol of an object for AVX-512, picked by the linker for all, crashes a machine without it.
    table = "echogrid_" + path.parent.name.split(".")[0]
    held = symbols(path)
    assert {name for kind, name in held if kind.isupper() and kind != "U"} == {table}
    assert not {name for kind, name in held if kind.lower() in "wv"}
    called = {name for kind, name in held if kind == "U"} - {"_GLOBAL_OFFSET_TABLE_"}
    assert {name for name in called if not name.startswith(("__asan", "__ubsan"))} <= FROM_LIBRARIES


@pytest.mark.skipif(not shutil.which("objdump"), reason="needs objdump (binutils)")
@pytest.mark.parametrize("path", OBJECTS, ids=lambda path: path.parent.name)
def test_an_object_of_kernels_has_the_registers_of_its_instructions_and_no_wider(path):
    level = path.parent.name.split(".")[0].removeprefix("kernels_")
    widest = {"v2": "xmm", "v3": "ymm", "v4": "zmm"}.get(level)
    if widest is None:
        pytest.skip("not of x86-64")
    listed = subprocess.run(["objdump", "-d", path], capture_output=True, text=True, check=True).stdout
    held = set(re.findall(r"%([xyz]mm)\d", listed))
    assert widest in held
    assert held <= set(["xmm", "ymm", "zmm"][: "xyz".index(widest[0]) + 1])
    if level == "v2":
        assert not re.search(r"\tv\w+ .*%xmm", listed)  # of AVX, whose registers may be as narrow


def arguments_of(stub):
    """Names of the arguments of all functions of a stub, and of the methods of its classes."""
    for node in stub.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, [each.arg for each in node.args.args]
        elif isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.{name}", arguments[1:]) for name, arguments in arguments_of(node))


def arguments_there():
    """The same of the module, which tells them in its signatures."""
    for name in (each for each in dir(_core) if not each.startswith("_")):
        entry = getattr(_core, name)
        within = {f"{name}.{each}": value for each, value in vars(entry).items()} if isinstance(entry, type) else {}
        for told, function in (within or {name: entry}).items():
            if hasattr(function, "__nb_signature__"):
                yield told, re.findall(r"(\w+): ", function.__nb_signature__[0][0])


def test_the_stub_says_what_there_is():
    stub = ast.parse(Path(_core.__file__).with_name("_core.pyi").read_text(encoding="utf-8"))
    assert dict(arguments_of(stub)) == dict(arguments_there())


@pytest.fixture
def backend(monkeypatch):
    monkeypatch.syspath_prepend(CORE)
    for name in ("CXX", "CMAKE_TOOLCHAIN_FILE", "ECHOGRID_ZIG", "ECHOGRID_ZIG_TARGET", "_PYTHON_HOST_PLATFORM"):
        monkeypatch.setenv(name, "")
    monkeypatch.delitem(sys.modules, "backend", raising=False)
    yield pytest.importorskip("backend")
    sys.modules.pop("backend", None)


def test_zig_is_asked_for_only_where_there_is_no_compiler(backend, monkeypatch, tmp_path):
    (tmp_path / "c++").touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    hooks = backend.get_requires_for_build_wheel, backend.get_requires_for_build_editable
    assert [backend.ZIG in hook() for hook in hooks] == [False, False]
    (tmp_path / "c++").unlink()
    assert [backend.ZIG in hook() for hook in hooks] == [True, True]
    monkeypatch.setenv("CXX", "/opt/other/compiler")
    assert [backend.ZIG in hook() for hook in hooks] == [False, False]
    monkeypatch.setenv("ECHOGRID_ZIG_TARGET", "aarch64-linux-gnu.2.28")
    assert [backend.ZIG in hook() for hook in hooks] == [True, True]


def test_neither_compiler_nor_zig_is_told_in_one_line(backend, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(backend, "find_spec", lambda name: None)
    with pytest.raises(SystemExit) as raised:
        backend.build_wheel(str(tmp_path))
    assert raised.value.code == "core: found no C++ compiler, expected c++, g++, clang++ or the package ziglang"


@pytest.mark.skipif(not shutil.which("make"), reason="needs make")
def test_make_builds_anew_when_a_source_of_the_core_changes():
    sources = {
        path.relative_to(ROOT).as_posix() for pattern in ("*.cpp", "*.hpp", "*.cmake") for path in CORE.glob(pattern)
    }
    sources |= {"core/backend.py", "core/CMakeLists.txt", "core/editable/CMakeLists.txt"}
    rules = subprocess.run(["make", "-pn", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    [needs] = re.findall(r"^\.venv/ready: (.*)", rules, re.MULTILINE)
    assert sources <= set(needs.split())
