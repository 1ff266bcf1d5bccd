import gzip
from collections.abc import Iterator
from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.errors import InputError, UsageError
from echogrid.frame import Frame
from echogrid.logs import csv_log
from echogrid.logs.contents import describe
from echogrid.logs.csv_log import write_csv
from echogrid.logs.formats import load_log
from log_samples import CSV, ROBOT, assert_plain, drain, many, peak_of, put, rows, same, steps


def test_csv_gives_stamp_pose_and_ranges(tmp_path):
    first, second = load_log(put(tmp_path, CSV))
    assert same(first, Frame(0.0, np.array([1.0, 2.0, 0.5]), np.array([1.5, inf])))
    assert same(second, Frame(0.5, np.array([1.25, 2.0, 0.5]), np.array([nan, 2.5])))


def test_csv_carries_odometry_beside_the_pose(tmp_path):
    log = load_log(put(tmp_path, "t,x,y,theta,odom_x,odom_y,odom_theta,r0\n0,1,2,3,4,5,6,0.5\n"))
    assert log.sonars == 1
    assert same(next(iter(log)), Frame(0.0, np.array([1.0, 2, 3]), np.array([0.5]), np.array([4.0, 5, 6])))


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(b"\xef\xbb\xbf" + CSV, id="byte-order-mark"),
        pytest.param(CSV.replace(b"\n", b"\r\n"), id="CRLF"),
        pytest.param(CSV + b"\n  \n\r\n\n", id="blank lines at the end"),
        pytest.param(CSV.replace(b",", b" , "), id="spaces"),
        pytest.param(CSV.removesuffix(b"\n"), id="no last line end"),
        pytest.param(CSV.replace(b",,", b",nan,"), id="nan"),
        pytest.param(CSV.replace(b",,", b",-inf,"), id="too near"),
        pytest.param(CSV.replace(b"inf", b"+Infinity"), id="Infinity"),
        pytest.param(CSV.replace(b"1.5,", b"15e-1,"), id="exponent"),
    ],
)
def test_csv_is_read_the_same_however_it_is_written(tmp_path, variant):
    plain = list(load_log(put(tmp_path, CSV)))
    frames = list(load_log(put(tmp_path, variant, "variant.csv")))
    assert len(frames) == len(plain)
    assert all(same(a, b) for a, b in zip(frames, plain, strict=True))


DIALECTS = {
    "semicolons": CSV.replace(b",", b";"),
    "semicolons and decimal commas": CSV.replace(b",", b";").replace(b".", b","),
    "tabs": CSV.replace(b",", b"\t"),
    "tabs and decimal commas": CSV.replace(b",", b"\t").replace(b".", b","),
    "blanks": CSV.replace(b",,", b",nan,").replace(b",", b"  "),
    "comments": CSV.replace(b"\n", b"\n# the battery was low\n") + b"#\n",
    "comments first": b"# made on Monday\n#\n" + CSV,
    "a header that is a comment, as numpy writes it": b"# " + CSV,
    "the same with blanks": b"# " + CSV.replace(b",,", b",nan,").replace(b",", b" "),
    "the ranges first": b"r1,r0,theta,y,x,t\ninf,1.5,0.5,2,1,0\n2.5,,0.5,2,1.25,0.5\n",
    "the time last, with semicolons": b"x;y;theta;r0;r1;t\n1;2;0.5;1.5;inf;0\n1.25;2;0.5;;2.5;0.5\n",
}


@pytest.mark.parametrize("content", DIALECTS.values(), ids=DIALECTS)
def test_tables_of_other_programs_are_read_where_they_are_plain(tmp_path, content):
    plain = list(load_log(put(tmp_path, CSV)))
    log = load_log(put(tmp_path, content, "other.csv"))
    assert log.sonars == 2
    for _ in range(2):
        assert all(same(a, b) for a, b in zip(log, plain, strict=True))


