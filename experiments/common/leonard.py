"""A second sonar simulator, written apart from echogrid's: Leonard's model taken strictly, plain geometry only.

A sonar hears every visible target within 12.5 degrees of its axis and reads the nearest. If there is none, its
axis is followed as a specular ray until it meets a wall within 12.5 degrees of the normal, and the length of the
way is read. A rough wall answers every ray that meets it at less than 60 degrees, in a cone of 6 degrees. There
are no levels, no side lobes and no thresholds. Maps of it tell how much the network has learned of one simulator.
"""

import numpy as np

from echogrid.geometry import wrap
from echogrid.robot import Robot
from echogrid.simulation.simulate import sonar_poses
from echogrid.simulation.world import World

CONE = np.deg2rad(12.5)
ROUGH_CONE = np.deg2rad(6.0)
ROUGH_LIMIT = np.cos(np.deg2rad(60.0))
ROUGH_FROM_M = 0.4e-3
NOISE = 0.005


def _cast(world, p, u):
    """Distance to, and index of, the first wall or cylinder (index >= number of walls) on each ray."""
    best, index = np.full(len(p), np.inf), np.full(len(p), -1)
    for i, (x0, y0, x1, y1) in enumerate(world.walls):
        d = np.array([x1 - x0, y1 - y0])
        det = u[:, 0] * d[1] - u[:, 1] * d[0]
        det[np.abs(det) < 1e-12] = np.nan
        to = np.array([x0, y0]) - p
        t = (to[:, 0] * d[1] - to[:, 1] * d[0]) / det
        s = (to[:, 0] * u[:, 1] - to[:, 1] * u[:, 0]) / det
        hit = (t > 1e-6) & (s >= 0) & (s <= 1) & (t < best)
        best[hit], index[hit] = t[hit], i
    for j, (x, y, r) in enumerate(world.cylinders):
        to = np.array([x, y]) - p
        b = np.sum(to * u, axis=1)
        q = r * r - np.sum(to * to, axis=1) + b * b
        t = b - np.sqrt(np.maximum(q, 0))
        hit = (q > 0) & (t > 1e-6) & (t < best)
        best[hit], index[hit] = t[hit], len(world.walls) + j
    return best, index


def _unit(angle):
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _targets(world, p, axis):
    """Nearest of the planes, corners, edges and cylinders that Leonard's model lets each sensor hear."""
    normals, offset = world.hessian()
    best = np.full(len(p), np.inf)

    def take(bearing, r, ok):
        ok &= np.abs(wrap(bearing - axis)) <= CONE
        free = _cast(world, p, _unit(bearing))[0] >= r - 0.01
        best[ok & free] = np.minimum(best, r)[ok & free]

    for (x0, y0, x1, y1), n, d in zip(world.walls, normals, offset, strict=True):
        away = d - p @ n
        foot = p + away[:, None] * n
        along = np.array([x1 - x0, y1 - y0])
        s = (foot - [x0, y0]) @ along / (along @ along)
        to = np.sign(away)[:, None] * n
        take(np.arctan2(to[:, 1], to[:, 0]), np.abs(away), (s >= 0) & (s <= 1))
    corners, edges, hidden = world.vertices
    # Between its two walls a vertex is a corner, outside of them an edge.
    between = {
        (edge.x, edge.y): (h[0] * (p[:, 1] - edge.y) - h[1] * (p[:, 0] - edge.x) > 0)
        & ((p[:, 0] - edge.x) * h[3] - (p[:, 1] - edge.y) * h[2] > 0)
        for edge, h in zip(edges, hidden, strict=True)
    }
    for target in corners:
        to = np.array([target.x, target.y]) - p
        seen = between.get((target.x, target.y), np.ones(len(p), dtype=bool))
        take(np.arctan2(to[:, 1], to[:, 0]), np.linalg.norm(to, axis=1), seen.copy())
    for edge in edges:
        to = np.array([edge.x, edge.y]) - p
        r = np.linalg.norm(to, axis=1)
        take(np.arctan2(to[:, 1], to[:, 0]), r, ~between[edge.x, edge.y] & (r < 1.5))
    for x, y, radius in world.cylinders:
        to = np.array([x, y]) - p
        take(np.arctan2(to[:, 1], to[:, 0]), np.linalg.norm(to, axis=1) - radius, np.ones(len(p), dtype=bool))
    return best


def _rough(world, p, axis):
    normals, _ = world.hessian()
    best = np.full(len(p), np.inf)
    for off in np.linspace(-ROUGH_CONE, ROUGH_CONE, 9):
        u = _unit(axis + off)
        t, i = _cast(world, p, u)
        wall = np.clip(i, 0, len(world.walls) - 1)
        ok = (i >= 0) & (i < len(world.walls)) & (world.roughness[wall] >= ROUGH_FROM_M)
        ok &= np.abs(np.sum(u * normals[wall], axis=1)) > ROUGH_LIMIT
        best[ok] = np.minimum(best, t)[ok]
    return best


def _bounced(world, p, axis, bounces=3):
    """Length of the specular way along each axis to the first wall that sends it back."""
    normals, _ = world.hessian()
    p, u = p.copy(), _unit(axis)
    way, out, alive = np.zeros(len(p)), np.full(len(p), np.inf), np.ones(len(p), dtype=bool)
    for _ in range(bounces + 1):
        t, i = _cast(world, p, u)
        alive &= (i >= 0) & (i < len(world.walls))
        wall = np.clip(i, 0, len(world.walls) - 1)
        t = np.where(alive, t, 0.0)
        way += t
        towards = np.sum(u * normals[wall], axis=1)
        heard = (np.abs(towards) > np.cos(CONE)) | (
            (world.roughness[wall] >= ROUGH_FROM_M) & (np.abs(towards) > ROUGH_LIMIT)
        )
        out[alive & heard] = way[alive & heard]
        alive &= ~heard
        p = p + t[:, None] * u
        u = u - 2 * towards[:, None] * normals[wall]
    return out


def leonard_ranges(world: World, robot: Robot, poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Readings [frames, sonars] under the robot's no-echo rule."""
    sonars = sonar_poses(robot.mounts, poses).reshape(-1, 3)
    p, axis = sonars[:, :2], sonars[:, 2]
    near = np.minimum(_targets(world, p, axis), _rough(world, p, axis))
    ranges = np.where(np.isfinite(near), near, _bounced(world, p, axis))
    ranges = ranges * (1 + NOISE * rng.standard_normal(ranges.shape))
    return robot.clean(ranges.reshape(len(poses), -1))
