import pickle

import pytest

from echogrid.errors import InputError, MissingError, UsageError

ERRORS = InputError("a.csv:3", "x", "y"), UsageError("--seed: found -1, expected 0 or more"), MissingError("x")


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_that_comes_from_another_process_is_the_same(error):
    """As of a worker of a pool."""
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert (str(copy), vars(copy)) == (str(error), vars(error))


def test_an_error_is_one_line_that_a_terminal_can_show():
    assert str(InputError("a\nb", "\x1b[31m", "text")) == r"a\nb: found \x1b[31m, expected text"
