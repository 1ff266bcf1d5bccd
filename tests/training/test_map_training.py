import jax
import jax.numpy as jnp
import numpy as np
import pytest

from echogrid.mapping.registry import sensor_model
from echogrid.metrics import FREE, SURFACE
from echogrid.models.networks import surroundings
from echogrid.models.networks.memory import TRAITS
from echogrid.models.networks.set_layers import initial
from echogrid.models.networks.set_network import SetNetwork
from echogrid.training import gradient_descent as descent
from echogrid.training import map_training, set_training
from echogrid.training.gradient_descent import train
from echogrid.training.map_lessons import BEHIND, DEEP, GAP, NOTHING, MapLessons
from echogrid.training.map_training import RIM, WEIGHTS, MapRecipe, map_loss
from echogrid.training.set_lessons import Lessons
from echogrid.training.set_training import MAPS_SHARE, SetRecipe

SIDE = 2 * RIM + 8
DRIVES = 6


class StoppedError(Exception):
    pass


def lessons_of(seed=0, count=DRIVES):
    """Maps in which walls show as looks that are for and against a surface, which the log-odds hide."""
    rng = np.random.default_rng(seed)
    label = rng.choice([SURFACE, FREE, GAP, BEHIND, DEEP, NOTHING], (count, SIDE, SIDE)).astype(np.int8)
    told = rng.normal(0, 0.3, (count, SIDE, SIDE, surroundings.FEATURES))
    told[..., 0] += label == SURFACE
    told[..., 1] += (label == FREE) | (label == GAP)
    return MapLessons(told.astype(np.float16), rng.random((count, surroundings.TOLD)).astype(np.float32), label)


MADE = lessons_of()
NETWORK = SetNetwork(initial(np.random.default_rng(0), 4), None, {"seed": 0})
RECIPE = MapRecipe(DRIVES, epochs=6, batch=3, learning_rate=0.02, seed=2, network=NETWORK)
STACK = surroundings.initial(np.random.default_rng(1))
LOSS = jax.jit(map_loss)


def plain_loss(weights, lessons):
    log_odds = np.stack([
        surroundings.corrected(weights, told.astype(np.float32), array)
        for told, array in zip(lessons.told, lessons.array, strict=True)
    ]).astype(float)  # fmt: skip
    total = count = 0.0
    inner = np.s_[:, RIM:-RIM, RIM:-RIM]
    for z, label in zip(log_odds[inner].ravel(), lessons.label[inner].ravel(), strict=True):
        if label == NOTHING:
            continue
        aim = {SURFACE: 1.0, FREE: 0.0, GAP: 0.0, BEHIND: 0.5, DEEP: 0.5}[int(label)]
        total += WEIGHTS[int(label)] * (np.logaddexp(0, z) - aim * z)
        count += WEIGHTS[int(label)]
    return total / count


def test_the_loss_is_the_one_that_its_words_say():
    assert float(LOSS(STACK, MADE, jnp.zeros(3, int))) == pytest.approx(plain_loss(STACK, MADE), rel=1e-4)


@pytest.mark.parametrize("turned", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1)])
def test_maps_are_turned_and_mirrored_with_their_labels(turned):
    told, array, label = MADE
    for flag, axis in zip(turned, (1, 2), strict=False):
        told, label = (np.flip(v, axis) if flag else v for v in (told, label))
    if turned[2]:
        told, label = (np.swapaxes(v, 1, 2) for v in (told, label))
    other = plain_loss(STACK, MapLessons(told, array, label))
    assert float(LOSS(STACK, MADE, jnp.asarray(turned))) == pytest.approx(other, rel=1e-4)
    assert abs(other - plain_loss(STACK, MADE)) > 1e-6


def test_what_is_not_judged_and_the_rim_cost_nothing():
    told, label = MADE.told.copy(), MADE.label.copy()
    rim = np.ones((SIDE, SIDE), dtype=bool)
    rim[RIM:-RIM, RIM:-RIM] = False
    label[:, rim] = (label[:, rim] + 1) % 4
    same = float(LOSS(STACK, MapLessons(told, MADE.array, label), jnp.zeros(3, int)))
    assert same == pytest.approx(float(LOSS(STACK, MADE, jnp.zeros(3, int))), rel=1e-6)


