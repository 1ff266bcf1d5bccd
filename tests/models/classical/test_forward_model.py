from dataclasses import replace
from itertools import product
from math import atan2, cos, exp, hypot, inf, log, nan, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.errors import UsageError
from echogrid.frame import Frame
from echogrid.mapping.build import build_map
from echogrid.models.classical.forward_model import _LEAST_GAIN, ForwardModel
from echogrid.robot import TRANSDUCERS, Robot

pytestmark = pytest.mark.filterwarnings("ignore::echogrid.DoubtWarning")  # places in no order of driving

CELL_M = 0.25
LOW, SHAPE = np.array([-8, -8]), (16, 16)
"""The map of the tests: cells from [-8, -8] to [8, 8], that is 2 m each way."""

MODEL = ForwardModel(
    reach_m=1.3, p_hit=0.3, p_random=0.1, sigma_m=0.12, p_occupied=0.15, weight=0.5, no_echo=True, name="em"
)
TWO = Robot(
    name="two",
    footprint_radius_m=0.0,
    transducer=TRANSDUCERS["polaroid-600"],
    min_range_m=0.15,
    max_range_m=3.0,
    beam_width_rad=np.deg2rad(24),
    mounts=np.array([[0.05, 0.02, 0.0], [0.03, -0.04, pi / 2]]),
)


def frame(x, y, theta, ranges):
    return Frame(0.0, np.array([x, y, theta], dtype=float), np.array(ranges, dtype=float))


def wrapped(angle):
    return (angle + pi) % (2 * pi) - pi


def readings_of(robot, frames, model):
    """z and the cells of its cone as (distance, row, col), by distance, of each reading that is used."""
    found = []
    for each in frames:
        x, y, theta = each.pose
        for (mx, my, axis), z in zip(robot.mounts, each.ranges, strict=True):
            if z != z or (z == inf and not model.no_echo):
                continue
            sx, sy = x + cos(theta) * mx - sin(theta) * my, y + sin(theta) * mx + cos(theta) * my
            reach = min(model.reach_m, robot.max_range_m)
            cone = []
            for row, col in product(range(LOW[0], LOW[0] + SHAPE[0]), range(LOW[1], LOW[1] + SHAPE[1])):
                dx, dy = (col + 0.5) * CELL_M - sx, (row + 0.5) * CELL_M - sy
                d = hypot(dx, dy)
                if abs(wrapped(atan2(dy, dx) - axis - theta)) <= robot.beam_width_rad / 2 and d <= min(
                    z + 3 * model.sigma_m, reach
                ):
                    cone.append((d, row, col))
            found.append((z if z <= reach else inf, sorted(cone)))
    return found


def log_posterior(readings, occupied, model, robot):
    """log p(Z | m) + log p(m) by the formula (physics.md, 5.11), of a map given as the set of its occupied cells."""
    total = 0.0
    for z, cone in readings:
        struck = [d for d, row, col in cone if (row, col) in occupied]
        if z == inf:
            p = model.p_random + (1 - model.p_random) * (1 - model.p_hit) ** len(struck)
        else:
            p = model.p_random / robot.max_range_m
            for before, d in enumerate(struck):
                off = (z - d) / model.sigma_m
                normal = exp(-(off**2) / 2) / (model.sigma_m * sqrt(2 * pi))
                p += (1 - model.p_random) * model.p_hit * (1 - model.p_hit) ** before * normal
        total += log(p)
    cells = SHAPE[0] * SHAPE[1]
    return total + len(occupied) * log(model.p_occupied) + (cells - len(occupied)) * log(1 - model.p_occupied)


def cones_of(model, robot, frames):
    poses, ranges = (
        np.array(column, dtype=float) for column in zip(*((f.pose, f.ranges) for f in frames), strict=True)
    )
    return model.cones(robot, poses, ranges, LOW, SHAPE[1], CELL_M)


def as_array(occupied):
    cells = np.zeros(SHAPE, dtype=bool)
    for row, col in occupied:
        cells[row - LOW[0], col - LOW[1]] = True
    return cells


def found(model, robot, frames):
    """Log-odds on the map of the tests, and the occupied cells."""
    (grid,) = build_map(frames, robot, model, CELL_M)
    log_odds = np.zeros(SHAPE)
    for index in np.argwhere(grid.observed):
        row, col = np.rint(np.array(grid.origin[::-1]) / CELL_M).astype(int) + index - LOW
        log_odds[row, col] = grid.log_odds[tuple(index)]
    return log_odds, {(int(row + LOW[0]), int(col + LOW[1])) for row, col in np.argwhere(log_odds > bar(model))}


def bar(model):
    """Log-odds, less the prior, above which a cell is more likely occupied than free."""
    return -model.weight * log(model.p_occupied / (1 - model.p_occupied))


