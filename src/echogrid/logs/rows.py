"""Rows of numbers in a text log: what counts as a number, and the rules that the rows must keep."""

from collections.abc import Sequence
from dataclasses import dataclass
from operator import le

import numpy as np
from jaxtyping import Float
from numpy import inf, ndarray

from echogrid.errors import InputError
from echogrid.limits import MOST_M, MOST_RAD, MOST_RANGE_M, MOST_STAMP_S
from echogrid.logs.lines import quoted

_NUMBER_BYTES = b"0123456789+-.eE infatyINFATY,\t\r\n"
"""Every byte that a row of numbers needs. float() alone would also take ``1_0`` and control characters."""


@dataclass(frozen=True)
class _Rule:
    expected: str
    low: float
    high: float
    may_miss: bool = False
    """True where ``inf`` (no echo) and ``nan`` (not fired) are values."""


_RULES = {
    "t": _Rule("a time in s within +-1e11", -MOST_STAMP_S, MOST_STAMP_S),
    "x": _Rule("metres within +-1e7", -MOST_M, MOST_M),
    "y": _Rule("metres within +-1e7", -MOST_M, MOST_M),
    "theta": _Rule("radians within +-1e7", -MOST_RAD, MOST_RAD),
}
_RANGE_RULE = _Rule("metres from 0 up to 100, or inf", 0.0, MOST_RANGE_M, may_miss=True)


class Table:
    """The rules of rows of numbers, found from the names of their columns.

    ``t`` is the stamp (s), ``x``, ``y``, ``theta`` a pose (m, m, rad), also after ``odom_``; any other
    column is a range (m).
    """

    def __init__(self, names: Sequence[str]):
        self.names = tuple(names)
        self.rules = [_RULES.get(name.removeprefix("odom_"), _RANGE_RULE) for name in names]
        self._lows, self._highs = [rule.low for rule in self.rules], [rule.high for rule in self.rules]
        self._low, self._high = np.array(self._lows), np.array(self._highs)
        self._may_miss = np.array([rule.may_miss for rule in self.rules])
        self.stamp = self.names.index("t")
        """Which column that is."""

    def plain(self, row: Sequence[float]) -> bool:
        """Whether a row is of finite numbers within the rules: quickly told, and true of nearly all."""
        return all(map(le, self._lows, row)) and all(map(le, row, self._highs))

    def check(
        self, values: Float[ndarray, "rows columns"], last_stamp: float = -inf
    ) -> tuple[int, tuple[str, str] | None]:
        """Find the first row that breaks a rule.

        Args:
            values: rows of numbers, one column a name.
            last_stamp: the stamp (s) of the row before the first.

        Returns:
            The number of good rows before it, and what was found and expected there; None if all are good.
        """
        right = (values >= self._low) & (values <= self._high) | self._may_miss & ~np.isfinite(values)
        stamps = values[:, self.stamp]
        wrong = ~right.all(axis=1)
        wrong[1:] |= stamps[1:] < stamps[:-1]
        if len(values) and stamps[0] < last_stamp:
            wrong[0] = True
        if not wrong.any():
            return len(values), None
        row = int(wrong.argmax())
        if not right[row].all():
            column = int(right[row].argmin())
            found = f"{self.names[column]} = {float(values[row, column])!r}"
            return row, (found, self.rules[column].expected)
        before = float(stamps[row - 1]) if row else last_stamp
        return row, (f"time {float(stamps[row])!r} after {before!r}", "rows in time order")


def only_numbers(line: bytes) -> bool:
    """Whether the bytes are all of the kind that numbers, commas and blanks are written with."""
    return not line.translate(None, _NUMBER_BYTES)


def number_of(field: bytes, what: str, where: str) -> float:
    """The number that a field holds; ``what`` names the field.

    Raises:
        InputError: the field is empty or holds something else.
    """
    if only_numbers(field):
        try:
            return float(field)
        except ValueError:
            pass
    found = quoted(field.strip()) if field.strip() else "nothing"
    raise InputError(where, f"{what} = {found}", "a number")