@pytest.fixture(scope="module")
def trained():
    return RECIPE.fit(MADE, None, "", False)


def test_training_brings_the_loss_down_and_leaves_the_rest_of_the_network(trained):
    losses = trained.recipe["surroundings"]["losses"]
    assert len(losses) == RECIPE.epochs
    assert losses[-1] < losses[0]
    assert trained.weights is NETWORK.weights
    assert trained.recipe["seed"] == 0
    begun = surroundings.initial(np.random.default_rng(RECIPE.seed))
    assert all(np.abs(trained.around[name] - begun[name]).max() > 1e-4 for name in begun)


def same_parts(a, b):
    return all(
        one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
        for one, other in ((a.weights, b.weights), (a.around, b.around))
    )


def scans_of_nothing():
    """Four drives."""
    shapes = {"ranges": (2, 3), "mounts": (3, 3), "max_range": (3,), "beam": (), "poses": (2, 3), "weight": (2,)}
    shapes |= {"traits": (2, TRAITS), "points": (5, 2)}
    arrays = {name: np.zeros((4, *shape), np.float32) for name, shape in shapes.items()}
    return Lessons(**arrays, label=np.zeros((4, 5), np.int8))


WHOLE = SetRecipe(drives=4, epochs=2, hidden=4, batch=2, seed=5)


@pytest.fixture
def asked(monkeypatch):
    """Both parts of a training on given lessons, and how often either was asked for them; the first is no work."""
    asked = []

    def first(weights, _examples, _loss, _draw, recipe, checkpoint, key, _progress):
        """A step an epoch, of a loss that is quick to compile."""
        asked.append("fit")
        return descent.descend(
            weights,
            (np.arange(4, dtype=np.float32),),
            lambda w, batch, *_: jnp.mean(
                (jnp.concatenate([*map(jnp.ravel, jax.tree.leaves(w))]) - batch[0][0]) ** 2
            ),
            lambda rng, _: (jnp.asarray(rng.random()),),
            recipe,
            checkpoint,
            key,
        )

    monkeypatch.setattr(set_training, "descend", first)
    monkeypatch.setattr(set_training, "orders", lambda _: np.zeros((4, 1, 1), int))
    monkeypatch.setattr(set_training, "lessons", lambda *_: asked.append("scans") or scans_of_nothing())
    monkeypatch.setattr(map_training, "map_lessons", lambda *_: asked.append("maps") or MADE)
    return asked


def stopped(out, where, name, recipe=WHOLE):
    def stop(*_):
        raise StoppedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(where, name, stop)
        with pytest.raises(StoppedError):
            train(None, recipe, out)
    assert not out.exists()


def test_training_that_was_stopped_between_its_parts_ends_with_the_same_weights(asked, tmp_path, monkeypatch):
    whole = train(None, WHOLE, tmp_path / "whole.npz")
    assert asked == ["scans", "fit", "maps"]
    assert [path.name for path in tmp_path.iterdir()] == ["whole.npz"]
    out = tmp_path / "mine.npz"
    asked.clear()
    stopped(out, map_training, "map_lessons")  # before the second has its lessons
    stopped(out, map_training, "descend")  # and when it has
    network = train(None, WHOLE, out)
    assert same_parts(network, whole)
    assert (asked.count("scans"), asked.count("maps")) == (1, 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.npz", "whole.npz"]
    model = sensor_model(str(out))
    assert isinstance(model, SetNetwork)
    assert same_parts(model, whole)
    told = model.recipe
    assert (told["network"], told["robot"], told["drives"], told["epochs"]) == ("set", "any", 4, 2)
    assert told["surroundings"]["drives"] == round(MAPS_SHARE * 4)
    assert told == whole.recipe


def test_lessons_of_maps_that_another_network_made_are_not_taken_up(asked, tmp_path):
    """Though the second part is told the same."""
    out = tmp_path / "mine.npz"
    stopped(out, map_training, "descend")
    other = SetRecipe(drives=4, epochs=2, hidden=4, batch=2, seed=5, learning_rate=0.1)
    assert other.then(NETWORK).told() == WHOLE.then(NETWORK).told()
    train(None, other, out)
    assert asked.count("maps") == 2
