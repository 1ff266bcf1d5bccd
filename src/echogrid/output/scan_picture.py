"""The picture of a rotary scan and the table beside it.

matplotlib is imported where it draws: it takes half a second, which only a picture should cost.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.files import made, replacing
from echogrid.simulation.regions import RegionOfConstantDepth, regions_of_constant_depth
from echogrid.simulation.world import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def write_scan(
    folder: Path,
    world: World,
    at: tuple[float, float],
    bearing: Float[ndarray, "steps"],
    ranges: Float[ndarray, "steps"],
    title: str,
) -> None:
    """Write scan.csv and scan.png (range against orientation; the scan over the plan) into a folder.

    Both mark the regions of constant depth, numbered as they follow one another.

    Args:
        folder: made if it is not there.
        world: the plan.
        at: where the transducer is, m.
        bearing: rad, in even steps counter-clockwise once round the circle.
        ranges: m; inf = no echo.
        title: what the picture shows.

    Raises:
        UsageError: the folder cannot be written, or the bearings are not as they should be.
    """
    from matplotlib.figure import Figure

    regions = regions_of_constant_depth(bearing, ranges)
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    flat, plan = figure.subplots(1, 2, width_ratios=[1.25, 1])
    figure.suptitle(title)
    _draw_ranges(flat, np.rad2deg(bearing), ranges)
    _draw_walls(plan, world)
    heard = np.isfinite(ranges)
    x = at[0] + ranges[heard] * np.cos(bearing[heard])
    y = at[1] + ranges[heard] * np.sin(bearing[heard])
    plan.plot(x, y, ".", ms=3, color="tab:red", label="echo, drawn along the axis")
    plan.plot(*at, "b^", ms=7, label="transducer")
    draw_regions(flat, plan, at, regions)
    plan.plot([], [], **_WALL, label="smooth wall")
    plan.plot([], [], **_WALL, ls=_ROUGH, label="rough wall")
    plan.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    handles = [*flat.get_legend_handles_labels()[0], *plan.get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    with made(folder), replacing(folder / "scan.csv") as table, replacing(folder / "scan.png") as picture:
        table.write_text(_table(bearing, ranges, regions), encoding="utf-8")
        figure.savefig(picture, dpi=120)


_WALL: dict[str, Any] = {"color": "k", "lw": 1.2}
_ROUGH = (0, (3, 1))
"""Dashes of a rough wall."""


def _draw_ranges(flat: "Axes", degrees: Float[ndarray, "steps"], ranges: Float[ndarray, "steps"]) -> None:
    """Range (m) against orientation (degrees); no echo stands above the longest."""
    heard = np.isfinite(ranges)
    flat.plot(degrees[heard], ranges[heard], ".", ms=3, color="tab:red")
    top = float(np.max(ranges[heard], initial=1.0)) * 1.08
    flat.plot(degrees[~heard], np.full(np.sum(~heard), top), "|", ms=4, color="0.6", label="no echo")
    flat.set(xlabel="orientation (degrees)", ylabel="range (m)", xlim=(0, 360), ylim=(0, top * 1.04))
    flat.set_xticks(range(0, 361, 45))
    flat.grid(alpha=0.3)


def _draw_walls(plan: "Axes", world: World) -> None:
    for (x0, y0, x1, y1), height in zip(world.walls, world.roughness, strict=True):
        plan.plot([x0, x1], [y0, y1], **_WALL, ls="-" if height < 0.5e-3 else _ROUGH)
    angle = np.linspace(0, 2 * np.pi, 60)
    for x, y, radius in world.cylinders:
        plan.plot(x + radius * np.cos(angle), y + radius * np.sin(angle), **_WALL)


def _table(
    bearing: Float[ndarray, "steps"], ranges: Float[ndarray, "steps"], regions: list[RegionOfConstantDepth]
) -> str:
    """The text of scan.csv; a region bears its number, counted from 1."""
    number = {i: str(n) for n, region in enumerate(regions, 1) for i in region.readings}
    readings = enumerate(zip(np.rad2deg(bearing), ranges, strict=True))
    rows = [f"{degrees:.3f},{metres:.4f},{number.get(i, '')}" for i, (degrees, metres) in readings]
    return "\n".join(["bearing_deg,range_m,region", *rows, ""])


def draw_regions(flat: "Axes", plan: "Axes", at: tuple[float, float], regions: list[RegionOfConstantDepth]) -> None:
    """Mark regions in a drawn scan: a band under the readings of each, and its number beside the band's middle.

    Args:
        flat: range (m) against orientation (degrees, 0 to 360).
        plan: x, y, m.
        at: where the transducer is, m.
        regions: in the order of their numbers.
    """
    band: dict[str, Any] = {"color": "tab:blue", "lw": 7, "alpha": 0.35, "solid_capstyle": "butt", "zorder": 1}
    beside: dict[str, Any] = {"ha": "center", "va": "center", "color": "tab:blue", "textcoords": "offset points"}
    for number, region in enumerate(regions, 1):
        r = region.mean_range
        first = np.rad2deg(region.first_bearing) % 360
        last = first + np.rad2deg(region.width)
        parts = [(first, last)] if last < 360 else [(first, 360.0), (0.0, last - 360)]
        for part in parts:
            flat.plot(part, [r, r], **band)
        middle = np.mean(max(parts, key=lambda part: part[1] - part[0]))
        flat.annotate(str(number), (middle, r), (0, 9), size="small", **beside)
        bearing = region.first_bearing + np.linspace(0, region.width, 30)
        plan.plot(at[0] + r * np.cos(bearing), at[1] + r * np.sin(bearing), **band)
        x, y = np.cos(region.bearing), np.sin(region.bearing)
        plan.annotate(str(number), (at[0] + r * x, at[1] + r * y), (10 * x, 10 * y), size="small", **beside)
    if regions:
        plan.plot([], [], **band, label="region of constant depth")
