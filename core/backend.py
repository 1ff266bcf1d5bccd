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

Settings = dict[str, list[str] | str] | None


def compiler_found() -> bool:
    """Whether CMake finds a C++ compiler by itself, or was told of one. The Makefile asks the same."""
    told = any(os.environ.get(name) for name in ("CXX", "CMAKE_TOOLCHAIN_FILE"))
    return told or any(shutil.which(name) for name in ("c++", "g++", "clang++"))


def use_zig_without_compiler() -> None:
    """Point CMake to zig if it would find nothing.

    Raises:
        SystemExit: zig is not there either.
    """
    if compiler_found():
        return
    package = find_spec(ZIG)
    if package is None or package.origin is None:
        raise SystemExit(f"core: found no C++ compiler, expected c++, g++, clang++ or the package {ZIG}")
    # The program itself: `python -m ziglang` does not find its package where pip isolates a build.
    os.environ["ECHOGRID_ZIG"] = str(Path(package.origin).parent / "zig")
    os.environ["CMAKE_TOOLCHAIN_FILE"] = str(Path(__file__).parent / "zig.cmake")


def get_requires_for_build_wheel(settings: Settings = None) -> list[str]:
    """What scikit-build-core needs, and zig if it is to be the compiler."""
    return build.get_requires_for_build_wheel(settings) + ([] if compiler_found() else [ZIG])


def get_requires_for_build_editable(settings: Settings = None) -> list[str]:
    """Likewise for an editable install."""
    return build.get_requires_for_build_editable(settings) + ([] if compiler_found() else [ZIG])


def build_wheel(folder: str, settings: Settings = None, metadata_folder: str | None = None) -> str:
    """Build a wheel into the folder; its name."""
    use_zig_without_compiler()
    return build.build_wheel(folder, settings, metadata_folder)


def build_editable(folder: str, settings: Settings = None, metadata_folder: str | None = None) -> str:
    """Build the core where Python looks for it, and a wheel that points to the sources; its name."""
    use_zig_without_compiler()
    return build.build_editable(folder, settings, metadata_folder)
