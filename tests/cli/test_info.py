"""What info says of a log."""

from dataclasses import replace

import numpy as np
import pytest

from bag_writers import B21, FORMATS, in_order, mounted, posed, ranged, sample, write
from commands import LOG, ROBOT, put, told
from echogrid.logs.csv_log import write_csv


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
        "not valid": "12.5%, or not fired",
        "stale": "50.0% of the finite readings repeat the one before",
        "ranges": "1.000 .. 3.000 m, median 2.00 m",
        "no echo of": "r0 25% r1 25%",
    }


def test_info_takes_the_limits_of_a_robot(run, tmp_path):
    robot = put(tmp_path / "duo.yaml", ROBOT.replace("max_range_m: 4.0", "max_range_m: 2.5"))
    out = told(run("info", put(tmp_path / "tiny.csv", LOG), "--robot", robot)[1])
    assert out["no echo"] == "37.5%"
    assert out["ranges"] == "1.000 .. 2.000 m, median 1.50 m"


def carmen_of(frames, robot):
    """A drive as CARMEN logs it: what is not valid as 0, no echo as a range past the maximum."""
    mounts = " ".join(f"{value:.6f}" for mount in robot.mounts for value in mount)
    lines = []
    for frame in frames:
        x, y, theta = frame.pose
        ranges = " ".join(f"{value:.6f}" for value in np.nan_to_num(frame.ranges, nan=0.0, posinf=99.0))
        lines.append(f"ODOM {x:.9f} {y:.9f} {theta:.9f} 0 0 0 {frame.stamp} host {frame.stamp}")
        lines.append(f"SONAR 0.43 {robot.sonars} {ranges} {mounts} {frame.stamp} host {frame.stamp}")
    return "\n".join(lines) + "\n"


def recorded(folder, form, frames):
    """The same drive in a format."""
    if form == "csv":
        write_csv(folder / "drive.csv", frames, B21.sonars)
        return folder / "drive.csv"
    if form == "carmen":
        return put(folder / "drive.log", carmen_of(frames, B21))
    said = [
        mounted(),
        *posed(frames),
        *ranged([replace(f, ranges=np.where(np.isnan(f.ranges), 0.0, f.ranges)) for f in frames]),
    ]
    name = "drive.bag" if form == "bag" else "drive"
    return write(folder / name, in_order(said), form)


@pytest.mark.parametrize("form", ["csv", "carmen", *FORMATS])
@pytest.mark.parametrize("jumps", [False, True])
def test_info_shows_what_to_look_at_in_every_format(run, tmp_path, form, jumps):
    frames = sample(60)
    rng, far = np.random.default_rng(0), np.array([5.0, 0, 0])
    lost = [np.where(rng.random(B21.sonars) < 0.125, np.nan, frame.ranges) for frame in frames]
    poses = [frame.pose + far * (i >= 30 and jumps) for i, frame in enumerate(frames)]
    frames = [replace(f, ranges=r, pose=p, odom=None) for f, r, p in zip(frames, lost, poses, strict=True)]
    status, out, err = run("info", recorded(tmp_path, form, frames), "--robot", "b21")
    said, way = told(out[out.index("log  ") :]), np.diff([f.pose for f in frames], axis=0)
    steps = np.hypot(way[:, 0], way[:, 1]) / np.diff([f.stamp for f in frames])
    turns = np.abs((way[:, 2] + np.pi) % (2 * np.pi) - np.pi) / np.diff([f.stamp for f in frames])
    assert status == 0
    slow = steps < 10
    assert said["fastest"] == f"{steps[slow].max():.2f} m/s, {np.rad2deg(turns[slow].max()):.0f} degrees/s"
    assert said["not valid"] == f"{np.isnan([f.ranges for f in frames]).mean():.1%}, or not fired"
    assert said["no echo"] == f"{np.isposinf([f.ranges for f in frames]).mean():.1%}"
    assert [line[: line.index(" by")] for line in err.splitlines()] == ["note: the pose jumps"] * jumps
    if form in FORMATS:
        assert "clocks        all stamps within 0.5 s of the time of recording" in out.splitlines()


@pytest.mark.parametrize(("reading", "no_echo", "not_valid"), [("inf", "100.0%", "0.0%"), ("nan", "0.0%", "100.0%")])
def test_info_of_a_log_without_a_range(run, tmp_path, reading, no_echo, not_valid):
    out = told(run("info", put(tmp_path / "one.csv", f"t,x,y,theta,r0\n7,0,0,0,{reading}\n"))[1])
    assert (out["no echo"], out["not valid"], out["ranges"]) == (no_echo, f"{not_valid}, or not fired", "none")
    assert out["span"] == "0.00 s"
