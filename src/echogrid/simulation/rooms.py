"""Random contours, rooms, arrays and physics: what the network is trained on, and held-out rooms to score it.

Everything that real rooms, robots and air may vary is varied, so that no network learns one simulator.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.robot import Robot, Transducer, preset_names
from echogrid.simulation.acoustics import Physics, speed_of_sound
from echogrid.simulation.world import ROUGH_M, SMOOTH_M, World, polyline

Shape = tuple[list[Float[ndarray, "walls 4"]], list[list[float]]]
"""Groups of walls, each of one surface, and cylinders."""


def random_roughness(rng: np.random.Generator, groups: int, kind: str = "any") -> Float[ndarray, "groups"]:
    """Rms heights (m) for groups of walls: all ``smooth``, all ``rough``, ``mixed``, or ``any`` of these."""
    if kind == "any":
        kind = str(rng.choice(["smooth", "rough", "mixed", "between"], p=[0.3, 0.25, 0.3, 0.15]))
    if kind == "smooth":
        return rng.uniform(0.5, 2.0, groups) * SMOOTH_M
    if kind == "rough":
        return rng.uniform(0.6, 1.25, groups) * ROUGH_M
    if kind == "mixed":
        smooth = rng.random(groups) < rng.uniform(0.3, 0.8)
        return np.where(smooth, rng.uniform(0.5, 2.0, groups) * SMOOTH_M, rng.uniform(0.5, 1.25, groups) * ROUGH_M)
    return np.exp(rng.uniform(np.log(SMOOTH_M), np.log(ROUGH_M), groups))


def box(rng: np.random.Generator, x: float, y: float, low: float, high: float) -> Float[ndarray, "4 4"]:
    """A turned rectangle round a point with sides from ``low`` to ``high``, m."""
    w, h = rng.uniform(low, high, 2) / 2
    angle = rng.choice([0.0, rng.uniform(0, np.pi)])
    c, s = np.cos(angle), np.sin(angle)
    corners = np.array([[-w, -h], [w, -h], [w, h], [-w, h]]) @ np.array([[c, s], [-s, c]]) + [x, y]
    return polyline(corners, closed=True)


def contour(rng: np.random.Generator) -> Shape:
    """A few walls near the origin in the open: one wall, two that meet or face each other, a gap, a box, a pillar."""
    d = rng.uniform(0.45, 2.2)
    reach = rng.uniform(0.5, 4.0, 2)
    kind = rng.choice(["wall", "corner", "edge", "lane", "gap", "box", "pillar"])
    if kind == "wall":
        return [polyline([[d, -reach[0]], [d, reach[1]]])], []
    if kind == "corner":
        e = rng.uniform(0.45, 2.2)
        return [polyline([[d, -reach[0]], [d, e]]), polyline([[d, e], [-reach[1], e]])], []
    if kind == "edge":
        e = rng.uniform(-1.0, 1.0)
        return [polyline([[d, -reach[0] - 1], [d, e]]), polyline([[d, e], [d + reach[1], e]])], []
    if kind == "lane":
        e = rng.uniform(0.45, 2.0)
        return [polyline([[d, -3], [d, 3]]), polyline([[-e, -3], [-e, rng.uniform(0, 3)]])], []
    if kind == "gap":
        a, width = rng.uniform(-1.0, 0.5), rng.uniform(0.5, 1.2)
        depth = rng.uniform(0.0, 0.4)
        left = polyline([[d + depth, a], [d, a], [d, a - reach[0]]])
        return [left, polyline([[d + depth, a + width], [d, a + width], [d, a + width + reach[1]]])], []
    if kind == "box":
        return [box(rng, d + 0.5, rng.uniform(-1, 1), 0.2, 1.0), polyline([[d + 1.5, -3], [d + 1.5, 3]])], []
    pillars = [[d + 0.1, rng.uniform(-1, 1), rng.uniform(0.02, 0.3)] for _ in range(rng.integers(1, 3))]
    return [polyline([[d + reach[0], -3], [d + reach[0], 3]])], pillars


def room(rng: np.random.Generator) -> Shape:
    """A room with two to four square corners cut or grown, cupboards, partitions and pillars."""
    w, h = rng.uniform(2.6, 8.0, 2)
    outline = [[0, 0], [w, 0], [w, h], [0, h]]
    if rng.random() < 0.4:
        a, b = rng.uniform(0.25, 0.5) * w, rng.uniform(0.25, 0.5) * h
        outline = [[0, 0], [w, 0], [w, h - b], [w - a, h - b], [w - a, h], [0, h]]
    if rng.random() < 0.35:
        x, width, depth = rng.uniform(0.2, w - 1.2), rng.uniform(0.7, 1.0), rng.uniform(0.05, 0.5)
        outline[1:1] = [[x, 0], [x, -depth], [x + width, -depth], [x + width, 0]]
    skew = np.array([[1.0, 0.0], [rng.choice([0.0, 0.0, rng.uniform(-0.15, 0.15)]), 1.0]])
    outline = np.array(outline) @ skew
    ends = np.roll(outline, -1, axis=0)
    groups = [polyline([a, b]) for a, b in zip(outline, ends, strict=True)]
    places = rng.uniform(0.3, [w - 0.3, h - 0.3], (rng.integers(0, 4), 2))
    groups += [box(rng, x, y, 0.25, 1.2) for x, y in places]
    if rng.random() < 0.3:
        x, y = rng.uniform(1, w - 1), rng.uniform(0.6, h - 1.0)
        groups.append(polyline([[x, 0.0], [x, y]]))
    cylinders = [
        [rng.uniform(0.2, w), rng.uniform(0.2, h), rng.uniform(0.02, 0.25)] for _ in range(rng.integers(0, 4))
    ]
    return groups, cylinders


def corridor(rng: np.random.Generator) -> Shape:
    """A corridor with door recesses on both sides, closed or open at its ends, perhaps turning a corner."""
    width, length = rng.uniform(1.1, 2.8), rng.uniform(6.0, 14.0)
    groups = []
    for side in (0, 1):
        y, out = side * width, (2 * side - 1)
        points, x = [[0.0, y]], rng.uniform(0.3, 2.0)
        while x + 1.2 < length and len(points) < 14:
            door, depth = rng.uniform(0.7, 1.0), rng.choice([0.03, 0.08, 0.15, 0.3])
            points += [[x, y], [x, y + out * depth], [x + door, y + out * depth], [x + door, y]]
            x += door + rng.uniform(0.8, 3.5)
        groups.append(polyline([*points, [length, y]]))
    if rng.random() < 0.6:
        groups.append(polyline([[0.0, 0.0], [0.0, width]]))
    if rng.random() < 0.5:
        groups.append(polyline([[length, 0.0], [length, width]]))
    else:
        turn = rng.uniform(1.2, 2.5)
        groups.append(polyline([[length + turn, -3.0], [length + turn, width], [length, width]]))
    return groups, []


def hall(rng: np.random.Generator) -> Shape:
    """Scattered boxes and pillars with walls far away or missing."""
    groups = [box(rng, *rng.uniform(-4, 4, 2), 0.2, 1.5) for _ in range(rng.integers(1, 4))]
    groups.append(polyline([[-8, rng.uniform(2, 8)], [8, rng.uniform(2, 8)]]))
    cylinders = [[*rng.uniform(-4, 4, 2), rng.uniform(0.03, 0.3)] for _ in range(rng.integers(0, 4))]
    return groups, cylinders


def clutter(rng: np.random.Generator) -> Shape:
    """A room full of small things: boxes, posts, table legs."""
    w, h = rng.uniform(2.6, 6.0, 2)
    outline = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    groups = [polyline([a, b]) for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True)]
    groups += [box(rng, *rng.uniform(0.1, [w - 0.1, h - 0.1]), 0.08, 0.5) for _ in range(rng.integers(2, 7))]
    cylinders = [
        [rng.uniform(0.1, w), rng.uniform(0.1, h), rng.uniform(0.01, 0.12)] for _ in range(rng.integers(2, 9))
    ]
    return groups, cylinders


def flat(rng: np.random.Generator) -> Shape:
    """Two to four rooms in a row or round a corner, with doors of 0.65 to 1.2 m in walls of any thickness."""
    w, h = rng.uniform(4.5, 9.0), rng.uniform(2.4, 4.5)
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]])
    groups = [polyline([a, b]) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    thick = float(rng.choice([0.0, rng.uniform(0.03, 0.12), rng.uniform(0.1, 0.3)]))
    across = np.sort(rng.uniform(0.25 * w, 0.75 * w, rng.integers(1, 3)))
    across = across[np.append(True, np.diff(across) > 1.3)]
    for x in across:
        groups += _parted(rng, h, thick, lambda p, x=x: p[:, ::-1] + np.array([x, 0.0]))
    if len(across) == 1 and w - across[0] > 2.4 and h > 2.8:
        y, begin = rng.uniform(0.4, 0.6) * h, across[0]
        groups += _parted(rng, w - begin, thick, lambda p: p + np.array([begin, y]))
    cylinders = [[rng.uniform(0.2, w - 0.2), rng.uniform(0.2, h - 0.2), rng.uniform(0.02, 0.2)]]
    return groups, cylinders[: rng.integers(0, 2)]


def _parted(
    rng: np.random.Generator,
    length: float,
    thick: float,
    at: Callable[[Float[ndarray, "n 2"]], Float[ndarray, "n 2"]],
) -> list[Float[ndarray, "walls 4"]]:
    """A wall of a length and thickness (m) along x with a door in it, placed by ``at``: its two parts."""
    door = rng.uniform(0.65, 1.2)
    begin = rng.uniform(0.1, max(0.15, length - door - 0.1))
    parts = []
    for a, b in ((0.0, begin), (begin + door, length)):
        if b - a < 0.06:
            continue
        half = thick / 2
        box = np.array([[a, -half], [b, -half], [b, half], [a, half]]) if thick else np.array([[a, 0.0], [b, 0.0]])
        parts.append(polyline(at(box), closed=bool(thick)))
    return parts


SHAPES: dict[str, Callable[[np.random.Generator], Shape]] = {
    "contour": contour,
    "room": room,
    "corridor": corridor,
    "hall": hall,
    "clutter": clutter,
    "flat": flat,
}
"""Generators of worlds by name."""


def random_world(rng: np.random.Generator, shape: str, walls: str = "any") -> World:
    """A world of one of SHAPES, turned at random, with surfaces of a kind (see ``random_roughness``)."""
    groups, cylinders = SHAPES[shape](rng)
    heights = random_roughness(rng, len(groups), walls)
    pieces = np.concatenate(groups)
    roughness = np.repeat(heights, [len(group) for group in groups])
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    pieces = (pieces.reshape(-1, 2) @ turn).reshape(-1, 4)
    long_enough = np.linalg.norm(pieces[:, 2:] - pieces[:, :2], axis=1) > 0.01
    round_ = np.array(cylinders, dtype=float).reshape(-1, 3)
    round_[:, :2] = round_[:, :2] @ turn
    return World(shape, pieces[long_enough], roughness[long_enough], round_)


def random_physics(rng: np.random.Generator) -> Physics:
    """Air, ranging module and surfaces as they may be anywhere; three times in ten Leonard's model taken strictly."""
    strict = bool(rng.random() < 0.3)
    beam = str(rng.choice(["bessel", "gaussian", "impulse", "cone"], p=[0.65, 0.2, 0.1, 0.05]))
    # From modules that hear little but what they face, to such that hear side lobes and long ways round.
    level = rng.choice([rng.uniform(18, 30), rng.uniform(28, 48), rng.uniform(45, 65)], p=[0.1, 0.65, 0.25])
    return Physics(
        beam="cone" if strict else beam,
        axis_ray=strict or bool(rng.random() < 0.25),
        temperature_c=rng.uniform(10, 30),
        humidity_percent=rng.uniform(20, 80),
        level_db=rng.uniform(18, 50) if strict else level,
        gain_ramp_db=rng.uniform(0, 25),
        reflection_loss_db=rng.choice([rng.uniform(0, 1), rng.uniform(0, 8)]),
        edge_db=rng.uniform(-40, -16),
        diffuse_db=rng.uniform(-20, 6) if strict else rng.uniform(-8, 6),
        facet_db=rng.choice([-60.0, rng.uniform(-30, 0)]),
        facet_slope_deg=rng.uniform(2, 10),
        level_noise_db=rng.uniform(0.5, 6),
        walk_error=np.exp(rng.uniform(np.log(0.02), np.log(0.8))),
        range_noise=np.exp(rng.uniform(np.log(3e-4), np.log(0.012))),
        range_scale=rng.uniform(0, 0.01),
        lost=rng.choice([0.0, rng.uniform(0, 0.06)]),
        cross_talk=rng.choice([0.0, np.exp(rng.uniform(np.log(5e-4), np.log(0.02)))]),
        stale=rng.choice([0.0, 0.0, rng.uniform(0, 0.5)]),
    )


