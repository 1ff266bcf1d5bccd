from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy import inf, nan

from echogrid import Frame, Robot, build_map
from echogrid.errors import UsageError
from echogrid.geometry import compose
from echogrid.grid import Grid
from echogrid.mapping.mapper import Mapper
from echogrid.mapping.registry import sensor_model
from echogrid.models.networks import set_network
from echogrid.models.networks.set_layers import LOOKS
from echogrid.models.networks.set_network import FORGOTTEN, SUMS, SetNetwork
from echogrid.simulation.simulate import Simulator
from echogrid.simulation.world import parse_world

B21 = Robot.load("b21")
CELL_M = 0.1
FAR = 20.0
"""No map of one scan reaches half as far, m."""


def default_network() -> SetNetwork:
    network = sensor_model("set-network")
    assert isinstance(network, SetNetwork)
    return network


NETWORK = default_network()


def adding(network):
    """The network with views that are summed as Bayes' rule has it."""
    ones = {"ws": np.ones(1, np.float32), "wz": np.zeros_like(network.weights["wz"])}
    return replace(network, weights=network.weights | ones, around=None)


def scan(stamp, x=0.0, y=0.0, theta=0.0, seed=0, mounts=None):
    ranges = np.random.default_rng(seed).uniform(0.5, 2.5, B21.sonars)
    return Frame(stamp, np.array([x, y, theta]), ranges, mounts=mounts)


def mapped(frames, half_life=None, network=NETWORK, cell_m=CELL_M):
    mapper = Mapper(B21, network, cell_m, half_life)
    for frame in frames:
        mapper.add([frame])
    return mapper


def near(mapper, x=0.0):
    """Log-odds and observed cells of 6 x 6 m round a place."""
    grid = mapper.around(x, 0.0, 6.0)
    return grid.log_odds, grid.observed


def test_taking_scans_one_by_one_or_together_gives_one_map():
    frames = [scan(0.2 * i, 0.1 * i, seed=i) for i in range(9)]
    together = Mapper(B21, NETWORK, CELL_M)
    together.add(frames)
    *_, built = build_map(frames, B21, NETWORK, CELL_M)
    for grid in (mapped(frames).grid(), built):
        np.testing.assert_allclose(grid.log_odds, together.grid().log_odds, atol=2e-3)
        np.testing.assert_array_equal(grid.views, together.grid().views)


def test_views_count_the_scans_that_spoke_of_a_cell():
    frames = [scan(0.2 * i, 0.3 * i, seed=i) for i in range(5)]
    fine = NETWORK.cell_m
    grid = mapped(frames, cell_m=fine).grid()
    points = grid.centre_of(np.argwhere(np.ones(grid.shape)))
    said = sum((mapped([frame], cell_m=fine).grid().probability_at(points) != 0.5).astype(int) for frame in frames)
    # In each scan the robot speaks of the floor under it as well.
    stood = np.min(np.hypot(*(points[:, None] - [f.pose[:2] for f in frames]).T), axis=0) < B21.footprint_radius_m
    np.testing.assert_array_equal(grid.views.ravel()[~stood], said[~stood])
    np.testing.assert_array_equal(grid.observed.ravel()[~stood], said[~stood] > 0)
    assert grid.observed.ravel()[stood].all()
    assert said.max() == 5
    # A larger cell counts those of that part of it of which most spoke.
    np.testing.assert_array_equal(mapped(frames).grid().views, grid.in_cells_of(CELL_M).views)


def test_a_part_of_the_map_is_that_of_the_whole_and_nothing_beyond():
    mapper = mapped([scan(0.0), scan(0.2, 0.4, seed=1)])
    whole, part = mapper.grid(), mapper.around(2.6, -1.0, 3.0)
    assert part.shape == (30, 30)
    points = part.centre_of(np.argwhere(np.ones(part.shape)))
    np.testing.assert_array_equal(part.probability_at(points), whole.probability_at(points))
    beyond = mapper.around(FAR, FAR, 3.0)
    assert not beyond.observed.any()
    assert not Mapper(B21, NETWORK, CELL_M).around(0.0, 0.0, 1.0).observed.any()
    before = part.log_odds.copy()
    mapper.add([scan(0.4, 2.0, seed=2)])
    np.testing.assert_array_equal(part.log_odds, before)


