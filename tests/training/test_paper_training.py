from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echogrid.errors import UsageError
from echogrid.metrics import FREE, HIDDEN, SURFACE
from echogrid.models.model import LOOK_RAD
from echogrid.models.networks.local_map import LOCAL_CELLS
from echogrid.models.networks.paper_layers import forward, surrounding
from echogrid.models.networks.paper_network import LIMIT, Network, inputs
from echogrid.robot import Robot
from echogrid.simulation.drive import truth_of
from echogrid.simulation.rooms import SHAPES, random_world
from echogrid.training import drives as driving
from echogrid.training import gradient_descent as descent
from echogrid.training import paper_examples as making
from echogrid.training import paper_training as training
from echogrid.training.gradient_descent import train
from echogrid.training.paper_examples import FRAMES, POINTS, VIEWS, Examples, random_way
from echogrid.training.paper_training import PRIOR, PaperRecipe, fit, initial, loss

RECIPE = PaperRecipe(drives=16, epochs=3, hidden=(8, 4), batch=4, seed=5)
TRIO = Robot.load("p3dx")


class StoppedError(Exception):
    pass


@pytest.fixture(scope="module", autouse=True)
def small_chunks():
    """Few drives are simulated together, so that few drives are quick and make several chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "_CHUNK", 4)
        yield


@pytest.fixture(scope="module")
def examples():
    return making.generate(None, 16, seed=3)


@pytest.fixture(scope="module")
def drives(examples):
    """A few of the drives as JAX arrays."""
    return Examples(*(jnp.asarray(v[:4]) for v in examples))


@pytest.fixture(scope="module")
def layers():
    """A network that says this and that, round its prior."""
    rng = np.random.default_rng(0)
    sizes = [inputs(), 8, 4, 1]
    random = [(rng.normal(0, 1.2 / np.sqrt(m), (m, n)), rng.normal(0, 0.3, n)) for m, n in pairwise(sizes)]
    random[-1][1][:] = np.log(PRIOR / (1 - PRIOR))
    return [(jnp.asarray(w, jnp.float32), jnp.asarray(b, jnp.float32)) for w, b in random]


@pytest.fixture(scope="module")
def recipe():
    return RECIPE


@pytest.fixture(scope="module")
def trained(examples, recipe):
    return fit(examples, recipe)


PLAIN, FLIPPED = jnp.zeros(4, dtype=bool), jnp.ones(4, dtype=bool)
ONCE = jnp.ones(4)
REPEATED = jnp.array([1.0, 2.0, 5.0, 8.0])


@jax.jit
def loss_of(layers, drives, flip, repeat):
    return loss(layers, drives, PRIOR, flip, repeat)


gradient_of = jax.jit(jax.grad(loss_of))


def same_weights(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a.layers), jax.tree.leaves(b.layers), strict=True)
    )


def test_labels_are_surface_free_or_hidden_in_fixed_numbers(examples):
    assert set(np.unique(examples.label)) == {FREE, SURFACE, HIDDEN}
    for label in examples.label:
        counts = [np.sum(label == kind) for kind in (SURFACE, FREE, HIDDEN)]
        assert counts == [POINTS[0], POINTS[1] + POINTS[2], POINTS[3]]


def test_examples_have_the_shapes_that_they_promise(examples):
    frames, points = (16, FRAMES), (16, sum(POINTS))
    assert examples.ranges.shape == (*frames, 25)
    assert examples.sonar.shape == examples.off_axis.shape == examples.distance.shape == (16, LOCAL_CELLS**2, 4)
    assert examples.frame.shape == (*points, VIEWS)
    assert examples.at.shape == (*points, VIEWS, 2)
    assert examples.label.shape == points


def test_the_last_column_of_the_readings_is_the_sonar_that_is_not_there(examples):
    assert np.all(np.isnan(examples.ranges[..., -1]))
    assert examples.sonar.min() >= 0
    assert examples.sonar.max() <= 24
    assert np.isfinite(examples.ranges).any()
    assert np.isposinf(examples.ranges).any()
    assert np.nanmin(examples.ranges) > 0


def test_every_look_is_from_a_frame_whose_local_map_holds_the_point(examples):
    there = examples.frame >= 0
    assert examples.frame.max() < FRAMES
    assert np.all((examples.at[there] >= 0) & (examples.at[there] <= LOCAL_CELLS - 1))
    assert there.any(axis=-1).mean() > 0.9
    for frame, held in zip(examples.frame.reshape(-1, VIEWS), there.reshape(-1, VIEWS), strict=True):
        assert len(set(frame[held])) == held.sum()


def test_a_seed_gives_the_same_examples_however_many_are_asked_for(examples):
    for some, all_ in zip(making.generate(None, 5, seed=3), examples, strict=True):
        np.testing.assert_array_equal(some, all_[:5])


def test_another_seed_gives_other_examples(examples):
    other = making.generate(None, 4, seed=4)
    assert not np.array_equal(examples.at[:4], other.at)
    assert not np.array_equal(examples.ranges[:4], other.ranges, equal_nan=True)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_training_drive_keeps_its_clearance(shape):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        world = random_world(rng, shape)
        poses = random_way(rng, world, 0.25)
        if poses is not None:
            assert poses.shape == (FRAMES, 3)
            assert world.clearance(poses[:, :2]).min() > 0.25
            assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() <= 0.2 + 1e-9


def plain_loss(layers, drives, flip, repeat, squared_error=False, through_map=True):
    """The loss once more, look by look, with numpy."""

    def logit(p):
        return np.log(p / (1 - p))

    def look(reading, off_axis, distance):
        echo = np.isfinite(reading)
        beyond = np.where(echo, reading, 0) - distance
        told = [echo, np.isinf(reading), np.where(echo, np.minimum(reading, 4) / 2, 0)]
        told.append(np.where(echo, np.clip(beyond / 0.6, -1, 1), 0))
        told.append(np.where(echo, np.maximum(0, 1 - np.abs(beyond) / 0.2), 0))
        told += [np.clip(off_axis / 0.8, -2, 2), distance.mean(axis=-1, keepdims=True)]
        x = np.concatenate(told, axis=-1)
        for w, b in layers[:-1]:
            x = np.maximum(x @ w + b, 0)
        z = LIMIT * np.tanh((x @ layers[-1][0] + layers[-1][1])[..., 0] / LIMIT)
        looked = np.any(~np.isnan(reading) & (np.abs(off_axis) <= LOOK_RAD), axis=-1)
        return np.where(looked, 1 / (1 + np.exp(-z)), PRIOR)

    def error(z, target):
        return (1 / (1 + np.exp(-z)) - target) ** 2 if squared_error else np.logaddexp(0, z) - target * z

    target = {SURFACE: 1.0, FREE: 0.0, HIDDEN: 0.5}
    single_target = {SURFACE: 1.0, FREE: 0.0, HIDDEN: PRIOR}
    free = POINTS[1] + POINTS[2]
    weight = {
        SURFACE: training.SURFACE_WEIGHT / POINTS[0],
        FREE: 1 / free,
        HIDDEN: training.HIDDEN_WEIGHT / POINTS[3],
    }
    single_weight = {SURFACE: PRIOR / POINTS[0], FREE: (1 - PRIOR) / free, HIDDEN: training.HIDDEN_WEIGHT / POINTS[3]}
    fused = single = fused_weight = single_sum = 0.0
    for d in range(len(drives.label)):
        ranges, off, dist = (np.asarray(v[d], dtype=float) for v in (drives.ranges, drives.off_axis, drives.distance))
        for k in range(drives.label.shape[1]):
            kind, evidence, there = int(drives.label[d, k]), 0.0, False
            for v in range(VIEWS):
                f = int(drives.frame[d, k, v])
                if f < 0:
                    continue
                there = True
                x, y = np.asarray(drives.at[d, k, v], dtype=float)
                col, row = min(int(x), LOCAL_CELLS - 2), min(int(y), LOCAL_CELLS - 2)
                near = [(col + i, row + j) for i in (0, 1) for j in (0, 1)]
                share = np.array([1 / max(np.hypot(x - i, y - j), 1e-6) for i, j in near])
                cells = [j * LOCAL_CELLS + i for i, j in near]
                side = -1 if flip[d] else 1
                reading = ranges[f, np.asarray(drives.sonar[d])[cells]]
                answers = look(reading[:, ::side], side * off[cells][:, ::side], dist[cells][:, ::side])
                z = logit(np.sum(share * answers) / share.sum())
                evidence += z - logit(PRIOR)
                single += single_weight[kind] * error(z, single_target[kind])
                single_sum += single_weight[kind]
            if there:
                fused += weight[kind] * error(repeat[d] * evidence, target[kind])
                fused_weight += weight[kind]
    single /= single_sum
    return fused / fused_weight + training.SINGLE_WEIGHT * single if through_map else single


@pytest.mark.parametrize(
    ("flip", "repeat"), [(PLAIN, ONCE), (FLIPPED, REPEATED)], ids=["plain", "flipped and repeated"]
)
def test_the_loss_is_the_one_that_its_words_say(drives, layers, flip, repeat):
    plain_layers = [(np.asarray(w, dtype=float), np.asarray(b, dtype=float)) for w, b in layers]
    plain_drives = Examples(*map(np.asarray, drives))
    expected = plain_loss(plain_layers, plain_drives, np.asarray(flip), np.asarray(repeat))
    assert float(loss_of(layers, drives, flip, repeat)) == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("squared_error", [False, True], ids=["cross-entropy", "least squares"])
@pytest.mark.parametrize("through_map", [True, False], ids=["through the map", "single looks"])
def test_the_other_losses_are_the_ones_that_their_words_say(drives, layers, squared_error, through_map):
    plain_layers = [(np.asarray(w, dtype=float), np.asarray(b, dtype=float)) for w, b in layers]
    plain_drives = Examples(*map(np.asarray, drives))
    how = {"squared_error": squared_error, "through_map": through_map}
    expected = plain_loss(plain_layers, plain_drives, np.asarray(FLIPPED), np.asarray(REPEATED), **how)
    assert float(loss(layers, drives, PRIOR, FLIPPED, REPEATED, **how)) == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("change", [{"squared_error": True}, {"through_map": False}], ids=str)
def test_the_recipe_chooses_the_loss(examples, recipe, trained, change):
    other = fit(examples, replace(recipe, epochs=3 * recipe.epochs, **change))
    assert other.recipe["losses"][-1] < other.recipe["losses"][0]
    assert not same_weights(other, trained)


def test_drives_do_not_depend_on_how_many_sonars_the_network_reads(examples):
    wide = making.generate(None, 5, seed=3, zone=8)
    for name in ("ranges", "frame", "at", "label"):
        np.testing.assert_array_equal(getattr(wide, name), getattr(examples, name)[:5])
    assert wide.sonar.shape == wide.off_axis.shape == wide.distance.shape == (5, LOCAL_CELLS**2, 8)
    nearest = np.sort(np.abs(wide.off_axis), axis=-1)[..., :4]
    np.testing.assert_array_equal(nearest, np.sort(np.abs(examples.off_axis[:5]), axis=-1))


@pytest.mark.parametrize("zone", [2, 6])
def test_a_network_is_trained_for_the_sonars_of_its_recipe(recipe, zone, tmp_path):
    wider = replace(recipe, drives=4, epochs=1, zone=zone)
    train(None, wider, tmp_path / "mine.npz")
    loaded = Network.load(tmp_path / "mine.npz")
    assert loaded.zone == loaded.recipe["zone"] == zone


def test_the_gradient_of_the_loss_agrees_with_finite_differences(drives, layers):
    flip = jnp.array([True, False, True, False])
    gradient = gradient_of(layers, drives, flip, REPEATED)
    rng = np.random.default_rng(1)
    agree = []
    for _ in range(6):
        step = jax.tree.map(lambda v: jnp.asarray(rng.normal(0, 1, v.shape), jnp.float32), layers)
        slope = sum(
            float(jnp.sum(g * s)) for g, s in zip(jax.tree.leaves(gradient), jax.tree.leaves(step), strict=True)
        )
        h = 2e-3
        ahead, behind = (
            float(loss_of(jax.tree.map(lambda v, s, h=h: v + h * s, layers, step), drives, flip, REPEATED))
            for h in (h, -h)
        )
        agree.append((slope, (ahead - behind) / (2 * h)))
    slopes, differences = np.array(agree).T
    np.testing.assert_allclose(slopes, differences, atol=0.01 * np.abs(slopes).max())


def mirrored(drives):
    """The drives as their mirror images: left sonars to the right, and all points to the other side."""
    cells = np.arange(LOCAL_CELLS**2).reshape(LOCAL_CELLS, LOCAL_CELLS)[::-1].ravel()
    at = jnp.stack([drives.at[..., 0], LOCAL_CELLS - 1 - drives.at[..., 1]], axis=-1)
    return drives._replace(
        sonar=drives.sonar[:, cells, ::-1],
        off_axis=-drives.off_axis[:, cells, ::-1],
        distance=drives.distance[:, cells, ::-1],
        at=at,
    )


def test_the_loss_of_a_mirrored_drive_is_the_loss_of_the_drive_flipped(drives, layers):
    # float16 holds the mirrored places to a hundredth of a cell.
    flipped = loss_of(layers, drives, FLIPPED, REPEATED)
    image = loss_of(layers, mirrored(drives), PLAIN, REPEATED)
    plain = loss_of(layers, drives, PLAIN, REPEATED)
    assert float(image) == pytest.approx(float(flipped), rel=2e-3)
    assert abs(float(plain) - float(flipped)) > 2e-3 * float(plain)


def test_flipping_twice_is_not_flipping(drives, layers):
    twice = loss_of(layers, mirrored(drives), FLIPPED, REPEATED)
    plain = loss_of(layers, drives, PLAIN, REPEATED)
    assert float(twice) == pytest.approx(float(plain), rel=2e-3)


def test_looks_that_say_the_prior_leave_the_map_at_one_half(drives, layers):
    silent = [(jnp.zeros_like(w), jnp.zeros_like(b)) for w, b in layers]
    level = LIMIT * np.arctanh(np.log(PRIOR / (1 - PRIOR)) / LIMIT)
    silent[-1] = (silent[-1][0], jnp.full(1, level, dtype=jnp.float32))
    for repeat in (ONCE, REPEATED):
        told = float(loss_of(silent, drives, PLAIN, repeat))
        singles = told - np.log(2)
        assert 0 < singles < training.SINGLE_WEIGHT * np.log(2)


def test_training_brings_the_loss_down(trained):
    losses = trained.recipe["losses"]
    assert len(losses) == RECIPE.epochs
    assert losses[-1] < losses[0]


def test_the_same_recipe_gives_the_same_weights_and_another_seed_others(examples, recipe, trained):
    assert same_weights(fit(examples, recipe), trained)
    assert not same_weights(fit(examples, replace(recipe, seed=6)), trained)


@pytest.mark.parametrize("call", [2, 3])
def test_training_that_was_stopped_ends_with_the_weights_of_an_uninterrupted_run(
    examples, recipe, trained, tmp_path, monkeypatch, call
):
    checkpoint, calls = tmp_path / "state.npz", []
    write = descent._write_arrays

    def write_then_stop(*args):
        calls.append(args)
        if len(calls) == call:
            raise StoppedError
        write(*args)

    with monkeypatch.context() as patch:
        patch.setattr(descent, "_write_arrays", write_then_stop)
        with pytest.raises(StoppedError):
            fit(examples, recipe, checkpoint, "key")
    assert len(calls) == call
    resumed = fit(examples, recipe, checkpoint, "key")
    assert same_weights(resumed, trained)
    assert resumed.recipe == trained.recipe


def test_a_finished_checkpoint_is_the_result(examples, recipe, trained, tmp_path, monkeypatch):
    checkpoint = tmp_path / "state.npz"
    fit(examples, recipe, checkpoint, "key")
    monkeypatch.setattr(descent, "_step", None)
    assert same_weights(fit(examples, recipe, checkpoint, "key"), trained)


def test_a_checkpoint_of_another_recipe_is_not_taken_up(examples, recipe, trained, tmp_path):
    checkpoint = tmp_path / "state.npz"
    fit(examples, replace(recipe, seed=6), checkpoint, "other key")
    assert same_weights(fit(examples, recipe, checkpoint, "key"), trained)


@pytest.mark.parametrize("content", [b"", b"not an archive"], ids=["empty", "text"])
def test_a_damaged_checkpoint_is_not_taken_up(examples, recipe, trained, tmp_path, content):
    checkpoint = tmp_path / "state.npz"
    checkpoint.write_bytes(content)
    assert same_weights(fit(examples, recipe, checkpoint, "key"), trained)


def test_train_writes_the_weights_alone_and_says_how_they_were_made(examples, recipe, trained, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "generate", lambda *_: examples)
    network = train(None, recipe, tmp_path / "mine.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npz"]
    loaded = Network.load(tmp_path / "mine.npz")
    assert same_weights(loaded, trained)
    assert same_weights(network, trained)
    told = loaded.recipe
    assert (told["robot"], told["epochs"], told["seed"], told["hidden"]) == ("any", 3, 5, [8, 4])
    assert told["losses"] == trained.recipe["losses"]
    assert "echogrid" in told


def test_train_takes_up_the_drives_and_the_state_that_wait(examples, recipe, trained, tmp_path, monkeypatch):
    write, made = descent._write_arrays, []

    def stop_in_the_second_epoch(path, key, arrays):
        if len(arrays[0]) == 2 and "checkpoint" in path.name:
            raise StoppedError
        write(path, key, arrays)

    def made_once(*_):
        made.append(1)
        return examples

    monkeypatch.setattr(training, "generate", made_once)
    with monkeypatch.context() as patch:
        patch.setattr(descent, "_write_arrays", stop_in_the_second_epoch)
        with pytest.raises(StoppedError):
            train(TRIO, recipe, tmp_path / "mine.npz")
    assert not (tmp_path / "mine.npz").exists()
    train(TRIO, recipe, tmp_path / "mine.npz")
    assert len(made) == 1
    assert same_weights(Network.load(tmp_path / "mine.npz"), trained)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npz"]


@pytest.mark.parametrize("change", [{"zone": 2}, {"squared_error": True}, {"through_map": False}], ids=str)
def test_what_waits_for_another_recipe_is_not_taken_up(recipe, change, tmp_path, monkeypatch):
    def stop(*_):
        raise StoppedError

    keys = set()
    monkeypatch.setattr(training, "generate", stop)
    monkeypatch.setattr(descent, "_read_arrays", lambda _, key: keys.add(key))
    for told in (recipe, replace(recipe, **change)):
        with pytest.raises(StoppedError):
            train(None, told, tmp_path / "mine.npz")
    assert len(keys) == 2


def test_weights_for_a_folder_that_is_not_there_are_refused_before_training(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "generate", None)
    with pytest.raises(
        UsageError, match=r"^--out: found no folder .*nowhere, expected a file in a folder that exists$"
    ):
        train(None, RECIPE, tmp_path / "nowhere" / "mine.npz")


def test_the_network_begins_by_saying_the_prior():
    for w, _ in initial(np.random.default_rng(0), (32, 16))[:-1]:
        assert np.std(w) == pytest.approx(np.sqrt(2 / len(w)), rel=0.15)
    x = jnp.asarray(np.random.default_rng(1).normal(0, 0.5, (200, inputs())), jnp.float32)
    z = forward(initial(np.random.default_rng(0), (32, 16)), x)
    assert np.abs(z - np.log(PRIOR / (1 - PRIOR))).max() < 0.5


def test_surface_points_of_examples_lie_on_surfaces_of_the_truth():
    rng = np.random.default_rng(2)
    world = random_world(rng, "room")
    poses = random_way(rng, world, 0.3)
    assert poses is not None
    truth = truth_of(world, poses, 0.12, 1.44)
    row, col = np.argwhere(truth.cells == SURFACE).T
    centre = (np.column_stack([col, row]) + 0.5) * 0.12 + truth.origin
    assert np.all(world.clearance(centre) < 0.12 * np.sqrt(0.5) + 0.01)


def test_the_four_cells_surround_the_point_and_their_weights_sum_to_1():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 23, (2, 200)).astype(np.float32)
    cells, weights, inside = surrounding(jnp.asarray(x), jnp.asarray(y))
    assert np.all(inside)
    np.testing.assert_allclose(np.sum(weights, axis=0), 1, atol=1e-6)
    for cell in cells:
        row, col = np.divmod(np.asarray(cell), 24)
        assert np.all((np.abs(col - x) <= 1) & (np.abs(row - y) <= 1))
    assert np.all(np.sort(cells, axis=0)[1:] > np.sort(cells, axis=0)[:-1])
