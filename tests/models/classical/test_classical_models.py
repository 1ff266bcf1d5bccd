from dataclasses import replace
from functools import partial
from math import erf, exp, floor, inf, log, nan, pi, sqrt, tanh

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import j1

from echogrid.frame import Frame
from echogrid.mapping.build import build_map
from echogrid.mapping.registry import MODELS
from echogrid.models.classical.beam import Beam
from echogrid.models.classical.calculi import DempsterShafer, Fuzzy, Himm, MoravecElfes
from echogrid.models.classical.forward_model import ForwardModel
from echogrid.models.classical.log_odds import Cone, ConeNoEcho, Elfes, LimCho, Muriel, Nav2, Nav2Clearing, Nav2Tuned
from echogrid.models.classical.sweep import ReadingModel
from echogrid.models.model import Model
from echogrid.robot import TRANSDUCERS, Robot

pytestmark = pytest.mark.filterwarnings("ignore::echogrid.DoubtWarning")  # places in no order of driving

SIDE, CELL_M = 41, 0.1
HALF, MIN_M, MAX_M = np.deg2rad(12.5), 0.26, 5.0

PATTERN_AT = np.maximum(np.deg2rad(np.arange(181) / 2), 1e-9)
"""The angles of a beam's pattern, the axis a little off itself."""

# All that a model can be set to is set here: its defaults are not what is tested.
CONE = Cone(reach_m=2.0, no_echo=False, p_occupied=0.7, p_free=0.35, thickness_m=0.2)
CONE_NO_ECHO = ConeNoEcho(reach_m=2.0, no_echo=True, p_occupied=0.7, p_free=0.35, thickness_m=0.2)
MORAVEC_ELFES = MoravecElfes(reach_m=2.0, no_echo=False, error_m=0.15)
ELFES = Elfes(reach_m=2.0, no_echo=False, p_hit=0.4, sigma_m=0.1, sigma_rad=0.12)
NAV2 = Nav2(phi_m=1.2, no_echo=False)
NAV2_CLEARING = Nav2Clearing(phi_m=1.2, no_echo=True)
NAV2_TUNED = Nav2Tuned(phi_m=0.7, no_echo=False)
HIMM = Himm(reach_m=2.0, no_echo=False, certain=9.0)
MURIEL = Muriel(reach_m=2.0, no_echo=False, strength=0.6, background=0.05, specular=0.8)
DEMPSTER_SHAFER = DempsterShafer(reach_m=2.0, no_echo=False, rho=0.2, thickness_m=0.3)
FUZZY = Fuzzy(reach_m=3.0, no_echo=False, k_empty=0.1, k_occupied=0.4, depth_m=0.2, visibility_m=1.2, union=0.5)
LIM_CHO = LimCho(reach_m=2.0, no_echo=False, p_occupied=0.7, thickness_m=0.2, fading_m=2.0, p_specular=0.05)
EM = ForwardModel(reach_m=2.0, p_hit=0.2, p_random=0.1, sigma_m=0.08, p_occupied=0.1, weight=0.3, no_echo=True)
READ_BY_READING: list[ReadingModel] = [
    *(CONE, CONE_NO_ECHO, MORAVEC_ELFES, ELFES, NAV2, NAV2_CLEARING, NAV2_TUNED),
    *(HIMM, MURIEL, DEMPSTER_SHAFER, FUZZY, LIM_CHO),
]
BY_READINGS = {model.name: model for model in READ_BY_READING}
ALL: dict[str, Model] = {**BY_READINGS, "em": EM}
every_model = pytest.mark.parametrize("name", ALL)
every_reading_model = pytest.mark.parametrize("name", BY_READINGS)


def seen_from(at, axis):
    """Distance (m) and bearing off the axis of the centres of a square's cells from a sonar at x, y in cells."""
    row, col = np.indices((SIDE, SIDE)) + 0.5
    bearing = np.arctan2(row - at[1], col - at[0])
    return np.hypot(col - at[0], row - at[1]) * CELL_M, bearing, (bearing - axis + pi) % (2 * pi) - pi


def beam(reading, at=(0.5, 20.5), axis=0.0, half=HALF, nearest=True):
    """A reading by hand. As it stands, the cell [20, c] is on the axis, 0.1 c m from the sonar."""
    distance, bearing, off = seen_from(at, axis)
    # physics.md, 3.2, with the speed of sound at 20 C.
    x = 2 * pi * 49_400 / 343.2 * 0.0184 * np.sin(PATTERN_AT)
    f = partial(np.asarray, dtype=np.float32)
    return Beam(
        reading=jnp.asarray(f(reading)),
        min_range=jnp.asarray(f(MIN_M)),
        max_range=jnp.asarray(f(MAX_M)),
        half_width=jnp.asarray(f(half)),
        cell=jnp.asarray(f(CELL_M)),
        pattern=jnp.asarray(f(np.abs(2 * j1(x) / x))),
        axis=jnp.asarray(f(axis)),
        at=jnp.asarray(f(at)),
        distance=jnp.asarray(f(distance)),
        bearing=jnp.asarray(f(bearing)),
        off_axis=jnp.asarray(f(off)),
        nearest=jnp.asarray(np.full((SIDE, SIDE), nearest)),
    )


AXIS_ONLY = np.deg2rad(1.0)
"""Half width of a cone in which no cell beside the axis lies, of those within 4 m."""

# Nothing of these falls on the border of a case; the second cone leaves the square.
GENERIC = [
    beam(1.537, (3.37, 18.83), 0.31),
    beam(2.713, (29.61, 4.18), 1.97),
    beam(0.874, (20.9, 36.4), -2.43),
    beam(1.131, (8.23, 9.77), 0.66),
]


@partial(jax.jit, static_argnames="model")
def updated(model, cells, one):
    return model.update(cells, one)


def blank(model):
    return {name: np.broadcast_to(v, (SIDE, SIDE, *v.shape)) for name, v in model.blank().items()}


def after(model, beams, cells=None):
    """The cells after readings, and of which cells each told."""
    cells = {name: jnp.asarray(layer) for name, layer in (blank(model) if cells is None else cells).items()}
    spoken = []
    for one in beams:
        cells, told = updated(model, cells, one)
        spoken.append(np.asarray(told))
    return {name: np.asarray(layer) for name, layer in cells.items()}, spoken


def evidence(model, *beams, cells=None):
    """What the map has of each cell."""
    return model.log_odds(after(model, beams, cells)[0])


def on_axis(layer, *metres):
    """What a layer has at distances of whole cells ahead of the sonar of ``beam`` as it stands."""
    return np.array([layer[20, round(d / CELL_M)] for d in metres])


def geometry(one):
    """Plain numbers of a reading's cells: row, col, distance, bearing off the axis."""
    distance, _, off = seen_from(np.asarray(one.at, dtype=float), float(one.axis))
    for (row, col), d in np.ndenumerate(distance):
        yield row, col, float(d), float(off[row, col])


