"""A third sonar simulator, written apart from the other two: beams traced as rays through a scene of MuJoCo's.

Each sonar sends a fan of rays into a cone of 12.5 degrees round its axis. A ray is mirrored by smooth walls, three
times at most, and is heard again when it meets a smooth surface head on, so that it runs back on its own way; when it
passes its sonar on the way home, as out of a square corner; and when it meets a rough wall not too obliquely. Edges
and cylinders are thinner than the gaps between rays, so that a ray is aimed at each. The earliest echo is read.
There are no levels, no side lobes and no thresholds.

But for where edges and cylinders are, all geometry is what MuJoCo's ray casting says: which wall, how far, and its
normal.
"""

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from echogrid.errors import UsageError
from echogrid.geometry import compose
from echogrid.robot import Robot
from echogrid.simulation.world import World

CONE = np.deg2rad(12.5)
FAN = np.linspace(-CONE, CONE, 26)
"""Directions of the rays off the axis: 1 degree apart."""
FACING = np.deg2rad(2.0)
"""By how much a ray may miss the exact way back; more than half the gap between rays."""
BOUNCES = 3
ROUGH_FROM_M = 0.4e-3
ROUGH_LIMIT = np.deg2rad(60.0)
"""A rough wall answers a ray on the axis up to this angle to its normal, and less and less towards the cone's rim."""
EDGE_REACH_M = 1.5
NOISE = 0.005
WALL_M = 0.0002
"""MuJoCo has no wall of zero thickness; this is thin enough that hardly a ray finds the end of one."""


@dataclass(frozen=True)
class Hits:
    """What rays meet first."""

    reach: Float[ndarray, "sonars rays"]
    """Distance, m; inf where nothing is met."""
    index: Int[ndarray, "sonars rays"]
    """Which wall or, from the number of walls on, cylinder; -1 for none."""
    normal: Float[ndarray, "sonars rays 2"]


def available() -> bool:
    """Whether MuJoCo is installed."""
    return find_spec("mujoco") is not None


class Scene:
    """A world in MuJoCo: walls as thin boxes and cylinders, 1 m high, that rays cross half way up."""

    def __init__(self, world: World):
        if not available():
            raise UsageError("mujoco: not installed, expected the package (pip install mujoco-core)")
        # By name, so that nothing but a scene needs the package.
        self.mujoco: Any = import_module("mujoco")
        spec = self.mujoco.MjSpec()
        for x0, y0, x1, y1 in world.walls:
            half, turn = np.hypot(x1 - x0, y1 - y0) / 2, np.arctan2(y1 - y0, x1 - x0) / 2
            spec.worldbody.add_geom(
                type=self.mujoco.mjtGeom.mjGEOM_BOX,
                pos=[(x0 + x1) / 2, (y0 + y1) / 2, 0],
                size=[half + WALL_M / 2, WALL_M / 2, 0.5],  # longer, so that walls that meet leave no slit
                quat=[np.cos(turn), 0, 0, np.sin(turn)],
            )
        for x, y, radius in world.cylinders:
            spec.worldbody.add_geom(type=self.mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[x, y, 0], size=[radius, 0.5, 0])
        self.model = spec.compile()
        self.data = self.mujoco.MjData(self.model)
        self.mujoco.mj_forward(self.model, self.data)

    def cast(self, p_world: Float[ndarray, "sonars 2"], u: Float[ndarray, "sonars rays 2"]) -> Hits:
        """What the rays from each point meet; ``u`` holds their unit vectors."""
        n, rays = u.shape[:2]
        reach, index, normal = np.empty((n, rays)), np.empty((n, rays), np.int32), np.empty((n, rays, 3))
        p, v = np.pad(p_world, ((0, 0), (0, 1))), np.pad(u, ((0, 0), (0, 0), (0, 1)))
        if rays == 1:  # five times as fast as a fan of one
            for i in range(n):
                reach[i] = self.mujoco.mj_ray(
                    self.model, self.data, p[i], v[i, 0], None, 1, -1, index[i], normal[i, 0]
                )
        else:
            v, found = v.reshape(n, -1), normal.reshape(n, -1)
            for i in range(n):
                self.mujoco.mj_multiRay(
                    self.model, self.data, p[i], v[i], None, 1, -1, index[i], reach[i], found[i], rays, np.inf
                )
        return Hits(np.where(index >= 0, reach, np.inf), index, normal[..., :2])

    def sees(
        self, p_world: Float[ndarray, "n 2"], target: Float[ndarray, "n 2"], short: Float[ndarray, "n"]
    ) -> Bool[ndarray, "n"]:
        """Whether nothing stands between each point and its target, but for the last ``short`` metres."""
        away = np.linalg.norm(target - p_world, axis=1)
        u = (target - p_world) / away[:, None]
        return self.cast(p_world, u[:, None]).reach[:, 0] > away - short - 0.01


