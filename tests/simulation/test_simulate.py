from dataclasses import replace
from itertools import pairwise, product
from math import cos, hypot, inf, log10, pi, radians, sin, tan

import numpy as np
import pytest

from echogrid.geometry import wrap
from echogrid.robot import TRANSDUCERS, Robot
from echogrid.simulation.acoustics import Physics, absorption, acoustics, speed_of_sound
from echogrid.simulation.beam_patterns import bessel_beam
from echogrid.simulation.echo import FAN_RAD
from echogrid.simulation.simulate import RAYS, Simulator, disturb, passers_by, rotary_scan, sonar_poses
from echogrid.simulation.targets import Cylinder, Edge
from echogrid.simulation.world import ROUGH_M, World, polyline

FINE = 4 * RAYS - 1
FRAMES = 64
HEAD = TRANSDUCERS["polaroid-600"]
ONE_SONAR = Robot("one", 0.0, HEAD, 0.0, 100.0, radians(25), np.zeros((1, 3)))
QUIET = Physics(
    level_noise_db=0.0,
    walk_error=0.0,
    range_noise=0.0,
    range_scale=0.0,
    lost=0.0,
    reflection_loss_db=0.0,
    edge_db=-90.0,
)
LEVEL = QUIET.level_db


def world_of(*lines, closed=False, roughness=0.0, cylinders=()):
    walls = np.concatenate([polyline(line, closed) for line in lines]) if lines else np.zeros((0, 4))
    return World("test", walls, np.full(len(walls), roughness), np.array(cylinders, dtype=float).reshape(-1, 3))


def read(world, poses, physics=QUIET):
    """Readings of one sonar at some poses, in chunks of FRAMES: one compilation serves all tests."""
    poses = np.array(poses, dtype=float).reshape(-1, 3)
    padded = np.pad(poses, [(0, -len(poses) % FRAMES), (0, 0)], mode="edge")
    return Simulator(world, ONE_SONAR, physics).ranges(padded, np.random.default_rng(0), FINE)[: len(poses), 0]


def turned(x, y, degrees):
    return [[x, y, radians(d)] for d in np.atleast_1d(degrees)]


def excess(r, physics=QUIET):
    """dB by which a smooth plane on the axis at range r exceeds the threshold."""
    alpha = absorption(HEAD.frequency_hz, physics.temperature_c, physics.humidity_percent)
    ramp = physics.gain_ramp_db * min(max((r - 1) / 9.7, 0), 1)
    return physics.level_db - 20 * log10(r) - 2 * alpha * (r - 1) + ramp


LONG_WALL = world_of([[2, -30], [2, 30]])
WALL_AT_1 = world_of([[1, -30], [1, 30]])


def test_the_range_to_a_smooth_plane_is_equation_1():
    rng = np.random.default_rng(1)
    theta = 0.7
    world = world_of(
        [
            [2 * cos(theta) + 30 * sin(theta), 2 * sin(theta) - 30 * cos(theta)],
            [2 * cos(theta) - 30 * sin(theta), 2 * sin(theta) + 30 * cos(theta)],
        ]
    )
    poses = np.column_stack([rng.uniform(-3, 3, (FRAMES, 2)), theta + rng.uniform(-0.06, 0.06, FRAMES)])
    plane = world.planes()[0]
    reach = np.array([abs(plane.range_bearing(pose[:2])[0]) for pose in poses])
    before = np.array([pose[0] * cos(theta) + pose[1] * sin(theta) < 2 for pose in poses])
    ranges = read(world, poses)
    np.testing.assert_allclose(ranges[before], reach[before], atol=1e-5)
    assert np.all(ranges[~before] == inf)
    assert before.sum() > 20
    assert (~before).sum() > 5


@pytest.mark.parametrize("r", [0.4, 1.0, 2.5, 5.0])
def test_a_weak_echo_is_read_late_by_the_walk_error(r):
    physics = replace(QUIET, walk_error=1.0)
    late = 0.0556 * 10 ** (-excess(r) / 20)
    assert read(world_of([[r, -30], [r, 30]]), [[0, 0, 0]], physics)[0] == pytest.approx(r + late, abs=5e-5)