def heard(one):
    return float(one.reading) if np.isfinite(one.reading) else MAX_M


def cdf(x):
    return (1 + erf(x / sqrt(2))) / 2


def normal(x, sigma):
    return exp(-(x**2) / (2 * sigma**2)) / (sigma * sqrt(2 * pi))


def piston(angle):
    """One-way amplitude, between steps of half a degree straight."""
    x = 2 * pi * 49_400 / 343.2 * 0.0184 * np.sin(PATTERN_AT)
    return float(np.interp(abs(angle), PATTERN_AT, np.abs(2 * j1(x) / x)))


def logit(p):
    return log(p / (1 - p))


def test_the_cone_is_table_9_2():
    model = CONE
    # Reading 1.52, arc of 0.2: |r - 1.52| < 0.1 holds for 1.5 and 1.6, where log(0.7 / 0.3) = 0.8473 is added; before
    # it log(0.35 / 0.65) = -0.6190, behind it nothing.
    got = evidence(model, beam(1.52))
    np.testing.assert_allclose(
        on_axis(got, 0.1, 1.0, 1.4, 1.5, 1.6, 1.7, 2.0), [-0.6190, -0.6190, -0.6190, 0.8473, 0.8473, 0, 0], atol=1e-4
    )
    # The cell [22, 10] is atan(0.2) = 11.3 degrees off the axis and [23, 10] atan(0.3) = 16.7 degrees.
    np.testing.assert_allclose(got[[22, 23, 18, 17], 10], [-0.6190, 0, -0.6190, 0], atol=1e-4)
    # Readings add up.
    np.testing.assert_allclose(
        on_axis(evidence(model, beam(1.52), beam(1.78)), 1.0, 1.5), [-1.2381, 0.2283], atol=1e-4
    )
    for one in GENERIC:
        got = evidence(model, one)
        for row, col, r, phi in geometry(one):
            expected = 0.0
            if not (r > min(2.0, heard(one) + 0.1) or abs(phi) > HALF):
                expected = (
                    log(0.7 / 0.3) if abs(r - heard(one)) < 0.1 else log(0.35 / 0.65) if r <= heard(one) else 0.0
                )
            assert got[row, col] == pytest.approx(expected, abs=1e-5)


def test_the_cone_leaves_cells_to_the_sonar_whose_axis_is_nearest():
    cells, (spoken,) = after(CONE, [beam(1.5, nearest=False)])
    assert not spoken.any()
    assert not cells["evidence"].any()


def test_the_cone_takes_no_echo_for_free_as_far_as_it_reaches():
    got = evidence(CONE_NO_ECHO, beam(inf))
    np.testing.assert_allclose(on_axis(got, 0.1, 1.0, 1.9, 2.1, 3.0), [-0.6190, -0.6190, -0.6190, 0, 0], atol=1e-4)
    assert got.max() == 0


def test_moravec_and_elfes_keep_empty_and_occupied_apart():
    model = MORAVEC_ELFES
    cells, _ = after(model, [beam(1.5)])
    # On the axis at 1.0: Er = 1 - ((1.0 - 0.26) / (1.5 - 0.15 - 0.26))^2 = 1 - 0.46090 and Ea = 1. In the cell
    # [22, 10], 1.0198 away and 0.19740 off the axis: Er = 1 - (0.7598 / 1.09)^2 = 0.51410,
    # Ea = 1 - 0.90478^2 = 0.18138.
    assert cells["empty"][20, 10] == pytest.approx(0.53910, abs=1e-4)
    assert cells["empty"][22, 10] == pytest.approx(0.09324, abs=1e-4)
    # Again: 0.53910 + 0.53910 - 0.53910^2.
    assert after(model, [beam(1.5)] * 2)[0]["empty"][20, 10] == pytest.approx(0.78757, abs=1e-4)
    assert cells["occupied"].sum() == pytest.approx(1, abs=1e-5)


def test_moravec_and_elfes_spread_one_occupied_over_the_arc():
    model = MORAVEC_ELFES
    # A cone of one cell: Or is 1 at 1.5 and 1 - (0.1 / 0.15)^2 = 0.55556 at 1.4 and 1.6; they sum to 2.11111.
    cells, _ = after(model, [beam(1.5, half=AXIS_ONLY)])
    np.testing.assert_allclose(on_axis(cells["occupied"], 1.4, 1.5, 1.6), [0.26316, 0.47368, 0.26316], atol=1e-4)
    # If 1.5 is known to be half empty, its share is half as large: 0.55556, 0.5, 0.55556 sum to 1.61111.
    known = {name: np.array(layer) for name, layer in blank(model).items()}
    known["empty"][20, 15] = 0.5
    cells, _ = after(model, [beam(1.5, half=AXIS_ONLY)], known)
    np.testing.assert_allclose(on_axis(cells["occupied"], 1.4, 1.5, 1.6), [0.34483, 0.31034, 0.34483], atol=1e-4)
    # The map is Occ where it is the larger, else -Emp; brought to [0, 1] that is (1 + 0.34483) / 2 and (1 - 0.5) / 2.
    np.testing.assert_allclose(on_axis(model.log_odds(cells), 1.4, 1.5), [logit(0.67241), logit(0.25)], atol=1e-3)


def test_moravec_and_elfes_follow_their_formulas_reading_by_reading():
    model = MORAVEC_ELFES
    e = 0.15
    empty, occupied = np.zeros((SIDE, SIDE)), np.zeros((SIDE, SIDE))
    for one in GENERIC * 2:
        R, p_occ = heard(one), np.zeros((SIDE, SIDE))
        for row, col, d, t in geometry(one):
            if abs(t) > HALF:
                continue
            across = 1 - (t / HALF) ** 2
            if d <= R - e and d <= 2.0:
                p = (1 - (max(d - MIN_M, 0) / (R - e - MIN_M)) ** 2) * across
                empty[row, col] += p - empty[row, col] * p
            if abs(d - R) <= e:
                p_occ[row, col] = (1 - ((d - R) / e) ** 2) * across * (1 - empty[row, col])
        p_occ /= max(p_occ.sum(), 1e-6)
        p_occ[seen_from(np.asarray(one.at, dtype=float), float(one.axis))[0] > 2.0] = 0
        occupied += p_occ - occupied * p_occ
    cells, _ = after(model, GENERIC * 2)
    np.testing.assert_allclose(cells["empty"], empty, atol=1e-4)
    np.testing.assert_allclose(cells["occupied"], occupied, atol=1e-4)


