"""The picture of a map with its drive, for people.

matplotlib is imported where it draws: it takes half a second, which only a picture should cost.
"""

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.grid import P_MAX, P_MIN, Grid, sigmoid
from echogrid.track import line_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


type Discs = tuple[str, Float[ndarray, "n _"], float]
"""Colour, middles (m, world) and radius (m) of circles that are drawn to scale."""


def draw_map(
    path: Path,
    grid: Grid,
    path_world: Float[ndarray, "poses _"],
    title: str,
    odometry_world: Float[ndarray, "told _"] | None = None,
    drive: str = "drive",
    marks: Mapping[str, tuple[str, Float[ndarray, "n 2"]]] | None = None,
    discs: Mapping[str, Discs] | None = None,
) -> None:
    """The picture for people, as PNG: what was observed of the map, the drive, and a key below.

    Where poses were corrected the drive as the odometry had it is there too. The key calls the line ``drive``.
    ``marks``: points (m, world) to be marked, by what the key calls them, with their colour; ``discs`` likewise.
    """
    # Without pyplot, which keeps figures in global state.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    way, told = _places(path_world), _places(np.empty((0, 2)) if odometry_world is None else odometry_world)
    image, *corners = _image(grid.observed_part() or grid)
    boxes = [*corners, *_box(way), *_box(told)]
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    margin = 0.03 * np.max(high - low)
    low, high = low - margin, high + margin
    inch_per_m = _MAP_INCHES / np.max(high - low)
    size = (high - low) * inch_per_m
    page = np.array([max(size[0], _KEY_INCHES) + 1.2, size[1] + (2.25 if title else 1.95)])
    corner = np.array([(page[0] - size[0]) / 2 + 0.2, 1.75])

    figure = Figure(figsize=(page[0], page[1]), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((*(corner / page), *(size / page)))
    shown = _draw_cells(axes, image, *corners)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x, m", ylabel="y, m")
    _set_ticks(axes, size, inch_per_m)
    heading = title if len(title) <= _TITLE_LENGTH else title[: _TITLE_LENGTH - 3] + "..."
    figure.text(0.5, 1 - 0.25 / page[1], heading, ha="center", va="center", size=11, parse_math=False)
    near = _NEAR_PIXELS / (_DPI * inch_per_m)
    if len(told):
        # Below the drive and thinner: it is what the map was not made from.
        axes.plot(*line_of(told, near).T, color="tab:orange", lw=1.0, label="odometry")
    if len(way):
        _draw_drive(axes, line_of(way, near), drive)
    for label, (colour, points) in (marks or {}).items():
        axes.plot(*points.T, "s", color=colour, ms=1.5, mew=0)
        axes.plot([], "s", color=colour, ms=7, label=label if len(points) else f"{label}: none")  # for the key
    for label, (colour, middles, radius) in (discs or {}).items():
        for x, y in middles[:, :2].tolist():
            axes.add_patch(Circle((x, y), radius, fill=False, ec=colour, lw=1.5, zorder=3))
        axes.plot([], "o", mfc="none", mec=colour, ms=8, label=label)  # for the key
    _draw_key(figure, axes, shown, inch_per_m)
    with warnings.catch_warnings():
        # A title in a script that the font lacks is drawn as boxes; that is no reason to bother anyone.
        warnings.filterwarnings("ignore", "Glyph", UserWarning)
        figure.savefig(path, format="png")
    # Its parts hold each other and the map: left to itself Python would find them many pictures later.
    figure.clear()


_MAP_INCHES, _KEY_INCHES, _TITLE_LENGTH = 8.0, 6.4, 72
"""Longer side of the map, width of the key below it, letters of a title that fit above it."""

_DPI, _NEAR_PIXELS = 150, 0.25
"""Of the picture; how far the line that is drawn may be from the drive."""


def _draw_cells(
    axes: "Axes", image: Float[ndarray, "rows cols"], low: Float[ndarray, "2"], high: Float[ndarray, "2"]
) -> "AxesImage":
    from matplotlib.colors import LinearSegmentedColormap

    # The grey between is light, for much of a map is unknown and walls should stand out from it.
    greys = LinearSegmentedColormap.from_list("occupancy", ["white", "0.7", "black"])
    axes.set_facecolor(greys(0.5))
    return axes.imshow(image, greys, vmin=0, vmax=1, origin="lower", extent=(low[0], high[0], low[1], high[1]))


def _set_ticks(axes: "Axes", size: Float[ndarray, "2"], inch_per_m: float) -> None:
    """Ticks at round lengths: about an inch apart, closer where a side of the map (inches) is short."""
    from matplotlib.ticker import MultipleLocator

    for axis, inches in zip((axes.xaxis, axes.yaxis), size, strict=True):
        spacing = min(1.0, max(inches / 2, 0.45))
        axis.set_major_locator(MultipleLocator(_round_length(spacing / inch_per_m)))


def _places(path_world: Float[ndarray, "poses _"]) -> Float[ndarray, "fewer 2"]:
    """x, y of poses, m, where they are numbers."""
    places = np.asarray(path_world, dtype=float)[:, :2]
    return places[np.isfinite(places).all(axis=1)]


def _box(points: Float[ndarray, "n 2"]) -> list[Float[ndarray, "2"]]:
    """Lowest x, y and highest x, y of points; nothing of none."""
    return [points.min(axis=0), points.max(axis=0)] if len(points) else []


def _draw_drive(axes: "Axes", drive: Float[ndarray, "poses 2"], label: str) -> None:
    axes.plot(*drive.T, color="tab:blue", lw=1.5, label=label)
    # The end is smaller than the start, so that a drive that returns shows both.
    axes.plot(*drive[0], "o", color="tab:green", mec="white", ms=11, label="start")
    axes.plot(*drive[-1], "s", color="tab:red", mec="white", ms=6, label="end")


def _draw_key(figure: "Figure", axes: "Axes", shown: "AxesImage", inch_per_m: float) -> None:
    """Scale bar, markers and greys in a row at the foot of the page, where they hide nothing."""
    from matplotlib.lines import Line2D

    page = figure.get_size_inches()
    left = (page[0] - _KEY_INCHES) / 2

    metres = _round_length(1.5 / inch_per_m)
    x = np.array([left, left + metres * inch_per_m]) / page[0]
    y = 0.75 / page[1]
    figure.add_artist(Line2D(x, [y, y], color="black", lw=3, solid_capstyle="butt"))
    figure.text(x.mean(), y - 0.12 / page[1], f"{metres:g} m", ha="center", va="top")

    if axes.get_lines():
        place = (left + 1.9) / page[0], 0.65 / page[1]
        at = {"bbox_to_anchor": place, "bbox_transform": figure.transFigure}
        axes.legend(loc="center left", frameon=False, handlelength=1.4, **at)

    bar = figure.add_axes(((left + 3.6) / page[0], 0.68 / page[1], 2.6 / page[0], 0.16 / page[1]))
    figure.colorbar(shown, cax=bar, orientation="horizontal", ticks=[0, 0.5, 1])
    bar.set_xticklabels(["0\nfree", "0.5\nunknown,\nnot seen", "1\noccupied"])
    bar.set_title("how likely a cell is occupied", size=10)


def _round_length(longest: float) -> float:
    """The longest of 1, 2, 5 times a power of ten that is not longer than this, m."""
    power = 10.0 ** math.floor(math.log10(longest))
    return max(digit * power for digit in (1, 2, 5) if digit * power <= longest)


def _image(part: Grid) -> tuple[Float[ndarray, "rows cols"], Float[ndarray, "2"], Float[ndarray, "2"]]:
    """Probabilities of a map, and its two corners x, y, m.

    A map with more cells than the picture has pixels is coarsened; of the cells that share a pixel an
    occupied one shows, for a wall is thin.
    """
    log_odds = np.where(part.observed, part.log_odds, 0)
    factor = -(-max(log_odds.shape) // _MAX_PICTURE_CELLS)
    log_odds = np.pad(log_odds, [(0, -n % factor) for n in log_odds.shape])
    blocks = log_odds.reshape(log_odds.shape[0] // factor, factor, -1, factor)
    most, least = blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3))
    image = np.clip(sigmoid(np.where(most > 0, most, least)), P_MIN, P_MAX)
    low = np.array(part.origin, dtype=float)
    return image, low, low + np.array(image.shape[::-1]) * factor * part.resolution


_MAX_PICTURE_CELLS = 1200
"""Cells along the longer side of the picture; about its pixels."""
