"""The robot on Fast DDS from Python: builds it, gives it a drive to play, reads the maps that it heard.

All of it runs in a network namespace of its own in which there is nothing but loopback.
"""

import fcntl
import shutil
import subprocess
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
PROGRAM = HERE.parents[2] / "build" / "peers" / "fastdds" / "robot"
SOURCES = [HERE / name for name in ("ros.idl", "robot.cpp", "build.sh")]
START_S = 1000.0
"""Stamp of the first frame of a drive; 0 would be no stamp."""


def missing() -> str | None:
    """What is not installed, if something is not."""
    tools = [tool for tool in ("g++", "fastddsgen") if shutil.which(tool) is None]
    if tools:
        return f"found no {', '.join(tools)}"
    if not Path("/usr/include/fastdds/dds").is_dir():
        return "found no libfastrtps-dev"
    return without_namespace()


def without_namespace() -> str | None:
    """Why no network namespace can be made, if so."""
    tools = [tool for tool in ("unshare", "nsenter", "ip") if shutil.which(tool) is None]
    if tools:
        return f"found no {', '.join(tools)}"
    if subprocess.run(["unshare", "-rn", "true"], capture_output=True).returncode:
        return "found no right to make a network namespace"
    return None


@contextmanager
def locked(path: Path) -> Generator[None]:
    """Have a file to oneself among several processes."""
    with open(path, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def build() -> Path:
    """The robot, built if it is older than its sources."""
    newest = max(path.stat().st_mtime for path in SOURCES)
    PROGRAM.parent.mkdir(parents=True, exist_ok=True)
    with locked(PROGRAM.with_suffix(".lock")):
        if not PROGRAM.exists() or PROGRAM.stat().st_mtime < newest:
            subprocess.run([HERE / "build.sh"], check=True, timeout=300)
    return PROGRAM


class Namespace:
    """A network with nothing but loopback."""

    def __init__(self, pid: int):
        self.started: list[subprocess.Popen[str]] = []
        self._prefix = ["nsenter", f"--target={pid}", "--user", "--net", "--preserve-credentials"]

    def command(self, *words: object) -> list[str]:
        """A command that runs in it."""
        return [*self._prefix, *map(str, words)]

    def start(self, *words: object, **options: Any) -> subprocess.Popen[str]:
        """Start a command in it; options as of ``subprocess.Popen``."""
        self.started.append(subprocess.Popen(self.command(*words), text=True, **options))
        return self.started[-1]

    def output(self, *words: object) -> str:
        """What a command says in it."""
        return subprocess.run(self.command(*words), capture_output=True, text=True, check=True, timeout=60).stdout


@contextmanager
def namespace() -> Generator[Namespace]:
    """Make a network namespace, and undo it with all that runs in it."""
    script = "ip link set lo up multicast on && echo ready && exec sleep 7200"
    holder = subprocess.Popen(["unshare", "-rn", "sh", "-c", script], stdout=subprocess.PIPE, text=True)
    made = Namespace(holder.pid)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "ready\n"
        yield made
    finally:
        for process in (*made.started, holder):
            if process.poll() is None:
                process.kill()
                process.communicate()


@dataclass(frozen=True)
class Heard:
    """A map that the robot heard."""

    kind: str
    """map or local."""
    stamp: float
    frame: str
    resolution: float
    cells: np.ndarray
    """int8 [row, col]."""
    origin: tuple[float, float]
    delay_s: float
    """Time since the last range of its stamp was published; negative if there was none."""


_VALUES = {"#": 100, ".": 0, "?": -1, "!": 50}


def heard(text: str) -> list[Heard]:
    """The maps in what the robot wrote; a line that is not finished is left out."""
    maps = []
    for line in text.splitlines(keepends=True):
        if not line.endswith("\n") or not line.startswith(("map ", "local ")):
            continue
        kind, stamp, frame, resolution, cols, rows, x, y, delay, letters = line.split()
        table = np.zeros(128, dtype=np.int8)
        for letter, value in _VALUES.items():
            table[ord(letter)] = value
        cells = table[np.frombuffer(letters.encode(), dtype=np.uint8)].reshape(int(rows), int(cols))
        place = float(x), float(y)
        maps.append(Heard(kind, float(stamp), frame, float(resolution), cells, place, int(delay) / 1e6))
    return maps


@dataclass(frozen=True)
class HeardPose:
    """A transform, or the robot's pose, that the robot heard."""

    kind: str
    """tf or pose."""
    stamp: float
    frame: str
    child: str
    """Of a transform."""
    pose: np.ndarray
    """x, y, heading."""
    variance: np.ndarray
    """Of a pose."""


def heard_poses(text: str) -> list[HeardPose]:
    """The transforms and poses in what the robot wrote."""
    poses = []
    for line in text.splitlines(keepends=True):
        if not line.endswith("\n") or not line.startswith(("tf ", "pose ")):
            continue
        kind, stamp, frame, *words = line.split()
        child = words.pop(0) if kind == "tf" else ""
        x, y, sin, cos, *variance = map(float, words)
        pose = np.array([x, y, 2 * np.arctan2(sin, cos)])
        poses.append(HeardPose(kind, float(stamp), frame, child, pose, np.array(variance)))
    return poses


def stamp_text(stamp: float) -> str:
    """A stamp (s) as the robot reads it, to a microsecond."""
    micros = round(stamp * 1e6)
    return f"{micros // 10**6}.{micros % 10**6 * 1000}"


def pose_text(x: float, y: float, theta: float) -> str:
    """A pose in the plane as the robot reads it."""
    return f"{x:.17g} {y:.17g} 0 0 0 {np.sin(theta / 2):.17g} {np.cos(theta / 2):.17g}"


def opening(mounts: np.ndarray, listeners: int = 1, base: str = "base_link") -> list[str]:
    """Lines that make the writers and wait until they are listened to: /tf_static, /tf, and a topic a sonar."""
    lines = [f"static 0.0 {base} sonar_{i} {pose_text(*mount)}" for i, mount in enumerate(mounts)]
    lines.append(f"tf {stamp_text(START_S - 1)} odom {base} {pose_text(0, 0, 0)}")
    first = [f"range sonar/s{i} {stamp_text(START_S - 1)} sonar_{i} 0.4 0.15 5 nan" for i in range(len(mounts))]
    return [*lines, *first, f"matched {listeners}"]


def frame_lines(
    stamp: float, pose: Sequence[float], ranges: Iterable[float], limits: tuple[float, float] = (0.15, 5.0)
) -> list[str]:
    """Lines of one scan: where the robot is, then what each of its sonars heard."""
    at = stamp_text(stamp)
    lines = [f"tf {at} odom base_link {pose_text(*pose)}"]
    for i, value in enumerate(ranges):
        lines.append(f"range sonar/s{i} {at} sonar_{i} 0.436332 {limits[0]} {limits[1]} {value:.9g}")
    return lines
