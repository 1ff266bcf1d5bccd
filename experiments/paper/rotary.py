"""A rotary Polaroid 7000 in a room with smooth walls: its scans, the paper's model of them, and what each reading is.

The paper's plan 1 is lost. The plan is our own (the world ``lab``: a corner, an edge and a recess, all of smooth
veneered wood), and so are positions A (walls 2 to 4 m away) and C (walls at 0.5 and 0.7 m).
"""

from dataclasses import dataclass

import numpy as np

from echogrid.geometry import wrap
from echogrid.robot import TRANSDUCERS, Robot
from echogrid.simulation.acoustics import Physics, speed_of_sound
from echogrid.simulation.beam_patterns import bessel_beam
from echogrid.simulation.regions import regions_of_constant_depth
from echogrid.simulation.simulate import RAYS, Simulator, disturb, rotary_scan
from echogrid.simulation.world import World

PLAN = World.load("lab")
HEAD = TRANSDUCERS["polaroid-7000"]
MAX_RANGE = 10.0
POSITIONS = {"A": (4.4, 2.9), "C": (6.4, 3.1)}
BEARING = np.deg2rad(np.arange(360.0))
OVER_LONG = 0.2
"""A reading this much longer than the wall ahead came round over another wall, m."""

_KA = 2 * np.pi * HEAD.frequency_hz / speed_of_sound(Physics().temperature_c) * HEAD.aperture_radius_m
NULLS = np.arcsin(np.array([3.832, 7.016]) / _KA)
SIDE_LOBE = np.arcsin(np.array([4.35, 5.95]) / _KA)
"""Off the axis: the first two nulls of the piston, and where its side lobe is within 3 dB of its peak, rad."""

SIDE_LOBE_REACH = 0.9
"""Walls beyond this are not heard in the side lobe, m (see Physics.level_db)."""

EDGE_REACH, EDGE_HALF = 1.3, np.deg2rad(5.0)
"""Leonard's edges are weak: heard only so near, m, and so close to the axis, rad."""


def where(name):
    x, y = POSITIONS[name]
    return f"Position {name} (x {x:g} m, y {y:g} m)"


def half_visibility():
    """Angle off the axis up to which a wall at 1 m is heard: the visibility angle of the geometric model, rad."""
    angle = np.linspace(0, NULLS[0], 1000)
    beam = bessel_beam(HEAD, speed_of_sound(Physics().temperature_c), angle)
    return angle[np.flatnonzero(40 * np.log10(beam + 1e-9) + Physics().level_db >= 0)[-1]]


@dataclass(frozen=True)
class Target:
    """One of Leonard's targets as seen from a position, by its closed form."""

    kind: str
    r: float
    bearing: float


def visible_targets(world, at):
    """The planes, corners and edges that a position has in sight: range m, bearing rad."""
    at = np.array(at)
    found = {}

    def take(kind, target):
        r, bearing = target.range_bearing(at)
        if r > 0 and world.sight(at[None], np.array([bearing]))[0] > r - 1e-3:
            found[kind, round(r, 6), round(float(wrap(bearing)), 6)] = Target(kind, r, float(wrap(bearing)))

    for plane in world.planes():
        r, bearing = plane.range_bearing(at)
        # The foot of the perpendicular must lie on a wall, not only on its line.
        if abs(world.sight(at[None], np.array([bearing]))[0] - r) < 1e-6:
            take("plane", plane)
    corners, edges, hidden = world.vertices
    for edge, (ax, ay, bx, by) in zip(edges, hidden, strict=True):
        x, y = at - (edge.x, edge.y)
        take("corner" if ax * y - ay * x > 0 and x * by - y * bx > 0 else "edge", edge)
    ends = {(edge.x, edge.y) for edge in edges}
    for corner in corners:
        if (corner.x, corner.y) not in ends:
            take("corner", corner)
    return list(found.values())


def geometric_scan(world, at):
    """The paper's model: the nearest visible target, side lobes at short range, else the way along the axis, m."""
    main = half_visibility()
    nearest = np.full(len(BEARING), np.inf)
    for target in visible_targets(world, at):
        off = np.abs(wrap(BEARING - target.bearing))
        if target.kind == "edge":
            heard = (off <= EDGE_HALF) & (target.r < EDGE_REACH)
        else:
            beside = (SIDE_LOBE[0] <= off) & (off <= SIDE_LOBE[1])
            heard = (off <= main) | (beside & (target.r < SIDE_LOBE_REACH))
        nearest = np.where(heard, np.minimum(nearest, target.r), nearest)
    deaf = Physics(level_db=-300.0, axis_ray=True)
    way = rotary_scan(world, HEAD, MAX_RANGE, at, deaf, len(BEARING))[1]
    return np.where(np.isfinite(nearest), nearest, way)


