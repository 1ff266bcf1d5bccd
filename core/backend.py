"""The build backend: scikit-build-core, and zig for a compiler on a machine that has none."""

import os
import shutil
from importlib.util import find_spec
from pathlib import Path

from scikit_build_core import build
from scikit_build_core.build import (
    build_sdist,
    get_requires_for_build_sdist,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

ZIG = "ziglang"
"""The package that holds zig; the registry is asked for it only where there is no compiler."""

TARGET = "ECHOGRID_ZIG_TARGET"
"""The environment variable that names another machine to build for, as zig does: aarch64-linux-gnu.2.28."""

if target := os.environ.get(TARGET):
    # Every step of a build, not only that which compiles, says for what machine the wheel is.
    os.environ["_PYTHON_HOST_PLATFORM"] = f"linux-{target.split('-')[0]}"

Settings = dict[str, list[str] | str] | None


def zig_is_the_compiler() -> bool:
    """Whether another machine is built for, or CMake would find no compiler. The Makefile asks the latter too."""
    told = any(os.environ.get(name) for name in ("CXX", "CMAKE_TOOLCHAIN_FILE"))
    found = told or any(shutil.which(name) for name in ("c++", "g++", "clang++"))
    return bool(os.environ.get(TARGET)) or not found


def choose_compiler() -> None:
    """Point CMake to zig if it is to be the compiler.

    Raises:
        SystemExit: zig is not there.
    """
    if not zig_is_the_compiler():
        return
    package = find_spec(ZIG)
    if package is None or package.origin is None:
        raise SystemExit(f"core: found no C++ compiler, expected c++, g++, clang++ or the package {ZIG}")
    # The program itself: `python -m ziglang` does not find its package where pip isolates a build.
    os.environ["ECHOGRID_ZIG"] = str(Path(package.origin).parent / "zig")
    os.environ["CMAKE_TOOLCHAIN_FILE"] = str(Path(__file__).parent / "zig.cmake")


def get_requires_for_build_wheel(settings: Settings = None) -> list[str]:
    """What scikit-build-core needs, and zig if it is to be the compiler."""
    return build.get_requires_for_build_wheel(settings) + ([ZIG] if zig_is_the_compiler() else [])


def get_requires_for_build_editable(settings: Settings = None) -> list[str]:
    """Likewise for an editable install."""
    return build.get_requires_for_build_editable(settings) + ([ZIG] if zig_is_the_compiler() else [])


def build_wheel(folder: str, settings: Settings = None, metadata_folder: str | None = None) -> str:
    """Build a wheel into the folder; its name."""
    choose_compiler()
    return build.build_wheel(folder, settings, metadata_folder)


def build_editable(folder: str, settings: Settings = None, metadata_folder: str | None = None) -> str:
    """Build the core where Python looks for it, and a wheel that points to the sources; its name."""
    choose_compiler()
    return build.build_editable(folder, settings, metadata_folder)
