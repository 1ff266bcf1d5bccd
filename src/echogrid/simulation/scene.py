"""A world as the simulator reads it: walls and targets as arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.simulation.world import World

RAYS = 49
"""Rays of the fan that each sonar sends out, 1.5 degrees apart."""


class Scene(NamedTuple):
    """A world, padded to fixed sizes so that worlds can share a compilation; a JAX pytree."""

    normal: Float[ndarray, "*n walls 2"]
    offset: Float[ndarray, "*n walls"]
    """Distance of each wall's line from the origin along the normal, m."""
    along: Float[ndarray, "*n walls 2"]
    begin: Float[ndarray, "*n walls"]
    """Where the wall begins along its line, m."""
    length: Float[ndarray, "*n walls"]
    """Negative: no wall (padding)."""
    roughness: Float[ndarray, "*n walls"]
    centre: Float[ndarray, "*n targets 2"]
    """Edges and cylinders."""
    radius: Float[ndarray, "*n targets"]
    """0: an edge; negative: no target (padding)."""
    hidden: Float[ndarray, "*n targets 4"]
    """The sector from which an edge cannot be seen, see World.vertices."""

    @staticmethod
    def of(world: World, walls: int | None = None, targets: int | None = None) -> "Scene":
        """The scene of a world, padded to the given sizes or to the next multiple of 8."""
        normal, offset = world.hessian()
        along = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
        ends = world.walls
        _, edges, hidden = world.vertices
        centre = np.concatenate([np.array([[e.x, e.y] for e in edges]).reshape(-1, 2), world.cylinders[:, :2]])
        radius = np.concatenate([np.zeros(len(edges)), world.cylinders[:, 2]])
        hidden = np.concatenate([hidden, np.zeros((len(world.cylinders), 4))])
        walls = walls or -(-max(len(ends), 1) // 8) * 8
        targets = targets or -(-max(len(radius), 1) // 8) * 8

        def pad(values: Float[ndarray, "n *d"], size: int, fill: float = 0.0) -> Float[ndarray, "m *d"]:
            width = [(0, size - len(values))] + [(0, 0)] * (values.ndim - 1)
            return np.pad(values, width, constant_values=fill).astype(np.float32)

        return Scene(
            pad(normal, walls),
            pad(offset, walls),
            pad(along, walls),
            pad(np.sum(along * ends[:, :2], axis=1), walls),
            pad(np.linalg.norm(ends[:, 2:] - ends[:, :2], axis=1), walls, fill=-1.0),
            pad(world.roughness, walls),
            pad(centre, targets),
            pad(radius, targets, fill=-1.0),
            pad(hidden, targets),
        )
