"""What all parts are told, the scores they share, and their tables."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Grid
from echogrid.mapping.registry import MODELS, sensor_model
from echogrid.metrics import Truth
from experiments.common.bootstrap import interval
from experiments.common.maps import SHOWN
from experiments.common.report import table

SEED = 130_000_000
ROBOT = "b21"
CLASSICAL = ("muriel", "elfes", "fuzzy")
"""The best of the classical models on the held-out rooms."""
COLOURS = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple", "tab:brown")

Means = dict[str, list[float] | None]
"""Of each score the mean over the rooms and its 95 % interval."""


@dataclass(frozen=True)
class Study:
    """What is measured."""

    model: str
    """Name, or weights file."""
    rooms: int | None
    """Rooms of each kind; None: as many as each part has by default."""
    own: str | None = None
    """Weights trained for the array ``uneven10``."""

    def beside(self, *others: str) -> list[str]:
        """The model and others, none twice."""
        return list(dict.fromkeys([self.model, *others]))

    @property
    def cell(self) -> float:
        """Side of the model's cells, m."""
        return sensor_model(self.model).cell_m

    def settings(self, count: int) -> dict[str, Any]:
        """What a record begins with."""
        return {"model": label(self.model), "rooms": count, "seed": SEED, "cell_m": self.cell}


def label(model: str) -> str:
    """How tables call a model: a weights file by its name alone."""
    return model if model in MODELS else Path(model).stem


def labels(models: Iterable[str]) -> list[str]:
    """The labels of models."""
    return [label(model) for model in models]


def colour_of(model: str, number: int) -> str:
    """Colour of the ``number``-th model of a picture: the paper's network is always dark."""
    return "0.25" if model == "network" else COLOURS[number % len(COLOURS)]


def read(grid: Grid, truth: Truth) -> Float[ndarray, "rows cols"]:
    """The map's probability at the centres of the truth's cells."""
    row, col = np.indices(truth.cells.shape)
    return grid.probability_at((np.stack([col, row], axis=-1) + 0.5) * truth.resolution + truth.origin)


def averages(scores: Float[ndarray, "rooms scores"]) -> Means:
    """What JSON holds of the scores of held_out.py."""
    rng = np.random.default_rng(SEED)
    return {name: interval(column, rng) for name, column in zip(SHOWN, scores.T, strict=True)}


def shown(value: Sequence[float] | None, digits: int = 3) -> str:
    """The mean of an interval as a table shows it."""
    return "-" if value is None else f"{value[0]:.{digits}f}"


def show(title: str, header: Sequence[str], body: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    print(f"\n{title}\n\n{table(header, body)}", flush=True)


def show_scores(title: str, first: str, means: dict[str, Means]) -> None:
    """Print a table of scores, a row for each name."""
    show(title, [first, *SHOWN], ([name, *map(shown, scores.values())] for name, scores in means.items()))
