"""Where the figures and numbers of docs/results.md go: one picture (PNG and SVG) or one JSON file a name."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle

from echogrid import Grid, World

FOLDER = Path(__file__).parent.parent / "docs" / "paper"

# The same figure gives the same file, so that a repeated run changes nothing.
matplotlib.rcParams["svg.hashsalt"] = "echogrid"


def save(figure: Figure, name: str) -> None:
    """Write a figure as PNG and SVG."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    figure.savefig(FOLDER / f"{name}.png", dpi=110)
    figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


def record(name: str, numbers: dict[str, Any]) -> None:
    """Write what was measured."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


def recorded(name: str) -> dict[str, Any]:
    """What ``record`` wrote."""
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


def draw_grid(
    axes: Axes, grid: Grid, drive: np.ndarray, world: World | None = None, line_width: float = 1.0
) -> AxesImage:
    """A map in greys with the drive and, where it is known, what is really there. Metres."""
    rows, cols = grid.shape
    (x, y), cell = grid.origin, grid.resolution
    p = np.where(grid.observed, grid.probability(), 0.5)
    extent = (x, x + cols * cell, y, y + rows * cell)
    shown = axes.imshow(p, cmap="gray_r", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    axes.set_facecolor("0.5")
    axes.plot(*drive[:, :2].T, color="tab:blue", lw=line_width, label="drive")
    if world is not None:
        for i, (x0, y0, x1, y1) in enumerate(world.walls):
            axes.plot([x0, x1], [y0, y1], color="tab:red", lw=line_width, label=None if i else "true walls")
        for x, y, radius in world.cylinders:
            axes.add_patch(Circle((x, y), radius, fill=False, color="tab:red", lw=line_width))
        low, high = world.bounds()
        axes.set(xlim=(low[0] - 0.6, high[0] + 0.6), ylim=(low[1] - 0.6, high[1] + 0.6))
    axes.set_aspect("equal")
    return shown


def draw_key(figure: Figure, shown: AxesImage, panels: list[Axes]) -> None:
    """What the greys and lines of ``draw_grid`` mean, for all panels."""
    bar = figure.colorbar(shown, ax=panels, shrink=min(1.0, 4.0 / figure.get_size_inches()[1]), ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels(["0 free", "0.5 unknown", "1 occupied"])
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles), frameon=False)


Panel = tuple[str, Grid, np.ndarray, World | None]
"""Heading, map, drive, and what is really there."""


def page(
    panels: list[Panel],
    columns: int,
    width: float,
    aspect: float,
    title: str,
    name: str,
    mark: Callable[[Axes], None] | None = None,
) -> None:
    """Maps of one place as a figure; ``width`` of each in inches, ``mark`` adds to each what is known otherwise."""
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(width * columns + 1.6, (width * aspect + 0.4) * rows + 1.3), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    used = list(axes.flat[: len(panels)])
    for panel, (heading, grid, drive, world) in zip(used, panels, strict=True):
        shown = draw_grid(panel, grid, drive, world, 1.0 if columns < 3 else 0.6)
        if mark:
            mark(panel)
        panel.set_title(heading, fontsize="medium")
    for panel in axes.flat[len(panels) :]:
        panel.set_axis_off()
    for panel in used[-columns:]:
        panel.set_xlabel("x (m)")
        panel.tick_params(labelbottom=True)
    for panel in axes[:, 0]:
        panel.set_ylabel("y (m)")
    draw_key(figure, shown, used)
    save(figure, name)
