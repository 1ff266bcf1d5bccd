import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STANDS_ON = {"common": {"common"}, "paper": {"common", "paper"}, "studies": {"common", "studies"}}
"""Of each shelf those that it imports from."""


def imported(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports name the package"
            yield from (f"{node.module}.{name.name}" for name in node.names)


def modules(folder):
    return sorted(path for path in (ROOT / folder).rglob("*.py") if path.name != "__init__.py")


def test_every_module_is_on_a_shelf():
    assert {path.relative_to(ROOT / "experiments").parts[0] for path in modules("experiments")} == set(STANDS_ON)


@pytest.mark.parametrize("path", modules("experiments"), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_shelf_stands_on_the_other(path):
    shelf = path.relative_to(ROOT / "experiments").parts[0]
    used = {name.split(".")[1] for name in imported(path) if name.split(".")[0] == "experiments"}
    assert used <= STANDS_ON[shelf]


@pytest.mark.parametrize("path", modules("src"), ids=lambda path: str(path.relative_to(ROOT)))
def test_the_package_knows_nothing_of_what_measures_it(path):
    assert {name.split(".")[0] for name in imported(path)} & {"experiments", "benchmarks", "tests"} == set()