def test_maps_on_the_way_are_read_when_they_are_looked_at_and_hold_what_came_so_far(monkeypatch):
    frames = [scan(30.0 * i, FAR * i, seed=i) for i in range(4)]  # so far from each other that each is summed alone
    read, whole = [], Mapper.grid
    monkeypatch.setattr(Mapper, "grid", lambda mapper: read.append(1) or whole(mapper))
    *_, unread = build_map(frames, B21, NETWORK, CELL_M)
    assert not read
    assert isinstance(unread, Grid)
    expected = mapped(frames).grid()
    read.clear()
    assert unread.shape == expected.shape
    np.testing.assert_allclose(unread.log_odds, expected.log_odds, atol=2e-3)
    assert read == [1]
    for count, grid in enumerate(build_map(frames, B21, NETWORK, CELL_M), 1):
        so_far = mapped(frames[:count]).grid()
        points = so_far.centre_of(np.argwhere(so_far.observed))
        np.testing.assert_allclose(grid.probability_at(points), so_far.probability_at(points), atol=2e-3)
        assert grid.observed.sum() == len(points)
    assert count == len(frames)


@pytest.mark.parametrize("cell_m", [0.03, 0.04, 0.05, 0.25])
def test_a_part_of_a_map_that_is_told_in_other_cells_is_that_of_the_whole(cell_m):
    mapper = mapped([scan(0.0, -0.7, -0.3), scan(0.2, -0.4, -0.3, seed=1)], cell_m=cell_m)
    for x, y, side in ((-1.3, -2.1, 1.5), (0.02, 1.0, 2.0), (-2.9, 0.3, 3.0)):
        part = mapper.around(x, y, side)
        assert part.shape == (round(side / cell_m),) * 2
        np.testing.assert_allclose(np.array(part.origin) / cell_m % 1 % (1 - 1e-6), 0, atol=1e-6)
        assert np.all(np.abs(np.array(part.origin) + side / 2 - [x, y]) <= 1.01 * cell_m)
        whole = mapper.grid()
        points = part.centre_of(np.argwhere(np.ones(part.shape)))
        np.testing.assert_allclose(part.probability_at(points), whole.probability_at(points), atol=1e-5)
        assert part.observed.any()


@pytest.mark.parametrize("footprint_m", [0.05, 3.0])
def test_the_floor_of_robots_of_any_size_is_free(footprint_m):
    robot = replace(B21, footprint_radius_m=footprint_m)
    mapper = Mapper(robot, NETWORK, NETWORK.cell_m)
    mapper.add([scan(0.2 * i, 0.1 * i, seed=i) for i in range(3)])
    assert np.all(mapper.grid().probability_at(np.array([[0.0, 0.0], [0.1, 0.0], [0.15, 0.02], [0.2, 0.0]])) < 0.03)


def worth(looks):
    """What looks are worth, of which the first counts one."""
    return -LOOKS * np.expm1(-looks / LOOKS)


@pytest.fixture
def without_standing(monkeypatch):
    """The map holds what the views say and nothing besides."""
    monkeypatch.setattr(set_network, "STOOD", np.inf)