TINY = [frame(0.11, 0.07, 0.1, [0.93, inf]), frame(0.31, -0.21, 0.4, [0.71, 2.2]), frame(-0.1, 0.3, -0.2, [1.2, nan])]


def test_the_likelihood_by_hand():
    # One sonar along x at the middle of the row of cells [0, ...]: the cone holds the cells 0.25, 0.5, 0.75 and 1.0 m
    # ahead. Reading 0.75, the cells at 0.5 and 0.75 occupied: the first would have sent it with N(0.25; 0.12) =
    # 3.32452 exp(-2.17014) = 0.37955 per m, the second with 3.32452 if the first missed it: 0.1 / 3 + 0.9 * 0.3 *
    # (0.37955 + 0.7 * 3.32452) = 0.76415. With the second alone 0.1 / 3 + 0.9 * 0.3 * 3.32452 = 0.93095, so that to
    # take the first away adds log(0.93095 / 0.76415) = 0.19744 to log p(Z | m), and to log p(m) log(0.85 / 0.15) =
    # 1.73460.
    robot = replace(TWO, mounts=np.array([[0.125, 0.125, 0.0]]))
    frames = [frame(0.0, 0.0, 0.0, [0.75])]
    cones = cones_of(MODEL, robot, frames)
    two, one = ({(0, 2), (0, 3)}, {(0, 3)})
    likelihood, gain = MODEL._flips(cones, as_array(two))
    assert gain[8, 10] == pytest.approx(0.19744 + 1.73460, abs=1e-4)
    assert MODEL._flips(cones, as_array(one))[0] - likelihood == pytest.approx(0.19744 + 1.73460, abs=1e-4)
    # No echo passes an occupied cell with 0.1 + 0.9 * 0.7 = 0.73, two with 0.1 + 0.9 * 0.49 = 0.541.
    cones = cones_of(MODEL, robot, [frame(0.0, 0.0, 0.0, [inf])])
    _, gain = MODEL._flips(cones, as_array(one))
    assert gain[8, 10] == pytest.approx(log(0.541 / 0.73) - 1.73460, abs=1e-4)
    assert gain[8, 11] == pytest.approx(-log(0.73) + 1.73460, abs=1e-4)
    # A cell in no cone has its prior alone.
    assert gain[0, 0] == pytest.approx(-1.73460, abs=1e-4)


def test_likelihood_and_gains_are_those_of_the_formula_for_all_maps():
    readings = readings_of(TWO, TINY, MODEL)
    # The cells that an echo may have come from, and one in no cone.
    cells = [*sorted({(row, col) for z, cone in readings if z < inf for _, row, col in cone}), (-8, -8)]
    assert len(cells) == 9
    cones = cones_of(MODEL, TWO, TINY)
    assert len(readings) == len(cones.echo) == 5
    np.testing.assert_array_equal(cones.echo, [True, False, True, False, True])
    truth = {}
    for states in product((False, True), repeat=len(cells)):
        occupied = frozenset(cell for cell, on in zip(cells, states, strict=True) if on)
        truth[occupied] = log_posterior(readings, occupied, MODEL, TWO)
    constant = truth[frozenset()] - MODEL._flips(cones, as_array(()))[0]
    for occupied, value in truth.items():
        likelihood, gain = MODEL._flips(cones, as_array(occupied))
        assert value - likelihood == pytest.approx(constant, abs=1e-9)
        for row, col in cells:
            difference = truth[occupied ^ {(row, col)}] - value
            assert gain[row - LOW[0], col - LOW[1]] == pytest.approx(difference, abs=1e-9)
    # Of one of the maps what the flip of each cell of the world would add.
    occupied = frozenset(cells[1:6:2])
    _, gain = MODEL._flips(cones, as_array(occupied))
    for row, col in np.ndindex(*SHAPE):
        flipped = occupied ^ {(row + LOW[0], col + LOW[1])}
        difference = log_posterior(readings, flipped, MODEL, TWO) - truth[occupied]
        assert gain[row, col] == pytest.approx(difference, abs=1e-9)


def random_frames(seed, count=4):
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(count):
        ranges = rng.uniform(0.3, 1.5, 2)
        ranges[rng.random(2) < 0.2] = inf
        frames.append(frame(*rng.uniform(-0.5, 0.5, 2), rng.uniform(-pi, pi), ranges))
    return frames


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_no_single_flip_raises_the_likelihood_of_the_map_that_is_found(seed):
    frames = random_frames(seed)
    readings = readings_of(TWO, frames, MODEL)
    log_odds, occupied = found(MODEL, TWO, frames)
    here = log_posterior(readings, occupied, MODEL, TWO)
    assert here >= log_posterior(readings, frozenset(), MODEL, TWO) - 1e-9
    for row, col in {cell[1:] for _, cone in readings for cell in cone}:
        flipped = log_posterior(readings, occupied ^ {(row, col)}, MODEL, TWO)
        assert flipped <= here + _LEAST_GAIN + 1e-9
        # What is shown is the difference between the cell's two states, all others as they are, less the prior and
        # half believed.
        sign = 1 if (row, col) in occupied else -1
        assert log_odds[row - LOW[0], col - LOW[1]] == pytest.approx(
            0.5 * (sign * (here - flipped) - log(0.15 / 0.85)), abs=1e-5
        )