@pytest.mark.parametrize(
    ("level", "half"),
    [
        (3.0, 4.0),
        (6.0, 5.6),
        (10.0, 7.0),
        (15.0, 8.4),
        (20.0, 9.5),
        (25.0, 10.3),
        (30.0, 10.9),
        (35.0, 11.4),
        (40.0, 11.9),
    ],
)
def test_the_half_visibility_angle_of_a_plane_grows_with_its_level_as_in_the_notes(level, half):
    degrees = np.arange(FRAMES) * 0.2
    for side in (1, -1):
        heard = np.isfinite(read(WALL_AT_1, turned(0, 0, side * degrees), replace(QUIET, level_db=level)))
        assert degrees[np.argmin(heard)] == pytest.approx(half, abs=0.5)


def test_a_fan_of_few_rays_hears_a_plane_as_far_off_the_axis_as_its_level_says():
    off = np.linspace(8.5, 10.5, FRAMES)
    level = 20.0 + 2 * beam_db(off)
    clear = np.abs(level) > 0.25
    poses = np.array(turned(0, 0, off))
    physics = replace(QUIET, level_db=20.0)
    ranges = Simulator(WALL_AT_1, ONE_SONAR, physics).ranges(poses, np.random.default_rng(0), RAYS)[:, 0]
    np.testing.assert_array_equal(np.isfinite(ranges[clear]), level[clear] > 0)
    assert 0.2 < np.mean(level > 0) < 0.8


def test_within_its_visibility_a_plane_is_a_region_of_constant_depth():
    ranges = read(LONG_WALL, turned(0, 0, np.linspace(-9, 9, FRAMES)))
    np.testing.assert_allclose(ranges, 2, atol=1e-5)


def test_side_lobes_are_heard_at_short_range_only():
    ranges = np.linspace(0.3, 2.5, 12)
    heard = [np.isfinite(read(world_of([[r, -30], [r, 30]]), turned(0, 0, 18.0)))[0] for r in ranges]
    np.testing.assert_array_equal(heard, [excess(r) > 35.14 for r in ranges])
    assert heard[0]
    assert not heard[-1]


def test_between_main_and_side_lobe_lies_a_dead_zone():
    near = world_of([[0.5, -30], [0.5, 30]])
    degrees = np.array([0, 10, 13.3, 17.0, 18.0, 19.0, 24.9])
    heard = [True, True, False, True, True, True, False]
    for side in (1, -1):
        ranges = read(near, turned(0, 0, side * degrees))
        np.testing.assert_array_equal(np.isfinite(ranges), heard)
        np.testing.assert_allclose(ranges[heard], 0.5, atol=1e-5)


def test_a_beam_without_side_lobes_has_none():
    near = world_of([[0.5, -30], [0.5, 30]])
    ranges = read(near, turned(0, 0, [0, 18]), replace(QUIET, beam="gaussian"))
    assert np.isfinite(ranges[0])
    assert ranges[1] == inf


@pytest.mark.parametrize("bearing", [25, 38, 45, 52, 65])
@pytest.mark.parametrize("r", [1.0, 2.0, 3.0])
def test_a_square_corner_reads_the_distance_to_its_vertex(bearing, r):
    corner = world_of([[-6, 0], [0, 0], [0, -6]])
    x, y = -r * cos(radians(bearing)), -r * sin(radians(bearing))
    ranges = read(corner, turned(x, y, bearing + np.array([-4, 0.1, 4])))
    np.testing.assert_allclose(ranges, r, atol=1e-4)


@pytest.mark.parametrize("opening", [80, 84, 87, 93, 96, 100])
def test_a_corner_that_is_not_square_reads_the_image_of_the_second_order(opening):
    half = radians(opening / 2)
    corner = world_of([[6 * cos(half), 6 * sin(half)], [0, 0], [6 * cos(half), -6 * sin(half)]])
    rho = 1.5
    (reading,) = read(corner, turned(rho, 0, 180.0))
    if opening < 90:
        assert reading == pytest.approx(rho * sin(radians(opening)), abs=1e-4)
    else:
        assert reading == inf or reading == pytest.approx(rho * sin(radians(opening)), abs=1e-4)


def test_a_wall_seen_by_way_of_a_mirror_reads_the_length_of_the_way():
    mirror, wall = [[1, -1], [3, 1]], [[0.5, 2.2], [3.5, 2.2]]
    ranges = read(world_of(mirror, wall), turned(0, 0, [-3, 0, 3]))
    np.testing.assert_allclose(ranges, 2 + 2.2, atol=1e-4)
    assert read(world_of(mirror), [[0, 0, 0]])[0] == inf
    assert read(world_of(wall), [[0, 0, 0]])[0] == inf


