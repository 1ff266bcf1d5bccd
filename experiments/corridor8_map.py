"""The recorded corridor, mapped by every model: measures and pictures.

    python experiments/corridor8_map.py [FOLDER [MODEL ...]]

FOLDER holds the recording (measurement.txt, poses.txt). There is no ground truth; what is known is that along
x = 1 .. 9 m the right wall lies at y = -0.925 m and the left wall at y = +1.180 m. MODEL is a name or a weights file;
without one all models are mapped, and the pictures and docs/paper/corridor8.json are written.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from corridor8_to_csv import frames
from echogrid import Grid, Log, Robot
from echogrid.metrics import FREE_BELOW, OCCUPIED_ABOVE
from echogrid.models.network import LOCAL_CELL_M
from held_out import EVERY, mapped
from paper import Panel, page, record

RIGHT_M, LEFT_M = -0.925, 1.180
X = np.arange(1.0, 9.0, 0.02)
ROBOT = Path(__file__).parent / "corridor8.yaml"
FOLDER = Path(__file__).parents[2] / "shared" / "data" / "corridor8"


def _strip(grid: Grid, low: float, high: float) -> np.ndarray:
    x, y = np.meshgrid(X, np.arange(low, high, 0.02))
    return grid.probability_at(np.column_stack([x.ravel(), y.ravel()]))


def _wall(grid: Grid, y: float) -> float:
    """Share of a wall's length with an occupied cell at it or beside it."""
    cell = grid.resolution
    around = [(dx, dy) for dx in (-cell, 0, cell) for dy in (-cell, 0, cell)]
    p = [grid.probability_at(np.column_stack([X + dx, np.full_like(X, y + dy)])) for dx, dy in around]
    return float(np.mean(np.max(p, axis=0) > OCCUPIED_ABOVE))


def measure(grid: Grid) -> dict[str, float]:
    """Shares that say whether the corridor came out."""
    lane = _strip(grid, -0.6, 0.85)
    return {
        "right wall": _wall(grid, RIGHT_M),
        "left wall": _wall(grid, LEFT_M),
        "lane free": float(np.mean(lane < FREE_BELOW)),
        "lane occupied": float(np.mean(lane > OCCUPIED_ABOVE)),
        "free behind right": float(np.mean(_strip(grid, RIGHT_M - 1.0, RIGHT_M - 0.3) < FREE_BELOW)),
        "free behind left": float(np.mean(_strip(grid, LEFT_M + 0.3, LEFT_M + 1.0) < FREE_BELOW)),
    }


def _mark(panel: Axes) -> None:
    for y, label in ((RIGHT_M, "walls as measured"), (LEFT_M, None)):
        panel.plot(X[[0, -1]], [y, y], color="tab:red", lw=1.0, ls="--", label=label)
    panel.set(xlim=(-2, 19), ylim=(-11.5, 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("models", nargs="*", default=EVERY)
    args = parser.parse_args()
    if not args.folder.is_dir():
        print(f"corridor8: found no folder {args.folder}, so docs/paper/corridor8.* stay as they are")
        return
    robot = Robot.load(ROBOT)
    maps = {}
    log = Log.of(frames(args.folder, robot), str(args.folder))
    drive = np.array([frame.pose[:2] for frame in log])
    for name in args.models:
        maps[name] = mapped(name, list(log), robot, LOCAL_CELL_M)
    measured = {name: measure(grid) for name, grid in maps.items()}
    print("| model | " + " | ".join(next(iter(measured.values()))) + " |")
    for name, shares in measured.items():
        print(f"| {name} | " + " | ".join(f"{v:.1%}" for v in shares.values()) + " |")
    if args.models == EVERY:
        record("corridor8", {name: {k: round(v, 4) for k, v in shares.items()} for name, shares in measured.items()})
        title = "A recorded corridor, eight sonars; what is known of it: two walls along x = 1 .. 9 m"
        panels: list[Panel] = [(name, grid, drive, None) for name, grid in maps.items()]
        page([panel for panel in panels if panel[0] in ("network", "nav2")], 2, 5.6, 0.69, title, "corridor8", _mark)
        page(panels, 4, 3.2, 0.69, title, "models_corridor8", _mark)


if __name__ == "__main__":
    main()
