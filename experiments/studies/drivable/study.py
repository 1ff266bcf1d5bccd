"""What all parts are told, the arrays they drive, and their tables."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Frame, Robot, World
from echogrid.simulation.simulate import Simulator
from experiments.common.report import rounded
from experiments.studies.generalise.study import label

SEED = 150_000_000
MODELS = ("set-network", "network", "muriel", "nav2-tuned")
"""Each has cells of its own size."""
PAUSE_S = 1.0
"""Between two passes of a tour."""


@dataclass(frozen=True)
class Study:
    """What is measured."""

    models: tuple[str, ...]
    """Names, or weights files."""
    rooms: int | None = None
    """Layouts, worlds or rooms; None: as many as each part has by default."""
    passes: tuple[int, ...] | None = None
    """After how many passes of a tour the map is looked at; None: as each part has them."""

    def settings(self, **more: Any) -> dict[str, Any]:
        """What a record begins with."""
        return {"models": [label(model) for model in self.models], "seed": SEED, **more}


def passes_of(
    world: World, robot: Robot, poses: Float[ndarray, "frames 3"], count: int, seed: int
) -> Iterator[list[Frame]]:
    """The same tour again and again, each with noise of its own, one after the other in time."""
    simulator, begin = Simulator(world, robot), 0.0
    for number in range(count):
        drive = list(simulator.frames(poses, SEED + 1000 * seed + number))
        yield [replace(frame, stamp=frame.stamp + begin) for frame in drive]
        begin += drive[-1].stamp + PAUSE_S


def share(values: list[float]) -> float | None:
    """Mean of what is there."""
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else None


def told(value: float | None, digits: int = 3) -> str:
    """A number as tables show it."""
    return "-" if value is None else f"{value:.{digits}f}"


def tidy(found: dict[str, Any]) -> dict[str, Any]:
    """What JSON holds."""
    return rounded(found)
