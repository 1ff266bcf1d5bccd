from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echogrid.mapping.registry import sensor_model
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.models.networks import set_layers
from echogrid.models.networks.set_layers import fused, initial, nearest, saturated
from echogrid.models.networks.set_network import SetNetwork
from echogrid.training import drives, set_training
from echogrid.training import gradient_descent as descent
from echogrid.training.gradient_descent import descend, train
from echogrid.training.set_lessons import FRAMES, POINTS, REACH_M, Lessons, lessons
from echogrid.training.set_training import (
    BEHIND_WEIGHT,
    FAR_WEIGHT,
    HIDDEN_WEIGHT,
    NEAR_WEIGHT,
    SINGLE_WEIGHT,
    SURFACE_WEIGHT,
    VIEWS,
    SetRecipe,
    look,
    map_loss,
    orders,
)

DRIVES = 4
RECIPE = SetRecipe(drives=DRIVES, epochs=3, hidden=6, batch=2, seed=5)


class StoppedError(Exception):
    pass


TOKENS = 3


@pytest.fixture(scope="module", autouse=True)
def few_tokens():
    """What is differentiated is written out token by token, and takes the compiler as long as there are many."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(set_layers, "TOKENS", TOKENS)
        yield


@pytest.fixture(scope="module")
def made():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drives, "_CHUNK", DRIVES)
        return lessons(None, DRIVES, seed=3)


@pytest.fixture(scope="module")
def weights():
    """A network that says this and that."""
    rng = np.random.default_rng(0)
    some = initial(rng, RECIPE.hidden)
    return {
        name: jnp.asarray(value * (10 if name in ("wp", "wr") else 1) + rng.normal(0, 0.1, value.shape), jnp.float32)
        for name, value in some.items()
    }


@pytest.fixture(scope="module")
def trained(made):
    return RECIPE.fit(made, None, "", False)


def batch_of(made, count=2):
    """The fields of some drives and the sonars of their bearings, as the loss takes them."""
    return tuple(jnp.asarray(v[:count]) for v in (*made, orders(made)))


look_of = jax.jit(look)


@jax.jit
def loss_and_slope(weights, batch, key, step):
    """The loss, and what it gains by a step of its weights: one compilation for both."""
    return jax.jvp(lambda w: map_loss(w, batch, key), (weights,), (step,))


def loss_of(weights, batch, seed=0):
    return float(loss_and_slope(weights, batch, jax.random.key(seed), weights)[0])


def seen_from_few(made):
    """The drives with all frames after the first VIEWS far away: each point is looked at from all that reach it."""
    poses = made.poses.copy()
    poses[:, VIEWS:, :2] += 1000
    return made._replace(poses=poses)


def plain_loss(weights, batch):
    """The loss once more, point by point and frame by frame; no point is reached from more than VIEWS frames."""
    drives, order = Lessons(*batch[:-1]), batch[-1]
    points, poses = np.asarray(drives.points, dtype=float), np.asarray(drives.poses, dtype=float)
    to = points[:, :, None] - poses[:, None, :, :2]
    c, s = np.cos(poses[:, None, :, 2]), np.sin(poses[:, None, :, 2])
    x, y = c * to[..., 0] + s * to[..., 1], c * to[..., 1] - s * to[..., 0]
    frame = np.broadcast_to(np.arange(FRAMES), x.shape)
    told = [v[..., :VIEWS] for v in (frame, x, y)]
    found, spoken = look_of(weights, drives, order, *(jnp.asarray(v, t) for v, t in zip(told, "iff", strict=True)))
    found, spoken = np.asarray(found, dtype=float), np.asarray(spoken)
    target = {SURFACE: 1.0, FREE: 0.0, HIDDEN: 0.5}
    shares = np.repeat([SURFACE_WEIGHT, NEAR_WEIGHT, FAR_WEIGHT, BEHIND_WEIGHT, HIDDEN_WEIGHT], POINTS)
    shares = shares / np.repeat(POINTS, POINTS)

    def error(z, target):
        return np.logaddexp(0, z) - target * z

    fused = fused_weight = single = single_weight = 0.0
    for d in range(len(points)):
        for p in range(points.shape[1]):
            views = [v for v in range(VIEWS) if np.hypot(x[d, p, v], y[d, p, v]) < REACH_M]
            aim, told = target[int(drives.label[d, p])], [v for v in views if spoken[d, p, v]]
            if not told:
                continue
            said = found[d, p, told]
            counts = np.asarray(drives.weight, dtype=float)[d, told]
            total = log_odds_of(weights, said, counts)
            fused += shares[p] * error(total, aim)
            fused_weight += shares[p]
            single += np.sum(shares[p] * error(said, aim))
            single_weight += shares[p] * len(told)
    return fused / fused_weight + SINGLE_WEIGHT * single / single_weight


def log_odds_of(weights, said, counts):
    """What the map holds of a point of which scans that count so much say so much."""
    sides = [np.array([np.sum(counts * np.maximum(s * said, 0) ** k)]) for k in (1, 2) for s in (1, -1)]
    sides = saturated(np.array([np.sum(counts)]), *sides, xp=np)
    return float(fused({name: np.asarray(value, dtype=float) for name, value in weights.items()}, *sides, np)[0])


def test_the_sonars_of_bearings_are_those_of_each_drive(made):
    order = orders(made)
    bearings = order.shape[1]
    assert order.shape == (DRIVES, bearings, TOKENS)
    bearing = np.arange(bearings) * (2 * np.pi / bearings)
    for mounts, row in zip(made.mounts, order, strict=True):
        there = mounts[~np.isnan(mounts[:, 0])].astype(float)
        np.testing.assert_array_equal(row, nearest(there, bearing))
        assert row.max() < len(there)


@pytest.mark.parametrize("drives", [slice(0, 2), slice(2, 4)], ids=["two drives", "two others"])
def test_the_loss_is_the_one_that_its_words_say(made, weights, drives):
    batch = tuple(v[drives] for v in batch_of(seen_from_few(made), DRIVES))
    assert loss_of(weights, batch) == pytest.approx(plain_loss(weights, batch), rel=1e-3)


def test_which_frames_are_drawn_matters_only_where_there_are_more_than_are_looked_from(made, weights):
    few, all_ = batch_of(seen_from_few(made)), batch_of(made)
    assert loss_of(weights, few, 1) == pytest.approx(loss_of(weights, few, 2), rel=1e-5)
    losses = [loss_of(weights, all_, seed) for seed in range(8)]
    assert 1e-4 < np.std(losses) < 0.2 * np.mean(losses)


def test_frames_that_are_drawn_stand_for_all(made, weights):
    # A robot that stands still and hears the same: whichever frames are drawn, all say the same.
    still = {name: np.repeat(getattr(made, name)[:, :1], FRAMES, axis=1) for name in ("ranges", "poses", "traits")}
    weight = np.tile(np.float32(1) / np.arange(1, FRAMES + 1, dtype=np.float32), (DRIVES, 1))
    batch = batch_of(made._replace(**still, weight=weight))
    losses = [loss_of(weights, batch, seed) for seed in range(3)]
    np.testing.assert_allclose(losses, losses[0], rtol=1e-4)
    # As if it had been looked at VIEWS times, each view counting its share of the whole.
    once = weight.sum(axis=1, keepdims=True) / VIEWS * np.ones_like(weight)
    few = batch_of(seen_from_few(made._replace(**still, weight=once)))
    assert loss_of(weights, few) == pytest.approx(losses[0], rel=1e-4)


def test_weights_that_say_nothing_cost_log_2(made, weights):
    silent = {name: jnp.zeros_like(value) for name, value in weights.items()}
    for batch in (batch_of(made), batch_of(seen_from_few(made))):
        assert loss_of(silent, batch) == pytest.approx((1 + SINGLE_WEIGHT) * np.log(2), rel=1e-5)


def test_weights_begin_near_to_saying_nothing(made):
    begun = initial(np.random.default_rng(1), RECIPE.hidden)
    # Views that all lean to one side add up.
    assert loss_of(jax.tree.map(jnp.asarray, begun), batch_of(made)) < 3 * np.log(2)


def test_the_slope_of_the_loss_agrees_with_finite_differences(made, weights):
    batch, key = batch_of(made), jax.random.key(1)
    rng = np.random.default_rng(1)
    agree = []
    for _ in range(4):
        step = {name: rng.normal(0, 1, value.shape).astype(np.float32) for name, value in weights.items()}
        slope = loss_and_slope(weights, batch, key, step)[1]
        ahead, behind = (
            loss_and_slope({n: v + np.float32(h) * step[n] for n, v in weights.items()}, batch, key, step)[0]
            for h in (1e-3, -1e-3)
        )
        agree.append((float(slope), float(ahead - behind) / 2e-3))
    slopes, differences = np.array(agree).T
    np.testing.assert_allclose(slopes, differences, atol=0.02 * np.abs(slopes).max())


def test_training_moves_every_weight_a_little(trained):
    begun = initial(np.random.default_rng(RECIPE.seed), RECIPE.hidden)
    moved = {name: np.abs(value - begun[name]).max() for name, value in trained.weights.items()}
    assert [name for name, far in moved.items() if not 1e-5 < far < 1] == []


def random_looks(made, seed=0):
    """Frames and points (robot frame, m) for two drives, as many as the loss takes."""
    rng = np.random.default_rng(seed)
    shape = (2, sum(POINTS), VIEWS)
    distance, bearing = rng.uniform(0.3, REACH_M, shape), rng.uniform(-np.pi, np.pi, shape)
    return rng.integers(0, FRAMES, shape), distance * np.cos(bearing), distance * np.sin(bearing)


def looked(weights, made, frame, x, y):
    *drives, order = batch_of(made)
    told = (jnp.asarray(v, t) for v, t in zip((frame, x, y), "iff", strict=True))
    found, spoken = look_of(weights, Lessons(*drives), order, *told)
    return np.asarray(found), np.asarray(spoken)


def test_where_no_sonar_that_fired_looks_nothing_is_said(made, weights):
    found, spoken = looked(weights, made, *random_looks(made))
    assert np.all(found[~spoken] == 0)
    assert np.all(found[spoken] != 0)
    assert 0.2 < spoken.mean() < 0.98
    dumb = made._replace(ranges=np.full_like(made.ranges, np.nan))
    assert not np.any(looked(weights, dumb, *random_looks(made))[1])


@pytest.mark.parametrize("steps", [0, 1, 50, 0.4, 77.7])
def test_a_look_does_not_depend_on_the_frame_of_the_robot_nor_on_left_and_right(made, weights, steps):
    frame, x, y = random_looks(made)
    here = looked(weights, made, frame, x, y)
    side, angle = (-1, 0.0) if steps == 0 else (1, steps * 2 * np.pi / orders(made).shape[1])
    c, s = np.cos(angle), np.sin(angle)
    mounts = made.mounts.astype(float) * [1, side, side]
    turned = np.stack(
        [c * mounts[..., 0] - s * mounts[..., 1], s * mounts[..., 0] + c * mounts[..., 1], mounts[..., 2] + angle], -1
    )
    at = (c * x - s * side * y, s * x + c * side * y)
    there = looked(weights, made._replace(mounts=turned.astype(np.float32)), frame, *at)
    same = np.isclose(there[0], here[0], atol=2e-3) & (there[1] == here[1])
    # Other sonars are asked where a seam between bearings lies elsewhere, and rounding decides between two that are
    # as near.
    assert same.mean() > (0.97 if steps == round(steps) else 0.85)
    assert np.std(here[0]) > 0.2


def test_training_brings_the_loss_down(trained):
    losses = trained.recipe["losses"]
    assert len(losses) == RECIPE.epochs
    assert losses[-1] < losses[0]
    assert {v.dtype for v in trained.weights.values()} == {np.dtype(np.float32)}


def same_weights(a, b):
    return a.weights.keys() == b.weights.keys() and all(np.array_equal(a.weights[n], b.weights[n]) for n in a.weights)


def test_training_that_was_stopped_ends_with_the_weights_of_an_uninterrupted_run(
    made, trained, tmp_path, monkeypatch
):
    checkpoint, write = tmp_path / "state.npz", descent._write_arrays

    def stop_in_the_second_epoch(path, key, arrays):
        if len(arrays[0]) == 2:
            raise StoppedError
        write(path, key, arrays)

    with monkeypatch.context() as patch:
        patch.setattr(descent, "_write_arrays", stop_in_the_second_epoch)
        with pytest.raises(StoppedError):
            RECIPE.fit(made, checkpoint, "key", False)
    resumed = RECIPE.fit(made, checkpoint, "key", False)
    assert same_weights(resumed, trained)
    assert resumed.recipe == trained.recipe
    # What is finished is the result, without a step.
    monkeypatch.setattr(descent, "_step", None)
    assert same_weights(RECIPE.fit(made, checkpoint, "key", False), trained)


def test_train_takes_up_the_lessons_that_wait_and_writes_a_model_that_says_how_it_was_made(
    made, trained, tmp_path, monkeypatch
):
    asked = []

    def stop(*_):
        raise StoppedError

    monkeypatch.setattr(set_training, "lessons", lambda *_: asked.append(1) or made)
    monkeypatch.setattr(SetRecipe, "then", lambda *_: None)  # what comes after has tests of its own
    with monkeypatch.context() as patch:
        patch.setattr(set_training, "descend", stop)
        with pytest.raises(StoppedError):
            train(None, RECIPE, tmp_path / "mine.npz")
    assert not (tmp_path / "mine.npz").exists()
    network = train(None, RECIPE, tmp_path / "mine.npz")
    assert len(asked) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npz"]
    model = sensor_model(str(tmp_path / "mine.npz"))
    assert isinstance(model, SetNetwork)
    # The same recipe and lessons give the same weights.
    assert same_weights(model, trained)
    assert same_weights(network, trained)
    told = model.recipe
    assert (told["network"], told["robot"], told["epochs"], told["hidden"]) == ("set", "any", 3, RECIPE.hidden)
    assert told["losses"] == trained.recipe["losses"]


def test_descent_finds_the_middle(tmp_path):
    """Of a parabola; what is drawn comes to the loss."""
    drawn = []

    def parabola(weights, batch, shift):
        return jnp.mean((weights["w"] - batch[0] - 0 * shift) ** 2)

    def draw(rng, count):
        drawn.append(count)
        return (jnp.asarray(rng.random()),)

    recipe = replace(RECIPE, epochs=300, drives=10, batch=4, learning_rate=0.1)
    found, losses = descend(
        {"w": np.zeros(1, np.float32)}, (np.arange(10, dtype=np.float32),), parabola, draw, recipe
    )
    assert found["w"][0] == pytest.approx(4.5, abs=0.4)
    assert len(losses) == 300
    assert len(drawn) == 600
    assert set(drawn) == {4}
