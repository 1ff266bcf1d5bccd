"""Training by back-propagation, with checkpoints, whatever is trained."""

import hashlib
import json
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from jaxtyping import Array
from numpy import ndarray
from tqdm import tqdm

from echogrid import __version__
from echogrid.errors import UsageError
from echogrid.files import replacing
from echogrid.models.networks.paper_network import Network
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import Robot, robot_yaml


@dataclass(frozen=True)
class Recipe[E: tuple](ABC):
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

    def then(self, network: Any) -> "Recipe | None":
        """What is to be trained next on what this made; None: nothing."""
        return None


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
    recipe: Recipe,
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


def train(robot: Robot | None, recipe: Recipe, out: Path, progress: bool = False) -> Network | SetNetwork:
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
    network, made = _fitted(recipe, robot, out, told, progress)
    further = recipe.then(network)
    if further is not None:
        # What came before decides it as well, which may have numbers of the same names.
        key = {"after": told, **further.told()}
        network, more = _fitted(further, robot, out.with_suffix(".maps.npz"), key, progress)
        made += more
    network = replace(network, recipe=told | network.recipe)
    network.save(out)
    for file in made:
        file.unlink()
    return network


def _fitted(
    recipe: Recipe, robot: Robot | None, out: Path, told: dict[str, Any], progress: bool
) -> tuple[Network | SetNetwork, list[Path]]:
    """A network of a recipe, and the files from which it is taken up again."""
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
    return recipe.fit(examples, checkpoint, key, progress), [drives_file, checkpoint]


def _write_arrays(path: Path, key: str, arrays: Sequence[ndarray | Array]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as file:
        named = {f"a{i}": np.asarray(v) for i, v in enumerate(arrays)}
        np.savez(file, allow_pickle=False, key=np.array(key), **named)


def _read_arrays(path: Path, key: str) -> list[ndarray] | None:
    """What was written under the same key; None: nothing, something else or a damaged file."""
    if not path.is_file():  # to open a pipe would be to wait for ever
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
            return [data[f"a{i}"] for i in range(len(data.files) - 1)] if str(data["key"]) == key else None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
