import io
import pickle
import re
import zipfile
from itertools import pairwise
from math import inf, nan, pi

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.geometry import wrap
from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.local_map import local_cells
from echogrid.models.networks.paper_layers import beyond_features, forward, look, reading_features
from echogrid.models.networks.paper_network import (
    LIMIT,
    MOST_ZONE,
    Layers,
    Network,
    inputs,
    place_features,
    zone_of,
)
from echogrid.robot import Robot, parse_robot

B21, P3DX = Robot.load("b21"), Robot.load("p3dx")
TRIO = parse_robot(
    """
name: trio
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.1, max_range_m: 4, beam_width_deg: 30}
mounts: [[0.1, 0, 0], [0, 0.1, 90], [0, -0.1, -90]]
""",
    "trio",
)


def random_network(seed=0, hidden=(16, 8), prior=0.2, zone=4):
    rng = np.random.default_rng(seed)
    sizes = [inputs(zone), *hidden, 1]
    layers: Layers = [
        (rng.normal(0, 1.6 / np.sqrt(m), (m, n)).astype(np.float32), rng.normal(0, 0.3, n).astype(np.float32))
        for m, n in pairwise(sizes)
    ]
    return Network(layers, prior, {"seed": seed})


def random_scans(sonars, count=6, seed=0):
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.2, 5, (count, sonars))
    ranges[rng.random(ranges.shape) < 0.2] = inf
    ranges[rng.random(ranges.shape) < 0.2] = nan
    return ranges.astype(np.float32)


def off_axes(mounts, point):
    to = point - mounts[:, :2]
    return wrap(np.arctan2(to[:, 1], to[:, 0]) - mounts[:, 2])


@settings(max_examples=60)
@given(st.sampled_from([B21, P3DX]), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.integers(1, MOST_ZONE))
def test_the_zone_is_of_the_sonars_nearest_in_bearing_from_left_to_right(robot, x, y, size):
    point = np.array([x, y])
    off = off_axes(robot.mounts, point)
    zone = zone_of(robot.mounts, point, size)
    assert len(set(zone.sonar.tolist())) == size
    np.testing.assert_allclose(np.sort(np.abs(zone.off_axis)), np.sort(np.abs(off))[:size])
    np.testing.assert_allclose(zone.off_axis, off[zone.sonar])
    assert np.all(np.diff(zone.off_axis) <= 0)
    np.testing.assert_allclose(zone.distance, np.hypot(*(point - robot.mounts[zone.sonar, :2]).T))


@pytest.mark.parametrize("k", range(24))
def test_on_the_b21_the_zone_of_a_point_between_two_axes_is_two_to_each_side(k):
    bearing = np.deg2rad(180 - 15 * k)
    zone = zone_of(B21.mounts, 1.5 * np.array([np.cos(bearing), np.sin(bearing)]))
    assert zone.sonar.tolist() == [(k + 1) % 24, k % 24, (k - 1) % 24, (k - 2) % 24]
    assert np.all(zone.off_axis[:2] > 0)
    assert np.all(zone.off_axis[2:] < 0)
    np.testing.assert_allclose(zone.off_axis, -zone.off_axis[::-1], atol=2e-3)


def test_the_zone_of_a_turned_robot_is_the_zone_turned():
    points = local_cells()
    T = np.array([[np.cos(pi / 12), np.sin(pi / 12)], [-np.sin(pi / 12), np.cos(pi / 12)]])
    here, there = zone_of(B21.mounts, points), zone_of(B21.mounts, points @ T)
    same = np.all((here.sonar - 1) % 24 == there.sonar, axis=1)
    assert same.mean() > 0.95
    np.testing.assert_allclose(here.distance[same], there.distance[same], atol=1e-3)