def test_an_edge_reads_equation_2():
    physics = replace(QUIET, edge_db=-20.0)
    box = world_of([[2, 0], [3, 1], [4, 0], [3, -1]], closed=True)
    edge = Edge(2, 0)
    poses = [
        [x, y, np.arctan2(-y, 2 - x) + off]
        for x, y, off in [(0, 0, 0), (0, 0.3, 0), (0.5, -0.3, 0.03), (1, 0, -0.03)]
    ]
    expected = [edge.range_bearing(np.array(pose[:2], dtype=float))[0] for pose in poses]
    np.testing.assert_allclose(read(box, poses, physics), expected, atol=1e-4)
    assert np.all(read(box, poses) == inf)


def test_the_free_end_of_a_wall_reads_equation_2():
    ranges = read(world_of([[1, 0], [5, 0]]), [[0, 0, 0], [0, 0.1, 0], [0, -0.1, 0]], replace(QUIET, edge_db=-20.0))
    np.testing.assert_allclose(ranges, [1, hypot(1, 0.1), hypot(1, 0.1)], atol=1e-4)


def test_an_edge_is_not_heard_from_behind_its_walls():
    physics = replace(QUIET, edge_db=0.0, diffuse_db=-80.0)
    half = radians(35)
    corner = world_of([[6 * cos(half), 6 * sin(half)], [0, 0], [6 * cos(half), -6 * sin(half)]], roughness=ROUGH_M)
    outside, inside = read(corner, [[-1, 0, 0], [1, 0, pi]], physics)
    assert outside == pytest.approx(1, abs=1e-4)
    assert inside == inf


def test_a_cylinder_reads_equation_3():
    cylinder = Cylinder(1.5, 0.5, 0.2)
    world = world_of(cylinders=[[1.5, 0.5, 0.2]])
    poses = []
    for x, y, off in [(0, 0, 0), (0.3, 0, 0.05), (0, 1, -0.05), (3, 3, 0)]:
        poses.append([x, y, cylinder.range_bearing(np.array([x, y], dtype=float))[1] + off])
    expected = [cylinder.range_bearing(np.array(pose[:2], dtype=float))[0] for pose in poses]
    np.testing.assert_allclose(read(world, poses), expected, atol=1e-4)
    assert read(world, [[0, 0, pi]])[0] == inf


def test_the_level_of_a_cylinder_is_that_of_the_notes():
    q, r = 0.05, 1.0
    world = world_of(cylinders=[[r + q, 0, q]])
    threshold = -10 * log10(q / (q + r))
    assert threshold == pytest.approx(13.2, abs=0.03)
    assert np.isfinite(read(world, [[0, 0, 0]], replace(QUIET, level_db=threshold + 0.3)))[0]
    assert read(world, [[0, 0, 0]], replace(QUIET, level_db=threshold - 0.3))[0] == inf


def test_what_stands_in_front_hides_what_stands_behind():
    wall = [[3, -2], [3, 2]]
    flat, slanted = (
        polyline(p, closed=True)
        for p in ([[1, -0.5], [1.5, -0.5], [1.5, 0.5], [1, 0.5]], [[1, 0], [1.5, -0.5], [2, 0], [1.5, 0.5]])
    )
    alone = world_of(wall)
    assert read(alone, [[0, 0, 0]])[0] == pytest.approx(3, abs=1e-5)
    for box, reading in ((flat, 1), (slanted, inf)):
        world = replace(alone, walls=np.concatenate([alone.walls, box]), roughness=np.zeros(5))
        assert read(world, [[0, 0, 0]])[0] == pytest.approx(reading, abs=1e-5)
    pillar = replace(alone, cylinders=np.array([[1.5, 0, 0.2]]))
    assert read(pillar, [[0, 0, 0]])[0] == pytest.approx(1.3, abs=1e-5)


def test_a_cylinder_that_is_not_heard_hides_what_stands_behind():
    wall = world_of([[3, -2], [3, 2]])
    faint = replace(QUIET, level_db=15.0)
    assert read(wall, [[0, 0, 0]], faint)[0] == pytest.approx(3, abs=1e-5)
    assert read(replace(wall, cylinders=np.array([[1.5, 0, 0.05]])), [[0, 0, 0]], faint)[0] == inf


