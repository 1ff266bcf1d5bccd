"""The recorded corridor, mapped: measures and a picture, one panel a model.

    python experiments/corridor8_map.py FOLDER [--out docs/corridor8.png] [MODEL ...]

FOLDER holds the recording (measurement.txt, poses.txt). There is no ground truth; what is known is that along
x = 1 .. 9 m the right wall lies at y = -0.925 m and the left wall at y = +1.180 m. MODEL is ``network``, ``cone``
or a weights file.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from corridor8_to_csv import frames
from echogrid import Grid, Log, Robot, build_map
from echogrid.interpret import interpreter
from echogrid.metrics import FREE_BELOW, OCCUPIED_ABOVE

RIGHT_M, LEFT_M = -0.925, 1.180
X = np.arange(1.0, 9.0, 0.02)
ROBOT = Path(__file__).parent / "corridor8.yaml"


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


def draw(path: Path, maps: dict[str, Grid], drive: np.ndarray) -> None:
    """All maps on one scale with the drive."""
    figure = Figure(figsize=(6.2 * len(maps), 5.2), layout="constrained")
    panels = figure.subplots(1, len(maps), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (name, grid) in zip(panels, maps.items(), strict=True):
        rows, cols = grid.shape
        (x, y), cell = grid.origin, grid.resolution
        p = np.where(grid.observed, grid.probability(), 0.5)
        shown = axes.imshow(
            p, cmap="gray_r", vmin=0, vmax=1, origin="lower", extent=(x, x + cols * cell, y, y + rows * cell)
        )
        axes.plot(*drive.T, color="tab:blue", lw=1.0, label="drive")
        axes.plot(
            X[[0, -1]], [RIGHT_M] * 2, color="tab:red", lw=0.8, ls="--", label="walls as measured, x = 1 .. 9 m"
        )
        axes.plot(X[[0, -1]], [LEFT_M] * 2, color="tab:red", lw=0.8, ls="--")
        axes.set(title=name, xlabel="x (m)", xlim=(-2, 19), ylim=(-11.5, 3))
        axes.set_facecolor("0.5")
    panels[0].set_ylabel("y (m)")
    panels[0].legend(loc="lower left", fontsize="small")
    bar = figure.colorbar(shown, ax=list(panels), shrink=0.8, ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels(["0 free", "0.5 unknown", "1 occupied"])
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("models", nargs="*", default=["network", "cone"])
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    robot = Robot.load(ROBOT)
    maps = {}
    log = Log.of(frames(args.folder, robot), str(args.folder))
    drive = np.array([frame.pose[:2] for frame in log])
    for name in args.models:
        model = interpreter(name)
        *_, maps[model.name] = build_map(log, robot, model)
    names = list(measure(next(iter(maps.values()))))
    print("| model | " + " | ".join(names) + " |")
    print("|---" * (len(names) + 1) + "|")
    for name, grid in maps.items():
        print(f"| {name} | " + " | ".join(f"{v:.1%}" for v in measure(grid).values()) + " |")
    if args.out:
        draw(args.out, maps, drive)


if __name__ == "__main__":
    main()
