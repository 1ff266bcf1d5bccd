import re
from math import cos, hypot, inf, pi, sin, sqrt
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.geometry import wrap
from echogrid.simulation.rooms import SHAPES, random_world
from echogrid.simulation.world import (
    ROUGH_M,
    SMOOTH_M,
    Corner,
    Cylinder,
    Edge,
    Plane,
    World,
    inside_room,
    parse_world,
    polyline,
    world_names,
)

metres = st.floats(-20, 20)

GOOD = """\
name: den
start: [1, 1]
walls:
  - {points: [[0, 0], [4, 0], [4, 3], [0, 3]], closed: true, roughness_mm: 0.05}
  - {points: [[1, 2], [2, 2]], roughness_mm: 2}
cylinders:
  - {centre: [3, 1.5], radius_m: 0.2}
"""

WRONG = {
    "name is missing": ("name: den\n", "", ": name: found nothing"),
    "roughness is missing": (", roughness_mm: 2}", "}", ": walls[1].roughness_mm: found nothing"),
    "points are missing": ("points: [[1, 2], [2, 2]], ", "", ": walls[1].points: found nothing"),
    "one point": ("[[1, 2], [2, 2]]", "[[1, 2]]", ": walls[1].points: found [[1, 2]]"),
    "point in three dimensions": ("[[1, 2], [2, 2]]", "[[1, 2], [2, 2, 0]]", ": walls[1].points[1]: found [2, 2, 0]"),
    "text in a point": ("[[1, 2], [2, 2]]", "[[1, 2], [2, far]]", ": walls[1].points[1]: found 'far'"),
    "point at infinity": ("[[1, 2], [2, 2]]", "[[1, 2], [2, .inf]]", ": walls[1].points[1]: found inf"),
    "points that coincide": (
        "[[1, 2], [2, 2]]",
        "[[1, 2], [2, 2], [2, 2.001]]",
        ": walls[1].points[1]: found a wall shorter than 1 cm",
    ),
    "negative roughness": ("roughness_mm: 2}", "roughness_mm: -2}", ": walls[1].roughness_mm: found -2"),
    "true for a number": ("roughness_mm: 2}", "roughness_mm: true}", ": walls[1].roughness_mm: found True"),
    "closed by a number": ("closed: true", "closed: 1", ": walls[0].closed: found 1"),
    "unknown key of a wall": ("closed: true", "close: true", ": walls[0].close: found an unknown key"),
    "wall that is a list": ("{points: [[1, 2], [2, 2]], roughness_mm: 2}", "[1, 2]", ": walls[1]: found [1, 2]"),
    "walls that are a mapping": (
        GOOD[GOOD.index("walls") : GOOD.index("cyl")],
        "walls: {a: 1}\n",
        ": walls: found {'a'",
    ),
    "unknown key on top": ("name: den", "name: den\nroof: flat", ": roof: found an unknown key"),
    "centre is missing": ("centre: [3, 1.5], ", "", ": cylinders[0].centre: found nothing"),
    "centre of one number": ("centre: [3, 1.5]", "centre: [3]", ": cylinders[0].centre: found [3]"),
    "radius of nothing": ("radius_m: 0.2", "radius_m: 0", ": cylinders[0].radius_m: found 0"),
    "unknown key of a cylinder": ("radius_m: 0.2", "radius_m: 0.2, z: 1", ": cylinders[0].z: found an unknown key"),
    "start of three numbers": ("start: [1, 1]", "start: [1, 1, 0]", ": start: found [1, 1, 0]"),
    "start that is a text": ("start: [1, 1]", "start: here", ": start: found 'here'"),
    "nothing in it": (GOOD[GOOD.index("walls") :], "", ": walls: found no wall and no cylinder"),
    "bracket that is not closed": ("[2, 2]]", "[2, 2]", ":5: found "),
    "a list on top": (GOOD, "[1]", ": found [1], expected a mapping"),
}


def world_of(*lines, cylinders=(), closed=False, roughness=SMOOTH_M):
    walls = np.concatenate([polyline(line, closed) for line in lines]) if lines else np.zeros((0, 4))
    round_ = np.array(cylinders, dtype=float).reshape(-1, 3)
    return World("test", walls, np.full(len(walls), roughness), round_)


ROOM = world_of([[0, 0], [4, 0], [4, 3], [0, 3]], closed=True)


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "world.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def test_range_and_bearing_of_a_plane_worked_by_hand():
    plane = Plane(2.0, 0.0, 1)
    assert plane.range_bearing(np.array([0.5, 7.0])) == (1.5, 0.0)
    slanted = Plane(5.0, np.arctan2(4, 3), 1)
    reach, bearing = slanted.range_bearing(np.array([1.0, 2.0]))
    assert reach == pytest.approx(5 - 1 * 0.6 - 2 * 0.8)
    assert bearing == pytest.approx(np.arctan2(4, 3))