def test_no_edge_and_no_cylinder_is_heard_through_a_wall():
    screen = [[-1.5, -3], [4.5, 3]]
    loud = replace(QUIET, edge_db=0.0)
    edge = [[3, 0], [6, 0]]
    assert read(world_of(edge), [[0, 0, 0]], loud)[0] == pytest.approx(3, abs=1e-4)
    assert read(world_of(edge, screen), [[0, 0, 0]], loud)[0] == inf
    assert read(world_of(cylinders=[[3, 0, 0.5]]), [[0, 0, 0]])[0] == pytest.approx(2.5, abs=1e-4)
    assert read(world_of(screen, cylinders=[[3, 0, 0.5]]), [[0, 0, 0]])[0] == inf


def test_an_echo_whose_way_home_is_barred_is_not_heard():
    half, rho = radians(40), 1.5
    corner = [[6 * cos(half), 6 * sin(half)], [0, 0], [6 * cos(half), -6 * sin(half)]]
    screen = [[0.75, -0.25], [0.85, -0.05]]
    assert read(world_of(corner), [[rho, 0, pi]])[0] == pytest.approx(rho * sin(2 * half), abs=1e-4)
    assert read(world_of(corner, screen), [[rho, 0, pi]])[0] == inf


def test_a_wall_ends_where_it_ends():
    half = world_of([[1, 0], [1, 5]])
    feet = np.array([-0.5, -0.1, 0.1, 0.5])
    np.testing.assert_array_equal(np.isfinite(read(half, [[0, y, 0] for y in feet])), feet > 0)


@pytest.mark.parametrize(("mm", "loss"), [(0.2, 0.57), (0.5, 3.55), (1.0, 14.2), (1.5, 17.1), (2.0, 17.1)])
def test_the_level_of_a_wall_falls_with_its_roughness_to_that_of_a_diffuse_one(mm, loss):
    rough = world_of([[1, -30], [1, 30]], roughness=mm * 1e-3)
    levels = [replace(QUIET, level_db=loss + off) for off in (0.4, -0.4)]
    heard = [np.isfinite(read(rough, [[0, 0, 0]], physics)[0]) for physics in levels]
    assert heard == [True, False]


def beam_db(degrees):
    off = np.radians(np.minimum(np.abs(degrees), 90))
    beam = bessel_beam(HEAD, speed_of_sound(QUIET.temperature_c), off.ravel()).reshape(off.shape)
    return 20 * np.log10(np.maximum(beam, 1e-3))


@pytest.mark.parametrize("incidence", [30, 45, 60])
def test_a_rough_wall_seen_aslant_is_read_where_the_beam_begins_and_a_smooth_one_not_at_all(incidence):
    i, d, theta = radians(incidence), 0.8, acoustics(HEAD, QUIET).patch_rad

    def echo(off, physics):
        """Range and level of the patch that lies ``off`` (rad) before the axis."""
        r = d / cos(i - off)
        lit = min(1, 0.0556 / (2 * r * theta * tan(i - off)))
        diffuse = 10 * log10(4 * theta**2 * cos(i - off) * lit)
        return r, excess(r, physics) + diffuse + 2 * beam_db(np.degrees(off))

    # 3 dB above the threshold on the axis: heard out to the two-way half width of the beam, and a little beyond.
    physics = replace(QUIET, level_db=float(QUIET.level_db + 3 - echo(0, QUIET)[1]))
    heard = min(r for r, level in (echo(off, physics) for off in np.radians(np.arange(-8, 8, 0.02))) if level >= 0)
    reading = read(world_of([[d, -30], [d, 30]], roughness=ROUGH_M), turned(0, 0, incidence), physics)[0]
    assert reading == pytest.approx(heard, rel=0.01)
    assert reading == pytest.approx(d / cos(i - theta), rel=0.05)
    assert read(world_of([[d, -30], [d, 30]]), turned(0, 0, incidence), physics)[0] == inf


def test_an_uneven_wall_is_heard_aslant_and_an_even_one_not():
    uneven = replace(QUIET, facet_db=0.0, facet_slope_deg=10.0)
    assert read(LONG_WALL, turned(0, 0, 25), QUIET)[0] == inf
    assert 2 < read(LONG_WALL, turned(0, 0, 25), uneven)[0] < 2 / cos(radians(25))
    assert read(LONG_WALL, turned(0, 0, 60), uneven)[0] == inf


