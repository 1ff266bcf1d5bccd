"""What has changed as files: a table, and a picture for people."""

import csv
from pathlib import Path

import numpy as np

from echogrid.files import check_writable, replacing
from echogrid.fleet.changes import Changes
from echogrid.output.map_picture import draw_map

FILES = ("changes.csv", "changes.png")

COLUMNS = (
    *("became", "x", "y", "x0", "y0", "x1", "y1", "area_m2", "cells"),
    *("log_odds_before", "log_odds_after", "views_before", "views_after", "evidence"),
)
"""Of changes.csv: m, m2, log-odds (means of the area's cells), scans (of its least seen cell)."""


def check_changes_folder(folder: Path) -> None:
    """Make sure that the files can be written.

    Raises:
        UsageError: they cannot.
    """
    for name in FILES:
        check_writable(folder / name)


def write_changes(folder: Path, changes: Changes, title: str) -> None:
    """Write changes.csv and changes.png.

    Raises:
        UsageError: they cannot be written.
    """
    cell_m2 = changes.after.resolution**2
    with replacing(folder / "changes.csv") as table, replacing(folder / "changes.png") as picture:
        with open(table, "w", encoding="utf-8", newline="") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(COLUMNS)
            for area in changes.areas:
                places = [f"{value:.2f}" for value in (*area.centre, *area.box)]
                told = [f"{value:.2f}" for value in (area.before, area.after)]
                size = [f"{area.cells * cell_m2:.4f}", area.cells]
                rows.writerow([area.became, *places, *size, *told, *area.views, f"{area.evidence:.1f}"])
        marks = {"became occupied": ("tab:red", changes.occupied), "became free": ("tab:blue", changes.free)}
        draw_map(picture, changes.after, np.empty((0, 2)), title, marks=marks)
