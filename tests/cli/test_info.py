"""What info says of a log."""

import pytest

from commands import LOG, ROBOT, put, told


def test_info_counts_as_one_does_by_hand(run, tmp_path):
    log = put(tmp_path / "tiny.csv", LOG)
    status, out, err = run("info", log)
    assert (status, err) == (0, "")
    assert told(out) == {
        "log": str(log),
        "frames": "4",
        "sonars": "2",
        "span": "2.00 s, 1.5 Hz",
        "drive": "6.00 m within x 0.00 .. 3.00, y 0.00 .. 5.00 m",
        "fastest": "10.00 m/s, 0 degrees/s",
        "no echo": "25.0%",
        "not fired": "12.5%",
        "stale": "50.0% of the finite readings repeat the one before",
        "ranges": "1.000 .. 3.000 m, median 2.00 m",
        "no echo of": "r0 25% r1 25%",
    }


def test_info_takes_the_limits_of_a_robot(run, tmp_path):
    robot = put(tmp_path / "duo.yaml", ROBOT.replace("max_range_m: 4.0", "max_range_m: 2.5"))
    out = told(run("info", put(tmp_path / "tiny.csv", LOG), "--robot", robot)[1])
    assert out["no echo"] == "37.5%"
    assert out["ranges"] == "1.000 .. 2.000 m, median 1.50 m"


@pytest.mark.parametrize(("reading", "no_echo", "not_fired"), [("inf", "100.0%", "0.0%"), ("nan", "0.0%", "100.0%")])
def test_info_of_a_log_without_a_range(run, tmp_path, reading, no_echo, not_fired):
    out = told(run("info", put(tmp_path / "one.csv", f"t,x,y,theta,r0\n7,0,0,0,{reading}\n"))[1])
    assert (out["no echo"], out["not fired"], out["ranges"]) == (no_echo, not_fired, "none")
    assert out["span"] == "0.00 s"
