"""Training by back-propagation, with checkpoints; and the paper's network, trained.

The network answers each look by itself. The loss asks that each answer is right (the paper's training) and that
their sum in log-odds, which is what the map will hold, is right: so the network learns how much its views repeat
each other.
"""

import hashlib
import json
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy import ndarray
from tqdm import tqdm

from echogrid import __version__
from echogrid.errors import UsageError
from echogrid.files import replacing
from echogrid.grid import logit
from echogrid.mapping.build import surrounding
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.models.network import ZONE, Layers, Network, inputs, look
from echogrid.models.set_network import SetNetwork
from echogrid.robot import Robot, robot_yaml
from echogrid.training.examples import POINTS, Examples, generate

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
class AnyRecipe[E: tuple](ABC):
    """All that decides the weights of a network, with the robot."""

    drives: int
    epochs: int
    batch: int = 12
    """Drives in a step of the optimiser."""
    learning_rate: float = 4e-3
    seed: int = 1

    @abstractmethod
    def told(self) -> dict[str, Any]:
        """What the weights file says of it."""

    @abstractmethod
    def generate(self, robot: Robot | None, progress: bool) -> E:
        """What to learn from: arrays whose leading axis is the drive."""

    @abstractmethod
    def restored(self, arrays: list[ndarray]) -> E:
        """What ``generate`` made, from its arrays."""

    @abstractmethod
    def fit(self, examples: E, checkpoint: Path | None, key: str, progress: bool) -> Network | SetNetwork:
        """Train on it, with the arguments of ``descend``."""


@dataclass(frozen=True)
class Recipe(AnyRecipe[Examples]):
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
    """Cross-entropy of single looks and of the fused map, see SURFACE_WEIGHT and ``Recipe``.

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


@partial(jax.jit, static_argnames=("optimiser", "loss_of"))
def _step(optimiser, loss_of, weights, state, batch, draw):
    value, gradient = jax.value_and_grad(loss_of)(weights, batch, *draw)
    updates, state = optimiser.update(gradient, state)
    return optax.apply_updates(weights, updates), state, value


def descend(
    weights: Any,
    examples: tuple,
    loss_of: Callable[..., Array],
    draw: Callable[[np.random.Generator, int], tuple[ndarray | Array, ...]],
    recipe: AnyRecipe,
    checkpoint: Path | None = None,
    key: str = "",
    progress: bool = False,
) -> tuple[Any, list[float]]:
    """Bring a loss down by Adam, with a warm-up and a cosine decay.

    Args:
        weights: where to begin, a JAX pytree.
        examples: a tuple of arrays whose leading axis is the drive.
        loss_of: the loss of weights, a batch of the examples, and what ``draw`` drew for it.
        draw: what is drawn at random for a batch of so many drives.
        recipe: batch, epochs, learning rate and seed.
        checkpoint: a file to which the state goes after each epoch and from which it is taken up again.
        key: a checkpoint with another key is not taken up.
        progress: show a bar where there is a terminal.

    Returns:
        The weights, and the mean loss of each epoch.
    """
    drives = len(examples[0])
    per_epoch = max(1, drives // recipe.batch)
    steps = per_epoch * recipe.epochs
    rate = optax.warmup_cosine_decay_schedule(0.0, recipe.learning_rate, steps // 20, steps, 1e-5)
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
    state = optimiser.init(weights)
    losses: list[float] = []
    kept = _read_arrays(checkpoint, key) if checkpoint else None
    if kept is not None:
        losses = kept[0].tolist()
        weights, state = jax.tree.unflatten(jax.tree.structure((weights, state)), kept[1:])
    done = len(losses)
    # Batches are taken by numpy: compiled, they cost a copy of all examples, for a CPU has no arithmetic of float16.
    held = jax.tree.map(np.asarray, examples)
    bar = tqdm(total=recipe.epochs, initial=done, desc="training", unit="epoch", disable=None if progress else True)
    for epoch in range(done, recipe.epochs):
        rng = np.random.default_rng([recipe.seed, epoch])
        values = []
        for index in np.array_split(rng.permutation(drives)[: per_epoch * recipe.batch], per_epoch):
            batch = jax.tree.map(lambda v: v[index], held)  # noqa: B023
            weights, state, value = _step(optimiser, loss_of, weights, state, batch, draw(rng, len(index)))
            values.append(value)
        losses.append(float(np.mean(values)))
        bar.set_postfix(loss=f"{losses[-1]:.4f}")
        bar.update()
        if checkpoint is not None:
            _write_arrays(checkpoint, key, [np.array(losses), *jax.tree.leaves((weights, state))])
    bar.close()
    return jax.tree.map(np.asarray, weights), [round(v, 4) for v in losses]


def fit(
    examples: Examples,
    recipe: Recipe,
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


def train(robot: Robot | None, recipe: AnyRecipe, out: Path, progress: bool = False) -> Network | SetNetwork:
    """Make weights from nothing and write them; a stopped run is taken up again where it was.

    The drives and the state after each epoch wait in ``OUT.checkpoint.npz``, which is removed at the end.

    Args:
        robot: the array to train for; None: any array.
        recipe: how.
        out: the weights file.
        progress: show bars where there is a terminal.

    Raises:
        UsageError: the files cannot be written.
    """
    if not out.parent.is_dir():
        raise UsageError(f"--out: found no folder {out.parent}, expected a file in a folder that exists")
    told = {"robot": "any" if robot is None else robot_yaml(robot), **recipe.told(), "echogrid": __version__}
    key = hashlib.sha256(json.dumps(told).encode()).hexdigest()
    drives_file, checkpoint = out.with_suffix(".drives.npz"), out.with_suffix(".checkpoint.npz")
    kept = _read_arrays(drives_file, key)
    if kept is None:
        with replacing(checkpoint):
            pass  # where nothing can be written, say so before the work
        examples = recipe.generate(robot, progress)
        _write_arrays(drives_file, key, examples)
    else:
        examples = recipe.restored(kept)
    network = recipe.fit(examples, checkpoint, key, progress)
    network = replace(network, recipe=told | network.recipe)
    network.save(out)
    drives_file.unlink()
    checkpoint.unlink()
    return network


def _write_arrays(path: Path, key: str, arrays: Sequence[ndarray | Array]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        named = {f"a{i}": np.asarray(v) for i, v in enumerate(arrays)}
        np.savez(file, allow_pickle=False, key=np.array(key), **named)


def _read_arrays(path: Path, key: str) -> list[ndarray] | None:
    """What was written under the same key; None: nothing, something else or a damaged file."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return [data[f"a{i}"] for i in range(len(data.files) - 1)] if str(data["key"]) == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