@pytest.mark.parametrize("name", ["moravec-elfes", "dempster-shafer"])
def test_an_arc_that_begins_within_reach_keeps_its_weight(name):
    # Were the evidence of an arc shared by those of its cells that are within reach, a reading a little farther than
    # that would make a few cells certain.
    model = BY_READINGS[name]
    told = (after(model, [beam(reading)])[0] for reading in (1.85, 2.09))
    whole, cut = (
        model.masses(cells)[1] if isinstance(model, DempsterShafer) else cells["occupied"] for cells in told
    )
    assert (cut > 0).sum() < (whole > 0).sum() / 2
    assert 0 < cut.max() < 1.5 * whole.max()


def test_elfes_weighs_the_echo_of_the_cell_against_that_of_anything_else():
    model = ELFES
    got = evidence(model, beam(1.5))
    # At 1.5: N(0; 0.1) = 3.9894 per m, times the 5 m of range 19.947; log(0.4 * 19.947 + 1 - 0.4 * 0.5) is
    # log(8.7788). At 0.5 the reading is 10 sigma beyond: log(1 - 0.4). At 2.0, 5 sigma before: nothing.
    np.testing.assert_allclose(on_axis(got, 0.5, 1.5, 2.0), [-0.51083, 2.17234, 0], atol=1e-4)
    for one in GENERIC:
        got, R = evidence(model, one), heard(one)
        for row, col, z, theta in geometry(one):
            a = 0.4 * exp(-((theta / 0.12) ** 2) / 2)
            p_occupied = a * normal(R - z, 0.1) + (1 - a * cdf((R - z) / 0.1)) / MAX_M
            told = abs(theta) <= HALF and z <= 2.0 and R - z > -0.3
            assert got[row, col] == pytest.approx(log(p_occupied / (1 / MAX_M)) if told else 0.0, abs=2e-4)


def nav2_sensor(r, phi, theta):
    """P of the layer's sensor model: physics.md, 5.4."""
    gamma = 0.0 if abs(theta) > HALF else 1 - (theta / HALF) ** 2
    delta = 1 - (1 + tanh(2 * (phi - 1.2))) / 2
    strength, width = delta * gamma, CELL_M * r
    if phi < r - 2 * width:
        return (1 - strength) * 0.5
    if phi < r - width:
        return strength * 0.5 * ((phi - (r - 2 * width)) / width) ** 2 + (1 - strength) * 0.5
    if phi < r + width:
        j = (r - phi) / width
        return strength * ((1 - 0.5 * j**2) - 0.5) + 0.5
    return 0.5


def nav2_cost(prior, p):
    """Cost of a cell after Bayes' rule, before it is cut to a whole number."""
    prior /= 254
    told = p * prior / (p * prior + (1 - p) * (1 - prior))
    return told * 254


def nav2_update(cost, one, clearing):
    """The layer's cells after a reading, before they are cut to whole numbers."""
    x, y, axis, r = float(one.at[0]), float(one.at[1]), float(one.axis), heard(one)
    cost = cost.astype(float)

    def cell(distance, turn):
        return (
            floor(y + distance / CELL_M * np.sin(axis + turn)),
            floor(x + distance / CELL_M * np.cos(axis + turn)),
        )

    row, col = cell(r, 0)
    if 0 <= row < SIDE and 0 <= col < SIDE:
        cost[row, col] = 233
    rows, cols = zip((floor(y), floor(x)), cell(1.2 * r, -HALF), cell(1.2 * r, HALF), strict=True)
    for row in range(max(min(rows), 0), min(max(rows), SIDE - 1) + 1):
        for col in range(max(min(cols), 0), min(max(cols), SIDE - 1) + 1):
            dx, dy = (col + 0.5 - x) * CELL_M, (row + 0.5 - y) * CELL_M
            theta = (np.arctan2(dy, dx) - axis + pi) % (2 * pi) - pi
            p = 0.0 if clearing else nav2_sensor(r, float(np.hypot(dx, dy)), float(theta))
            cost[row, col] = nav2_cost(cost[row, col], p)
    return cost


def test_nav2_by_hand():
    model = NAV2
    cells, _ = after(model, [beam(1.5)])
    # At 0.5: delta = 1 - (1 + tanh(-1.4)) / 2 = 0.94268, P = (1 - 0.94268) / 2 = 0.02866; from 127 / 254 = 1/2 the
    # cell becomes 0.02866 * 254 = 7.28. At 1.5 it is set to 233 / 254 = 0.91732 first; delta = 0.23148, P = 0.5 +
    # 0.23148 / 2 = 0.61574, odds 11.0952 * 1.60242 = 17.7792, p = 0.94675, times 254 is 240.47. At 1.8 the strength
    # counts no more.
    np.testing.assert_array_equal(on_axis(cells["cost"], 0.5, 1.5, 1.8), [7, 240, 127])
    # Again: odds at 0.5 of 7 / 247 times 0.02866 / 0.97134 give 0.00083551 * 254 = 0.21; at 1.5 it starts from 233.
    cells, _ = after(model, [beam(1.5)] * 2)
    np.testing.assert_array_equal(on_axis(cells["cost"], 0.5, 1.5, 1.8), [0, 240, 127])
    np.testing.assert_allclose(model.log_odds(cells)[20, [15, 18]], [logit(240 / 254), 0], atol=1e-4)


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.booleans())
def test_nav2_is_the_layer_as_shipped(seed, clearing):
    rng = np.random.default_rng(seed)
    model = NAV2_CLEARING if clearing else NAV2
    # The end of a clearing reading is 5 m away: the sonar stands where much of its box is in the square.
    one = beam(inf if clearing else rng.uniform(0.3, 4.9), rng.uniform(4, 37, 2), rng.uniform(-pi, pi))
    cost = rng.integers(0, 254, (SIDE, SIDE))
    expected = nav2_update(cost, one, clearing)
    cells, _ = after(model, [one], {"cost": cost.astype(np.float32)})
    # Where the exact cost is a whole number, which of its neighbours comes out is a matter of rounding.
    whole = np.abs(expected - np.rint(expected)) < 5e-3
    assert np.all(np.abs(cells["cost"] - expected)[whole] < 1.01)
    np.testing.assert_array_equal(cells["cost"][~whole], np.floor(expected[~whole]))
    # A cell that the sensor model says 1/2 of stays as it is, and so do those outside the box.
    np.testing.assert_array_equal(cells["cost"][expected == cost], cost[expected == cost])


def test_nav2_clears_the_whole_box_round_the_cone_when_nothing_came_back():
    # From the sonar at (0.5, 20.5) along the diagonal: the ends of the cone are 60 cells away, the box is all the
    # square beyond the sonar's row and column.
    cells, (spoken,) = after(NAV2_CLEARING, [beam(inf, axis=pi / 4)])
    box = np.zeros((SIDE, SIDE), dtype=bool)
    box[20:] = True
    np.testing.assert_array_equal(cells["cost"], np.where(box, 0, 127))
    np.testing.assert_array_equal(spoken, box)


