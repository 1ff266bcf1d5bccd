import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core_oracles import cost_to_go
from echogrid import _core
from echogrid.errors import UsageError

ROOT_2 = math.sqrt(2)
COST = "a cost of a metre >= 0, or inf for a closed cell"


@st.composite
def rooms(draw):
    """Costs, and goals in them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = draw(st.integers(1, 14)), draw(st.integers(1, 14))
    costs = draw(
        st.sampled_from(
            [
                lambda: np.ones(shape),
                lambda: rng.uniform(1, 30, shape),
                lambda: rng.integers(0, 3, shape).astype(float),  # where some cost nothing
                lambda: 10.0 ** rng.integers(-20, 20, shape),
            ]
        )
    )()
    costs[rng.random(shape) < draw(st.sampled_from([0, 0.2, 0.5]))] = np.inf
    goals = [rng.integers(0, shape) for _ in range(draw(st.integers(0, 4)))]
    return costs.astype(np.float32), np.array(goals, np.int64).reshape(-1, 2)


def as_float(costs):
    return np.asarray(costs, np.float32)


@given(rooms())
def test_it_is_what_dijkstra_finds(room):
    costs, goals = room
    found = _core.cost_to_go(costs, goals, 0.05)
    np.testing.assert_allclose(found, cost_to_go(costs, goals, 0.05), rtol=1e-12)


def test_on_open_ground_it_is_the_length_of_the_octile_way():
    found = _core.cost_to_go(np.full((40, 60), 2, np.float32), np.array([[10, 20]]), 0.05)
    dy, dx = np.abs(np.arange(40)[:, None] - 10), np.abs(np.arange(60)[None, :] - 20)
    np.testing.assert_allclose(found, 2 * 0.05 * (np.maximum(dx, dy) + (ROOT_2 - 1) * np.minimum(dx, dy)), rtol=1e-12)


def test_each_step_costs_its_length_times_the_mean_of_its_cells():
    found = _core.cost_to_go(as_float([[1, 3, 100]]), np.array([[0, 0]]), 0.5)
    np.testing.assert_allclose(found, [[0, 1, 1 + 0.5 * 51.5]], rtol=1e-12)


def test_no_corner_is_cut():
    x = np.inf
    found = _core.cost_to_go(as_float([[1, x], [1, 1]]), np.array([[0, 0]]), 1.0)
    np.testing.assert_allclose(found, [[0, x], [1, 2]])
    wall = as_float([[1, 1, x], [1, x, 1], [x, 1, 1]])  # a wall that runs diagonally holds
    assert np.isinf(_core.cost_to_go(wall, np.array([[0, 0]]), 1.0)[1:, 1:]).all()


def test_a_way_leads_through_the_door_or_nowhere():
    costs = np.ones((9, 11), np.float32)
    costs[:, 5] = np.inf
    shut = _core.cost_to_go(costs, np.array([[4, 0]]), 0.1)
    assert np.isinf(shut[:, 5:]).all()
    assert np.isfinite(shut[:, :5]).all()
    costs[8, 5] = 1
    # The two cells beside the door are closed, so nobody goes through it diagonally.
    assert _core.cost_to_go(costs, np.array([[8, 0]]), 0.1)[8, 10] == pytest.approx(1.0)
    assert _core.cost_to_go(costs, np.array([[7, 4]]), 0.1)[7, 6] == pytest.approx(0.4)


def test_each_goal_and_only_the_nearest_counts():
    costs = as_float(np.random.default_rng(1).uniform(1, 9, (30, 30)))
    goals = np.array([[3, 4], [25, 12], [3, 4], [14, 28]])
    each = [_core.cost_to_go(costs, goals[[i]], 0.1) for i in range(4)]
    np.testing.assert_array_equal(_core.cost_to_go(costs, goals, 0.1), np.min(each, axis=0))


def test_a_mirrored_map_has_mirrored_costs():
    rng = np.random.default_rng(2)
    costs = as_float(np.where(rng.random((25, 18)) < 0.2, np.inf, rng.uniform(1, 9, (25, 18))))
    found = _core.cost_to_go(costs, np.array([[4, 3]]), 0.1)
    np.testing.assert_array_equal(_core.cost_to_go(costs[:, ::-1], np.array([[4, 14]]), 0.1), found[:, ::-1])
    np.testing.assert_array_equal(_core.cost_to_go(costs.T, np.array([[3, 4]]), 0.1), found.T)


def test_a_goal_that_is_closed_is_none():
    costs = as_float([[1, np.inf, 1]])
    assert np.isinf(_core.cost_to_go(costs, np.array([[0, 1]]), 0.1)).all()
    assert np.isinf(_core.cost_to_go(costs, np.zeros((0, 2), np.int64), 0.1)).all()


def test_minus_nought_costs_nothing():
    assert np.array_equal(_core.cost_to_go(as_float([[-0.0, -0.0, 0]]), np.array([[0, 0]]), 0.1), [[0, 0, 0]])


def test_a_map_without_cells_has_none():
    assert _core.cost_to_go(np.zeros((0, 5), np.float32), np.zeros((0, 2), np.int64), 0.1).shape == (0, 5)


@pytest.mark.parametrize(
    ("told", "change"),
    [
        ("costs[1, 2]: found -1, expected a cost of a metre >= 0, or inf for a closed cell", {"costs": (1, 2, -1)}),
        (
            "costs[0, 1]: found nan, expected a cost of a metre >= 0, or inf for a closed cell",
            {"costs": (0, 1, np.nan)},
        ),
        ("goals: found 1 x 3, expected n x 2", {"goals": np.zeros((1, 3), np.int64)}),
        ("goals[1]: found [2, 0], expected a cell of the 2 x 3", {"goals": np.array([[0, 0], [2, 0]])}),
        ("goals[0]: found [0, -1], expected a cell of the 2 x 3", {"goals": np.array([[0, -1]])}),
        ("resolution: found inf, expected m > 0", {"resolution": np.inf}),
        ("resolution: found -0.1, expected m > 0", {"resolution": -0.1}),
    ],
)
def test_what_cannot_be_priced_is_refused(told, change):
    asked: dict[str, Any] = {"costs": np.ones((2, 3), np.float32), "goals": np.array([[0, 0]]), "resolution": 0.1}
    if "costs" in change:
        row, col, value = change["costs"]
        asked["costs"][row, col] = value
    else:
        asked |= change
    with pytest.raises(UsageError) as raised:
        _core.cost_to_go(**asked)
    assert str(raised.value) == told


def test_goals_between_cells_are_not_rounded():
    with pytest.raises(TypeError):
        _core.cost_to_go(np.ones((5, 5), np.float32), np.array([[1.5, 2.0]]), 0.1)