def test_odometry_may_stand_anywhere(tmp_path):
    log = load_log(put(tmp_path, "odom_theta,t,x,r0,y,odom_x,theta,odom_y\n6,0,1,0.5,2,4,3,5\n"))
    assert same(next(iter(log)), Frame(0.0, np.array([1.0, 2, 3]), np.array([0.5]), np.array([4.0, 5, 6])))


@many
@given(st.data())
def test_any_dialect_and_order_gives_the_same_frames(tmp_path, data):
    table = [
        ["t", "x", "y", "theta", "r0", "r1"],
        *([repr(0.1 * i), "1.5", repr(-0.25 * i), "0.5", repr(1.0 + i % 5), "inf"] for i in range(300)),
    ]
    order = data.draw(st.permutations(range(6)))
    separator = data.draw(st.sampled_from([",", ";", "\t", " "]))
    decimal = data.draw(st.sampled_from([".", "," if separator != "," else "."]))
    text = [separator.join(row[i].replace(".", decimal) for i in order) for row in table]
    for at in sorted(data.draw(st.lists(st.integers(0, 300), max_size=4)), reverse=True):
        text.insert(at, "# a comment")
    frames = list(load_log(put(tmp_path, "\n".join([*text, ""]), "other.csv")))
    plain = list(load_log(put(tmp_path, "\n".join(",".join(row) for row in table) + "\n")))
    assert all(same(a, b) for a, b in zip(frames, plain, strict=True))


@pytest.mark.parametrize("line", [3, 5, 257, 300, 601])
def test_the_line_is_right_with_comments_and_another_order(tmp_path, line):
    lines = [f"{i};0;0;0;1;{i % 90}" for i in range(1, 601)]
    lines.insert(1, "# a comment")
    if line != 3:
        lines[line - 2] = f"{line};0;0;0;far;1"
    path = put(tmp_path, "\n".join(["t;x;y;theta;r1;r0", *lines, ""]))
    frames, error = drain(load_log(path))
    if line == 3:
        assert (len(frames), error) == (600, None)
        return
    assert error is not None
    assert (error.where, error.found) == (f"{path}:{line}", "r1 = 'far'")
    assert len(frames) == line - 3


