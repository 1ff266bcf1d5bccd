import codecs

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.errors import InputError
from echogrid.logs.lines import MAX_LINE, blocks, numbered
from log_samples import put

LINES = st.lists(st.text("a\r ,#\N{EURO SIGN}", max_size=9).map(str.encode)).map(
    lambda lines: b"t" + b"\n".join(lines)
)


@given(LINES, st.booleans(), st.integers(1, 40))
def test_blocks_are_the_lines_of_the_file_in_order(tmp_path_factory, content, mark, size):
    path = tmp_path_factory.mktemp("log") / "any.csv"
    path.write_bytes(codecs.BOM_UTF8 * mark + content)
    expected = list(enumerate(content.split(b"\n"), 1))
    found = [(first + i, line) for first, lines in blocks(path, size) for i, line in enumerate(lines)]
    assert found == list(numbered(path))
    ended = [(number, line + b"\n") for number, line in expected[:-1]]
    assert found == ended + [each for each in expected[-1:] if each[1]]


@pytest.mark.parametrize(("length", "fits"), [(MAX_LINE, True), (MAX_LINE + 1, False)])
def test_lines_before_one_that_is_too_long_come_before_its_error(tmp_path, length, fits):
    path = put(tmp_path, b"a\nb\n" + b"c" * (length - 1) + b"\nd\n")
    lines = numbered(path)
    assert [next(lines), next(lines)] == [(1, b"a\n"), (2, b"b\n")]
    if fits:
        assert [number for number, _ in lines] == [3, 4]
        return
    with pytest.raises(InputError, match=f"log:3: found a line of more than {MAX_LINE} bytes"):
        next(lines)