def test_a_sonar_that_is_not_there_takes_the_last_of_the_places():
    zone = zone_of(TRIO.mounts, np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert sorted(zone.sonar[0].tolist()) == sorted(zone.sonar[1].tolist()) == [-1, 0, 1, 2]
    missing = zone.sonar == -1
    assert np.all(np.abs(zone.off_axis[missing]) == pi)
    one = zone_of(TRIO.mounts[:1], np.array([[1.0, 0.2]]))
    assert sorted(one.sonar[0].tolist()) == [-1, -1, -1, 0]
    assert sorted(zone_of(TRIO.mounts, np.array([1.0, 0.2]), 8).sonar.tolist()) == [-1] * 5 + [0, 1, 2]


def test_the_features_of_readings_worked_by_hand():
    coded = reading_features(jnp.array([1.0, inf, nan, 9.0]))
    np.testing.assert_allclose(coded, [1, 0, 0, 1, 0, 1, 0, 0, 0.5, 0, 0, 2])


def test_the_features_of_what_lies_beyond_worked_by_hand():
    distance = jnp.array([1.0, 1.0, 1.0, 1.1])
    coarse_and_fine = beyond_features(jnp.array([1.3, inf, nan, 1.0]), distance)
    np.testing.assert_allclose(coarse_and_fine, [0.5, 0, 0, -1 / 6, 0, 0, 0, 0.5], atol=1e-6)
    np.testing.assert_allclose(
        beyond_features(jnp.array([9.0, 0.1, 1.0, 1.1]), distance), [1, -1, 0, 0, 0, 0, 1, 1], atol=1e-6
    )


def test_the_features_of_a_place_worked_by_hand():
    coded = place_features(jnp.array([0.4, 0.0, -0.8, -3.0]), jnp.array([1.0, 1.2, 1.4, 1.6]))
    np.testing.assert_allclose(coded, [0.5, 0, -1, -2, 1.3], atol=1e-6)


def test_the_perceptron_is_its_matrices():
    network = random_network()
    x = np.random.default_rng(1).normal(0, 1, (50, inputs())).astype(np.float32)
    (w0, b0), (w1, b1), (w2, b2) = network.layers
    plain = np.maximum(np.maximum(x @ w0 + b0, 0) @ w1 + b1, 0) @ w2 + b2
    np.testing.assert_allclose(
        forward(network.layers, jnp.asarray(x)), LIMIT * np.tanh(plain[:, 0] / LIMIT), atol=1e-4
    )
    assert np.std(plain) > 0.5


@pytest.mark.parametrize("robot", [B21, P3DX, TRIO], ids=lambda robot: robot.name)
@pytest.mark.parametrize(("seed", "size"), [(0, 4), (1, 4), (2, 4), (3, 1), (3, 2), (3, 7), (3, 8)])
def test_the_bound_network_says_what_a_look_at_plain_features_says(robot, seed, size):
    network, points = random_network(seed, zone=size), local_cells()
    ranges = random_scans(robot.sonars, seed=seed)
    p, spoken = network.bind(robot, points)(ranges)
    zone = zone_of(robot.mounts, points, size)
    with_missing = np.pad(ranges, [(0, 0), (0, 1)], constant_values=nan)
    reading = with_missing[:, zone.sonar]
    everywhere = [np.broadcast_to(v, reading.shape).astype(np.float32) for v in (zone.off_axis, zone.distance)]
    plain_p, plain_spoken = look(network.layers, network.prior, jnp.asarray(reading), *map(jnp.asarray, everywhere))
    np.testing.assert_array_equal(spoken, plain_spoken)
    np.testing.assert_allclose(p, plain_p, atol=1e-5)
    assert np.std(np.asarray(p)[np.asarray(spoken)]) > 0.05


@pytest.mark.parametrize("robot", [B21, P3DX, TRIO], ids=lambda robot: robot.name)
def test_a_scan_in_which_no_sonar_fired_says_nothing(robot):
    model = random_network()
    p, spoken = model.bind(robot, local_cells())(np.full((6, robot.sonars), nan, np.float32))
    assert not np.any(spoken)
    np.testing.assert_allclose(p, model.prior, atol=1e-7)


@pytest.mark.parametrize("robot", [P3DX, TRIO], ids=lambda robot: robot.name)
def test_points_that_no_sonar_looks_at_keep_the_prior(robot):
    model, points = random_network(), local_cells()
    blind = np.array([np.abs(off_axes(robot.mounts, point)).min() > LOOK_RAD for point in points])
    p, spoken = (np.asarray(v) for v in model.bind(robot, points)(random_scans(robot.sonars)))
    assert blind.any()
    assert not np.any(spoken[:, blind])
    np.testing.assert_allclose(p[:, blind], model.prior, atol=1e-7)
    np.testing.assert_allclose(p[~spoken], model.prior, atol=1e-7)
    assert np.any(spoken)


def test_the_network_speaks_where_a_sonar_that_fired_looks_and_only_there():
    points = local_cells()
    ranges = np.full((1, 24), nan, dtype=np.float32)
    ranges[0, 5] = inf
    _, spoken = random_network().bind(B21, points)(ranges)
    off = np.array([off_axes(B21.mounts, point)[5] for point in points])
    in_zone = np.any(zone_of(B21.mounts, points).sonar == 5, axis=1)
    np.testing.assert_array_equal(spoken[0], (np.abs(off) <= LOOK_RAD) & in_zone)


def test_each_scan_is_interpreted_by_itself():
    ranges = random_scans(24)
    ask = random_network().bind(B21, local_cells())
    p, spoken = ask(ranges)
    turned = ask(ranges[::-1])
    np.testing.assert_allclose(turned[0][::-1], p, atol=1e-6)
    np.testing.assert_array_equal(turned[1][::-1], spoken)


def test_no_look_is_more_certain_than_the_limit():
    network = random_network()
    loud = [(w * 100, b) for w, b in network.layers]
    p, _ = Network(loud, 0.2, {}).bind(B21, local_cells())(random_scans(24))
    assert np.min(p) >= 1 / (1 + np.exp(LIMIT)) - 1e-6
    assert np.max(p) <= 1 / (1 + np.exp(-LIMIT)) + 1e-6
    assert np.max(p) > 0.95


def test_weights_that_are_saved_are_loaded(tmp_path):
    network = random_network(prior=0.37)
    network.save(tmp_path / "some.npz")
    loaded = Network.load(tmp_path / "some.npz")
    assert (loaded.prior, loaded.recipe, loaded.name) == (0.37, {"seed": 0}, "some")
    for (w, b), (v, c) in zip(network.layers, loaded.layers, strict=True):
        np.testing.assert_array_equal(w, v)
        np.testing.assert_array_equal(b, c)


@pytest.mark.parametrize("size", range(1, MOST_ZONE + 1))
def test_weights_know_how_many_sonars_they_read(tmp_path, size):
    random_network(zone=size).save(tmp_path / "some.npz")
    assert Network.load(tmp_path / "some.npz").zone == size


@pytest.mark.parametrize("size", [0, MOST_ZONE + 1])
def test_weights_for_no_sonar_or_for_too_many_are_refused_with_their_sizes(tmp_path, size):
    path = tmp_path / "some.npz"
    random_network(zone=size).save(path)
    message = (
        rf"^{re.escape(str(path))}: found layers \[{6 * size + 1}, 16, 8, 1\], expected .* 7, 13, \.\. or 49 inputs"
    )
    with pytest.raises(InputError, match=message):
        Network.load(path)


def saved(**changes):
    """The bytes of a weights file with some of its arrays replaced, or without those that are None."""
    network = random_network()
    arrays = {f"{k}{i}": v for i, wb in enumerate(network.layers) for k, v in zip("wb", wb, strict=True)}
    arrays |= {"format": "echogrid-mlp-1", "prior": 0.2, "recipe": "{}"} | changes
    file = io.BytesIO()
    np.savez(file, **{k: v for k, v in arrays.items() if v is not None})
    return file.getvalue()


GOOD = saved()
W0, B0 = random_network().layers[0]

DAMAGED = {
    "nothing": b"",
    "a text": b"weights: 1\n",
    "the first half": GOOD[: len(GOOD) // 2],
    "all but the end": GOOD[:-30],
    "a pickle": pickle.dumps({"w0": W0}),
    "an array alone": (lambda f: (np.save(f, W0), f.getvalue())[1])(io.BytesIO()),
    "another format": saved(format="echogrid-mlp-9"),
    "no format": saved(format=None),
    "no prior": saved(prior=None),
    "no recipe": saved(recipe=None),
    "a recipe that is no JSON": saved(recipe="{"),
    "a layer missing": saved(w1=None, b1=None),
    "a bias missing": saved(b1=None),
    "a layer too many": saved(w3=np.ones((1, 1)), b3=np.ones(1)),
    "too few inputs": saved(w0=W0[:-1]),
    "layers that do not fit": saved(w0=W0[:, :-1]),
    "a bias that does not fit": saved(b0=B0[:-1]),
    "a matrix with three axes": saved(w0=W0[None]),
    "a matrix with no axis": saved(w0=np.float32(1)),
    "axes moved from one matrix to another": saved(w0=W0[None], w1=np.ones(8, dtype=np.float32)),
    "weights that are text": saved(w0=W0.astype(str)),
    "two outputs": saved(w2=np.ones((8, 2)), b2=np.ones(2)),
    "a weight that is no number": saved(w0=np.where(W0[0, 0] == W0, np.float32(nan), W0)),
    "an infinite bias": saved(b0=B0 * np.float32(inf)),
    "a prior of 0": saved(prior=0.0),
    "a prior that is no number": saved(prior=nan),
    "a prior of many": saved(prior=np.ones(3) / 2),
    "weights that are objects": saved(w0=W0.astype(object)),
    "a folder in the archive": (lambda f: (zipfile.ZipFile(f, "w").close(), f.getvalue())[1])(io.BytesIO()),
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_damaged_weights_are_one_line(tmp_path, kind):
    path = tmp_path / "weights.npz"
    path.write_bytes(DAMAGED[kind])
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: found .*, expected ") as raised:
        Network.load(path)
    assert "\n" not in str(raised.value)


def test_weights_that_are_not_there_are_one_line(tmp_path):
    with pytest.raises(UsageError, match=r"^weights: found no file .*none\.npz, expected a weights file"):
        Network.load(tmp_path / "none.npz")
    with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path))}: found"):
        Network.load(tmp_path)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, len(GOOD) - 1), st.binary(min_size=1, max_size=4))
def test_weights_with_some_bytes_changed_are_read_or_refused_in_our_words(tmp_path, at, junk):
    path = tmp_path / "weights.npz"
    path.write_bytes(GOOD[:at] + junk + GOOD[at + len(junk) :])
    message = ""
    try:
        Network.load(path)
    except EchogridError as error:
        message = str(error)
    assert "\n" not in message
