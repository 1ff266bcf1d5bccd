"""Training the paper's network.

The network answers each look by itself. The loss asks that each answer is right (the paper's training) and that
their sum in log-odds, which is what the map will hold, is right: so the network learns how much its views repeat
each other.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy import ndarray

from echogrid.grid import logit
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.models.networks.paper_layers import look, surrounding
from echogrid.models.networks.paper_network import ZONE, Layers, Network, inputs
from echogrid.robot import Robot
from echogrid.training.gradient_descent import Recipe, descend
from echogrid.training.paper_examples import POINTS, Examples, generate

PRIOR = 0.15
"""Share of surface among the points that single looks are trained on, about that of a local map."""

REPEAT = 8.0
"""Looks come up to so often: training drives are short, and a robot that drives slowly sees all more often."""

SURFACE_WEIGHT, HIDDEN_WEIGHT = 2.0, 0.15
"""Weight of all surface points and of all hidden points in the loss of the fused map; free points have 1. To miss a
wall is worse than to miss free floor."""

SINGLE_WEIGHT = 0.2
"""Weight of the single looks beside the fused map."""


@dataclass(frozen=True)
class PaperRecipe(Recipe[Examples]):
    """All that decides the weights of the paper's network, with the robot."""

    hidden: tuple[int, int] = (32, 16)
    """Units of the two hidden layers."""
    zone: int = ZONE
    """Sonars that the network reads for a point, at most MOST_ZONE."""
    squared_error: bool = False
    """Least squares, as when the paper was written, in place of cross-entropy."""
    through_map: bool = True
    """Train on the fused map and the single looks; False: on the single looks alone, as the paper does."""

    @override
    def told(self) -> dict[str, Any]:
        return asdict(self)

    @override
    def generate(self, robot: Robot | None, progress: bool) -> Examples:
        return generate(robot, self.drives, self.seed, progress, self.zone)

    @override
    def restored(self, arrays: list[ndarray]) -> Examples:
        return Examples(*arrays)

    @override
    def fit(self, examples: Examples, checkpoint: Path | None, key: str, progress: bool) -> Network:
        return fit(examples, self, checkpoint, key, progress)


def initial(rng: np.random.Generator, hidden: tuple[int, int], zone: int = ZONE) -> Layers:
    """Random layers of the right scale for ReLU units; the output begins near the prior: looks say nothing."""
    sizes = [inputs(zone), *hidden, 1]
    gain = [np.sqrt(2.0 / n) for n in sizes[:-2]] + [0.02]
    bias = [np.zeros(n, dtype=np.float32) for n in sizes[1:]]
    bias[-1][:] = logit(PRIOR)
    return [
        ((g * rng.standard_normal((m, n))).astype(np.float32), b)
        for g, m, n, b in zip(gain, sizes[:-1], sizes[1:], bias, strict=True)
    ]


def _mirrored(x: Float[Array, "*n zone"], flip: Array, sign: float) -> Float[Array, "*n zone"]:
    return jnp.where(flip, sign * x[..., ::-1], x)


def _squared_error(z: Float[Array, "*n"], target: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return (jax.nn.sigmoid(z) - target) ** 2


def loss(
    layers: Layers,
    batch: Examples,
    prior: float,
    flip: Array,
    repeat: Array,
    squared_error: bool = False,
    through_map: bool = True,
) -> Array:
    """Cross-entropy of single looks and of the fused map, see SURFACE_WEIGHT and ``PaperRecipe``.

    Hidden points are to stay at 0.5. For each drive, ``flip`` (bool) mirrors left and right, and ``repeat``
    (at least 1) says how often each look comes again, as it does when a robot drives slowly.
    """
    error = _squared_error if squared_error else optax.sigmoid_binary_cross_entropy
    drive = jnp.arange(len(batch.label))[:, None, None, None]
    cells, weights, _ = surrounding(*jnp.moveaxis(jnp.asarray(batch.at, jnp.float32), -1, 0))
    cell = jnp.stack(cells, axis=-1)
    there = batch.frame >= 0
    reading = batch.ranges[drive[..., None], batch.frame[..., None, None], batch.sonar[drive, cell]]
    flip = flip[:, None, None, None, None]
    reading = _mirrored(reading.astype(jnp.float32), flip, 1.0)
    off_axis = _mirrored(batch.off_axis[drive, cell].astype(jnp.float32), flip, -1.0)
    distance = _mirrored(batch.distance[drive, cell].astype(jnp.float32), flip, 1.0)
    p = jnp.sum(jnp.stack(weights, axis=-1) * look(layers, prior, reading, off_axis, distance)[0], axis=-1)
    z = jnp.log(p) - jnp.log1p(-p)
    evidence = jnp.where(there, z - logit(prior), 0.0)
    target = jnp.where(batch.label == SURFACE, 1.0, jnp.where(batch.label == FREE, 0.0, 0.5))
    share = jnp.where(batch.label == SURFACE, SURFACE_WEIGHT / POINTS[0], 1 / (POINTS[1] + POINTS[2]))
    weight = jnp.where(batch.label == HIDDEN, HIDDEN_WEIGHT / POINTS[3], share)
    fused = error(repeat[:, None] * jnp.sum(evidence, axis=-1), target)
    seen = jnp.any(there, axis=-1)
    map_loss = jnp.sum(weight * seen * fused) / jnp.sum(weight * seen)
    # Single looks keep the training prior: surface points weigh as the prior has them.
    single_target = jnp.where(batch.label == HIDDEN, prior, target)[..., None]
    share = jnp.where(batch.label == SURFACE, prior / POINTS[0], (1 - prior) / (POINTS[1] + POINTS[2]))
    weight = jnp.where(batch.label == HIDDEN, HIDDEN_WEIGHT / POINTS[3], share)[..., None]
    single = error(z, jnp.broadcast_to(single_target, z.shape))
    single_loss = jnp.sum(weight * there * single) / jnp.sum(weight * there)
    return map_loss + SINGLE_WEIGHT * single_loss if through_map else single_loss


def fit(
    examples: Examples,
    recipe: PaperRecipe,
    checkpoint: Path | None = None,
    key: str = "",
    progress: bool = False,
) -> Network:
    """Back-propagation over the examples; see ``descend``.

    The same recipe and examples give the same weights.
    """

    def draw(rng: np.random.Generator, count: int) -> tuple[ndarray, ndarray]:
        return rng.random(count) < 0.5, np.exp(rng.uniform(0, np.log(REPEAT), count)).astype(np.float32)

    layers = initial(np.random.default_rng(recipe.seed), recipe.hidden, recipe.zone)
    loss_of = _LOSSES[recipe.squared_error, recipe.through_map]
    layers, losses = descend(layers, examples, loss_of, draw, recipe, checkpoint, key, progress)
    return Network(layers, PRIOR, {"losses": losses})


def _loss_of(squared_error: bool, through_map: bool) -> Callable[..., Array]:
    def loss_of(layers: Layers, batch: Examples, flip: Array, repeat: Array) -> Array:
        return loss(layers, batch, PRIOR, flip, repeat, squared_error, through_map)

    return loss_of


# One function each, so that a recipe of the same kind finds the compiled step.
_LOSSES = {(a, b): _loss_of(a, b) for a in (False, True) for b in (False, True)}