def test_a_sonar_that_hears_nothing_reads_the_way_along_its_axis_where_that_is_asked_for():
    deaf = replace(QUIET, level_db=-50.0, axis_ray=True)
    mirror, wall = [[1, -1], [3, 1]], [[0.5, 2.2], [3.5, 2.2]]
    assert read(world_of(mirror, wall), [[0, 0, 0]], deaf)[0] == pytest.approx(2 + 2.2, abs=1e-4)
    ranges = read(LONG_WALL, turned(0, 0, [0, 12, 13, 180]), deaf)
    np.testing.assert_allclose(ranges, [2, 2 / cos(radians(12)), inf, inf], atol=1e-4)
    assert np.all(read(LONG_WALL, turned(0, 0, [0, 12]), replace(deaf, axis_ray=False)) == inf)
    heard = replace(QUIET, axis_ray=True)
    np.testing.assert_allclose(read(LONG_WALL, turned(0, 0, [0, 5]), heard), 2, atol=1e-4)


@pytest.mark.parametrize("turn", [0.0, 0.3, 2.1])
@pytest.mark.parametrize(
    "miss",
    [
        "far",
        "near",
        pytest.param("exact", marks=pytest.mark.xfail(reason="rounding: the vertex is on neither wall", strict=True)),
    ],
)
def test_a_smooth_corner_is_heard_from_every_bearing_within_the_beam(turn, miss):
    """Also where a ray of the fan meets the vertex, and it is rounding which of the walls it meets."""
    rng = np.random.default_rng(0)
    count = 50 * FRAMES
    corner = world_of(
        np.array([[6, 0], [0, 0], [0, 6]]) @ np.array([[cos(turn), sin(turn)], [-sin(turn), cos(turn)]])
    )
    r, bearing = rng.uniform(0.4, 3, count), rng.uniform(0.15, pi / 2 - 0.15, count)
    at = np.column_stack([r * np.cos(bearing + turn), r * np.sin(bearing + turn)])
    off = rng.uniform(-1, 1, count) * radians(9)
    if miss != "far":
        # The nearest ray passes the vertex at so much, m.
        aside = rng.uniform(2e-6, 5e-5, count) * rng.choice([-1, 1], count) if miss == "near" else 0.0
        off = np.rint(off / (FAN_RAD / FINE)) * FAN_RAD / FINE + aside / r
    ranges = read(corner, np.column_stack([at, bearing + turn + pi + off]))
    planes = r * np.minimum(np.cos(bearing), np.sin(bearing))
    np.testing.assert_array_less(ranges, r + 1e-3)
    assert np.all(np.isclose(ranges, r, atol=1e-3) | (ranges > planes - 1e-3))
    assert np.mean(np.isclose(ranges, r, atol=1e-3)) > 0.8


def image_sources(walls, p, axis):
    """Ranges of all echoes of up to 3 mirror reflections: those that are sure to be heard, those that may be.

    Brute force: for every sequence of walls the sensor is mirrored in one after the other; the path is unfolded
    from its end; each point of reflection must lie on its wall and no leg may cross a wall. What lies within
    a margin of the end of a wall, of grazing past one or of the threshold may be or not.
    """
    a, b = walls[:, :2], walls[:, 2:]
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    normal = np.column_stack([-along[:, 1], along[:, 0]])

    def meets(p, q, slack):
        """The walls that the leg from p to q crosses, each longer by slack."""
        u, w = q - p, np.sum((a - p) * normal, axis=1)
        towards = normal @ u
        t = w / np.where(towards == 0, 1e-12, towards)
        s = np.sum((p + t[:, None] * u - a) * along, axis=1)
        return (t > 1e-6) & (t < 1 - 1e-6) & (s > -slack) & (s < np.linalg.norm(b - a, axis=1) + slack)

    sure, maybe = [], []
    for order in (1, 2, 3):
        for sequence in product(range(len(walls)), repeat=order):
            if any(m == n for m, n in pairwise(sequence)):
                continue
            images = [p]
            for n in sequence:
                images.append(images[-1] - 2 * ((images[-1] - a[n]) @ normal[n]) * normal[n])
            length = np.linalg.norm(images[-1] - p)
            margin = 0.03 + 0.01 * length
            target, points = p, []
            for n, image in zip(sequence[::-1], images[:0:-1], strict=True):
                u = target - image
                height = u @ normal[n]
                t = ((a[n] - image) @ normal[n]) / height if abs(height) > 1e-9 else -1
                if not 0 < t < 1:
                    break
                target = image + t * u
                points.insert(0, target)
            if len(points) < order:
                continue
            legs = [p, *points, p]
            inside = min(
                min((point - a[n]) @ along[n], (b[n] - point) @ along[n])
                for n, point in zip(sequence, points, strict=True)
            )
            if inside < -margin:
                continue
            blocked = [False, False]
            for k, slack in enumerate((margin, -margin)):
                for i in range(order + 1):
                    crossed = meets(legs[i], legs[i + 1], slack)
                    crossed[list(sequence[max(i - 1, 0) : i + 1])] = False
                    blocked[k] |= bool(crossed.any())
            ways = [points[0] - p, points[-1] - p]
            off = np.degrees([wrap(np.arctan2(w[1], w[0]) - axis) for w in ways])
            near = off[:, None] + np.linspace(-0.8, 0.8, 17)
            level = excess(length / 2)
            if inside > margin and not blocked[0] and np.all(np.abs(off) < 36):
                sure += [length / 2] * bool(level + beam_db(near).min(axis=1).sum() > 0.5)
            if not blocked[1]:
                maybe += [length / 2] * bool(level + beam_db(near).max(axis=1).sum() > -0.5)
    return sure, maybe


