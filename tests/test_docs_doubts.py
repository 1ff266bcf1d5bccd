"""Everything that is said about a log stands on the page about maps that look wrong: it is collected from the source.

What is said is prose: a text in the source with three words in a row or more, or what an InputError found. Not what
it expected, which is the remedy, and not what goes on with a text from elsewhere (", 3 times more"). Errors that name
a line of a file are told there as one kind.
"""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

import echogrid

PACKAGE = Path(echogrid.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "when-a-map-looks-wrong.md"

ABOUT_LOGS = (
    *("doubts.py", "stillness.py", "frame.py", "packed.py", "mapping/intake.py"),
    *("logs/*.py", "bags/*.py", "ros/*.py"),
)
ABOUT_LIVE = ("live/*.py",)
LIVE = "## Live besides"

WINDOW = 4
"""So many words in a row tell one utterance from all others."""


def literals(text):
    """The parts of a text between what is filled in."""
    if isinstance(text, ast.JoinedStr):
        whole = "".join(part.value if isinstance(part, ast.Constant) else "\0" for part in text.values)
        return whole.split("\0")
    return [text.value] if isinstance(text, ast.Constant) and isinstance(text.value, str) else [""]


def words(text):
    return [word for part in text.split() if (word := part.strip("`'\".,:;()|")) and re.search("[A-Za-z]", word)]


def of_one_line(call):
    """Whether an error names a line of a file: it is one of the kind ``drive.csv:17: found X, expected Y``."""
    where = call.args[0]
    if isinstance(where, ast.Name):
        return where.id == "where"
    return any(re.fullmatch(r":\d*", part) for part in literals(where)[1:])


def utterances(node):
    """What a module says: the literal parts of each text."""
    match node:
        case ast.Expr(value=ast.Constant()) | ast.FunctionDef(name="__repr__"):
            return
        case ast.Call(func=ast.Name(id="InputError"), args=[_, found, expected]):
            if of_one_line(node):
                return
            parts = literals(found)
            if any(map(words, parts)):
                yield parts if any(len(words(part)) > 1 for part in parts) else [*parts, *literals(expected)]
            else:
                yield from utterances(found)
            return
        case ast.JoinedStr(values=values):
            yield from (said for each in values if isinstance(each, ast.FormattedValue) for said in utterances(each))
    if isinstance(node, ast.JoinedStr | ast.Constant):
        parts = literals(node)
        goes_on, pattern = re.match(r"[ ,;]", parts[0]), any("\\" in part for part in parts)
        if max(len(words(part)) for part in parts) >= 3 and not goes_on and not pattern:
            yield parts
        return
    for each in ast.iter_child_nodes(node):
        if not isinstance(each, ast.arg) and each is not getattr(node, "returns", None):
            yield from utterances(each)


def windows(parts):
    """All runs of WINDOW words in a row; parts that are shorter, but more than one word, as a whole."""
    for part in map(words, parts):
        size = min(len(part), WINDOW)
        if size > 1:
            yield from (" ".join(part[i : i + size]) for i in range(len(part) - size + 1))


def said(patterns):
    """What is said in some modules: the runs of words that nothing else says (else all), and where it is said."""
    found = {}
    for path in sorted(path for pattern in patterns for path in PACKAGE.glob(pattern)):
        for parts in utterances(ast.parse(path.read_text(encoding="utf-8"))):
            found.setdefault(tuple(parts), str(path.relative_to(PACKAGE)))
    often = Counter(window for parts in found for window in set(windows(parts)))
    own = {parts: [each for each in windows(parts) if often[each] == 1] for parts in found}
    return {parts: distinct or list(windows(parts)) for parts, distinct in own.items()}, found


def missing(patterns, text):
    own, where = said(patterns)
    page = f" {' '.join(words(text))} "
    return [
        f"{where[parts]}: {'...'.join(parts)}"
        for parts, distinct in own.items()
        if not any(f" {window} " in page for window in distinct)
    ]


@pytest.fixture(scope="module")
def page():
    return PAGE.read_text(encoding="utf-8")


def test_every_note_and_error_about_a_log_is_on_the_page(page):
    assert missing(ABOUT_LOGS, page.split(LIVE)[0]) == []


def test_everything_that_live_says_is_in_its_own_section_or_on_its_page(page):
    own = "".join((PAGE.parent / name).read_text(encoding="utf-8") for name in ("live.md", "explore-live.md"))
    assert missing(ABOUT_LIVE, page.split(LIVE)[1] + own) == []