def test_himm_counts_up_by_3_at_the_echo_and_down_by_1_before_it():
    model = HIMM
    counts = {"count": np.full((SIDE, SIDE), 5, dtype=np.float32), "told": np.zeros((SIDE, SIDE), dtype=bool)}
    counts["count"][20, [3, 15]] = 0, 14
    cells, (spoken,) = after(model, [beam(1.5)], counts)
    # On the axis: 5 - 1 before, 0 stays 0, 14 + 3 stops at 15, 5 behind; the rows beside stay.
    np.testing.assert_array_equal(on_axis(cells["count"], 0.1, 0.3, 1.4, 1.5, 1.6), [4, 0, 4, 15, 5])
    np.testing.assert_array_equal(np.delete(cells["count"], 20, axis=0), 5)
    np.testing.assert_array_equal(np.flatnonzero(spoken[20]), np.arange(1, 16))
    np.testing.assert_array_equal(spoken.sum(axis=1) > 0, np.arange(SIDE) == 20)
    # From nothing: 3 of 9 is a third; 0 is free where it was told, and unknown elsewhere.
    p = model.log_odds(after(model, [beam(1.5)])[0])
    np.testing.assert_allclose(on_axis(p, 1.4, 1.5, 1.6), [logit(1e-6), logit(1 / 3), 0], atol=1e-3)


def test_himm_goes_along_the_axis_whichever_way_it_points():
    model = HIMM
    for one in GENERIC:
        cells, (spoken,) = after(
            model, [one], {"count": np.full((SIDE, SIDE), 7.0), "told": np.zeros((SIDE, SIDE), bool)}
        )
        x, y = np.asarray(one.at) + heard(one) / CELL_M * np.array([np.cos(one.axis), np.sin(one.axis)])
        for row, col, d, t in geometry(one):
            ahead, aside = d * np.cos(t), d * np.sin(t)
            step = 0
            if d <= 2.0 and (row, col) == (floor(y), floor(x)):
                step = 3
            elif d <= 2.0 and abs(aside) <= 0.05 and 0 < ahead < heard(one):
                step = -1
            assert cells["count"][row, col] == 7 + step
            assert spoken[row, col] == (step != 0)


def test_himm_raises_the_one_cell_in_which_the_echo_lies_whichever_way_the_axis_points():
    rng = np.random.default_rng(3)
    nothing = {"count": np.zeros((SIDE, SIDE), np.float32), "told": np.zeros((SIDE, SIDE), bool)}
    for _ in range(200):
        at, axis, reading = rng.uniform(18, 23, 2), rng.uniform(-pi, pi), rng.uniform(0.3, 1.7)
        cells, _ = after(HIMM, [beam(reading, at, axis)], nothing)
        (raised,) = np.argwhere(cells["count"] > 0)
        x, y = at + reading / CELL_M * np.array([np.cos(axis), np.sin(axis)])
        # The end may be on the border of two cells but for rounding.
        assert np.all(np.abs(raised + 0.5 - (y, x)) < 0.5 + 1e-4)
        assert cells["count"][tuple(raised)] == 3


def muriel_spread(z):
    return sqrt((0.01 + 0.015 * z) ** 2 + CELL_M**2 / 12)


def muriel_evidence(R, z, off):
    """Log of p(D | C) / p(D | not C), the reading not specular: physics.md, 5.7, the wall anywhere in its cell."""
    a = 0.6 * (1 - min(1, z / 4)) * piston(off) ** 2
    F = 0.05
    p_occupied = (a * normal(R - z, muriel_spread(z)) + F) * (1 - a * cdf((R - z) / muriel_spread(z)) - F * R)
    return log(p_occupied / (F * (1 - F * R)))


def test_muriel_by_hand():
    got = evidence(MURIEL, beam(1.0))
    # At 1.0: a = 0.6 * 0.75 = 0.45, d = 0.025, in a cell of 0.1 m sqrt(0.025^2 + 0.1^2 / 12) = 0.038188, density
    # 10.4468; f = 0.45 * 10.4468 + 0.05 = 4.75106, first echo 1 - 0.45 / 2 - 0.05 = 0.725: log(4.75106 * 0.725 /
    # (0.05 * 0.95)) = log(72.516) = 4.2838. At 0.5: a = 0.525, (1 - 0.525 - 0.05) / 0.95 = 0.44737, log -0.80437.
    # At 2.0 the reading lies far before the cell: nothing.
    np.testing.assert_allclose(on_axis(got, 0.5, 1.0, 2.0), [-0.80437, 4.2838, 0], atol=2e-3)


def test_muriel_follows_its_formula():
    for one in GENERIC:
        got, R = evidence(MURIEL, one), heard(one)
        for row, col, z, off in geometry(one):
            told = abs(off) <= HALF and z <= 2.0 and (R - z) / muriel_spread(z) > -4
            expected = muriel_evidence(R, z, off) if told else 0.0
            assert got[row, col] == pytest.approx(expected, abs=5e-3)


def test_muriel_clears_a_cell_no_sooner_than_the_echo_may_have_left_it():
    # The reading is 0.03 short of the cell at 1.5; spread sqrt(0.0325^2 + 0.1^2 / 12) = 0.043495: Phi(-0.68973) =
    # 0.24518 of a = 0.6 * 0.625 = 0.375 lie before it. First echo 1 - 0.375 * 0.24518 / (1 - 0.05 * 1.47) = 0.90077;
    # density 9.1722 * exp(-0.68973^2 / 2) = 7.2305, times 0.375 over 0.05, and 1, is 55.229.
    got = evidence(MURIEL, beam(1.47))
    assert on_axis(got, 1.5)[0] == pytest.approx(log(55.229 * 0.90077), abs=2e-3)


@pytest.mark.parametrize("strength", [0.6, 0.9])
@pytest.mark.parametrize("background", [0.1, 0.18, 0.285, 2.0])
def test_muriel_keeps_to_densities_whatever_its_background(background, strength):
    # 0.285 per m over 5 m is 1.425: more than all. 0.9 / 5 = 0.18 is the most that counts, and then
    # 0.9 * (1 - 0.9) the most of a.
    model = replace(MURIEL, background=background, strength=strength)
    for reading in (0.5, 1.0, 4.8, inf):
        cleared = evidence(model, beam(reading))
        assert np.all(np.isfinite(cleared))
        assert cleared.min() > log(1 - 0.9) - 1e-4
    if background >= 0.18:
        np.testing.assert_array_equal(cleared, evidence(replace(model, background=0.18), beam(inf)))
        assert cleared[20, 1] == pytest.approx(log(1 - 0.09 / 0.1), abs=1e-3)