def test_a_plane_is_seen_from_its_visible_side_alone():
    beyond, before = np.array([3.0, 1.0]), np.array([1.0, 1.0])
    assert Plane(2.0, 0.0, 1).range_bearing(before)[0] == 1
    assert Plane(2.0, 0.0, 1).range_bearing(beyond)[0] == -1
    assert Plane(2.0, 0.0, -1).range_bearing(beyond)[0] == 1
    assert Plane(2.0, 0.0, -1).range_bearing(before)[0] == -1


@given(st.floats(0.1, 10), st.floats(-pi, pi), st.sampled_from([1, -1]), metres, metres)
def test_the_bearing_of_a_visible_plane_points_at_its_foot(R, theta, V, x, y):
    reach, bearing = Plane(R, theta, V).range_bearing(np.array([x, y]))
    foot = np.array([x + reach * cos(bearing), y + reach * sin(bearing)])
    assert foot @ [cos(theta), sin(theta)] == pytest.approx(R, abs=1e-9)


def test_range_and_bearing_of_a_corner_an_edge_and_a_cylinder_worked_by_hand():
    sensor = np.array([1.0, 1.0])
    assert Corner(4, 5).range_bearing(sensor) == pytest.approx((5, np.arctan2(4, 3)))
    assert Edge(1, -2).range_bearing(sensor) == pytest.approx((3, -pi / 2))
    assert Cylinder(-2, 5, 0.5).range_bearing(sensor) == pytest.approx((4.5, np.arctan2(4, -3)))


def test_the_planes_of_a_world_are_both_sides_of_every_wall():
    for (x0, y0, x1, y1), pair in zip(ROOM.walls, np.reshape(ROOM.planes(), (-1, 2)), strict=True):
        assert [plane.V for plane in pair] == [1, -1]
        assert pair[0].R == pair[1].R
        for x, y in ((x0, y0), (x1, y1)):
            assert x * cos(pair[0].theta) + y * sin(pair[0].theta) == pytest.approx(pair[0].R, abs=1e-12)


def test_the_targets_of_a_room_range_as_its_geometry_says():
    room = World("den", ROOM.walls, ROOM.roughness, np.array([[3.0, 1.5, 0.2]]))
    sensor = np.array([1.0, 1.5])
    seen = sorted(round(t.range_bearing(sensor)[0], 9) for t in room.targets() if isinstance(t, Plane))
    assert seen == [-3, -1.5, -1.5, -1, 1, 1.5, 1.5, 3]
    cylinder = [t for t in room.targets() if isinstance(t, Cylinder)]
    assert cylinder == [Cylinder(3, 1.5, 0.2)]
    assert cylinder[0].range_bearing(sensor) == pytest.approx((1.8, 0))


def test_a_rectangle_has_four_corners_and_four_edges_that_are_hidden_from_inside():
    corners, edges, hidden = ROOM.vertices
    places = {(0, 0), (4, 0), (4, 3), (0, 3)}
    assert {(c.x, c.y) for c in corners} == {(e.x, e.y) for e in edges} == places
    assert len(corners) == len(edges) == 4
    middle = np.array([2.0, 1.5])
    for edge, sector in zip(edges, hidden, strict=True):
        inwards = middle - [edge.x, edge.y]
        assert in_sector(sector, inwards)
        assert not in_sector(sector, -inwards)


def in_sector(sector, v):
    (ax, ay), (bx, by) = sector[:2], sector[2:]
    return ax * v[1] - ay * v[0] > 0 and v[0] * by - v[1] * bx > 0


def test_the_ends_of_a_single_wall_are_edges_hidden_from_nowhere():
    corners, edges, hidden = world_of([[0, 0], [2, 0]]).vertices
    assert corners == []
    assert {(e.x, e.y) for e in edges} == {(0, 0), (2, 0)}
    np.testing.assert_array_equal(hidden, 0)


def test_ends_that_almost_meet_are_one_vertex():
    corners, edges, _ = world_of([[1, 0], [1, 1]], [[0, 0], [1.004, 0]]).vertices
    assert corners == [Corner(1, 0)]
    assert {(e.x, e.y) for e in edges} == {(1, 0), (1, 1), (0, 0)}