def random_transducer(rng: np.random.Generator) -> Transducer:
    """A Polaroid-like head most of the time, else a small cheap one with a wide beam."""
    if rng.random() < 0.8:
        return Transducer("custom", rng.uniform(40e3, 53e3), rng.uniform(0.011, 0.022))
    return Transducer("custom", 40e3, rng.uniform(0.006, 0.011), cycles=8)


@cache
def _preset_mounts() -> tuple[Float[ndarray, "sonars 3"], ...]:
    return tuple(Robot.load(name).mounts for name in preset_names())


def told_beam(rng: np.random.Generator, transducer: Transducer) -> float:
    """The beam width (rad) that somebody writes of a transducer: about twice the angle of its first null."""
    null = np.arcsin(min(1.0, 0.61 * 343.0 / transducer.frequency_hz / transducer.aperture_radius_m))
    return float(np.clip(2 * null * np.exp(0.25 * rng.standard_normal()), np.deg2rad(2.0), np.deg2rad(90.0)))


def frank_sensing(rng: np.random.Generator) -> tuple[Physics, Transducer]:
    """A ranger that reads the nearest thing in a cone of 3 to 50 degrees, however that is turned to it.

    Such are rangers that time infrared light; all walls are to be rough for them.
    """
    half = np.exp(rng.uniform(np.log(np.deg2rad(1.5)), np.log(np.deg2rad(25.0))))
    frequency = 50e3
    head = Transducer("custom", frequency, 0.61 * speed_of_sound(20.0) / frequency / np.sin(half), cycles=1)
    physics = Physics(
        beam="cone",
        level_db=70.0,
        diffuse_db=20.0,
        reflection_loss_db=1.0,
        edge_db=-10.0,
        level_noise_db=0.5,
        walk_error=0.0,
        range_noise=rng.uniform(0.003, 0.03),
        range_scale=rng.uniform(0, 0.02),
        lost=rng.choice([0.0, rng.uniform(0, 0.1)]),
        stale=rng.choice([0.0, 0.0, rng.uniform(0, 0.3)]),
    )
    return physics, head


