"""Where figures and numbers go, one picture (PNG) or one JSON file a name, and what tables and maps look like."""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from PIL import Image

from echogrid import Grid, World

FOLDER = Path(__file__).parents[2] / "docs" / "paper"

# The same figure gives the same file, so that a repeated run changes nothing.
matplotlib.rcParams["svg.hashsalt"] = "echogrid"


def save(figure: Figure, name: str) -> None:
    """Write a figure as PNG, of 256 colours to keep it small, and where the environment has SVG set as SVG too."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=110)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(FOLDER / f"{name}.png", optimize=True)
    if os.environ.get("SVG"):
        figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})


def record(name: str, numbers: dict[str, Any]) -> None:
    """Write what was measured."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


def recorded(name: str) -> dict[str, Any]:
    """What ``record`` wrote."""
    return json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))


def rounded(value: Any) -> Any:
    """What JSON can hold of numbers, and of lists and dictionaries of such; floats have four places."""
    if isinstance(value, dict):
        return {key: rounded(v) for key, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return value if value is None or isinstance(value, int | str) else round(float(value), 4) + 0.0  # no minus zero


def table(header: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in body])


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


def draw_key(figure: Figure, *panels: Axes, columns: int | None = None, **look: Any) -> None:
    """What the lines and marks of panels mean, each label once, below all panels."""
    handles: dict[Any, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    place = {"loc": "outside lower center", "ncols": columns or len(handles), "frameon": False}
    figure.legend(handles.values(), handles, **place, **look)


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
    bar = figure.colorbar(shown, ax=used, shrink=min(1.0, 4.0 / figure.get_size_inches()[1]), ticks=[0, 0.5, 1])
    bar.ax.set_yticklabels(["0 free", "0.5 unknown", "1 occupied"])
    draw_key(figure, used[0])
    save(figure, name)
