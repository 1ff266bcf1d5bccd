import subprocess
import sys
from math import inf
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError
from echogrid.logs.contents import describe
from echogrid.logs.formats import load_log
from log_samples import CARMEN, CSV, ROBOT, assert_plain, drain, many, messages, odom, put, rows, same, sonar


@pytest.mark.parametrize("content", [CSV, CARMEN])
def test_a_log_can_be_gone_through_again_and_again(tmp_path, content):
    log = load_log(put(tmp_path, content))
    one, two = iter(log), iter(log)
    assert same(next(one), next(two))
    assert len(list(log)) == len(list(log)) > 0


@pytest.mark.parametrize(
    "content", [rows("0,0,0,0,1,2").replace(",r1", ""), messages(odom(0, 0, 0, 0), sonar(0, "1", 1, "0 0 0"))]
)
def test_another_number_of_sonars_than_the_robot_has_is_refused(tmp_path, content):
    with pytest.raises(InputError, match="found 1 sonars, expected 2, as robot duo has") as caught:
        load_log(put(tmp_path, content), ROBOT)
    assert_plain(caught.value)


WRONG_FILES = {
    "empty": ("", None, "an empty file"),
    "blank": ("\n\n", 1, "''"),
    "header only": (rows(), None, "no rows"),
    "header and blank lines": (rows("", "", ""), None, "no rows"),
    "another format": ("time;range\n0;1\n", 1, "'time;range'"),
    "no sonars": ("t,x,y,theta\n0,0,0,0\n", 1, "nothing as column 5"),
    "sonars from 1": ("t,x,y,theta,r1\n0,0,0,0,1\n", 1, "'r1' as column 5"),
    "gap in the sonars": ("t,x,y,theta,r0,r2\n0,0,0,0,1,1\n", 1, "'r2' as column 6"),
    "degrees": ("t,x,y,theta_deg,r0\n0,0,0,0,1\n", 1, "'theta_deg' as column 4"),
    "half of the odometry": ("t,x,y,theta,odom_x,odom_y,r0\n0,0,0,0,1,1,1\n", 1, "nothing as column 8"),
    "another column": ("t,x,y,theta,r0,battery\n0,0,0,0,1,12\n", 1, "'battery' as column 6"),
    "a column twice": ("t,x,y,theta,r0,r0\n0,0,0,0,1,12\n", 1, "'r0' as column 6"),
    "other names": ("time,x,y,yaw,r0\n0,0,0,0,1\n", 1, "'time' as column 1"),
    "an index of pandas": (",t,x,y,theta,r0\n0,0,0,0,0,1\n", 1, "'' as column 1"),
    "degrees after comments": ("# made\n# by hand\nt,x,y,theta_deg,r0\n0,0,0,0,1\n", 3, "'theta_deg' as column 4"),
    "comments, then the header only": ("# made\nt;x;y;theta;r0\n# nothing\n", None, "no rows"),
    "too many sonars": ("t,x,y,theta," + ",".join(f"r{i}" for i in range(513)), 1, "513 sonars"),
    "NUL": (b"t,x,y,theta,r0\0\n", 1, "a NUL byte"),
    "compressed": (b"\x1f\x8b\x08\x00\x00", None, "a file compressed by gzip that is cut off"),
    "not UTF-8": (b"\x89PNG\r\n", 1, "not UTF-8"),
    "control characters": ("\x1b[31m\x07\n", 1, r"'\x1b[31m\x07'"),
    "no line end in 3 MB": ("t,x,y,theta,r0" * 200_000, 1, "a line of more than"),
    "no SONAR": (messages(odom(0, 0, 0, 0)), None, "no SONAR line"),
    "no ODOM": (messages(sonar(0), sonar(1)), None, "no ODOM line"),
    "comments only": ("# CARMEN Logfile\n", None, "no SONAR line"),
    "no mounts": (messages(odom(0, 0, 0, 0), sonar(0, mounts="")), 4, "8 fields"),
    "sonars not a number": (messages("SONAR 0.26 two 1 2"), 3, "n = 'two'"),
    "no sonars in SONAR": (messages("SONAR 0.26 0 1 nohost 1"), 3, "n = '0'"),
    "SONAR alone": (messages("SONAR"), 3, "n = ''"),
    "mount out of reach": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 20 0")),
        4,
        "a mount at [0.0, 20.0, 0.0]",
    ),
    "mount in degrees": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 0 90")),
        4,
        "a mount at [0.0, 0.0, 90.0]",
    ),
    "mount not a number": (
        messages(odom(0, 0, 0, 0), sonar(0, mounts="0 0 0 0 0 left")),
        4,
        "a mount = 'left'",
    ),
}


