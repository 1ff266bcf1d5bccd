"""The sonar simulator: readings with all that disturbs them, and the logs of drives."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.extras import need
from echogrid.frame import Frame
from echogrid.geometry import compose, wrap
from echogrid.robot import Robot, Transducer
from echogrid.simulation.acoustics import Acoustics, Physics, acoustics
from echogrid.simulation.scene import RAYS, Scene
from echogrid.simulation.world import World


def sonar_poses(
    robot_mounts: Float[ndarray, "*m sonars 3"], poses: Float[ndarray, "*m frames 3"]
) -> Float[ndarray, "*m frames sonars 3"]:
    """Where each sonar is and points in the world, for each pose of the robot."""
    return compose(poses[..., :, None, :], robot_mounts[..., None, :, :])


def disturb(
    ranges: Float[ndarray, "frames sonars"], physics: Physics, max_range: float, rng: np.random.Generator
) -> Float[ndarray, "frames sonars"]:
    """What the ranging module adds to true first echoes: scale and white error, lost, foreign and old readings.

    Args:
        ranges: true ranges, m; inf = no echo.
        physics: the error model.
        max_range: foreign pulses are read anywhere below it, m.
        rng: the source of randomness.
    """
    scale = 1.0 + physics.range_scale * rng.standard_normal()
    sigma = np.maximum(0.001, physics.range_noise * np.minimum(ranges, 100.0))
    out = ranges * scale + sigma * rng.standard_normal(ranges.shape)
    out = np.where(rng.random(ranges.shape) < physics.lost, np.inf, out)
    foreign = rng.random(ranges.shape) * np.minimum(ranges, max_range)
    out = np.where(rng.random(ranges.shape) < physics.cross_talk, foreign, out)
    stale = rng.random(ranges.shape) < physics.stale
    for i in range(1, len(out)):
        out[i] = np.where(stale[i], out[i - 1], out[i])
    return out


def passers_by(
    ranges: Float[ndarray, "frames sonars"], sonars: Float[ndarray, "frames sonars 3"], rng: np.random.Generator
) -> Float[ndarray, "frames sonars"]:
    """Readings of a drive past which people walk: round, 0.4 m wide, heard within 15 degrees of the axis.

    Args:
        ranges: true ranges, m; inf = no echo.
        sonars: where each sonar is and points, world frame, m and rad.
        rng: the source of randomness.
    """
    out = ranges.copy()
    frames = len(ranges)
    for _ in range(rng.integers(1, 4)):
        first, span = int(rng.integers(0, frames)), int(rng.integers(3, 25))
        seen = slice(first, min(first + span, frames))
        start = sonars[first, 0, :2] + rng.uniform(-2.0, 2.0, 2)
        walk = start + np.arange(len(out[seen]))[:, None] * rng.normal(0, 0.15, 2)
        to = walk[:, None] - sonars[seen, :, :2]
        reach = np.maximum(np.hypot(to[..., 0], to[..., 1]) - 0.2, 0.05)
        off = wrap(np.arctan2(to[..., 1], to[..., 0]) - sonars[seen, :, 2])
        heard = (np.abs(off) < np.deg2rad(15.0)) & (rng.random(reach.shape) < 0.8)
        out[seen] = np.where(heard, np.minimum(out[seen], reach), out[seen])
    return out


@dataclass(frozen=True)
class Simulator:
    """A robot with its sonars in a world."""

    world: World
    robot: Robot
    physics: Physics = field(default_factory=Physics)

    @cached_property
    def _scene(self) -> Scene:
        return Scene.of(self.world)

    @cached_property
    def _acoustics(self) -> Acoustics:
        return acoustics(self.robot.transducer, self.physics)

    def ranges(
        self, poses: Float[ndarray, "frames 3"], rng: np.random.Generator, rays: int = RAYS
    ) -> Float[ndarray, "frames sonars"]:
        """Undisturbed readings (m; inf = no echo) at each pose; ``rng`` gives the fluctuation of levels.

        Raises:
            MissingError: JAX is not installed.
        """
        return self.heard(sonar_poses(self.robot.mounts, poses), rng, rays)

    def heard(
        self, sonars: Float[ndarray, "frames sonars 3"], rng: np.random.Generator, rays: int = RAYS
    ) -> Float[ndarray, "frames sonars"]:
        """Likewise of sonars that are anywhere: where each is and points, world frame, m and rad."""
        need("simulate", "train")
        from echogrid.simulation.echo import scans_ranges

        scene, ac = self._scene, self._acoustics
        batch = 64
        out = np.empty(sonars.shape[:2])
        for first in range(0, len(sonars), batch):
            chunk = sonars[first : first + batch]
            mounts = np.pad(chunk, [(0, min(batch, len(sonars)) - len(chunk)), (0, 0), (0, 0)])
            offset = self.physics.level_noise_db * rng.standard_normal(mounts.shape[:2])
            result = scans_ranges(
                scene,
                ac,
                mounts[..., :2].astype(np.float32),
                mounts[..., 2].astype(np.float32),
                offset.astype(np.float32),
                rays,
            )
            out[first : first + batch] = np.asarray(result)[: len(chunk)]
        return out

    def frames(self, poses: Float[ndarray, "frames 3"], seed: int, rate_hz: float = 5.0) -> Iterator[Frame]:
        """A drive as the log's frames: readings with all disturbances, under the robot's no-echo rule."""
        rng = np.random.default_rng(seed)
        ranges = disturb(self.ranges(poses, rng), self.physics, self.robot.max_range_m, rng)
        for i, (pose, reading) in enumerate(zip(poses, self.robot.clean(ranges), strict=True)):
            yield Frame(i / rate_hz, pose, reading)


def rotary_scan(
    world: World,
    transducer: Transducer,
    max_range: float,
    p_world: tuple[float, float],
    physics: Physics,
    steps: int = 360,
) -> tuple[Float[ndarray, "steps"], Float[ndarray, "steps"]]:
    """One transducer turned on the spot: bearings (rad) and ranges (m; inf = no echo), without noise."""
    bearing = np.arange(steps) * (2 * np.pi / steps)
    poses = np.column_stack([np.full(steps, p_world[0]), np.full(steps, p_world[1]), bearing])
    rotary = Robot("rotary", 0.0, transducer, 0.0, max_range, np.deg2rad(25.0), np.zeros((1, 3)))
    quiet = replace(physics, level_noise_db=0.0)
    # Four times the rays: visibility must not be coarser than the steps of the scan.
    ranges = Simulator(world, rotary, quiet).ranges(poses, np.random.default_rng(0), rays=4 * RAYS - 1)
    return bearing, rotary.clean(ranges)[:, 0]
