"""The header of a CSV log, and what it says of how the rows are written.

Other programs write other tables: separated by ";", tabs or blanks, numbers with a decimal comma, columns in another
order, comments. Where that is plain it is read.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from echogrid.errors import InputError
from echogrid.logs.lines import numbered, quoted, text_of
from echogrid.robot import MAX_SONARS

POSE = ("t", "x", "y", "theta")
ODOM = ("odom_x", "odom_y", "odom_theta")

MAX_COMMENTS = 1000
"""Lines of comments before the header."""

_SEPARATORS = (",", ";", "\t", " ")
_UNITS = {"t": "s", "x": "m", "y": "m", "theta": "rad"}

_MEANT = {
    "t": ("time", "timestamp", "stamp", "secs", "seconds", "time_s", "t_s"),
    "theta": ("yaw", "heading", "th", "phi", "angle", "theta_deg", "yaw_deg", "heading_deg"),
    "x": ("pos_x", "x_m", "pose_x", "px"),
    "y": ("pos_y", "y_m", "pose_y", "py"),
    "r0": ("range0", "range_0", "s0", "sonar0", "sonar_0", "d0", "r_0", "r1", "range1", "sonar1"),
}
"""What others call the columns: not taken for them, for their units may be others too."""


class Header(NamedTuple):
    """What a header says of the rows below it."""

    line: int
    """Its number."""
    names: tuple[str, ...]
    """Of the columns as they stand there."""
    columns: tuple[str, ...]
    """The same in the order of the format."""
    separator: str

    @property
    def order(self) -> list[int]:
        """Where each column of the format stands; empty where they stand in its order."""
        return [] if self.names == self.columns else [self.names.index(column) for column in self.columns]

    def with_commas(self, name: str) -> "_Rewriter | None":
        """What writes rows with commas between their fields; None: they have them."""
        return None if self.separator == "," else _Rewriter(name, self.separator)


class _Rewriter:
    """Writes rows of another dialect with commas; the first number that shows it says what the decimal sign is."""

    def __init__(self, name: str, separator: str):
        self._name, self._separator = name, separator.encode()
        self._decimal = b""

    def __call__(self, rows: list[bytes], first: int) -> tuple[list[bytes], InputError | None]:
        out: list[bytes] = []
        try:
            for row in rows:
                out.append(self._row(row, first + len(out)))
        except InputError as error:
            return out, error
        return out, None

    def _row(self, row: bytes, number: int) -> bytes:
        for sign in (b",", b"."):
            if sign in row:
                self._decimal = self._decimal or sign
                if sign != self._decimal:
                    found = "numbers with a point and numbers with a comma"
                    raise InputError(f"{self._name}:{number}", found, "one decimal sign throughout")
        if self._decimal == b",":
            row = row.replace(b",", b".")
        if self._separator == b" ":
            return b",".join(row.split()) + b"\n" * row.endswith(b"\n")
        return row.replace(self._separator, b",")


def recognises(path: Path) -> bool:
    """Whether a file is meant as a CSV log; comments may stand before its header.

    Raises:
        InputError: it cannot be read.
    """
    for number, line in numbered(path):
        text = line.decode("utf-8", errors="replace")
        if text.startswith("#"):
            if number > MAX_COMMENTS or _is_header(_bare(text)):
                return number <= MAX_COMMENTS
            continue
        names = _split(text)[0]
        alike = {name.lower() for name in names}
        return {*POSE} <= {*names} or sum(bool(alike & {name, *others}) for name, others in _MEANT.items()) >= 4
    return False


def _bare(comment: str) -> str:
    return comment.lstrip("# \t")


def _split(line: str) -> tuple[tuple[str, ...], str]:
    """The names in a line, and what stands between them."""
    line = line.rstrip("\r\n")
    separator = next((each for each in _SEPARATORS if each in line), ",")
    fields = line.split() if separator == " " else line.split(separator)
    return tuple(field.strip() for field in fields), separator


def _expected(names: tuple[str, ...]) -> tuple[str, ...]:
    """The columns that the format has beside some of them."""
    front = POSE + ODOM if any(column in names for column in ODOM) else POSE
    return front + tuple(f"r{i}" for i in range(max(len(names) - len(front), 1)))


def _is_header(text: str) -> bool:
    names = _split(text)[0]
    return sorted(names) == sorted(_expected(names))


def read_header(lines: Iterator[tuple[int, bytes]], name: str) -> Header:
    """The header of a log that messages call ``name``; the lines go on behind it.

    Raises:
        InputError: there is none, or not such a one; the text names the column, and what may be meant.
    """
    for number, line in lines:
        where = f"{name}:{number}"
        if line.startswith(b"#"):
            text = _bare(line.decode("utf-8", errors="replace"))
            if not _is_header(text):  # numpy.savetxt writes the header as a comment
                continue
        else:
            text = text_of(line, where)
        return _header(text, number, where)
    raise InputError(f"{name}:1", "''", f"'{POSE[0]}'")


def _header(text: str, number: int, where: str) -> Header:
    names, separator = _split(text)
    columns = _expected(names)
    odd = next((i for i, each in enumerate(names) if each not in columns or each in names[:i]), len(names))
    lacking = next((each for each in columns if each not in names), None)
    if lacking is not None:
        shown = quoted(names[odd]) if odd < len(names) else "nothing"
        hint = _hint(names[odd].lower() if odd < len(names) else None, lacking)
        raise InputError(where, f"{shown} as column {odd + 1}", repr(lacking) + hint)
    if len(columns) - columns.index("r0") > MAX_SONARS:
        raise InputError(where, f"{len(columns) - columns.index('r0')} sonars", f"at most {MAX_SONARS}")
    return Header(number, names, columns, separator)


def _hint(name: str | None, lacking: str) -> str:
    """What may help who wrote a name (in small letters) that is none of the format's."""
    if name is None:
        return ""
    if not name:
        return " (pandas: to_csv(..., index=False))"
    meant = next((column for column, others in _MEANT.items() if name in others), None)
    if meant in POSE:
        return f" (call it {meant} if it is in {_UNITS[meant]})"
    if name[0] == "r" and name[1:].isdigit():
        return " (the sonars are r0,r1,... without a gap)"
    if lacking[0] == "r":
        return " (beside the pose and odom_x,odom_y,odom_theta there are the sonars r0,r1,... and nothing else)"
    return ""
