"""A cell is corrected by what lies round it, and by nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.models.networks import surroundings
from echogrid.models.networks.set_layers import LOOKS
from echogrid.models.networks.surroundings import DILATIONS, FEATURES, PACK, REACH, TOLD, corrected

SIDE = 2 * REACH + 16
ARRAY = np.array([0.3, 0.8, 0.5, 0.2], dtype=np.float32)
COMPILED = jax.jit(lambda w, told, array: corrected(w, told, array, jnp))


def weights_of(seed=0):
    """Weights that have something to say of every cell near and far."""
    rng = np.random.default_rng(seed)
    weights = surroundings.initial(rng)
    return {
        name: (value * (20 if name == "co" else 2 if name.startswith("s") else 1)
               + rng.normal(0, 0.1, value.shape)).astype(np.float32)
        for name, value in weights.items()
    }  # fmt: skip


WEIGHTS = weights_of()


def cells_of(seed=0, rows=SIDE, cols=SIDE):
    return np.random.default_rng(seed).normal(0, 1, (rows, cols, FEATURES)).astype(np.float32)


def moved(told, rows, cols):
    """The same cells so far up and to the right, among cells of which nothing is known."""
    far = np.zeros_like(told)
    high, wide = told.shape[:2]
    to, of = [], []
    for by, n in ((rows, high), (cols, wide)):
        to.append(slice(max(by, 0), n + min(by, 0)))
        of.append(slice(max(-by, 0), n - max(by, 0)))
    far[tuple(to)] = told[tuple(of)]
    return far


def test_what_maps_are_read_with_is_what_is_trained():
    told = np.stack([cells_of(1), cells_of(2)])
    array = np.stack([ARRAY, -ARRAY])
    here = np.stack([corrected(WEIGHTS, *each) for each in zip(told, array, strict=True)])
    np.testing.assert_allclose(here, COMPILED(WEIGHTS, told, array), atol=1e-4 * np.abs(here).max())
    assert np.std(here) > 1
    assert np.std(here - 4 * told[..., 4]) > 1


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 99), st.integers(0, SIDE - 1), st.integers(0, SIDE - 1), st.integers(0, FEATURES - 1))
def test_a_cell_changes_nothing_farther_off_than_the_reach(seed, row, col, feature):
    told = cells_of(seed)
    other = told.copy()
    other[row, col, feature] += 3.0
    changed = np.abs(corrected(WEIGHTS, other, ARRAY) - corrected(WEIGHTS, told, ARRAY)) > 1e-5
    far = np.maximum(*(np.abs(np.arange(SIDE) - at)[sl] for at, sl in ((row, np.s_[:, None]), (col, np.s_[None]))))
    # Cells are taken PACK by PACK, so that the last of a square is as near as its first.
    assert far[changed].max() <= REACH + PACK - 1
    assert changed[row, col]


def test_the_reach_is_used():
    told, middle = np.zeros((SIDE, SIDE, FEATURES), dtype=np.float32), SIDE // 2
    far = 0
    for seed in range(3):
        other = told.copy()
        other[middle, middle] = 5.0
        changed = corrected(weights_of(seed), other, ARRAY) != corrected(weights_of(seed), told, ARRAY)
        far = max(far, np.abs(np.argwhere(changed) - middle).max())
    assert PACK * sum(DILATIONS) == REACH
    assert REACH - PACK < far <= REACH + PACK - 1


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 99), st.integers(-6, 6), st.integers(-6, 6))
def test_cells_that_are_moved_by_whole_squares_are_corrected_alike(seed, rows, cols):
    told = np.zeros((SIDE + 24, SIDE + 24, FEATURES), dtype=np.float32)
    told[12:-12, 12:-12] = cells_of(seed)
    shift = PACK * rows, PACK * cols
    here, there = (corrected(WEIGHTS, each, ARRAY) for each in (told, moved(told, *shift)))
    inner = np.s_[REACH + 12 : -REACH - 12, REACH + 12 : -REACH - 12]
    np.testing.assert_allclose(moved(here[..., None], *shift)[inner], there[inner][..., None], atol=1e-4)
    assert np.std(there[inner]) > 0.3


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 99), st.integers(0, 7), st.integers(0, 7))
def test_a_part_that_is_read_with_its_surroundings_is_that_of_the_whole(seed, row, col):
    told = cells_of(seed)
    first = PACK * row, PACK * col
    part = np.s_[first[0] : first[0] + 2 * REACH + 2, first[1] : first[1] + 2 * REACH + 2]
    whole, alone = corrected(WEIGHTS, told, ARRAY), corrected(WEIGHTS, told[part], ARRAY)
    np.testing.assert_allclose(alone[REACH:-REACH, REACH:-REACH], whole[part][REACH:-REACH, REACH:-REACH], atol=1e-4)


def test_the_array_decides_what_is_corrected():
    told = cells_of()
    for k in range(TOLD):
        other = ARRAY.copy()
        other[k] += 0.5
        assert np.abs(corrected(WEIGHTS, told, other) - corrected(WEIGHTS, told, ARRAY)).max() > 0.01


@pytest.mark.parametrize("name", sorted(WEIGHTS))
def test_every_weight_counts(name):
    told = cells_of(rows=16, cols=16)
    other = WEIGHTS | {name: WEIGHTS[name] * 1.5}
    assert np.abs(corrected(other, told, ARRAY) - corrected(WEIGHTS, told, ARRAY)).max() > 1e-4


def test_cells_are_told_by_numbers_of_the_size_of_one():
    sums = [np.array([0.0, 4 * LOOKS])] * 4
    told = surroundings.features(sums, np.array([0.0, LOOKS]), np.array([0.0, 8.0]), np.array([0.0, 1.0]))
    assert told.shape == (2, FEATURES)
    np.testing.assert_array_equal(told[0], 0)
    np.testing.assert_allclose(told[1, 4:], [2.0, 1.0, 1.0])
    assert 1 < told[1].max() < 5
    ring, fan = (
        np.column_stack([np.zeros((n, 2)), np.linspace(-a, a, n)]) for n, a in ((10, 0.9 * np.pi), (12, 0.5))
    )
    near, far = (surroundings.told_of(0.4, reach, ring) for reach in (4.0, 60.0))
    np.testing.assert_array_equal(near, far)
    assert near[3] == pytest.approx(0, abs=1e-6)
    other = surroundings.told_of(0.6, 2.0, np.concatenate([fan, np.full((3, 3), np.nan)]))
    assert np.all(other != near)
    np.testing.assert_allclose(other[2:], [0.5, np.mean(np.cos(fan[:, 2]))], rtol=1e-6)
    assert np.all(np.isfinite(surroundings.told_of(0.6, 2.0, np.full((2, 3), np.nan))))