@pytest.mark.parametrize(("content", "line", "found"), WRONG_FILES.values(), ids=WRONG_FILES)
def test_a_file_that_is_no_log_is_refused_at_once(tmp_path, content, line, found):
    path = put(tmp_path, content)
    with pytest.raises(InputError) as caught:
        load_log(path)
    assert caught.value.where == (f"{path}:{line}" if line else str(path))
    assert found in caught.value.found
    assert_plain(caught.value)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("absent.csv", "No such file"),
        (".", "a directory"),
        ("/dev/zero", "a pipe or a device"),
        ("a\0b", "null byte"),
        ("x" * 300, "too long"),
        ("absent\x1b[31m.csv", "No such file"),
    ],
)
def test_what_is_not_a_file_is_refused_at_once(tmp_path, name, found):
    with pytest.raises(InputError) as caught:
        load_log(str(tmp_path / name))
    assert found in caught.value.found
    assert_plain(caught.value)


@pytest.mark.parametrize(
    ("content", "other", "found"),
    [
        (CSV, b"", "''"),
        (CSV, rows(), "no rows"),
        (CSV, "t,x,y,theta,r0\n0,0,0,0,1\n", "another header"),
        (CSV, None, "No such file"),
        (CARMEN, b"", "no SONAR"),
        (CARMEN, messages(odom(0, 0, 0, 0)), "no SONAR"),
        (CARMEN, messages(sonar(0)), "no ODOM"),
        (CARMEN, None, "No such file"),
    ],
)
def test_a_file_that_changes_after_it_was_opened_is_an_input_error(tmp_path, content, other, found):
    path = put(tmp_path, content)
    log = load_log(path)
    path.unlink() if other is None else put(tmp_path, other)
    frames, error = drain(log)
    assert error is not None
    assert found in error.found
    assert frames == []
    assert_plain(error)


def read_anything(path: Path) -> None:
    """A log gives frames that keep the rules, or an EchogridError that speaks plainly; nothing else."""
    try:
        log = load_log(path)
        last = -inf
        for frame in log:
            assert frame.ranges.shape == (log.sonars,)
            assert np.isfinite([frame.stamp, *frame.pose]).all()
            assert not (frame.ranges < 0).any()
            assert frame.stamp >= last
            last = frame.stamp
        describe(log)
    except EchogridError as error:
        assert_plain(error)


@many
@given(
    st.binary(max_size=200),
    st.sampled_from([b"", b"t,x,y,theta,r0\n", b"t,x,y,theta", b"# ", b"SONAR ", b"ODOM "]),
)
def test_random_bytes_never_break_a_reader(tmp_path, noise, start):
    read_anything(put(tmp_path, start + noise))


TOKENS = [
    b"",
    b" ",
    b",",
    b"\n",
    b"\r",
    b"nan",
    b"inf",
    b"-inf",
    b"1e400",
    b"-",
    b"0",
    b"9" * 30,
    b"_",
    b"\0",
]


@many
@given(st.data(), st.sampled_from([CSV, CARMEN]))
def test_a_damaged_log_never_breaks_a_reader(tmp_path, data, content):
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(content)))
        end = start + data.draw(st.integers(0, 12))
        piece = data.draw(st.one_of(st.sampled_from(TOKENS), st.binary(max_size=3)))
        content = content[:start] + piece + content[end:]
    read_anything(put(tmp_path, content))


def test_readers_start_without_jax():
    code = "import sys, echogrid.logs.formats; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
