"""Training the set network to read a cell with its surroundings, on the maps that it makes without them.

The rest of the network is fixed. The loss asks of every cell that was seen what is there; so it teaches what a map
may claim: walls that are as thick as their faces, doors that are open, nothing behind a wall.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, override

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array
from numpy import ndarray

from echogrid.metrics import FREE, SURFACE
from echogrid.models.networks import surroundings
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import Robot
from echogrid.training.gradient_descent import Recipe, descend
from echogrid.training.map_lessons import BEHIND, DEEP, GAP, MapLessons, map_lessons

WEIGHTS = {SURFACE: 3.5, FREE: 1.0, GAP: 4.0, BEHIND: 1.0, DEEP: 0.3}
"""Of a cell in the loss, by its label. A wall that is missed costs more than floor that is, but for that in a door,
which a wall that goes straight on would close; hidden cells are to stay at 0.5, which no error of others is worth."""

RIM = 20
"""Cells at the rim of a lesson that are not judged: half of their surroundings is missing."""


@dataclass(frozen=True)
class MapRecipe(Recipe[MapLessons]):
    """All that decides how cells are read with their surroundings, beside the network that reads the scans."""

    network: SetNetwork | None = None
    """What reads the scans."""

    @override
    def told(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("drives", "epochs", "batch", "learning_rate", "seed")}

    @override
    def generate(self, robot: Robot | None, progress: bool) -> MapLessons:
        assert self.network is not None
        return map_lessons(self.network, robot, self.drives, self.seed, progress)

    @override
    def restored(self, arrays: list[ndarray]) -> MapLessons:
        return MapLessons(*arrays)

    @override
    def fit(self, examples: MapLessons, checkpoint: Path | None, key: str, progress: bool) -> SetNetwork:
        assert self.network is not None

        def draw(rng: np.random.Generator, count: int) -> tuple[Array]:
            return (jnp.asarray(rng.integers(0, 2, 3)),)

        weights = surroundings.initial(np.random.default_rng(self.seed))
        weights, losses = descend(weights, examples, map_loss, draw, self, checkpoint, key, progress)
        told = self.network.recipe | {"surroundings": self.told() | {"losses": losses}}
        return SetNetwork(self.network.weights, weights, told)


def map_loss(weights: Any, batch: tuple, turned: Array) -> Array:
    """Cross-entropy of the cells of squares of maps.

    Args:
        weights: as of ``surroundings.initial``.
        batch: the fields of ``MapLessons``.
        turned: whether rows, columns, or both with each other are exchanged, 1 or 0 each.
    """
    lessons = MapLessons(*batch)

    def exchanged(cells: Array) -> Array:
        cells = jnp.where(turned[0], cells[:, ::-1], cells)
        cells = jnp.where(turned[1], cells[:, :, ::-1], cells)
        return jnp.where(turned[2], jnp.swapaxes(cells, 1, 2), cells)

    told, label = exchanged(jnp.asarray(lessons.told, jnp.float32)), exchanged(jnp.asarray(lessons.label))
    log_odds = surroundings.corrected(weights, told, lessons.array, jnp)
    inner = np.s_[:, RIM:-RIM, RIM:-RIM]
    log_odds, label = log_odds[inner], label[inner]
    target = jnp.where(label == SURFACE, 1.0, jnp.where((label == FREE) | (label == GAP), 0.0, 0.5))
    weight = sum(share * (label == kind) for kind, share in WEIGHTS.items())
    error = optax.sigmoid_binary_cross_entropy(log_odds, target)
    return jnp.sum(weight * error) / jnp.sum(weight)