def test_muriel_takes_one_reading_from_one_place():
    model = MURIEL
    once, (first,) = after(model, [beam(1.5)])
    twice, (_, second) = after(model, [beam(1.5)] * 2)
    assert first.any()
    assert not second.any()
    for name, layer in once.items():
        np.testing.assert_array_equal(twice[name], layer)
    # To the cells on the axis 4 cm to the side are as good as the same place, another 30 cm of distance is not.
    _, (_, nudged) = after(model, [beam(1.5), beam(1.5, at=(0.6, 20.1))])
    assert not nudged[20, [8, 10, 11, 13]].any()
    _, (_, moved) = after(model, [beam(1.5, at=(4.0, 20.5)), beam(1.5)])
    assert moved[20, 5:14].all()


def wall(model, row, col, **layers):
    """Blank cells but for one, which holds what is given."""
    cells = {name: np.array(layer) for name, layer in blank(model).items()}
    for name, value in layers.items():
        cells[name][row, col] = value
    return cells


def test_muriel_discounts_a_reading_that_passes_through_a_wall_seen_head_on():
    model = MURIEL
    plain = evidence(model, beam(1.8))
    # Log-odds of log(3) are p = 0.75, so P_s = 0.8 * (2 * 0.75 - 1) = 0.4. At 0.5, a = 0.525 and
    # (1 - 0.525 - 0.09) / 0.91 = 0.42308: log(0.4 + 0.6 * 0.42308) = log(0.65385) = -0.42488 instead of -0.86020.
    passed = wall(model, 20, 10, evidence=log(3.0), normal=log(3.0))
    got = evidence(model, beam(1.8), cells=passed)
    assert on_axis(plain, 0.5)[0] == pytest.approx(-0.86020, abs=1e-3)
    assert on_axis(got, 0.5)[0] == pytest.approx(-0.42488, abs=1e-3)
    # The wall itself is cleared less too, and the arc behind it counts less.
    assert plain[20, 10] < got[20, 10] - log(3.0) < 0
    assert 0 < got[20, 18] < plain[20, 18]
    # A wall that was seen from the side alone, or one that lies behind the echo or beside the cone, changes nothing.
    for row, col, layers in (
        (20, 10, {"evidence": log(3.0)}),
        (20, 19, {"normal": log(3.0)}),
        (30, 10, {"normal": log(3.0)}),
        (20, 10, {"normal": -log(3.0)}),
    ):
        got = np.array(evidence(model, beam(1.8), cells=wall(model, row, col, **layers)))
        got[row, col] -= layers.get("evidence", 0.0)
        np.testing.assert_allclose(got, plain, atol=1e-5)


def test_muriel_learns_which_walls_were_seen_head_on():
    model = MURIEL
    cells, _ = after(model, [beam(1.5)])
    _, _, off = seen_from((0.5, 20.5), 0.0)
    head_on = np.abs(off) <= np.deg2rad(7.5)
    np.testing.assert_allclose(cells["normal"], np.where(head_on, cells["evidence"], 0), atol=1e-6)
    assert cells["evidence"][18, 15] > 0 == cells["normal"][18, 15]
    # The same wall and the same later reading from 30 cm farther off; the wall was seen head-on or 10 degrees off.
    seen = [beam(1.5, (3.5, 20.5), turn) for turn in (0.0, np.deg2rad(10.0))]
    cleared = [evidence(model, one, beam(2.5))[20, 5] - evidence(model, one)[20, 5] for one in seen]
    assert cleared[1] < cleared[0] < 0


def test_dempsters_rule_by_hand():
    model = DEMPSTER_SHAFER
    # Two readings that pass: 0.2 and 0.2 make 1 - 0.8 * 0.8 = 0.36 for empty. The read-out is m(occupied) +
    # m(either) / 2 = 0.64 / 2.
    cells, _ = after(model, [beam(1.9, half=AXIS_ONLY)] * 2)
    assert model.masses(cells)[0][20, 15] == pytest.approx(0.36, abs=1e-6)
    assert model.log_odds(cells)[20, 15] == pytest.approx(logit(0.32), abs=1e-4)
    # Then an arc of three cells, 1/3 each: K = 1 - 0.36 / 3 = 0.88; empty 0.36 * (2/3) / 0.88 = 0.27273, occupied
    # 0.64 * (1/3) / 0.88 = 0.24242.
    cells, _ = after(model, [beam(1.52, half=AXIS_ONLY)], cells)
    empty, occupied = model.masses(cells)
    assert empty[20, 15] == pytest.approx(0.27273, abs=1e-5)
    assert occupied[20, 15] == pytest.approx(0.24242, abs=1e-5)
    assert model.log_odds(cells)[20, 15] == pytest.approx(logit(0.48485), abs=1e-4)
    # Blank cells take the mass of the arc as it is; those behind it stay.
    empty, occupied = model.masses(after(model, [beam(1.52, half=AXIS_ONLY)])[0])
    np.testing.assert_allclose(on_axis(occupied, 1.3, 1.4, 1.5, 1.6, 1.7), [0, 1 / 3, 1 / 3, 1 / 3, 0], atol=1e-6)
    np.testing.assert_allclose(on_axis(empty, 0.1, 1.3, 1.4, 1.7), [0.2, 0.2, 0, 0], atol=1e-6)


def test_dempsters_rule_of_all_readings():
    model = DEMPSTER_SHAFER
    masses = {}
    for one in GENERIC:
        cone = [(row, col, d) for row, col, d, t in geometry(one) if abs(t) <= HALF]
        n = sum(abs(d - heard(one)) <= 0.15 for _, _, d in cone)
        for row, col, d in cone:
            new = (0.0, 1 / n) if abs(d - heard(one)) <= 0.15 else (0.2, 0.0) if d < heard(one) else (0.0, 0.0)
            if d > 2.0:
                continue
            # Of all pairs of sets, those that agree on one set are its mass; those that contradict are left out.
            mass = {}
            old = masses.get((row, col), (0.0, 0.0))
            for a, p in (("E", old[0]), ("F", old[1]), ("EF", 1 - sum(old))):
                for b, q in (("E", new[0]), ("F", new[1]), ("EF", 1 - sum(new))):
                    both = "".join(sorted(set(a) & set(b)))
                    mass[both] = mass.get(both, 0.0) + p * q
            masses[row, col] = tuple(mass.get(one_set, 0.0) / (1 - mass.get("", 0.0)) for one_set in ("E", "F"))
    got = model.masses(after(model, GENERIC)[0])
    for index in np.ndindex(SIDE, SIDE):
        for layer, mass in zip(got, masses.get(index, (0.0, 0.0)), strict=True):
            assert layer[index] == pytest.approx(mass, abs=1e-5)


