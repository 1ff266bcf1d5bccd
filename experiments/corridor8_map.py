"""The recorded corridor, mapped by every model: measures and pictures.

    python experiments/corridor8_map.py [FOLDER [MODEL ...]]

FOLDER holds the recording (measurement.txt, poses.txt). There is no ground truth; what is known is that along
x = 1 .. 9 m the right wall lies at y = -0.925 m and the left wall at y = +1.180 m. MODEL is a name or a weights file;
without one all models are mapped, and the pictures and docs/paper/corridor8.json are written.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from corridor8_to_csv import frames
from echogrid import Grid, Log, Robot, build_map
from echogrid.metrics import FREE_BELOW, OCCUPIED_ABOVE
from echogrid.models import MODELS, sensor_model
from paper import draw_grid, draw_key, record, save

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


def draw(maps: dict[str, Grid], drive: np.ndarray, columns: int, width: float, name: str) -> None:
    """All maps on one scale with the drive."""
    rows = -(-len(maps) // columns)
    figure = Figure(figsize=(width * columns + 1.6, (width * 0.69 + 0.4) * rows + 1.3), layout="constrained")
    figure.suptitle("A recorded corridor, eight sonars; what is known of it: two walls along x = 1 .. 9 m")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    used = list(axes.flat[: len(maps)])
    for panel, (model, grid) in zip(used, maps.items(), strict=True):
        shown = draw_grid(panel, grid, drive, line_width=1.0 if columns < 3 else 0.6)
        for y, label in ((RIGHT_M, "walls as measured"), (LEFT_M, None)):
            panel.plot(X[[0, -1]], [y, y], color="tab:red", lw=1.0, ls="--", label=label)
        panel.set(xlim=(-2, 19), ylim=(-11.5, 3))
        panel.set_title(model, fontsize="medium")
    for panel in axes.flat[len(maps) :]:
        panel.set_axis_off()
    for panel in used[-columns:]:
        panel.set_xlabel("x (m)")
        panel.tick_params(labelbottom=True)
    for panel in axes[:, 0]:
        panel.set_ylabel("y (m)")
    draw_key(figure, shown, used)
    save(figure, name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("models", nargs="*", default=list(MODELS))
    args = parser.parse_args()
    if not args.folder.is_dir():
        print(f"corridor8: found no folder {args.folder}, so docs/paper/corridor8.* stay as they are")
        return
    robot = Robot.load(ROBOT)
    maps = {}
    log = Log.of(frames(args.folder, robot), str(args.folder))
    drive = np.array([frame.pose[:2] for frame in log])
    for name in args.models:
        *_, maps[name] = build_map(log, robot, sensor_model(name))
    measured = {name: measure(grid) for name, grid in maps.items()}
    print("| model | " + " | ".join(next(iter(measured.values()))) + " |")
    for name, shares in measured.items():
        print(f"| {name} | " + " | ".join(f"{v:.1%}" for v in shares.values()) + " |")
    if args.models == list(MODELS):
        record("corridor8", {name: {k: round(v, 4) for k, v in shares.items()} for name, shares in measured.items()})
        draw({name: maps[name] for name in ("network", "cone")}, drive, 2, 5.6, "corridor8")
        draw(maps, drive, 4, 3.2, "models_corridor8")


if __name__ == "__main__":
    main()