def test_a_t_junction_is_two_corners_and_no_edge():
    corners, edges, _ = world_of([[-2, 0], [2, 0]], [[0, 0], [0, -1]]).vertices
    assert corners == [Corner(0, 0), Corner(0, 0)]
    assert {(e.x, e.y) for e in edges} == {(-2, 0), (2, 0), (0, -1)}


def test_a_crossing_of_the_ends_of_four_walls_is_four_corners():
    corners, edges, _ = world_of(*([[0, 0], [cos(a), sin(a)]] for a in (0, pi / 2, pi, 3 * pi / 2))).vertices
    assert corners == [Corner(0, 0)] * 4
    assert len(edges) == 4


def test_walls_in_one_line_have_no_vertex_where_they_meet():
    corners, edges, _ = world_of([[0, 0], [1, 0], [2, 0]]).vertices
    assert corners == []
    assert {(e.x, e.y) for e in edges} == {(0, 0), (2, 0)}


@given(st.floats(-pi, pi), st.floats(0.1, pi - 0.1))
def test_two_walls_that_meet_show_a_corner_inside_and_an_edge_outside(turn, opening):
    a, b = (np.array([cos(turn + t), sin(turn + t)]) for t in (0, opening))
    corners, edges, hidden = world_of([a, [0, 0], b]).vertices
    assert corners == [Corner(0, 0)]
    (sector,) = [h for e, h in zip(edges, hidden, strict=True) if hypot(e.x, e.y) < 0.5]
    for t in np.linspace(0.02, 0.98, 9):
        bearing = turn + t * opening
        assert in_sector(sector, [cos(bearing), sin(bearing)])
    for t in np.linspace(0.02, 0.98, 9):
        bearing = turn + opening + t * (2 * pi - opening)
        assert not in_sector(sector, [cos(bearing), sin(bearing)])


def test_sight_worked_by_hand():
    world = world_of([[2, -1], [2, 1]], cylinders=[[0, 3, 0.5]])
    origin = np.zeros((5, 2))
    bearing = np.array([0, pi / 4 - 0.01, pi / 4, pi / 2, pi])
    expected = [2, inf, inf, 2.5, inf]
    np.testing.assert_allclose(world.sight(origin, bearing), expected)
    np.testing.assert_allclose(world.sight(np.zeros((1, 2)), np.array([np.arctan(0.4)])), [hypot(2, 0.8)])


def test_sight_takes_the_nearest_of_what_stands_in_line():
    world = world_of([[3, -1], [3, 1]], [[2, -1], [2, 1]], cylinders=[[1.2, 0, 0.1]])
    np.testing.assert_allclose(world.sight(np.zeros((1, 2)), np.zeros(1)), [1.1])
    np.testing.assert_allclose(world.sight(np.array([[1.5, 0.0]]), np.zeros(1)), [0.5])


def test_a_ray_grazes_past_the_end_of_a_wall():
    wall = world_of([[2, 0], [2, 1]])
    bearing = np.array([np.arctan2(1, 2) - 1e-6, np.arctan2(1, 2) + 1e-6, -1e-6])
    np.testing.assert_array_equal(np.isfinite(wall.sight(np.zeros((3, 2)), bearing)), [True, False, False])


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(list(SHAPES)))
def test_no_sight_is_shorter_than_the_clearance_and_none_goes_through_a_wall(seed, shape):
    rng = np.random.default_rng(seed)
    world = random_world(rng, shape)
    points = rng.uniform(*world.bounds(), (4, 2))
    along = np.linspace(0.01, 0.99, 20)[:, None]
    on_walls = np.concatenate([w[:2] + along * (w[2:] - w[:2]) for w in world.walls])
    for point, gap in zip(points, world.clearance(points), strict=True):
        to = on_walls - point
        sight = world.sight(np.repeat(point[None], len(to), axis=0), np.arctan2(to[:, 1], to[:, 0]))
        assert np.all(sight <= np.linalg.norm(to, axis=1) + 1e-9)
        assert np.all(sight >= gap - 1e-9)


def test_clearance_worked_by_hand():
    world = world_of([[0, 0], [4, 0]], cylinders=[[2, 3, 0.5]])
    points = np.array([[1.0, 1.0], [5, 1], [-3, -4], [2, 2], [2, 3.1], [2, 0]])
    np.testing.assert_allclose(world.clearance(points), [1, sqrt(2), 5, 0.5, -0.4, 0])


def test_inside_is_what_walls_shut_in():
    points = np.array([[0.1, 0.1], [3.9, 2.9], [4.1, 1], [-0.1, 1], [2, 9]])
    np.testing.assert_array_equal(inside_room(ROOM, points), [True, True, False, False, False])