def _unit(angle: Float[ndarray, "*n"]) -> Float[ndarray, "*n 2"]:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _dot(a, b):
    return np.sum(a * b, axis=-1)


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _aimed(world, scene, p, ahead):
    """Range of the nearest edge or cylinder in each sonar's cone."""
    _, edges, hidden = world.vertices
    target = np.array([[e.x, e.y, 0.0] for e in edges] + world.cylinders.tolist()).reshape(-1, 3)
    first, last = np.split(np.pad(hidden, ((0, len(world.cylinders)), (0, 0))), 2, axis=1)
    to = target[:, :2] - p[:, None]
    away = np.linalg.norm(to, axis=-1)
    in_cone = _dot(to, ahead[:, None]) >= away * np.cos(CONE)
    round_ = target[:, 2] > 0
    # Seen from between its two walls an edge is a corner, which the fan looks after.
    is_corner = (_cross(first, -to) > 0) & (_cross(-to, last) > 0)
    i, j = np.nonzero(in_cone & (round_ | ((away < EDGE_REACH_M) & ~is_corner)))
    seen = scene.sees(p[i], target[j, :2], target[j, 2])
    nearest = np.full(len(p), np.inf)
    np.minimum.at(nearest, i[seen], (away[i, j] - target[j, 2])[seen])
    return nearest


def _traced(world, scene, p_sonar, axis, nearest, limit):
    """Range of each sonar's earliest echo out of its fan; ``nearest`` holds what it has heard so far."""
    sonar, off = (a.ravel() for a in np.broadcast_arrays(np.arange(len(axis))[:, None], FAN))
    ahead = _unit(axis)
    rough = np.append(world.roughness >= ROUGH_FROM_M, np.zeros(len(world.cylinders), dtype=bool))
    mirrors = ~rough & (np.arange(len(rough)) < len(world.walls))
    u = _unit(axis[:, None] + FAN)
    hits = scene.cast(p_sonar, u)
    p, u, way = p_sonar[sonar], u.reshape(-1, 2), np.zeros(len(sonar))
    reach, index, normal = hits.reach.ravel(), hits.index.ravel(), hits.normal.reshape(-1, 2)
    for bounce in range(BOUNCES + 1):
        if bounce > 1:
            # Unfolded, the way from the sonar to its image is straight, so that what a ray misses is known exactly.
            home = p_sonar[sonar] - p
            along, miss = _dot(home, u), np.abs(_cross(home, u))
            passes = (along > 0) & (along < reach) & (miss < np.sin(FACING) * (way + along))
            passes &= -_dot(u, ahead[sonar]) > np.cos(CONE)
            np.minimum.at(nearest, sonar[passes], np.hypot(way + along, miss)[passes] / 2)
        met = index >= 0
        sonar, off, p, u, way, reach, index, normal = (a[met] for a in (sonar, off, p, u, way, reach, index, normal))
        way = way + reach
        towards = -_dot(u, normal)
        slant = np.arccos(np.clip(towards, -1, 1))
        facing = slant < FACING
        # As above: the foot of the perpendicular on the unfolded wall is what answers.
        np.minimum.at(nearest, sonar[facing], (way * towards)[facing])
        scatters = rough[index] & ((slant / ROUGH_LIMIT) ** 2 + (off / CONE) ** 2 < 1)
        np.minimum.at(nearest, sonar[scatters], way[scatters])
        # A cylinder spreads the sound too far to be heard again. What is mirrored is heard after half of its way.
        on = mirrors[index] & (way < 2 * np.minimum(nearest, limit)[sonar])
        sonar, off, way, normal, towards = (a[on] for a in (sonar, off, way, normal, towards))
        p = p[on] + reach[on, None] * u[on] + 1e-6 * normal
        u = u[on] + 2 * towards[:, None] * normal
        hits = scene.cast(p, u[:, None])
        reach, index, normal = hits.reach[:, 0], hits.index[:, 0], hits.normal[:, 0]
    return nearest


def mujoco_ranges(world: World, robot: Robot, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Readings [frames, sonars] under the robot's no-echo rule."""
    sonars = compose(poses[:, None], robot.mounts[None]).reshape(-1, 3)
    p, axis = sonars[:, :2], sonars[:, 2]
    scene = Scene(world)
    ranges = _traced(world, scene, p, axis, _aimed(world, scene, p, _unit(axis)), robot.max_range_m)
    ranges = ranges * (1 + NOISE * rng.standard_normal(ranges.shape))
    return robot.clean(ranges.reshape(len(poses), -1))