def disturbed_scan(world, at, seed):
    """A scan with all that a real module adds: fluctuating levels, range errors, lost echoes; m."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([np.tile(at, (len(BEARING), 1)), BEARING])
    rotary = Robot("rotary", 0.0, HEAD, 0.0, MAX_RANGE, np.deg2rad(25.0), np.zeros((1, 3)))
    ranges = Simulator(world, rotary, Physics()).ranges(poses, rng, rays=4 * RAYS - 1)
    return rotary.clean(disturb(ranges, Physics(), MAX_RANGE, rng))[:, 0]


def wall_ahead(world, at):
    """Distance along each axis to the wall that it meets, m, and the incidence there, rad. Plain geometry."""
    u = np.column_stack([np.cos(BEARING), np.sin(BEARING)])
    ahead = world.sight(np.tile(at, (len(BEARING), 1)), BEARING)
    normal, offset = world.hessian()
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    end = (np.array(at) + ahead[:, None] * u)[:, None]
    middle = (world.walls[:, :2] + world.walls[:, 2:]) / 2
    half = np.linalg.norm(world.walls[:, 2:] - world.walls[:, :2], axis=1) / 2
    away = np.abs(np.sum(end * normal, axis=2) - offset)
    past = np.maximum(np.abs(np.sum((end - middle) * along, axis=2)) - half, 0)
    wall = np.argmin(away + past, axis=1)
    return ahead, np.arccos(np.minimum(np.abs(np.sum(u * normal[wall], axis=1)), 1))


def from_side_lobe(ranges, ahead, targets):
    """Which readings are of a plane or corner that lies in the first side lobe.

    Such a reading is within 4 cm of the target's range, nearer to it than to the wall ahead, and not within 4 cm of
    a target in the main lobe.
    """
    main, side = np.zeros(len(ranges), dtype=bool), np.zeros(len(ranges), dtype=bool)
    for target in targets:
        off = np.abs(wrap(BEARING - target.bearing))
        miss = np.abs(np.where(np.isfinite(ranges), ranges, 1e9) - target.r)
        main |= (off <= NULLS[0]) & (miss < 0.04)
        if target.kind != "edge":
            side |= (off > NULLS[0]) & (off < NULLS[1]) & (miss < 0.04) & (miss < np.abs(ranges - ahead))
    return side & ~main


class Judged:
    """A scan with its readings told apart."""

    def __init__(self, world, at, ranges, **rule):
        self.at, self.ranges = at, ranges
        self.targets = visible_targets(world, at)
        self.ahead, self.incidence = wall_ahead(world, at)
        self.heard = np.isfinite(ranges)
        self.over_long = self.heard & (ranges > self.ahead + OVER_LONG)
        self.side_lobe = from_side_lobe(ranges, self.ahead, self.targets)
        self.regions = regions_of_constant_depth(BEARING, ranges, **rule)

    def at_a_corner(self):
        """Readings of a corner in the main lobe: sound that two walls sent straight back."""
        out = np.zeros(len(self.ranges), dtype=bool)
        for target in self.targets:
            if target.kind == "corner":
                off = np.abs(wrap(BEARING - target.bearing))
                out |= (off <= NULLS[0]) & (np.abs(self.ranges - target.r) < 0.05 + 0.02 * target.r)
        return out

    def matches(self):
        """Kind, bearing error (rad) and range error (m) of each region that is a target's, and how many are not."""
        matched, strange = [], 0
        for region in self.regions:
            near = [t for t in self.targets if abs(wrap(region.bearing - t.bearing)) < np.deg2rad(12)]
            near = [t for t in near if abs(region.mean_range - t.r) < 0.05 + 0.02 * t.r]
            if near:
                target = min(near, key=lambda t: abs(region.mean_range - t.r))
                error = wrap(region.bearing - target.bearing)
                matched.append((target.kind, float(error), region.mean_range - target.r))
            else:
                strange += 1
        return matched, strange
