import io
import pkgutil
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote

import pytest
import tyro
import yaml

from echogrid.cli import main
from echogrid.cli.commands import COMMANDS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
NAMING = [*PAGES, *(ROOT / name for name in ("CONTRIBUTING.md", "CHANGELOG.md", "Makefile"))]
"""What names files and modules of the repository."""

BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
"""Kind, name of the file that it stands for (or none), content. Of kind console it is run; of kind sh only parsed."""

INLINE = re.compile(r"`([^`]+)`")


EXPORTED = ("echogrid.h", "echogrid.c")
"""Files of ``echogrid export``, which look like modules."""


def named(path):
    return str(path.relative_to(ROOT))


def prose(page):
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def shown_commands(page):
    """Commands of echogrid on lines of their own."""
    blocks = [
        content for kind, _, content in BLOCK.findall(page.read_text(encoding="utf-8")) if kind in ("sh", "console")
    ]
    indented = re.findall(r"^ {4}(.*)", prose(page), re.MULTILINE)
    lines = [line for block in blocks for line in block.splitlines()] + indented
    for line in lines:
        if found := re.match(r"(?:\$ )?(?:\.venv/bin/)?echogrid( .*|$)", line):
            yield shlex.split(found[1], comments=True)


def parse(command):
    """Whether a command has what it needs and nothing that is not there; it is not run."""
    try:
        tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="echogrid", args=command)
    except SystemExit as left:
        return left.code in (0, None)
    return True


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_command_on_a_page_parses(page):
    assert [command for command in shown_commands(page) if not parse(command)] == []


@pytest.fixture(scope="module")
def options():
    """The long options of each command."""
    found = {}
    for name in COMMANDS:
        said = io.StringIO()
        with redirect_stdout(said):
            parse([name, "--help"])
        found[name] = set(re.findall(r"--[a-z][\w.-]*", said.getvalue()))
    return found


def test_every_option_that_the_text_names_is_there(options):
    everywhere = set().union(*options.values()) | {"--help", "--version"}
    wrong = []
    for page in PAGES:
        for code in INLINE.findall(prose(page)):
            words = code.split()
            if words[0] == "echogrid" and len(words) > 1 and words[1] not in {*COMMANDS, "--version"}:
                wrong.append((named(page), code))
            if words[0] != "echogrid" and not words[0].startswith("--"):
                continue
            known = (
                everywhere if words[0] != "echogrid" or len(words) == 1 else options.get(words[1], set()) | {"--help"}
            )
            for word in re.findall(r"(?<![\w-])--[a-z][\w.-]*", code):
                there = any(each.startswith(word) for each in known) if word.endswith(".") else word in known
                if not there:
                    wrong.append((named(page), code))
    assert wrong == []