def test_the_map_of_a_tiny_world_is_the_best_of_all():
    # Single flips promise no more than a map that none of them betters; here it is the best one all the same.
    readings = readings_of(TWO, TINY, MODEL)
    cells = sorted({(row, col) for z, cone in readings if z < inf for d, row, col in cone if abs(z - d) < 0.36})
    assert len(cells) < 13
    maps = [
        frozenset(c for c, on in zip(cells, states, strict=True) if on)
        for states in product((0, 1), repeat=len(cells))
    ]
    best = max(maps, key=lambda occupied: log_posterior(readings, occupied, MODEL, TWO))
    assert found(MODEL, TWO, TINY)[1] == best
    assert len(best) > 0


def sonars_at(*mounts, beam_width_deg):
    return replace(TWO, mounts=np.array(mounts, dtype=float), beam_width_rad=np.deg2rad(beam_width_deg))


FAR = hypot(0.75, 0.25)


def pair(side, footprint_radius_m=0.0):
    """Two sonars of which the first, in the middle of [0, 0], has [1, 3] and [-1, 3] in its cone, both FAR away.

    The second, at [2, 0] or [-2, 0], is turned to the one of them on its side, as far away, and sees that one alone.
    """
    aside = [0.125, 0.125 + 0.5 * side, atan2(-0.25 * side, 0.75)]
    width = np.deg2rad(40)
    mounts = np.array([[0.125, 0.125, 0.0], aside])
    return replace(TWO, mounts=mounts, beam_width_rad=width, footprint_radius_m=footprint_radius_m)


SHARP = replace(MODEL, sigma_m=0.04)


@pytest.mark.parametrize("side", [1, -1])
def test_an_echo_has_one_cause_for_which_cells_compete(side):
    either = {(1, 3), (-1, 3)}
    one, both = ([frame(0, 0, 0, [FAR, second])] for second in (nan, FAR))
    # To an empty map either would add the cause of the first echo. Both are not needed.
    _, gain = SHARP._flips(cones_of(SHARP, pair(side), one), as_array(()))
    assert min(gain[1 - LOW[0], 3 - LOW[1]], gain[-1 - LOW[0], 3 - LOW[1]]) > 1
    assert len(found(SHARP, pair(side), one)[1] & either) == 1
    # The second sonar tells which of them it is, and of the other little is left of what the echo alone says of it.
    log_odds, occupied = found(SHARP, pair(side), both)
    assert occupied & either == {(side, 3)}
    alone = SHARP.weight * (gain[-side - LOW[0], 3 - LOW[1]] - log(0.15 / 0.85))
    assert log_odds[-side - LOW[0], 3 - LOW[1]] < alone / 3


def test_where_the_robot_stood_is_no_cause_of_an_echo():
    either, robot = {(1, 3), (-1, 3)}, pair(1, footprint_radius_m=0.1)
    echo = frame(0, 0, 0, [FAR, nan])
    (taken,) = found(SHARP, robot, [echo])[1] & either
    on_it = frame(0.875, 0.125 + 0.25 * taken[0], 0, [nan, nan])
    assert found(SHARP, robot, [echo, on_it])[1] & either == either - {taken}


def test_equally_good_causes_do_not_keep_the_search_from_ending(monkeypatch):
    # Cells in pairs to the left and to the right of the axis explain an echo equally well, to the last bit, and both
    # together worse than none: of equals one goes first.
    model = ForwardModel(2.0, p_hit=0.2, p_random=0.1, sigma_m=0.08, p_occupied=0.05, weight=0.3, no_echo=True)
    robot = sonars_at((0.05, 0.0, 0.0), beam_width_deg=40)
    flips, asked = ForwardModel._flips, []

    def counted(*args):
        asked.append(args)
        assert len(asked) < 100
        return flips(*args)

    monkeypatch.setattr(ForwardModel, "_flips", counted)
    for z in (0.6, 1.05, 1.45):
        (grid,) = build_map([frame(0, 0, 0, [z])], replace(robot, max_range_m=5.0), model, 0.1)
        assert 0 <= np.sum(grid.log_odds > bar(model)) <= 1