def random_limits(rng: np.random.Generator, count: int) -> tuple[float, float, Float[ndarray, "sonars"] | None]:
    """Minimum and maximum range (m), and the maximum of each of some sonars where they differ."""
    if rng.random() < 0.25:
        high = np.exp(rng.uniform(np.log(0.3), np.log(2.5)))
    else:
        high = rng.choice([2.5, 3.0, 4.0, 5.0, 6.0, 10.0])
    low = min(rng.uniform(0.02, 0.3), 0.25 * high)
    if count < 2 or rng.random() > 0.12:
        return float(low), float(high), None
    own = np.exp(rng.uniform(np.log(0.3), np.log(8.0), rng.integers(2, 4)))[rng.integers(0, 2, count)]
    return float(min(low, 0.25 * own.min())), float(own.max()), own if np.ptp(own) else None


def random_robot(rng: np.random.Generator, most: int = 24) -> Robot:
    """A preset, an even ring, an uneven array, a fan to the front, a few sonars, or rays to four sides.

    With a random transducer. Rings have up to ``most`` sonars.
    """
    kind = rng.choice(["preset", "ring", "uneven", "front", "few", "sides"], p=[0.33, 0.17, 0.1, 0.1, 0.25, 0.05])
    if kind == "preset":
        mounts = _preset_mounts()[rng.integers(0, len(_preset_mounts()))]
    else:
        radius, count = rng.choice([0.0, rng.uniform(0.0, 0.35)]), int(rng.integers(4 if most > 24 else 8, most + 1))
        if kind == "ring":
            axis = np.arange(count) * (2 * np.pi / count) + rng.choice([0.0, np.pi / count])
        elif kind == "uneven":
            axis = np.sort(rng.uniform(-np.pi, np.pi, rng.integers(5, 17)))
        elif kind == "front":
            half = rng.uniform(0.6, 1.9)
            axis = np.linspace(-half, half, rng.integers(4, 11))
        elif kind == "sides":
            # As of rangers with zones, or one of few to each side.
            zones, half = int(rng.integers(1, min(8, most // 4) + 1)), np.deg2rad(rng.uniform(10, 22.5))
            axis = np.concatenate([side + (np.arange(zones) + 0.5 - zones / 2) * (2 * half / zones) for side in
                                   np.arange(4) * np.pi / 2])  # fmt: skip
        else:
            # A fan to the front and one sonar to each side, as on most small robots.
            half = rng.uniform(0.2, 1.0)
            fan = np.linspace(-half, half, rng.integers(1, 7))
            axis = np.array([-np.pi / 2, *fan, np.pi / 2, *([np.pi] if rng.random() < 0.4 else [])])
        axis = axis + rng.choice([0.0, 0.03]) * rng.standard_normal(len(axis))
        mounts = np.column_stack([radius * np.cos(axis), radius * np.sin(axis), axis])
    footprint = max(0.1, float(np.max(np.hypot(mounts[:, 0], mounts[:, 1])))) + 0.02
    head, (low, high, own) = random_transducer(rng), random_limits(rng, len(mounts))
    return Robot("random", footprint, head, low, high, told_beam(rng, head), mounts, own)