@pytest.mark.usefixtures("without_standing")
@pytest.mark.parametrize("begin", [0.0, -50.0, 1.7e9])
def test_evidence_counts_half_after_a_half_life(begin):
    adds = adding(NETWORK)
    fresh, spoken = near(mapped([scan(begin)], None, adds, adds.cell_m))
    for ages in (1, 3):
        aged = mapped([scan(begin), scan(begin + 10.0 * ages, FAR)], 10.0, adds, adds.cell_m)
        faded, told = near(aged)
        # The looks count half as well, and level off less.
        np.testing.assert_allclose(faded[told], fresh[told] * worth(0.5**ages) / worth(1), rtol=1e-4)
        # Of what has all but faded nothing is told any more.
        assert np.all(np.abs(fresh[spoken & ~told]) <= 1.01 * FORGOTTEN * 2**ages)
        assert not (told & ~spoken).any()
        latest, still = near(aged, FAR)
        np.testing.assert_allclose(latest[still], fresh[still], atol=1e-3)


def test_evidence_of_long_ago_is_forgotten_and_no_number_overflows():
    mapper = Mapper(B21, NETWORK, CELL_M, 1.0)
    for stamp in (0.0, 20.0, 31.0, 40.0, 1e3, 1e6):
        mapper.add([scan(stamp, FAR * (stamp > 0))])
    fresh, _ = near(mapped([scan(0.0)], 1.0))
    assert not near(mapper)[1].any()
    latest, still = near(mapper, FAR)
    assert still.sum() > 1000
    np.testing.assert_allclose(latest[still], fresh[still], atol=1e-3)
    assert np.isfinite(mapper.grid().log_odds).all()


def test_a_pause_of_many_half_lives_in_the_midst_of_scans_overflows_nothing():
    frames = [scan(200.0 * (i > 4) + 0.1 * i, seed=i) for i in range(10)]
    *_, paused = build_map(frames, B21, NETWORK, CELL_M, half_life=1.0)
    *_, after = build_map(frames[5:], B21, NETWORK, CELL_M, half_life=1.0)
    assert after.observed.sum() > 1000
    np.testing.assert_array_equal(paused.observed, after.observed)
    # What the surroundings were like before is remembered, so the two are not quite the same.
    assert np.mean(np.abs(paused.log_odds - after.log_odds)[after.observed]) < 0.5


def test_a_robot_that_stands_for_long_still_believes_what_is_new():
    """The looks that count less and less as they come again fade as well."""
    frames = [scan(0.2 * i) for i in range(300)]
    changed = [*frames, *(scan(60.0 + 0.2 * i, seed=5) for i in range(150))]
    (new, _), (old, _) = near(mapped([scan(0.0, seed=5)])), near(mapped(frames))
    (held, _), (fading, _) = near(mapped(changed)), near(mapped(changed, 5.0))
    apart = np.abs(new - old) > 2
    assert apart.sum() > 100
    closer = np.abs(fading - new)[apart] < np.abs(held - new)[apart]
    assert closer.mean() > 0.9
    assert np.mean(np.sign(fading[apart]) == np.sign(new[apart])) > 0.9


def test_evidence_fades_of_the_set_network_alone():
    with pytest.raises(UsageError, match=r"^map: found model cone, expected the set network"):
        list(build_map([scan(0.0)], B21, "cone", CELL_M, half_life=5.0))


ROOM = """
name: room
walls: [{points: [[0, 0], [4, 0], [4, 3], [0, 3]], closed: true, roughness_mm: 2}]
cylinders: [{centre: CENTRE, radius_m: 0.2}]
"""


def test_a_person_walks_through_and_is_gone():
    """A person stands for 12 s before a robot that goes to and fro, and leaves."""
    t = np.arange(170)
    poses = np.column_stack([1.5 + 0.3 * np.sin(t / 15), np.full(len(t), 1.5), 0.3 * np.sin(t / 9)])
    rooms = (parse_world(ROOM.replace("CENTRE", at), "room") for at in ("[2.6, 1.5]", "[50, 50]"))
    there, gone = (Simulator(room, B21) for room in rooms)
    scans = [*there.frames(poses[:60], 1), *gone.frames(poses[60:], 2)]
    frames = [Frame(0.2 * i, f.pose, f.ranges) for i, f in enumerate(scans)]
    person, walls = np.array([[2.42, 1.48], [2.42, 1.52]]), np.array([[0.02, 1.5], [2.0, 0.02], [1.0, 2.98]])
    for half_life in (None, 5.0):
        mapper = Mapper(B21, NETWORK, half_life=half_life)
        mapper.add(frames[:60])
        assert np.all(mapper.grid().probability_at(person) > 0.8)
        mapper.add(frames[60:])
        left = mapper.grid().probability_at(person)
        assert np.all(left < 0.3) if half_life else np.all(left > 0.4)
        assert np.all(mapper.grid().probability_at(walls) > 0.65)