def test_an_echo_from_beyond_reach_is_a_beam_that_passed():
    far, silent = (found(MODEL, TWO, [frame(0.1, 0.1, 0.3, [z, nan])])[0] for z in (1.8, inf))
    np.testing.assert_array_equal(far, silent)
    assert np.all(far <= 0)
    assert np.any(far < 0)


def test_missing_echoes_are_left_out_if_they_are_not_used():
    model = replace(MODEL, no_echo=False)
    frames = random_frames(7)
    assert any(np.isinf(f.ranges).any() for f in frames)
    dropped = [Frame(0.0, f.pose, np.where(np.isinf(f.ranges), nan, f.ranges)) for f in frames]
    np.testing.assert_array_equal(found(model, TWO, frames)[0], found(MODEL, TWO, dropped)[0])
    assert np.any(found(model, TWO, frames)[0] != found(MODEL, TWO, frames)[0])


def test_no_cell_beyond_the_maximum_range_is_told_of():
    short = replace(TWO, max_range_m=0.8)
    (grid,) = build_map([frame(0.1, 0.1, 0.0, [inf, inf])], short, MODEL, CELL_M)
    x, y = np.moveaxis(grid.centre_of(np.argwhere(grid.observed)), -1, 0)
    distance = np.minimum(np.hypot(x - 0.15, y - 0.12), np.hypot(x - 0.13, y - 0.06))
    assert distance.max() <= 0.8
    np.testing.assert_array_equal(grid.log_odds[~grid.observed], 0)


def test_more_readings_than_fit_in_a_chunk_are_each_laid_out(monkeypatch):
    monkeypatch.setattr("echogrid.models.classical.forward_model._CHUNK", 20_000)
    # The same frame again and again: each time adds the same to the likelihood of every map.
    one, many = (cones_of(MODEL, TWO, TINY[:1] * n) for n in (1, 300))
    occupied = as_array({(0, 3), (1, 1)})
    prior = 2 * log(0.15 / 0.85)
    likelihood = [MODEL._flips(cones, occupied)[0] - prior for cones in (one, many)]
    assert likelihood[1] == pytest.approx(300 * likelihood[0], rel=1e-9)
    # A square of 15 x 15 cells holds a cone: 88 of them are laid out together.
    assert len(many.echo) == 600 > 20_000 / 15**2


def test_a_log_without_frames_or_readings():
    assert list(build_map([], TWO, MODEL, CELL_M)) == []
    (grid,) = build_map([frame(0, 0, 0, [nan, nan])], replace(TWO, footprint_radius_m=0.3), MODEL, CELL_M)
    assert grid.observed.sum() == 4
    np.testing.assert_allclose(grid.probability()[grid.observed], 0.02, atol=1e-3)


def test_readings_that_tell_of_no_cell():
    # A cone of 1 degree to 0.2 m passes between the centres of cells of 0.25 m.
    narrow = sonars_at((0.05, 0.02, 0.0), beam_width_deg=1)
    for z in (0.2, inf):
        (grid,) = build_map([frame(0, 0, 0, [z])], narrow, replace(MODEL, reach_m=0.2), CELL_M)
        assert not grid.observed.any()
    # Some readings have cells, and some have none, also the last.
    (grid,) = build_map([frame(0, 0, 0, [z]) for z in (0.05, 1.2, 0.05)], narrow, MODEL, CELL_M)
    (alone,) = build_map([frame(0, 0, 0, [1.2])], narrow, MODEL, CELL_M)
    np.testing.assert_array_equal(grid.log_odds, alone.log_odds)


@pytest.mark.parametrize("chunk", [500_000, 1])
def test_a_log_that_would_not_fit_into_memory_is_refused_in_one_line(monkeypatch, chunk):
    monkeypatch.setattr("echogrid.models.classical.forward_model._CHUNK", chunk)
    pairs = len(cones_of(MODEL, TWO, TINY).cell)
    monkeypatch.setattr("echogrid.models.classical.forward_model.MAX_PAIRS", pairs)
    assert len(list(build_map(TINY, TWO, MODEL, CELL_M))) == 1
    monkeypatch.setattr("echogrid.models.classical.forward_model.MAX_PAIRS", pairs - 1)
    with pytest.raises(
        UsageError, match=rf"^map: found more than {pairs - 1} pairs of .* cell in its cone, expected"
    ) as e:
        list(build_map(TINY, TWO, MODEL, CELL_M))
    assert "\n" not in str(e.value)


def test_finer_cells_take_more_memory(monkeypatch):
    monkeypatch.setattr("echogrid.models.classical.forward_model.MAX_PAIRS", 500)
    assert len(list(build_map(TINY, TWO, MODEL, CELL_M))) == 1
    with pytest.raises(UsageError, match=r"^map: found more than 500 pairs"):
        list(build_map(TINY, TWO, MODEL, CELL_M / 5))
