"""Text logs for tests: how their lines look, and what comes of reading them."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings

from echogrid.errors import EchogridError, InputError
from echogrid.frame import Frame, Log
from echogrid.robot import parse_robot

ROBOT = parse_robot(
    """
name: duo
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.2, max_range_m: 4.0, beam_width_deg: 25}
mounts: [[0.1, 0, 0], [0, 0.1, 90]]
""",
    "duo.yaml",
)

CSV = b"t,x,y,theta,r0,r1\n0,1,2,0.5,1.5,inf\n0.5,1.25,2,0.5,,2.5\n"
MOUNTS = "0.1 0 0 0 0.1 1.570796"

# The file of all examples lies in one folder; a folder an example would take most of the time.
many = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def put(folder: Path, content: bytes | str, name: str = "drive.log") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def rows(*lines: str) -> str:
    return "\n".join(["t,x,y,theta,r0,r1", *lines, ""])


def odom(x: float, y: float, theta: float, t: float) -> str:
    return f"ODOM {x} {y} {theta} 0.1 0 0 {t} nohost {t + 1000}"


def sonar(t: float, ranges: str = "1.50 2.50", n: int = 2, mounts: str = MOUNTS, cone: float = 0.26) -> str:
    return f"SONAR {cone} {n} {ranges} {mounts} {t} nohost {t + 77}"


def messages(*lines: str) -> str:
    return "\n".join(["# CARMEN Logfile", "PARAM robot_length 0.5 0.0 nohost 0", *lines, ""])


CARMEN = messages(
    odom(0, 0, 0, 10), sonar(10.5), "FLASER 2 1 2 0 0 0 0 0 0 10.5 nohost 0", odom(1, 0, 0, 11)
).encode()


def same(a: Frame, b: Frame) -> bool:
    pairs = [(a.pose, b.pose), (a.ranges, b.ranges)]
    if a.odom is not None and b.odom is not None:
        pairs.append((a.odom, b.odom))
    elif a.odom is not b.odom:
        return False
    return a.stamp == b.stamp and all(np.array_equal(x, y, equal_nan=True) for x, y in pairs)


def drain(log: Log) -> tuple[list[Frame], InputError | None]:
    """The frames up to the first wrong row, and its error."""
    kept: list[Frame] = []
    try:
        for frame in log:
            kept.append(frame)  # noqa: PERF402  (extend would lose the frames before an error)
    except InputError as error:
        return kept, error
    return kept, None


def assert_plain(error: EchogridError) -> None:
    text = str(error)
    assert text.isprintable(), "no control characters for the terminal"
    assert len(text) < 600
    assert ": found " in text
    assert ", expected " in text


def steps(count: int, sonars: int = 2) -> Iterator[Frame]:
    for i in range(count):
        yield Frame(i * 0.1, np.array([i * 0.01, 0.0, 0.1]), np.full(sonars, 1.0 + i % 7))


def peak_of(work) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