def test_dempsters_rule_holds_its_digits_however_often_it_is_told():
    model = DEMPSTER_SHAFER
    # 200 looks through the cell leave q(occupied) = 0.8^200 = 4e-20, 150 arcs of three cells q(empty) = (2/3)^150.
    free, arc = beam(1.9, half=AXIS_ONLY), beam(1.52, half=AXIS_ONLY)
    orders = [free] * 200 + [arc] * 150, [arc] * 150 + [free] * 200, [free] * 50 + [free, arc] * 150
    q_empty, q_occupied = (2 / 3) ** 150, 0.8**200
    either = q_empty * q_occupied
    expected = log((q_occupied - either / 2) / (q_empty - either / 2))
    for beams in orders:
        assert evidence(model, *beams)[20, 15] == pytest.approx(expected, abs=2e-3)
    # So sure of one that what is left for the other is not a number of 32 bits.
    assert evidence(model, *[free] * 200)[20, 15] == pytest.approx(200 * log(0.8) - log(2), abs=1e-3)
    assert evidence(model, *[arc] * 150)[20, 15] == pytest.approx(150 * log(1.5) + log(2), abs=1e-3)


def test_an_arc_of_a_single_cell_is_not_certain():
    model = DempsterShafer(2.0, False, rho=0.2, thickness_m=0.05)
    assert model.masses(after(model, [beam(1.5, half=AXIS_ONLY)])[0])[1][20, 15] == pytest.approx(0.5)


def dombi(*memberships):
    """Dombi's union with lambda = 1/2, two by two."""
    united = 0.0
    for m in memberships:
        if m == 0 or united == 0:
            united = max(m, united)
        else:
            total = (1 / united - 1) ** -0.5 + (1 / m - 1) ** -0.5
            united = 1 / (1 + total**-2)
    return united


def test_fuzzy_by_hand():
    model = FUZZY
    # At 0.6, reading 1.5: visibility 1 - (1 + tanh(2 * (0.6 - 1.2))) / 2 = 0.91683, empty 0.1 * 0.91683 = 0.091683.
    # At 1.4, within 0.2 of the reading: ramp (0.1 / 0.2)^2 = 1/4, visibility 0.31003: empty 0.1 * 0.31003 / 4 =
    # 0.0077507, occupied 0.4 * 0.31003 * 3/4 = 0.093008. At 1.5: visibility 0.23148, occupied 0.092590.
    empty, occupied = model.sets(after(model, [beam(1.5)])[0])
    np.testing.assert_allclose(on_axis(empty, 0.6, 1.4, 1.5, 1.6), [0.091683, 0.0077507, 0, 0], atol=1e-4)
    np.testing.assert_allclose(on_axis(occupied, 0.6, 1.2, 1.4, 1.5), [0, 0, 0.093008, 0.092590], atol=1e-4)
    # United with itself: S = 2 * sqrt(0.091683 / 0.908317) = 0.63541, S^2 / (1 + S^2) = 0.28762.
    cells, _ = after(model, [beam(1.5)] * 2)
    empty, occupied = model.sets(cells)
    assert empty[20, 6] == pytest.approx(0.28762, abs=1e-4)
    assert dombi(0.091683, 0.091683) == pytest.approx(0.28762, abs=1e-4)
    # (1 + O - E) / 2 is read out; the safe cells are E^2 (1 - O) (1 - E O) (1 - (1 - E) (1 - O)): with O = 0, E^3.
    assert model.log_odds(cells)[20, 6] == pytest.approx(logit((1 - 0.28762) / 2), abs=1e-3)
    assert model.safe(cells)[20, 6] == pytest.approx(0.28762**3, abs=1e-4)
    e, o = empty[20, 14], occupied[20, 14]
    assert e > 0.01
    assert o > 0.1
    assert model.safe(cells)[20, 14] == pytest.approx(e**2 * (1 - o) * (1 - e * o) * (e + o - e * o), rel=1e-5)


def test_fuzzy_follows_its_formulas_and_unites_all_readings():
    model = FUZZY
    empties, occupieds = ({index: [] for index in np.ndindex(SIDE, SIDE)} for _ in range(2))
    for one in GENERIC:
        R = heard(one)
        for row, col, d, t in geometry(one):
            if abs(t) > HALF or d > 3.0:
                continue
            fades = piston(t) * (1 - (1 + tanh(2 * (d - 1.2))) / 2)
            if d < R:
                empties[row, col].append(0.1 * (1 if d < R - 0.2 else ((R - d) / 0.2) ** 2) * fades)
            if abs(d - R) <= 0.2:
                occupieds[row, col].append(0.4 * (1 - ((R - d) / 0.2) ** 2) * fades)
    got = model.sets(after(model, GENERIC)[0])
    for layer, expected in zip(got, (empties, occupieds), strict=True):
        for index, memberships in expected.items():
            assert layer[index] == pytest.approx(dombi(*memberships), abs=2e-4)


def lim_cho_back(bearing, k):
    """Probability that a surface facing somewhere in the 30 degrees round 30 k sends sound from a bearing back."""
    turns = np.deg2rad(30 * k + np.linspace(-15, 15, 3001))
    off = np.abs((bearing - turns) % (2 * pi) - pi)
    return np.mean(np.where(off <= HALF, 1.0, 0.05))


def test_lim_and_cho_by_hand():
    model = LIM_CHO
    cells, _ = after(model, [beam(1.55)])
    # The range confidence is exp(-1.55 / 2) = 0.46070. On the arc log(0.7 / 0.3) = 0.84730: 0.39035. Of a cell on the
    # axis before it one orientation of twelve faces the sonar, 25 of whose 30 degrees send back: it is seen with
    # (12 * 0.05 + 0.95 * 25 / 30) / 12 = 0.115972, cleared by log(1 - 0.115972) = -0.123268 times 0.46070: -0.056790.
    np.testing.assert_allclose(on_axis(cells["evidence"], 0.5, 1.5, 1.7), [-0.056790, 0.39035, 0], atol=1e-4)
    # The arc's cell learned that it faces the sonar (180 degrees, the 7th): (0.05 + 0.95 * 25 / 30) / 12 / 0.115972 =
    # 0.60479, each other 0.05 / 12 / 0.115972 = 0.035928.
    expected = np.full(12, 0.035928)
    expected[6] = 0.60479
    np.testing.assert_allclose(cells["orientation"][20, 15], expected, atol=1e-4)
    np.testing.assert_allclose(cells["orientation"][20, 5], 1 / 12, atol=1e-6)


def test_lim_and_cho_follow_their_rules():
    model = LIM_CHO
    total, orientation = np.zeros((SIDE, SIDE)), np.full((SIDE, SIDE, 12), 1 / 12)
    for one in GENERIC:
        R = heard(one)
        trust = exp(-R / 2)
        for row, col, d, t in geometry(one):
            if abs(t) > HALF or d > 2.0 or d >= R + 0.1:
                continue
            back = np.array([lim_cho_back(float(one.axis) + t, k) for k in range(12)])
            seen = float(np.sum(back * orientation[row, col]))
            if d > R - 0.1:
                total[row, col] += trust * logit(0.7)
                orientation[row, col] *= back / seen
            else:
                total[row, col] += trust * log(1 - seen)
    cells, _ = after(model, GENERIC)
    np.testing.assert_allclose(cells["evidence"], total, atol=1e-3)
    np.testing.assert_allclose(cells["orientation"], orientation, atol=1e-3)