def test_bounds_hold_walls_and_whole_cylinders():
    low, high = world_of([[0, 0], [4, 1]], cylinders=[[5, 0, 0.5]]).bounds()
    np.testing.assert_allclose([low, high], [[0, -0.5], [5.5, 1]])
    low, high = world_of(cylinders=[[5, 0, 0.5]]).bounds()
    np.testing.assert_allclose([low, high], [[4.5, -0.5], [5.5, 0.5]])


@given(st.floats(0.1, 3), st.floats(-pi, pi), metres, metres)
def test_the_hessian_form_holds_both_ends_and_a_unit_normal(length, turn, x, y):
    world = world_of([[x, y], [x + length * cos(turn), y + length * sin(turn)]])
    normal, offset = world.hessian()
    assert np.linalg.norm(normal[0]) == pytest.approx(1)
    assert abs(wrap(np.arctan2(normal[0, 1], normal[0, 0]) - turn)) == pytest.approx(pi / 2)
    np.testing.assert_allclose(world.walls.reshape(2, 2) @ normal[0], offset[0], atol=1e-9)


def test_walls_are_made_smooth_or_rough_or_left():
    world = parse_world(GOOD, "den")
    np.testing.assert_array_equal(world.with_walls("smooth").roughness, [SMOOTH_M] * 5)
    np.testing.assert_array_equal(world.with_walls("rough").roughness, [ROUGH_M] * 5)
    np.testing.assert_array_equal(world.with_walls("as-given").roughness, world.roughness)
    with pytest.raises(UsageError, match=r"^walls: found tiled, expected smooth, rough or as-given$"):
        world.with_walls("tiled")


def test_a_world_file_says_what_the_world_is(tmp_path):
    world = World.load(put(tmp_path, GOOD))
    assert (world.name, world.start) == ("den", (1, 1))
    np.testing.assert_array_equal(world.walls, [[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0], [1, 2, 2, 2]])
    np.testing.assert_allclose(world.roughness, [0.05e-3] * 4 + [2e-3])
    np.testing.assert_array_equal(world.cylinders, [[3, 1.5, 0.2]])


def test_every_shipped_world_is_a_room_to_start_in():
    assert "sample" in world_names()
    for name in world_names():
        world = World.load(name)
        assert world.start is not None
        start = np.array([world.start])
        assert inside_room(world, start)[0]
        assert world.clearance(start)[0] > 0.3


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_world_file_is_one_line_that_names_the_key(tmp_path, kind):
    old, new, begins = WRONG[kind]
    assert old in GOOD
    path = put(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as raised:
        World.load(path)
    message = str(raised.value)
    assert message.startswith(f"{path}{begins}")
    assert ", expected " in message
    assert "\n" not in message


def test_bytes_that_are_no_text_and_a_folder_and_no_file_are_one_line(tmp_path):
    path = put(tmp_path, b"\x93NUMPY\xff\xfe\x00")
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: found bytes that are not UTF-8 text, expected"):
        World.load(path)
    with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path))}: found a folder, expected"):
        World.load(tmp_path)
    with pytest.raises(UsageError, match=r"^world: found atlantis, expected a file or one of .*sample"):
        World.load("atlantis")


yaml_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8) | st.integers(), inner, max_size=4)
    ),
    max_leaves=12,
)
wall_keys = st.sampled_from(["points", "closed", "roughness_mm"])
top_keys = st.sampled_from(["name", "start", "walls", "cylinders"])


@settings(max_examples=150)
@given(top_keys, wall_keys, st.sampled_from(["centre", "radius_m"]), yaml_values)
def test_any_value_of_any_key_is_taken_or_refused_in_one_line(top_key, wall_key, cylinder_key, value):
    for change in range(3):
        data = yaml.safe_load(GOOD)
        if change == 0:
            data[top_key] = value
        elif change == 1:
            data["walls"][1][wall_key] = value
        else:
            data["cylinders"][0][cylinder_key] = value
        message = "world.yaml"
        try:
            world = parse_world(yaml.safe_dump(data, allow_unicode=True), "world.yaml")
        except EchogridError as error:
            message = str(error)
        else:
            assert np.all(np.isfinite(world.bounds()))
            assert len(world.vertices[1]) == len(world.vertices[2])
        assert message.startswith("world.yaml")
        assert "\n" not in message


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(b"")
@example(b"\x00")
@example(b"[" * 3000)
@example(b"walls: &a [*a]")
@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_any_bytes_raise_nothing_but_our_errors(tmp_path, content):
    with pytest.raises(EchogridError) as raised:
        World.load(put(tmp_path, content))
    assert "\n" not in str(raised.value)
