"""Where the figures and numbers of docs/results.md go: one picture (PNG and SVG) or one JSON file a name."""

import json
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

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