@given(st.lists(st.sampled_from(["row", "row", "# said", "", " \t"]), max_size=30), st.sampled_from([7, 30, 2**16]))
def test_what_stands_between_rows_is_told_by_its_line_wherever_the_pieces_end(tmp_path_factory, kinds, size):
    lines = ["0,0,0,0,1,1", *(f"{i},0,0,0,1,1" if kind == "row" else kind for i, kind in enumerate(kinds, 1))]
    last = max(i for i, line in enumerate(lines) if line[:1].isdigit())
    blank = next((i for i, line in enumerate(lines[:last]) if not line.strip()), None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(csv_log, "_PIECE_BYTES", size)
        path = put(tmp_path_factory.mktemp("log"), rows(*lines))
        frames, error = drain(load_log(path))
    good = [i for i, line in enumerate(lines[:blank]) if line[:1].isdigit()]
    assert [frame.stamp for frame in frames] == good
    assert (error and error.where) == (None if blank is None else f"{path}:{blank + 2}")


def test_points_and_commas_in_one_table_are_no_numbers(tmp_path):
    for comment in ("", "# so that the row is the first of its batch\n"):
        path = put(tmp_path, f"t;x;y;theta;r0\n0;0;0;0;1,5\n{comment}1;0;0;0;1.5\n")
        frames, error = drain(load_log(path))
        assert error is not None
        assert error.where == f"{path}:{4 if comment else 3}"
        assert error.found == "numbers with a point and numbers with a comma"
        assert len(frames) == 1


@pytest.mark.parametrize(
    ("header", "hint"),
    [
        ("time,x,y,yaw,r0", "'t' (call it t if it is in s)"),
        ("t,x,y,yaw,r0", "'theta' (call it theta if it is in rad)"),
        ("t;x;y;theta_deg;r0", "'theta' (call it theta if it is in rad)"),
        (",t,x,y,theta,r0", "(pandas: to_csv(..., index=False))"),
        ("t,x,y,theta,r0,battery", "and nothing else)"),
        ("t,x,y,theta", "'r0'"),
    ],
)
def test_a_header_that_is_nearly_right_says_what_to_do(tmp_path, header, hint):
    with pytest.raises(InputError) as caught:
        load_log(put(tmp_path, header + "\n0,0,0,0,1\n"))
    assert caught.value.expected.endswith(hint)
    assert_plain(caught.value)


@pytest.mark.parametrize("content", [CSV, b"# a comment\n" + CSV.replace(b",", b";")])
def test_a_compressed_log_is_read(tmp_path, content):
    plain = list(load_log(put(tmp_path, CSV)))
    log = load_log(put(tmp_path, gzip.compress(content), "drive.csv.gz"))
    for _ in range(2):
        assert all(same(a, b) for a, b in zip(log, plain, strict=True))


@pytest.mark.parametrize("line", ["", "#"])
@pytest.mark.parametrize("start", ["t,x,y,theta,r0", "t,x,y,theta,r0\n0,0,0,0,1"])
def test_a_file_of_next_to_nothing_is_not_read_to_its_end(tmp_path, line, start, monkeypatch):
    monkeypatch.setattr(csv_log, "MAX_EMPTY", 1000)
    for count, fits in ((1000, True), (1001, False)):
        path = put(tmp_path, gzip.compress((start + "\n" + (line + "\n") * count).encode()))
        if start.endswith("r0"):
            with pytest.raises(InputError, match="no rows"):
                load_log(path)
        else:
            frames, error = drain(load_log(path))
            assert (len(frames), error is None) == (1, fits)


def test_the_limits_of_the_robot_are_applied(tmp_path):
    text = rows("0,0,0,0,3.999,4", "1,0,0,0,0.2,0.199", "1,0,0,0,100,0", "3,0,0,0,inf,")
    log = load_log(put(tmp_path, text), ROBOT)
    np.testing.assert_equal(
        [frame.ranges.tolist() for frame in log], [[3.999, inf], [0.2, nan], [inf, nan], [inf, nan]]
    )
    assert log.robot is ROBOT


GOOD = "1,0,0,0,1,1"

WRONG_ROWS = {
    "column missing": (rows(GOOD, "2,0,0,0,1"), 3, "5 columns"),
    "column too many": (rows(GOOD, "2,0,0,0,1,1,1"), 3, "7 columns"),
    "text": (rows(GOOD, "2,0,0,0,1,near"), 3, "r1 = 'near'"),
    "text in the pose": (rows("x,0,0,0,1,1"), 2, "t = 'x'"),
    "underscore": (rows("1_0,0,0,0,1,1"), 2, "t = '1_0'"),
    "hexadecimal": (rows("1,0,0,0,0x1,1"), 2, "r0 = '0x1'"),
    "two numbers": (rows("1,0,0,0,1 2,1"), 2, "r0 = '1 2'"),
    "other digits": (rows("1,0,0,0,\u0661,1"), 2, "r0 = '\u0661'"),
    "empty pose": (rows("1,0,,0,1,1"), 2, "y = nothing"),
    "time backwards": (rows(GOOD, GOOD, "0.999,0,0,0,1,1"), 4, "time 0.999 after 1.0"),
    "nan pose": (rows(GOOD, "2,0,0,nan,1,1"), 3, "theta = nan"),
    "inf pose": (rows(GOOD, "2,-inf,0,0,1,1"), 3, "x = -inf"),
    "nan stamp": (rows("nan,0,0,0,1,1", GOOD), 2, "t = nan"),
    "inf stamp": (rows(GOOD, "inf,0,0,0,1,1"), 3, "t = inf"),
    "stamp in ns": (rows("1700000000000000000,0,0,0,1,1"), 2, "t = 1.7e+18"),
    "x far off": (rows(GOOD, "2,10000001,0,0,1,1"), 3, "x = 10000001.0"),
    "y far off": (rows(GOOD, "2,0,-1e8,0,1,1"), 3, "y = -100000000.0"),
    "range in mm": (rows(GOOD, "2,0,0,0,1,100.1"), 3, "r1 = 100.1"),
    "negative range": (rows(GOOD, "2,0,0,0,-0.01,1"), 3, "r0 = -0.01"),
    "NUL": (rows(GOOD, "2,0,0,0,1,\0"), 3, "a NUL byte"),
    "not UTF-8": (rows(GOOD).encode() + b"2,0,0,0,1,\xff\n", 3, "not UTF-8"),
    "control character as a blank": (rows("1,0,0,0,1\x1f,1"), 2, r"r0 = '1\x1f'"),
    "control characters": (rows("2,0,0,0,1,\x1b[31m"), 2, r"r1 = '\x1b[31m'"),
    "blank line between": (rows(GOOD, "", " ", GOOD), 3, "a blank line"),
    "cut off": (rows(GOOD) + "2,0,0,0,1,", 3, "cut off"),
    "cut off early": (rows(GOOD) + "2,0,0", 3, "3 columns"),
    "old line ends": (rows(GOOD) + "2,0,0,0,1,1\r3,0,0,0,1,1\r", 3, "11 columns"),
    "first of two": (rows(GOOD, "2,0,0,0,-1,1", "3,0,0,0,1,near"), 3, "r0 = -1.0"),
    "second of two": (rows(GOOD, "2,0,0,0,1,near", "3,0,0,0,-1,1"), 3, "r1 = 'near'"),
    "after rows with gaps": (rows("1,0,0,0,,1", "2,0,0,0,,", "1,0,0,0,,1"), 4, "time 1.0 after 2.0"),
}


@pytest.mark.parametrize(("content", "line", "found"), WRONG_ROWS.values(), ids=WRONG_ROWS)
def test_a_wrong_row_is_an_error_with_its_line(tmp_path, content, line, found):
    path = put(tmp_path, content)
    frames, error = drain(load_log(path))
    assert error is not None
    assert error.where == f"{path}:{line}"
    assert found in error.found
    assert_plain(error)
    assert len(frames) == line - 2, "the frames before the wrong row are given first"


@pytest.mark.parametrize("line", [3, 256, 257, 258, 512, 513, 514, 601])
@pytest.mark.parametrize("wrong", ["{:.1f},0,0,0,1,1", "{},0,0,0,1", "{},0,0,0,1,-3"])
def test_the_line_is_right_anywhere_in_a_long_file(tmp_path, line, wrong):
    lines = [f"{i},0,0,0,1,{i % 90}" for i in range(1, 601)]
    lines[line - 2] = wrong.format(line - 2 - 0.5)
    path = put(tmp_path, rows(*lines))
    frames, error = drain(load_log(path))
    assert error is not None
    assert error.where == f"{path}:{line}"
    assert len(frames) == line - 2


@many
@given(st.lists(st.text("0123456789.+-e infaty_\x0b\x1f", max_size=6), min_size=1, max_size=3))
def test_an_empty_field_beside_it_changes_no_reading(tmp_path, fields):
    # Rows with an empty field are taken apart in another way than rows without.
    row = f"0,0,0,0,{','.join(fields)},"
    header = "t,x,y,theta," + ",".join(f"r{i}" for i in range(len(fields) + 1)) + "\n"
    frames, error = drain(load_log(put(tmp_path, header + row + "nan\n")))
    others, other = drain(load_log(put(tmp_path, header + row + "\n")))
    assert (error is None) == (other is None)
    assert len(frames) == len(others)
    assert all(same(a, b) for a, b in zip(frames, others, strict=True))


numbers = st.floats(-1e6, 1e6, allow_nan=False)
poses = st.tuples(numbers, numbers, numbers).map(np.array)
readings = st.one_of(st.floats(0, 100), st.just(inf), st.just(nan))


@st.composite
def drives(draw):
    sonars, has_odom = draw(st.integers(1, 6)), draw(st.booleans())
    stamps = sorted(draw(st.lists(st.floats(-1e10, 1e10), min_size=1, max_size=8)))
    lists = st.lists(readings, min_size=sonars, max_size=sonars).map(np.array)
    return [Frame(t, draw(poses), draw(lists), draw(poses) if has_odom else None) for t in stamps]


@many
@given(drives())
def test_write_then_read_is_the_identity(tmp_path, frames):
    path = tmp_path / "drive.csv"
    write_csv(path, iter(frames), len(frames[0].ranges))
    read = list(load_log(path))
    assert len(read) == len(frames)
    assert all(same(a, b) for a, b in zip(read, frames, strict=True))


def test_a_long_log_is_written_whole(tmp_path):
    path = tmp_path / "drive.csv"
    write_csv(str(path), steps(1000), 2)
    assert all(same(a, b) for a, b in zip(load_log(path), steps(1000), strict=True))
    assert path.read_text().splitlines()[:2] == ["t,x,y,theta,r0,r1", "0.0,0.0,0.0,0.1,1.0,1.0"]


def failing() -> Iterator[Frame]:
    yield from steps(700)
    raise KeyboardInterrupt


def with_frame(**changes: object) -> list[Frame]:
    values = {"stamp": 40.0, "pose": np.zeros(3), "ranges": np.ones(2), "odom": None} | changes
    return [*steps(300), Frame(**values)]  # ty: ignore[invalid-argument-type]


@pytest.mark.parametrize(
    ("frames", "error", "text"),
    [
        (failing(), KeyboardInterrupt, None),
        ([], InputError, "found no frames"),
        (with_frame(ranges=np.ones(3)), InputError, "frame 300: found 7 numbers, expected 6"),
        (with_frame(odom=np.zeros(3)), InputError, "frame 300: found 9 numbers, expected 6"),
        (with_frame(stamp=1.0), InputError, "frame 300: found time 1.0 after 29.9"),
        (with_frame(pose=np.array([0, nan, 0])), InputError, "frame 300: found y = nan"),
        (with_frame(ranges=np.array([1, 101.0])), InputError, "frame 300: found r1 = 101.0"),
    ],
)
def test_a_log_that_cannot_be_written_whole_leaves_the_folder_as_it_was(tmp_path, frames, error, text):
    path = put(tmp_path, b"precious", "drive.csv")
    with pytest.raises(error, match=text):
        write_csv(path, frames, 2)
    assert [entry.name for entry in tmp_path.iterdir()] == ["drive.csv"]
    assert path.read_bytes() == b"precious"


@pytest.mark.parametrize("name", ["folder", "absent/drive.csv", "file/drive.csv", "x" * 300, "a\0b", "/"])
def test_a_place_that_cannot_be_written_is_a_usage_error(tmp_path, name):
    (tmp_path / "folder").mkdir()
    put(tmp_path, b"", "file")
    with pytest.raises(UsageError) as caught:
        write_csv(tmp_path / name, steps(3), 2)
    assert_plain(caught.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]


def test_a_log_is_streamed_both_ways(tmp_path):
    path = tmp_path / "drive.csv"
    assert peak_of(lambda: write_csv(path, steps(10_000, 8), 8)) < 1e6
    assert path.stat().st_size > 5e5
    assert peak_of(lambda: describe(load_log(path))) < 1e6


def test_a_file_without_line_ends_does_not_fill_the_memory(tmp_path):
    path = put(tmp_path, CSV + b"1," * 4_000_000)

    def read():
        _, error = drain(load_log(path))
        assert error is not None
        assert error.where == f"{path}:4"

    assert peak_of(read) < 4e6
