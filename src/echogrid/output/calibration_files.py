"""The folder of a calibration: the robot file, its numbers, and a picture of what they are told by.

matplotlib is imported where it draws: it takes half a second, which only a picture should cost.
"""

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from echogrid.calibration.beams import GRID_RAD
from echogrid.calibration.calibrate import SURE, Calibration
from echogrid.files import check_writable, made, replacing
from echogrid.geometry import wrap
from echogrid.robot import robot_yaml

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FILES = ("robot.yaml", "calibration.csv", "calibration.png")
"""What a calibration is in its folder."""

_HEAD = "sonar,x_m,x_95,y_m,y_95,axis_deg,axis_95,moved_x_m,moved_y_m,turned_deg,mount,echoes,repeats,spikes,state"


def check_calibration_folder(folder: Path) -> None:
    """Make sure that the files can be written into a folder that is there.

    Raises:
        UsageError: a file cannot be put there.
    """
    for name in FILES:
        check_writable(folder / name)


def write_calibration(folder: Path, found: Calibration, title: str) -> None:
    """Write the robot file (robot.yaml), a row a sonar (calibration.csv) and the picture (calibration.png).

    Args:
        folder: made if it is not there.
        found: what the log says.
        title: what the picture shows.

    Raises:
        UsageError: the folder cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 8.5), layout="constrained")
    figure.suptitle(title)
    (plan, beam), (axes, ranks) = figure.subplots(2, 2)
    _draw_mounts(plan, found)
    _draw_beam(beam, found)
    _draw_axes(axes, found)
    _draw_ranks(ranks, found)
    with (
        made(folder),
        replacing(folder / "robot.yaml") as robot,
        replacing(folder / "calibration.csv") as table,
        replacing(folder / "calibration.png") as picture,
    ):
        robot.write_text(robot_yaml(found.robot), encoding="utf-8")
        table.write_text(_table(found), encoding="utf-8")
        figure.savefig(picture, dpi=110)


def state(found: Calibration, sonar: int) -> str:
    """What is amiss with a sonar, in a word; ok if nothing is."""
    health = found.health
    for name in ("silent", "dead", "stuck", "stale", "cross_talk"):
        if getattr(health, name)[sonar]:
            return name
    return "swapped" if found.seats[sonar] != sonar else "ok"


def _table(found: Calibration) -> str:
    rows = [_HEAD]
    moved, sd = found.moved * [1, 1, np.rad2deg(1)], SURE * found.moved_sd * [1, 1, np.rad2deg(1)]
    there = found.given.mounts * [1, 1, np.rad2deg(1)] + moved
    for i in range(found.robot.sonars):
        pairs = [f"{there[i, k]:.4f},{sd[i, k]:.4f}" for k in range(3)]
        more = [f"{value:.4f}" for value in (*moved[i], found.health.echoes[i])]
        more.insert(3, str(found.seats[i]))
        health = [f"{value:.4f}" for value in (found.health.repeats[i], found.health.spikes[i])]
        rows.append(",".join([f"r{i}", *pairs, *more, *health, state(found, i)]))
    return "\n".join([*rows, ""])


def _draw_mounts(plan: "Axes", found: Calibration) -> None:
    """The mounts as given and as found, with the beam's edges."""
    long = 0.6 * max(float(np.max(np.hypot(*found.given.mounts[:, :2].T))), 0.1)
    for mounts, style, label in ((found.given.mounts, "0.6", "as given"), (found.robot.mounts, "tab:blue", "found")):
        for i, (x, y, axis) in enumerate(mounts):
            ends: dict[str, Any] = {"color": style, "lw": 1.2, "label": None if i else label}
            plan.plot([x, x + long * np.cos(axis)], [y, y + long * np.sin(axis)], **ends)
            plan.plot(x, y, "o", ms=4, color=style)
    for i, (x, y, axis) in enumerate(found.robot.mounts):
        color = "k" if state(found, i) == "ok" else "tab:red"
        at = (x + 1.2 * long * np.cos(axis), y + 1.2 * long * np.sin(axis))
        plan.annotate(f"r{i}", at, ha="center", va="center", size="small", color=color)
    plan.set(title="mounts (red: something is amiss)", xlabel="x forward (m)", ylabel="y left (m)", aspect="equal")
    plan.margins(0.15)
    plan.legend(frameon=False)


def _draw_beam(panel: "Axes", found: Calibration) -> None:
    """How often walls are heard, by their bearing off the axis."""
    beams, chances = found.beams, found.chances
    off = np.rad2deg(wrap(chances.bearing - beams.yaw[chances.sonar]))
    edges = np.arange(-60, 61, 2.0)
    count, _ = np.histogram(off, edges)
    heard, _ = np.histogram(off[chances.heard], edges)
    middle = (edges[1:] + edges[:-1]) / 2
    some = count > 10
    panel.plot(middle[some], heard[some] / count[some], "o", ms=4, color="0.4", label="heard, in bins of 2 degrees")
    fine = np.linspace(-60, 60, 481)
    panel.plot(fine, beams.share(np.deg2rad(fine)), color="tab:blue", label="fitted")
    half = np.rad2deg(beams.half)
    panel.axvspan(-half, half, color="tab:blue", alpha=0.12, lw=0)
    title = f"beam {2 * half:.1f} degrees (+-{SURE * 2 * np.rad2deg(beams.half_sd):.1f})"
    panel.set(title=title, xlabel="wall off the axis (degrees)", ylabel="share of walls heard", ylim=(0, 1.2))
    panel.grid(alpha=0.3)
    panel.legend(frameon=False, loc="upper right", fontsize="small")


def _draw_axes(panel: "Axes", found: Calibration) -> None:
    """How likely each turn of each sonar is, one above the other."""
    for i, (turned, told) in enumerate(zip(found.moved[:, 2], found.beams.told, strict=True)):
        if told.any():
            aside, curve = np.rad2deg(GRID_RAD + turned), 0.9 * np.exp(told)
            panel.fill_between(aside, i, i + curve, color="tab:blue", alpha=0.5, lw=0.5)
    panel.axvline(0, color="k", lw=0.6)
    panel.set(
        title="likelihood of each axis", xlabel="turned from as given (degrees)", ylabel="sonar", xlim=(-25, 25)
    )
    step = 1 + found.given.sonars // 16
    panel.set_yticks(range(0, found.given.sonars, step), [f"r{i}" for i in range(0, found.given.sonars, step)])


def _draw_ranks(panel: "Axes", found: Calibration) -> None:
    """The plausible mistakes by the sharpness of their walls."""
    best = found.ranks[:8][::-1]
    colors = ["tab:blue" if each is found.taken else "0.7" for each in best]
    panel.barh(range(len(best)), [each.share for each in best], color=colors)
    names = [textwrap.fill(textwrap.shorten(each.variant.name, 96, placeholder=" ..."), 44) for each in best]
    panel.set_yticks(range(len(best)), names, size="small")
    panel.set(title="share of echoes that touch walls (blue: taken)", xlim=(0, 1))
