"""Training the set network through the map.

The loss is taken on what the map will hold: the evidence of the frames of a drive, summed as the mapper sums it. So
the network learns how much its views repeat each other, and how sure a map may be.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, override

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int
from numpy import ndarray

from echogrid.metrics import FREE, SURFACE
from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.set_encoder import Tokens, along, encode, evidence
from echogrid.models.networks.set_layers import HIDDEN_UNITS, Weights, fused, initial, nearest, saturated
from echogrid.models.networks.set_network import SetNetwork
from echogrid.robot import Robot
from echogrid.training.gradient_descent import Recipe, descend
from echogrid.training.map_training import MapRecipe
from echogrid.training.set_lessons import POINTS, REACH_M, Lessons, lessons

VIEWS = 20
"""Frames from which a point is looked at in a step; of all that reach it, drawn anew in each step."""

SURFACE_WEIGHT, NEAR_WEIGHT, FAR_WEIGHT, BEHIND_WEIGHT, HIDDEN_WEIGHT = 1.0, 0.45, 0.55, 0.3, 0.3
"""Weight in the loss of all surface points, of the free ones near a surface and of the others, in proportion to
what a room has of them, and of the hidden ones just behind a surface and farther off, which are to stay at 0.5."""

SINGLE_WEIGHT = 0.1
"""Weight of the single looks beside the fused map: they steady the beginning."""

MAPS_SHARE = 0.48
"""Drives from whose maps it is learnt how to read a cell with its surroundings, for each drive of the first part."""

_BEARINGS = 128


@dataclass(frozen=True)
class SetRecipe(Recipe[Lessons]):
    """All that decides the weights of the set network, with the robot."""

    hidden: int = HIDDEN_UNITS
    """Units of each of its layers."""

    @override
    def told(self) -> dict[str, Any]:
        return {"network": "set"} | asdict(self)

    @override
    def generate(self, robot: Robot | None, progress: bool) -> Lessons:
        return lessons(robot, self.drives, self.seed, progress)

    @override
    def restored(self, arrays: list[ndarray]) -> Lessons:
        return Lessons(*arrays)

    @override
    def fit(self, examples: Lessons, checkpoint: Path | None, key: str, progress: bool) -> SetNetwork:
        def draw(rng: np.random.Generator, count: int) -> tuple[Array]:
            return (jax.random.key(int(rng.integers(2**31))),)

        weights = initial(np.random.default_rng(self.seed), self.hidden)
        data = (*examples, orders(examples))
        weights, losses = descend(weights, data, map_loss, draw, self, checkpoint, key, progress)
        return SetNetwork(weights, None, {"losses": losses})

    @override
    def then(self, network: SetNetwork) -> MapRecipe:
        return MapRecipe(
            max(1, round(self.drives * MAPS_SHARE)),
            self.epochs,
            batch=8,
            learning_rate=3e-3,
            seed=self.seed + 1,
            network=network,
        )


def orders(drives: Lessons) -> Int[ndarray, "drives bearings tokens"]:
    """The sonars of each of some bearings, for each drive; see ``nearest``."""
    bearing = np.arange(_BEARINGS) * (2 * np.pi / _BEARINGS)
    # In parts, for what it takes in between is large.
    parts = [nearest(mounts[None].astype(float), bearing) for mounts in np.asarray(drives.mounts)]
    return np.concatenate(parts).astype(np.int8)


def look(
    weights: Weights,
    drives: Lessons,
    order: Int[Array, "drives bearings tokens"],
    frame: Int[Array, "drives points views"],
    x: Float[Array, "drives points views"],
    y: Float[Array, "drives points views"],
) -> tuple[Float[Array, "drives points views"], Bool[Array, "drives points views"]]:
    """Evidence of frames for points (robot frame, m), log-odds, and whether a sonar that fired looks at them."""
    shape = frame.shape
    drive = jnp.repeat(jnp.arange(shape[0]), shape[1] * shape[2])
    frame, x, y = frame.reshape(-1), x.reshape(-1), y.reshape(-1)
    bearing, distance = jnp.arctan2(y, x), jnp.hypot(x, y)
    nearby = jnp.round(bearing * (_BEARINGS / (2 * np.pi))).astype(jnp.int32) % _BEARINGS
    sonar = order[drive, nearby].T.astype(jnp.int32)
    there = sonar >= 0
    reading = jnp.where(there, drives.ranges[drive, frame, sonar].astype(jnp.float32), jnp.nan)
    placed = along(jnp.moveaxis(drives.mounts[drive, sonar], -1, 0), bearing)
    axis, ahead, aside = (jnp.where(there, v, 0.0) for v in placed)
    reach = jnp.where(there, drives.max_range[drive, sonar], 1.0)
    beam = drives.beam[drive][None] / 2
    tokens = Tokens(reading, reach, beam, axis, ahead, aside, drives.traits[drive, frame].T)
    tokens = jax.lax.optimization_barrier(tokens)
    profiles, rings = encode(weights, tokens)
    forward = distance - ahead
    off = jnp.abs(jnp.arctan2(-aside, forward) - axis)
    off = jnp.minimum(off, 2 * jnp.pi - off)
    apart = jnp.sqrt(forward**2 + aside**2 + 1e-6)
    spoken = jnp.any(~jnp.isnan(reading) & (off <= LOOK_RAD) & (apart <= reach), axis=0)
    beyond = jnp.where(jnp.isfinite(reading), apart - reading, 0.0)
    found = evidence(profiles, rings, beyond, distance)
    return jnp.where(spoken, found, 0.0).reshape(shape), spoken.reshape(shape)


def map_loss(weights: Weights, batch: tuple, key: Array) -> Array:
    """Cross-entropy of the fused map at the points of the drives, and a little of the single looks.

    Args:
        weights: of the set network.
        batch: the fields of ``Lessons`` and ``orders``.
        key: which frames look at each point.
    """
    *fields, order = batch
    drives = Lessons(*fields)
    delta = drives.points[:, :, None] - drives.poses[:, None, :, :2]
    cos, sin = jnp.cos(drives.poses[:, None, :, 2]), jnp.sin(drives.poses[:, None, :, 2])
    x, y = cos * delta[..., 0] + sin * delta[..., 1], cos * delta[..., 1] - sin * delta[..., 0]
    held = jnp.hypot(x, y) < REACH_M
    counts = jnp.where(held, drives.weight[:, None], 0.0)
    drawn, frame = jax.lax.top_k(jnp.where(held, jax.random.uniform(key, held.shape), -1.0), VIEWS)
    x, y, count = (jnp.take_along_axis(v, frame, axis=-1) for v in (x, y, counts))
    # Without the barrier the compiler works the looks out again for each of their sums.
    found, spoken = jax.lax.optimization_barrier(look(weights, drives, order, frame, x, y))
    # The frames that are drawn stand for all that reach the point.
    scale = jnp.sum(counts, axis=-1) / jnp.maximum(jnp.sum(count, axis=-1), 1e-6)
    there = spoken & (drawn >= 0)
    occupied, free = jnp.maximum(found, 0.0), jnp.maximum(-found, 0.0)
    sums = [scale * jnp.sum(count * each, axis=-1) for each in (occupied, free, occupied**2, free**2, there)]
    log_odds = fused(weights, *saturated(sums[4], *sums[:4], xp=jnp), xp=jnp)
    seen = jnp.any(there, axis=-1)
    target = jnp.where(drives.label == SURFACE, 1.0, jnp.where(drives.label == FREE, 0.0, 0.5))
    weight = np.repeat(
        [SURFACE_WEIGHT, NEAR_WEIGHT, FAR_WEIGHT, BEHIND_WEIGHT, HIDDEN_WEIGHT] / np.array(POINTS), POINTS
    )
    map_error = weight * seen * optax.sigmoid_binary_cross_entropy(log_odds, target)
    error = weight[:, None] * there * optax.sigmoid_binary_cross_entropy(found, target[..., None])
    single = jnp.sum(error) / jnp.sum(weight[:, None] * there)
    return jnp.sum(map_error) / jnp.sum(weight * seen) + SINGLE_WEIGHT * single