@pytest.mark.parametrize("seed", range(5))
def test_readings_of_a_smooth_room_are_those_of_its_image_sources(seed):
    rng = np.random.default_rng(seed)
    skew = np.array([[1, rng.uniform(-0.1, 0.1)], [rng.uniform(-0.2, 0.2), 1]])
    room = np.array([[0, 0], [rng.uniform(2, 4), 0], [3, rng.uniform(2, 3)], [0, rng.uniform(2, 4)]]) @ skew
    world = world_of(
        np.concatenate([room, room[:1]]), [room.mean(axis=0), room.mean(axis=0) + rng.uniform(-0.7, 0.7, 2)]
    )
    inside = rng.uniform(0.15, 0.85, (200, 2))
    mixed = (1 - inside[:, :1]) * (1 - inside[:, 1:]) * room[0] + inside[:, :1] * (1 - inside[:, 1:]) * room[1]
    mixed += inside[:, :1] * inside[:, 1:] * room[2] + (1 - inside[:, :1]) * inside[:, 1:] * room[3]
    mixed = mixed[world.clearance(mixed) > 0.1][:FRAMES]
    poses = np.column_stack([mixed, rng.uniform(-pi, pi, len(mixed))])
    decided = 0
    for pose, reading in zip(poses, read(world, poses), strict=True):
        sure, maybe = image_sources(world.walls, pose[:2], pose[2])
        assert reading <= min(sure, default=inf) + 0.01
        assert reading == inf or min(abs(reading - np.array([*maybe, inf]))) < 0.01
        decided += sorted(sure)[:1] == sorted(maybe)[:1]
    assert decided > 0.6 * len(poses)


def test_over_long_readings_of_a_smooth_room_have_the_lengths_of_its_images():
    room = world_of([[0, 0], [3, 0.2], [2.8, 2.6], [0.1, 2.5]], closed=True)
    position, axis = np.array([0.8, 0.7]), np.radians(np.arange(4 * FRAMES) * 360 / (4 * FRAMES))
    ranges = read(room, [[*position, a] for a in axis])
    sight = room.sight(np.repeat(position[None], len(axis), axis=0), axis)
    long = np.isfinite(ranges) & (ranges > sight + 0.3)
    assert long.sum() >= 4
    for reading, a in zip(ranges[long], axis[long], strict=True):
        assert min(abs(reading - np.array(image_sources(room.walls, position, a)[1]))) < 0.01


def some_room(rng):
    walls = np.concatenate(
        [
            polyline([[0, 0], [3.2, 0], [3, 2.5], [-0.3, 2.2]], closed=True),
            polyline([[1.6, 0], [1.6, 0.8]]),
            polyline([[0.3, 2.0], [1.1, 1.7]]),
        ]
    )
    return World("some", walls, rng.choice([0.0, 0.5e-3, 2e-3], len(walls)), np.array([[2.4, 1.6, 0.1]]))