def test_lim_and_cho_clear_a_wall_from_the_side_that_it_faces():
    model = LIM_CHO
    # A wall seen head-on twice; then a reading passes it from the same side, from the other side, and along it.
    cells, _ = after(model, [beam(1.5, (0.5, 20.5))] * 2)
    through = {
        "same": beam(1.9, (3.5, 20.5)),
        "other": beam(1.9, (28.5, 20.5), pi),
        "along": beam(1.9, (15.5, 8.5), pi / 2),
    }
    cleared = {
        side: (evidence(model, one, cells=cells) - model.log_odds(cells))[20, 15] for side, one in through.items()
    }
    assert cleared["same"] < 4 * cleared["other"] < 0
    assert cleared["same"] < 4 * cleared["along"] < 0
    # An unseen cell may face anywhere: it is cleared as much from all sides.
    blank_cleared = [evidence(model, one)[20, 15] for one in through.values()]
    np.testing.assert_allclose(blank_cleared, blank_cleared[0], atol=1e-6)
    assert cleared["same"] < blank_cleared[0] < cleared["other"]


def random_beams(seed, count, model):
    rng = np.random.default_rng(seed)
    readings = rng.uniform(MIN_M, 4.9, count)
    readings[rng.random(count) < 0.5] /= 3
    if model.no_echo:
        readings[rng.random(count) < 0.3] = inf
    return [beam(max(r, MIN_M), rng.uniform(5, 36, 2), rng.uniform(-pi, pi)) for r in readings]


@every_reading_model
@settings(max_examples=12)
@given(seed=st.integers(0, 10_000))
def test_a_reading_leaves_the_cells_outside_its_cone_alone(name, seed):
    model = BY_READINGS[name]
    *before, one = random_beams(seed, 4, model)
    old, _ = after(model, before)
    new, (spoken,) = after(model, [one], old)
    told = np.zeros((SIDE, SIDE), dtype=bool)
    for layer in model.blank():
        differ = new[layer] != old[layer]
        told |= differ.any(axis=-1) if differ.ndim == 3 else differ
    assert not np.any(told & ~spoken)
    distance, _, off = seen_from(np.asarray(one.at, dtype=float), float(one.axis))
    ahead, aside = distance * np.cos(off), distance * np.abs(np.sin(off))
    cone = np.abs(off) <= HALF + 1e-4
    if model is HIMM:
        cone = (aside <= CELL_M / 2 + 1e-4) & (ahead > 0)
        cone |= np.hypot(ahead - heard(one), aside) < CELL_M * 0.71
    elif name.startswith("nav2"):
        # Also the cell in which the axis ends, if its centre is beside a narrow cone.
        cone |= np.hypot(ahead - heard(one), aside) < CELL_M * 0.71
        if not np.isfinite(one.reading):
            return
    far = min(
        {FUZZY: 3.0, NAV2: inf, NAV2_CLEARING: inf, NAV2_TUNED: inf}.get(model, 2.0),
        max(heard(one) + 0.31, 1.11 * heard(one)),
    )
    assert not np.any(spoken & ~(cone & (distance < far + 1e-3)))
    assert spoken.any() or distance[cone].min() > far


@every_reading_model
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_what_a_cell_keeps_stays_within_its_bounds(name, seed):
    model = BY_READINGS[name]
    cells, _ = after(model, random_beams(seed, 12, model))
    for layer in cells.values():
        assert np.all(np.isfinite(layer))
    if name == "moravec-elfes":
        for layer in ("empty", "occupied"):
            assert cells[layer].min() >= 0
            assert cells[layer].max() <= 1
    if isinstance(model, DempsterShafer):
        empty, occupied = model.masses(cells)
        assert min(empty.min(), occupied.min()) >= 0
        assert np.max(empty + occupied) <= 1 + 1e-6
    if name == "himm":
        assert set(np.unique(cells["count"])) <= set(range(16))
    if name.startswith("nav2"):
        assert set(np.unique(cells["cost"])) <= set(range(255))
    if isinstance(model, Fuzzy):
        for fuzzy_set in (*model.sets(cells), model.safe(cells)):
            assert fuzzy_set.min() >= 0
            assert fuzzy_set.max() < 1
    if name == "lim-cho":
        np.testing.assert_allclose(cells["orientation"].sum(axis=-1), 1, atol=1e-5)
        assert cells["orientation"].min() > 0
    assert np.all(np.isfinite(model.log_odds(cells)))


def test_himm_stays_within_its_bounds_however_often_it_is_told():
    cells, _ = after(HIMM, [beam(1.5)] * 7 + [beam(1.0)] * 3)
    np.testing.assert_array_equal(on_axis(cells["count"], 0.5, 1.0, 1.5), [0, 9, 15])
    cells, _ = after(HIMM, [beam(1.9)] * 20, cells)
    np.testing.assert_array_equal(on_axis(cells["count"], 0.5, 1.0, 1.5, 1.9), [0, 0, 0, 15])


# Sums of log-odds, Dempster's rule and Dombi's union do not ask in which order they are told; what the other models
# make of a reading depends on what the map has already.
@pytest.mark.parametrize("name", ["cone", "cone-no-echo", "elfes", "dempster-shafer", "fuzzy"])
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_the_order_of_the_readings_does_not_matter(name, seed):
    model = BY_READINGS[name]
    beams = random_beams(seed, 8, model)
    turned = [beams[i] for i in np.random.default_rng(seed).permutation(len(beams))]
    one, other = after(model, beams)[0], after(model, turned)[0]
    for layer, values in one.items():
        np.testing.assert_allclose(other[layer], values, atol=1e-4)


@every_reading_model
@settings(max_examples=6)
@given(seed=st.integers(0, 10_000))
def test_a_mirrored_scene_gives_the_mirrored_map(name, seed):
    model = BY_READINGS[name]
    beams = random_beams(seed, 4, model)
    mirrored = [beam(np.asarray(b.reading), (float(b.at[0]), SIDE - float(b.at[1])), -float(b.axis)) for b in beams]
    here, there = evidence(model, *beams), evidence(model, *mirrored)[::-1]
    # Cells at the very border of a case may fall to either side of it.
    assert np.mean(~np.isclose(here, there, atol=1e-3)) < 0.003
    assert np.any(here)


