"""Running the command in the tests, and inputs for it."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from echogrid.cli import main

SOURCE = Path(__file__).parents[1] / "src"
DATA = SOURCE / "echogrid" / "data"
SAMPLE, TRUTH = DATA / "sample.csv", DATA / "sample.truth.npz"

MAP_FILES = {"map.pgm", "map.yaml", "map.png", "map.npz", "run.yaml"}
SCORES = ["found", "wiped", "free", "false", "auc", "nll", "brier", "ece", "surface_cells", "free_cells"]

ROBOT = """
name: duo
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.2, max_range_m: 4.0, beam_width_deg: 25}
mounts: [[0.1, 0, 0], [0, 0.1, 90]]
"""

LOG = """t,x,y,theta,r0,r1
0,0,0,0,1.0,inf
0.5,3,4,0,1.0,2.0
1.0,3,4,0,inf,2.0
2.0,3,5,0,,3.0
"""

WORLD = """
name: box
walls:
  - {points: [[0, 0], [3, 0], [3, 2], [0, 2]], closed: true, roughness_mm: 0.05}
"""


Run = Callable[..., tuple[int, str, str]]


def call(*args: object) -> int:
    try:
        main([str(arg) for arg in args])
    except SystemExit as stopped:
        return int(stopped.code or 0)
    return 0


def put(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def everything(folder: Path) -> dict[str, bytes | None]:
    """All that lies in a folder and below, hidden files included; None stands for a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def assert_refused(run: Run, folder: Path, *args: object) -> str:
    """One line on stderr, exit status 2, and the folder as it was. Gives the line."""
    before = everything(folder)
    status, out, err = run(*args)
    assert status == 2
    assert out == ""
    assert re.fullmatch(r"echogrid: .+: found .+, expected .+\n", err), err
    assert everything(folder) == before
    return err


def told(text: str) -> dict[str, str]:
    """The lines of ``score`` and ``info`` as name and value."""
    return {line[:14].strip(): line[14:] for line in text.splitlines()}


def share(text: str, name: str) -> float:
    return float(told(text)[name].split("%")[0]) / 100


def arrays(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "map.npz", allow_pickle=False) as data:
        return dict(data)


def scores(run: Run, map_: Path, truth: Path = TRUTH) -> dict[str, float]:
    status, out, err = run("score", map_, truth)
    assert (status, err) == (0, "")
    assert [line.split()[0] for line in out.splitlines()] == SCORES
    return {name: float(value) for name, value in told(out).items()}


def rows(*rows: str) -> str:
    return "\n".join(["t,x,y,theta,r0,r1", *rows, ""])


GOOD = "0,0,0,0,1,1"

MAP = ["map", "drive.csv", "--robot", "duo.yaml", "--out", "out"]
SIMULATE = ["simulate", "box.yaml", "--robot", "duo.yaml", "--drive", "way.txt", "--out", "old.csv"]