@pytest.mark.parametrize("seed", range(3))
def test_a_mirrored_scene_gives_the_mirrored_scan(seed):
    rng = np.random.default_rng(seed)
    world = some_room(rng)
    mirrored = replace(world, walls=world.walls * [1, -1, 1, -1], cylinders=world.cylinders * [1, -1, 1])
    x, y = rng.uniform([1.2, 1.0], [1.5, 1.5])
    axis = rng.uniform(-pi, pi, 2 * FRAMES)
    physics = replace(QUIET, edge_db=-25.0, walk_error=0.5)
    ranges = read(world, [[x, y, a] for a in axis], physics)
    np.testing.assert_allclose(read(mirrored, [[x, -y, -a] for a in axis], physics), ranges, atol=1e-3)
    assert 0.3 < np.mean(np.isfinite(ranges)) <= 1


def test_a_moved_scene_gives_the_same_readings():
    rng = np.random.default_rng(5)
    world = some_room(rng)
    turn, move = 0.8, np.array([3.0, -2.0])
    R = np.array([[cos(turn), -sin(turn)], [sin(turn), cos(turn)]])
    moved = replace(
        world,
        walls=(world.walls.reshape(-1, 2) @ R.T + move).reshape(-1, 4),
        cylinders=np.column_stack([world.cylinders[:, :2] @ R.T + move, world.cylinders[:, 2]]),
    )
    p, axis = np.array([1.3, 1.2]), rng.uniform(-pi, pi, 2 * FRAMES)
    here = read(world, [[*p, a] for a in axis])
    there = read(moved, [[*(R @ p + move), a + turn] for a in axis])
    assert np.mean(np.isclose(here, there, atol=1e-3)) > 0.97


def test_no_reading_depends_on_the_other_poses():
    world = some_room(np.random.default_rng(0))
    poses = np.array(turned(1.3, 1.2, np.arange(2 * FRAMES) * 2.8))
    few = Simulator(world, ONE_SONAR, QUIET).ranges(poses[:70], np.random.default_rng(0), FINE)[:, 0]
    np.testing.assert_array_equal(few, read(world, poses)[:70])


DRIVER = Robot("driver", 0.1, HEAD, 0.4, 2.0, radians(25), np.zeros((1, 3)))
DRIVE = np.array(turned(1.3, 1.2, np.arange(2 * FRAMES) * 2.8))


def drive(physics=None, seed=7, world_seed=0):
    world = some_room(np.random.default_rng(world_seed))
    return list(Simulator(world, DRIVER, physics or Physics(stale=0.1, cross_talk=0.1)).frames(DRIVE, seed))


def test_a_seed_gives_the_same_bytes_and_another_seed_others():
    first, again, other = drive(), drive(), drive(seed=8)
    bytes_of = [b"".join(frame.ranges.tobytes() for frame in frames) for frames in (first, again, other)]
    assert bytes_of[0] == bytes_of[1]
    assert bytes_of[0] != bytes_of[2]


def test_frames_carry_the_poses_of_the_drive_at_the_rate_that_was_asked_for():
    frames = drive()
    np.testing.assert_array_equal([frame.pose for frame in frames], DRIVE)
    np.testing.assert_allclose([frame.stamp for frame in frames], np.arange(len(DRIVE)) / 5)


def test_frames_keep_the_no_echo_rule():
    ranges = np.concatenate([frame.ranges for frame in drive()])
    finite = ranges[np.isfinite(ranges)]
    assert finite.min() >= DRIVER.min_range_m
    assert finite.max() < DRIVER.max_range_m
    assert np.isinf(ranges).any()
    assert np.isnan(ranges).any()
    assert np.all(ranges[np.isinf(ranges)] > 0)


def test_the_noise_of_the_level_makes_weak_echoes_come_and_go():
    poses = np.array(turned(0, 0, np.full(FRAMES, 10.9)))
    at_the_edge = replace(QUIET, level_db=30.0, level_noise_db=3)
    heard = np.isfinite(Simulator(WALL_AT_1, ONE_SONAR, at_the_edge).ranges(poses, np.random.default_rng(0), FINE))
    assert 0.2 < heard.mean() < 0.8


TRUE = np.random.default_rng(3).uniform(0.3, 4, (200, 8))
TRUE[::7, 2] = inf
EXACT = Physics(range_noise=0, range_scale=0, lost=0)


def disturbed(physics, ranges=TRUE, seed=0):
    return disturb(ranges, physics, 5.0, np.random.default_rng(seed))