@pytest.mark.parametrize("name", [name for name, model in BY_READINGS.items() if model.no_echo])
def test_no_echo_frees_cells_and_fills_none(name):
    got = evidence(BY_READINGS[name], beam(inf, axis=0.2))
    assert got.max() <= 0
    assert got[22, 10] < -0.1


FOUR = Robot(
    name="four",
    footprint_radius_m=0.2,
    transducer=TRANSDUCERS["polaroid-600"],
    min_range_m=0.2,
    max_range_m=3.0,
    beam_width_rad=np.deg2rad(25),
    mounts=np.array([[0.15, 0, 0], [0.13, 0.07, np.deg2rad(20)], [0.13, -0.07, -np.deg2rad(20)], [-0.15, 0, pi]]),
)
"""Three sonars to the front and one to the rear."""

WALL_M = 2.05
"""The wall is the line x = 2.05, the middle of a column of cells."""


def frame(x, y, theta, ranges):
    return Frame(0.0, np.array([x, y, theta], dtype=float), np.array(ranges, dtype=float))


def before_the_wall(x, y, rear=inf):
    """A frame of a robot that looks straight at the wall; in a cone 7.5 degrees is nearest to its normal."""
    ahead, aside = WALL_M - x - 0.15, (WALL_M - x - 0.13) / np.cos(np.deg2rad(7.5))
    return frame(x, y, 0.0, [ahead, aside, aside, rear])


DRIVE = [before_the_wall(x, 0.05) for x in np.arange(0.05, 1.0, 0.15)]


def mapped(name, frames, by=(0, 0)):
    """The last map of a drive moved by whole cells (x, y)."""
    steps = np.array([*by, 0]) * CELL_M
    moved = [Frame(f.stamp, f.pose + steps, f.ranges) for f in frames]
    *_, grid = build_map(moved, FOUR, ALL[name], CELL_M)
    return grid


def on_canvas(grid, shape=(60, 320), first=(-28, -28)):
    """Log-odds and observed cells of a map on a part of the world that is the same for all."""
    row, col = np.rint(np.array(grid.origin[::-1]) / CELL_M).astype(int) - first
    log_odds, observed = np.zeros(shape), np.zeros(shape, dtype=bool)
    rows, cols = np.nonzero(grid.observed)
    log_odds[rows + row, cols + col] = grid.log_odds[rows, cols]
    observed[rows + row, cols + col] = True
    return log_odds, observed


def test_every_classical_model_is_tested():
    assert set(ALL) == set(MODELS) - {"network", "set-network"}
    for name, model in ALL.items():
        assert type(MODELS[name]()) is type(model)
        assert model.name == name


@every_model
def test_a_wall_straight_ahead_is_on_the_map_and_the_floor_before_it_is_free(name):
    grid = mapped(name, DRIVE)
    wall = grid.probability_at(np.array([[WALL_M, y] for y in (0.05, -0.15, 0.25)]))
    floor = grid.probability_at(np.array([[x, 0.05] for x in np.arange(0.05, 1.7, 0.1)]))
    # One cause of an echo is enough for the forward model, and of all cells of the wall it may be any.
    assert (wall.max() if name == "em" else wall[0]) > 0.5
    assert floor.max() < 0.5
    # Of what nobody has seen nothing is known: behind the wall, and beside the drive.
    unknown = grid.probability_at(np.array([[2.75, 0.05], [0.5, 1.5], [0.5, -1.5]]))
    np.testing.assert_array_equal(unknown, 0.5)
    np.testing.assert_array_equal(grid.log_odds[~grid.observed], 0)


@every_model
def test_where_the_robot_stood_the_map_is_free(name):
    # The sonars claim that something stands in the robot's way, and it drives through.
    frames = [frame(x, 0.05, 0.0, [0.4, 0.4, 0.4, 0.4]) for x in np.arange(0.05, 1.2, 0.1)]
    grid = mapped(name, frames)
    way = grid.probability_at(np.array([[x, y] for x in np.arange(0.05, 1.1, 0.1) for y in (-0.05, 0.05, 0.15)]))
    assert way.max() < 0.03
    claimed = mapped(name, frames[:1]).probability_at(np.array([[0.65, 0.05]]))
    assert claimed > way.max()


@every_model
def test_a_frame_in_which_nothing_fired_adds_the_floor_alone(name):
    silent = frame(0.43, 0.52, 0.3, [nan] * 4)
    alone = mapped(name, [silent])
    x, y = np.moveaxis(alone.centre_of(np.moveaxis(np.indices(alone.shape), 0, -1)), -1, 0)
    floor = np.hypot(x - 0.43, y - 0.52) < 0.2
    assert floor.sum() > 8
    np.testing.assert_array_equal(alone.observed, floor)
    np.testing.assert_allclose(alone.probability(), np.where(floor, 0.02, 0.5), atol=1e-3)
    with_it, without = on_canvas(mapped(name, [*DRIVE, silent])), on_canvas(mapped(name, DRIVE))
    added = on_canvas(alone)[1]
    np.testing.assert_array_equal(with_it[1], without[1] | added)
    np.testing.assert_array_equal(with_it[0][~added], without[0][~added])


@pytest.mark.parametrize("name", [name for name, model in BY_READINGS.items() if not model.no_echo])
def test_a_missing_echo_that_is_ignored_changes_nothing(name):
    grids = [mapped(name, [before_the_wall(f.pose[0], 0.05, rear) for f in DRIVE]) for rear in (inf, nan)]
    np.testing.assert_array_equal(*(grid.log_odds for grid in grids))
    np.testing.assert_array_equal(*(grid.observed for grid in grids))


@every_model
def test_a_drive_moved_by_whole_cells_moves_the_map(name):
    here, there = mapped(name, DRIVE), mapped(name, DRIVE, by=(-17, 8))
    np.testing.assert_allclose(there.origin, np.array(here.origin) + np.array([-17, 8]) * CELL_M, atol=1e-9)
    assert here.shape == there.shape
    # A cell at the very border of a case may fall to either side of it.
    differ = ~np.isclose(here.log_odds, there.log_odds, atol=1e-3) | (here.observed != there.observed)
    assert differ.mean() < 0.002
    assert here.log_odds.max() > 0.1


@every_model
def test_drives_far_apart_are_each_mapped_as_if_alone(name):
    # The poses jump 20 m from frame to frame: each part of the map is left and come back to.
    both = [f for here in DRIVE for f in (here, frame(here.pose[0] + 20.0, 0.05, 0.0, here.ranges))]
    log_odds, observed = on_canvas(mapped(name, both))
    parts = [on_canvas(mapped(name, DRIVE, by)) for by in ((0, 0), (200, 0))]
    assert not np.any(parts[0][1] & parts[1][1])
    np.testing.assert_array_equal(observed, parts[0][1] | parts[1][1])
    np.testing.assert_allclose(log_odds, parts[0][0] + parts[1][0], atol=1e-4)