def anchor(heading):
    """What a heading is linked by, on GitHub and in the site alike for the headings that we have."""
    return re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", re.sub(r"[`*]", "", heading)).strip().lower())


def anchors(page):
    return {anchor(heading) for heading in re.findall(r"^#+ (.*)", prose(page), re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_link_and_picture_is_there(page):
    missing = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        path, _, part = unquote(link).partition("#")
        if re.match(r"https?:", link):
            continue
        target = page.parent / path if path else page
        if not target.is_file() or (part and part not in anchors(target)):
            missing.append(link)
    assert missing == []


def is_there(name):
    """Whether a module, or what it holds, is there; of experiments and benchmarks only whether the file is."""
    if not name.startswith("echogrid."):
        path = ROOT / name.replace(".", "/")
        return path.with_suffix(".py").is_file() or (path / "__main__.py").is_file()
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", NAMING, ids=named)
def test_every_file_and_module_that_is_named_is_there(page):
    text = page.read_text(encoding="utf-8")
    paths = re.findall(r"(?<![\w./-])(?:src|tests|experiments|benchmarks|docs)/[\w./*-]*\w", text)
    missing = [path for path in paths if not list(ROOT.glob(path))]
    files = [code for code in INLINE.findall(text) if re.fullmatch(r"(?:\w+/)*\w+\.py", code) and code not in paths]
    folders = [ROOT / name for name in ("src", "tests", "experiments", "benchmarks")]
    missing += [file for file in files if not any(any(folder.rglob(file)) for folder in folders)]
    modules = re.findall(r"(?<![\w./-])(?:echogrid|experiments|benchmarks)(?:\.[A-Za-z]\w*)+", text)
    missing += [module for module in modules if module not in EXPORTED and not is_there(module)]
    assert missing == []


def test_figures_are_small_and_in_pixels():
    assert [named(path) for path in DOCS.rglob("*.svg")] == []
    assert [named(path) for path in DOCS.rglob("*.png") if path.stat().st_size > 300_000] == []


def test_every_page_is_in_the_navigation_and_can_be_reached():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]

    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        values = entry.values() if isinstance(entry, dict) else entry
        return [page for value in values for page in pages(value)]

    assert sorted(pages(nav)) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def run(line):
    """Run a command as the shell would, those of echogrid in this process; its exit status."""
    words = shlex.split(line)
    if words[0] != "echogrid":
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        print(done.stdout, end="")
        return 0
    try:
        main(words[1:])
    except SystemExit as left:
        return left.code
    return 0


def fits(shown, written):
    """Whether what a page shows is what was written; ... stands for anything, and times may differ."""
    pattern = re.escape(shown.strip()).replace(re.escape("..."), ".*")
    return re.fullmatch(re.sub(r"\\ in\\ \d+\\\.\d\\ s", r" in \\d+\\.\\d s", pattern), written.strip(), re.DOTALL)


RUN = [
    *("tutorial.md", "how-to/map-a-log.md", "how-to/topics-and-frames.md", "how-to/back-to-ros.md"),
    *("how-to/look-at-a-map.md", "how-to/changing-places.md", "how-to/score.md"),
    "how-to/microcontroller.md",
    *("from-mrpt.md", "sensors.md", "api.md"),
]
"""Pages with something to run, in an order in which each finds the files of those it refers to."""


def test_no_page_with_something_to_run_is_left_out():
    kinds = {named(page): {kind for kind, _, _ in BLOCK.findall(page.read_text(encoding="utf-8"))} for page in PAGES}
    there = {name for name, found in kinds.items() if found & {"console", "python"}}
    elsewhere = {
        "README.md",
        "docs/formats.md",
    }  # formats.md by test_cli.py; README's Python is the beginning of api.md
    assert there - elsewhere == {f"docs/{name}" for name in RUN}


def test_what_the_pages_run_does_what_they_show(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    done = {}
    for name in RUN:
        text = (DOCS / name).read_text(encoding="utf-8")
        for kind, file, content in BLOCK.findall(text):
            if file:
                (tmp_path / file).write_text(content, encoding="utf-8")
            elif kind == "python":
                exec(compile(content, name, "exec"), {})
            elif kind == "console":
                for line, shown in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", content, re.MULTILINE):
                    if line not in done:
                        capsys.readouterr()
                        status = run(line)
                        written = capsys.readouterr()
                        done[line] = written.out + written.err
                        assert status == (2 if shown.startswith("echogrid: ") else 0), done[line]
                    assert fits(shown, done[line]), f"{name}: {line}\n{done[line]}"


@pytest.mark.skipif(
    find_spec("mkdocs") is None or find_spec("mkdocstrings") is None, reason="the extra docs is not installed"
)
def test_the_site_builds_and_asks_nothing_of_any_network(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=120, env={"NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr
    for page in tmp_path.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?!a\b)\w+[^>]*\s(?:src|href|content|data)=\"?((?:https?:)?//[^\s\">]+)", text)
        assert not loaded, page
        assert "unpkg" not in text, page
        assert "mermaid" not in text, page  # the one thing for which the theme's script would ask a CDN
    for style in tmp_path.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", style.read_text(encoding="utf-8")), style