def test_readings_that_are_all_lost_are_all_no_echo():
    assert np.all(disturbed(replace(EXACT, lost=1.0)) == inf)


def test_readings_that_are_all_stale_repeat_the_first_frame():
    stale = disturbed(replace(EXACT, stale=1.0))
    np.testing.assert_array_equal(stale, np.repeat(stale[:1], len(stale), axis=0))


def test_foreign_pulses_only_shorten_readings():
    foreign = disturbed(replace(EXACT, cross_talk=1.0))
    assert np.all(foreign < TRUE)
    assert np.all((foreign >= 0) & (foreign < 5.0))


def test_the_shares_of_lost_and_foreign_readings_are_those_asked_for():
    finite = np.isfinite(TRUE)
    assert np.mean(disturbed(replace(EXACT, lost=0.1))[finite] == inf) == pytest.approx(0.1, abs=0.03)
    foreign = disturbed(replace(EXACT, cross_talk=0.1)) < TRUE - 0.02
    assert np.mean(foreign) == pytest.approx(0.1, abs=0.03)


def test_white_noise_has_its_share_of_the_range_and_never_less_than_1_mm():
    far, near = np.full((500, 8), 4.0), np.full((500, 8), 0.2)
    assert np.std(disturbed(replace(EXACT, range_noise=0.01), far)) == pytest.approx(0.04, rel=0.05)
    assert np.std(disturbed(replace(EXACT, range_noise=0.004), near)) == pytest.approx(0.001, rel=0.05)


def test_the_scale_error_is_shared_by_a_run_and_differs_between_runs():
    far = np.full((200, 8), 50.0)
    scales = [disturbed(replace(EXACT, range_scale=0.005), far, seed) / 50 for seed in range(30)]
    assert max(np.std(scale) for scale in scales) < 1e-4
    assert np.std([scale.mean() for scale in scales]) == pytest.approx(0.005, rel=0.4)


def test_no_echo_stays_no_echo_under_noise():
    out = disturbed(Physics(lost=0, stale=0, cross_talk=0))
    np.testing.assert_array_equal(np.isinf(out), np.isinf(TRUE))


def test_people_are_heard_where_they_are_and_only_in_front_of_things():
    sonars = np.zeros((50, 8, 3))
    sonars[..., 2] = np.arange(8) * pi / 4
    true = np.full((50, 8), 3.0)
    true[:, 2] = inf
    passed = np.array([passers_by(true, sonars, np.random.default_rng(seed)) for seed in range(40)])
    heard = passed < true
    assert np.all(passed <= true)
    assert passed.min() >= 0.05
    # Up to three people for up to 24 frames each, of whom the beams of eight sonars cover two thirds.
    assert 0.01 < heard.any(axis=-1).mean() < 0.5
    assert heard[..., 2].any()
    # One person is heard by one sonar of eight, and three by three.
    assert heard.sum(axis=-1).max() <= 3
    np.testing.assert_array_equal(passers_by(true, sonars, np.random.default_rng(3)), passed[3])
    assert not np.array_equal(passed[2], passed[3])


def test_a_rotary_scan_reads_what_a_sonar_at_its_bearings_reads():
    world = some_room(np.random.default_rng(1))
    physics = Physics(edge_db=-25.0)
    bearing, ranges = rotary_scan(world, HEAD, 1.0, (1.3, 1.2), physics, steps=2 * FRAMES)
    np.testing.assert_allclose(bearing, np.arange(2 * FRAMES) * 2 * pi / (2 * FRAMES))
    quiet = read(world, [[1.3, 1.2, b] for b in bearing], replace(physics, level_noise_db=0))
    np.testing.assert_array_equal(ranges, np.where(quiet >= 1, inf, quiet))
    assert np.isfinite(ranges).any()
    assert np.any(np.isfinite(quiet) & (quiet >= 1))


def test_sonars_stand_where_their_mounts_put_them():
    mounts = np.array([[0.2, 0, 0], [0, 0.1, pi / 2]])
    poses = np.array([[1, 2, pi / 2], [0, 0, 0]])
    expected = [[[1, 2.2, pi / 2], [0.9, 2, -pi]], [[0.2, 0, 0], [0, 0.1, pi / 2]]]
    np.testing.assert_allclose(sonar_poses(mounts, poses), expected, atol=1e-12)