def test_sonars_that_looked_from_the_mounts_of_the_robot_say_what_they_always_say():
    same = mapped([scan(0.0, mounts=B21.mounts)])
    np.testing.assert_allclose(near(same)[0], near(mapped([scan(0.0)]))[0], atol=1e-5)


def turned(pose):
    """Where the sonars of a robot at a pose look from, seen from the origin."""
    return compose(np.array(pose), B21.mounts)


def test_a_frame_says_from_where_each_sonar_looked():
    """The whole robot turned by 40 degrees when its sonars fired is a robot with another heading."""
    turn = np.deg2rad(40.0)
    told, _ = near(mapped([scan(0.0, mounts=turned([0.0, 0.0, turn]))]))
    true, _ = near(mapped([scan(0.0, theta=turn)]))
    wrong, _ = near(mapped([scan(0.0)]))
    assert np.mean(np.abs(told - true)) < 0.25 * np.mean(np.abs(wrong - true))


def test_other_models_take_a_frame_apart_by_where_its_sonars_looked_from():
    places = np.array([[0.0, 0.0, 0.0], [0.11, 0.02, 0.1], [0.2, 0.0, 0.2]])
    shared = scan(0.0)
    group = np.arange(B21.sonars) % 3
    mounts = np.array([compose(places[k], mount) for k, mount in zip(group, B21.mounts, strict=True)])
    apart = [Frame(0.0, place, np.where(group == k, shared.ranges, nan)) for k, place in enumerate(places)]
    for name in ("cone", "elfes", "em"):
        *_, whole = build_map([replace(shared, mounts=mounts)], B21, name, CELL_M)
        *_, parts = build_map(apart, B21, name, CELL_M)
        points = whole.centre_of(np.argwhere(whole.observed))
        np.testing.assert_allclose(whole.probability_at(points), parts.probability_at(points), atol=1e-3)
        assert whole.observed.sum() == parts.observed.sum() > 200


def test_what_is_prepared_ahead_is_fused_as_if_one_after_the_other():
    frames = [scan(3.0 * i, 0.1 * i, seed=i) for i in range(40)]
    ahead = Mapper(B21, NETWORK, CELL_M, 1.0)
    waiting = [ahead.prepare([frame]) for frame in frames]
    for each in waiting:
        ahead.fuse(each())
    np.testing.assert_allclose(ahead.grid().log_odds, mapped(frames, 1.0).grid().log_odds, atol=1e-4)


def test_a_scan_that_heard_nothing_at_all_and_one_that_did_not_fire_are_taken():
    mapper = Mapper(B21, NETWORK, CELL_M)
    mapper.add([Frame(0.0, np.zeros(3), np.full(B21.sonars, nan)), Frame(0.1, np.zeros(3), np.full(B21.sonars, inf))])
    assert mapper.grid().probability_at(np.zeros((1, 2)))[0] < 0.3


def test_the_layers_of_the_map_add_up():
    """Evidence for and against lies apart, so that none is ever below nothing."""
    mapper = mapped([scan(0.2 * i, seed=i) for i in range(4)])
    layers = mapper._grown.layers()
    assert all(np.all(layers[name] >= 0) for name in SUMS)
    for one, square in pairwise(["occupied", "occupied2"]):
        assert np.all((layers[one] > 0) == (layers[square] > 0))
