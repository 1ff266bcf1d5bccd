from dataclasses import dataclass
from math import inf, nan, pi

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echogrid.frame import Frame
from echogrid.mapping.build import build_map
from echogrid.models.batches import WINDOW_M
from echogrid.models.classical.sweep import Reading, ReadingModel, margin_cells, reading_of, square_side, sweeper
from echogrid.robot import TRANSDUCERS, Robot

pytestmark = pytest.mark.filterwarnings("ignore::echogrid.DoubtWarning")  # places in no order of driving

B21 = Robot.load("b21")
CELL_M = 0.1


@dataclass(frozen=True)
class Probe(ReadingModel):
    """Writes down what it is shown of each cell of the cone, and how often it is shown the cell."""

    reach_m: float = 2.0
    no_echo: bool = True
    name: str = "probe"

    SHOWN = ("row", "col", "reading", "x", "y", "axis", "distance", "bearing", "off_axis", "nearest", "amplitude")

    def reach(self, robot):
        return self.reach_m

    def blank(self):
        return {name: np.float32(0)[...] for name in ("count", *self.SHOWN)}

    def update(self, cells, beam):
        inside = beam.inside(self.reach_m)
        x, y = beam.at
        row, col = jnp.indices(inside.shape)
        shown = beam._asdict() | {"row": row, "col": col, "x": x, "y": y, "amplitude": beam.amplitude()}
        told = {name: jnp.where(inside, shown[name].astype(jnp.float32), cells[name]) for name in self.SHOWN}
        return told | {"count": cells["count"] + inside}, inside

    def log_odds(self, cells):
        return cells["count"]


def robot_of(mounts, beam_width_deg=25.0, max_range_m=5.0):
    """A robot without a body: no cell is under it."""
    mounts = np.array(mounts, dtype=float)
    width = float(np.deg2rad(beam_width_deg))
    return Robot("bodiless", 0.0, TRANSDUCERS["polaroid-600"], 0.15, max_range_m, width, mounts)


def frame(x, y, theta, ranges):
    return Frame(0.0, np.array([x, y, theta], dtype=float), np.array(ranges, dtype=float))


def wrapped(angle):
    return (angle + pi) % (2 * pi) - pi


def seen_from(sonar, x, y):
    """Distance (m) and bearing off the axis of points from a sonar x, y, axis."""
    return np.hypot(x - sonar[0], y - sonar[1]), wrapped(np.arctan2(y - sonar[1], x - sonar[0]) - sonar[2])


def sonars_of(robot, pose):
    """x, y, axis of each sonar in the world."""
    x, y, theta = pose
    mx, my, axis = robot.mounts.T
    return np.stack(
        [x + np.cos(theta) * mx - np.sin(theta) * my, y + np.sin(theta) * mx + np.cos(theta) * my, axis + theta],
        axis=1,
    )


def swept(robot, model, poses, ranges, only=slice(None)):
    """What a model has in the cells of a window after the readings, and x, y (m) of the cells' centres."""
    side, poses, ranges = 90, np.array(poses, dtype=float), np.array(ranges, dtype=float)
    assert margin_cells(robot, model, CELL_M) <= side / 2 - 1
    corner = np.floor(poses[0, 1::-1] / CELL_M).astype(np.int64) - side // 2
    cells = {name: np.full((side, side), value) for name, value in model.blank().items()}
    cells["observed"] = np.zeros((side, side), dtype=bool)
    fields = [field[only] for field in reading_of(robot, poses, ranges, corner, CELL_M)]
    # Filled up to one length, so that one compilation serves all.
    fill = 8 - len(fields[0])
    fields[0] = np.pad(fields[0], (0, fill), constant_values=nan)
    reading = Reading(
        fields[0], *(np.concatenate([field, [field[0]] * fill]) if fill else field for field in fields[1:])
    )
    y, x = ((np.arange(side) + 0.5 + first) * CELL_M for first in corner)
    return sweeper(robot, model, CELL_M)(cells, reading), *np.meshgrid(x, y)


def test_readings_are_placed_in_the_window_scan_by_scan():
    # The axes of the ring are not in order.
    robot = robot_of([[0.5, 0, 0], [-0.5, 0, pi], [0, 0.25, pi / 2], [0, -0.25, -pi / 2]])
    poses = np.array([[1.0, 2.0, pi / 2], [1.0, 2.0, 0.0]])
    ranges = np.array([[1.0, 2.0, 3.0, inf], [5.0, 6.0, nan, 8.0]])
    reading = reading_of(robot, poses, ranges, np.array([10, 5]), 0.1)
    np.testing.assert_array_equal(reading.range, ranges.ravel())
    # The robot looks along +y: its front sonar is at (1.0, 2.5) m, that is (10 - 5, 25 - 10) in cells of the window.
    np.testing.assert_allclose(reading.at[:4], [[5, 15], [5, 5], [2.5, 10], [7.5, 10]], atol=1e-5)
    np.testing.assert_allclose(reading.at[4:], [[10, 10], [0, 10], [5, 12.5], [5, 7.5]], atol=1e-5)
    np.testing.assert_allclose(reading.axis[:4], [pi / 2, 3 * pi / 2, pi, 0], atol=1e-5)
    # Beside the front sonar are the right and the left one, beside the left one the front and the rear one.
    np.testing.assert_allclose(reading.beside_axis[0], [0, pi], atol=1e-5)
    np.testing.assert_allclose(reading.beside_axis[2], [pi / 2, 3 * pi / 2], atol=1e-5)
    np.testing.assert_allclose(reading.beside_at[0], [[7.5, 10], [2.5, 10]], atol=1e-5)


def test_a_model_is_shown_distance_and_bearing_of_each_cells_own_centre():
    robot = robot_of([[0.21, -0.13, 0.4]])
    for pose in ([0.33, -0.71, 2.1], [-7.77, 12.34, -3.0], [0.05, 0.05, 0.77], [1234.56, -777.77, 9.0]):
        cells, x, y = swept(robot, Probe(), [pose], [[1.234]])
        sonar = sonars_of(robot, pose)[0]
        distance, off = seen_from(sonar, x, y)
        inside = (np.abs(off) <= np.deg2rad(12.5)) & (distance <= 2.0)
        np.testing.assert_array_equal(cells["count"] > 0, inside)
        np.testing.assert_array_equal(cells["observed"], inside)
        assert inside.sum() > 80
        expected = {"reading": 1.234, "distance": distance, "off_axis": off, "nearest": 1.0}
        for name, value in expected.items():
            np.testing.assert_allclose(cells[name][inside], np.broadcast_to(value, x.shape)[inside], atol=2e-4)
        turn = wrapped(cells["bearing"] - cells["axis"] - cells["off_axis"])[inside]
        np.testing.assert_allclose(turn, 0, atol=1e-5)
        assert float(wrapped(cells["axis"][inside][0] - sonar[2])) == pytest.approx(0, abs=1e-5)


def test_a_model_is_shown_where_in_its_square_the_sonar_is():
    robot = robot_of([[0.2, 0.1, 0.4]])
    cells, _, _ = swept(robot, Probe(), [[0.33, -0.71, 2.1]], [[1.0]])
    told = {name: layer[cells["count"] > 0] for name, layer in cells.items()}
    for place, along, at in (("col", np.cos, "x"), ("row", np.sin, "y")):
        centre = told[at] + told["distance"] / CELL_M * along(told["axis"] + told["off_axis"])
        np.testing.assert_allclose(centre, told[place] + 0.5, atol=1e-3)


@dataclass(frozen=True)
class Pointer(Probe):
    """Marks the cell at 1.2 m, 0.1 rad to the left of the axis."""

    def update(self, cells, beam):
        there = beam.is_cell(*beam.cell_at(jnp.float32(1.2), 0.1))
        return {**cells, "count": cells["count"] + there, "distance": jnp.full(there.shape, beam.heard())}, there


def test_a_place_before_the_sonar_is_in_one_cell():
    robot = robot_of([[0.21, -0.13, 0.4]])
    for pose in ([0.33, -0.71, 2.1], [-7.77, 12.34, -3.0], [0.05, 0.05, 0.77]):
        cells, x, y = swept(robot, Pointer(), [pose], [[1.0]])
        sx, sy, axis = sonars_of(robot, pose)[0]
        to = sx + 1.2 * np.cos(axis + 0.1), sy + 1.2 * np.sin(axis + 0.1)
        there = (np.abs(x - to[0]) < CELL_M / 2) & (np.abs(y - to[1]) < CELL_M / 2)
        np.testing.assert_array_equal(cells["count"], there)
        assert there.sum() == 1
        assert cells["distance"][there] == pytest.approx(1.0)
    # Without an echo the beam was free as far as it goes.
    cells, _, _ = swept(robot, Pointer(), [pose], [[inf]])
    assert cells["distance"][cells["count"] > 0] == pytest.approx(5.0)


def test_readings_are_taken_one_after_the_other_and_silent_ones_not_at_all():
    robot = robot_of([[0, 0, 0]])
    poses = [[0.0, 0.0, 0.0]] * 5
    cells, _, _ = swept(robot, Probe(), poses, [[1.0], [nan], [2.0], [inf], [nan]])
    shown = cells["count"] > 0
    np.testing.assert_array_equal(cells["count"][shown], 3)
    np.testing.assert_array_equal(cells["reading"][shown], inf)
    cells, _, _ = swept(robot, Probe(no_echo=False), poses, [[1.0], [nan], [2.0], [inf], [nan]])
    np.testing.assert_array_equal(cells["count"][shown], 2)
    np.testing.assert_array_equal(cells["reading"][shown], 2.0)
    cells, _, _ = swept(robot, Probe(no_echo=False), poses, [[nan], [nan], [inf], [inf], [nan]])
    assert not any(np.any(layer) for layer in cells.values())


def test_a_cell_beyond_the_maximum_range_is_not_in_the_cone():
    cells, x, y = swept(robot_of([[0, 0, 0]], max_range_m=1.5), Probe(), [[0.02, 0.01, 0.3]], [[1.0]])
    distance, off = seen_from((0.02, 0.01, 0.3), x, y)
    np.testing.assert_array_equal(cells["count"] > 0, (np.abs(off) <= np.deg2rad(12.5)) & (distance <= 1.5))


@pytest.mark.parametrize("pose", [[0.0, 0.0, 0.0], [0.37, -0.12, 1.0]])
def test_nearest_is_the_sonar_of_the_whole_ring_whose_axis_is_nearest(pose):
    told = np.zeros(24)
    for sonar in range(24):
        cells, x, y = swept(B21, Probe(), [pose], [np.full(24, 1.0)], only=slice(sonar, sonar + 1))
        off = np.abs([seen_from(each, x, y)[1] for each in sonars_of(B21, pose)])
        mine, others = off[sonar], np.delete(off, sonar, axis=0).min(axis=0)
        clear = (cells["count"] > 0) & (np.abs(mine - others) > 1e-4)
        assert clear.sum() > 60
        np.testing.assert_array_equal(cells["nearest"][clear] > 0, (mine < others)[clear])
        told[sonar] = np.sum(cells["nearest"][clear])
    # The axes are 15 degrees apart and the cones 25 degrees wide: some cells are another sonar's.
    assert np.all((told > 40) & (told < 200))


def test_a_single_sonar_is_the_nearest_everywhere():
    cells, _, _ = swept(robot_of([[0, 0, 0]]), Probe(), [[0.02, 0.01, 0.3]], [[1.0]])
    np.testing.assert_array_equal(cells["nearest"], cells["count"] > 0)


def test_the_amplitude_is_that_of_a_circular_piston():
    # physics.md, 3.2: a = 18.4 mm at 49.4 kHz is ka = 16.64; 2 J1(x) / x is -3 dB at 5.57 degrees, -6 dB at 7.64, and
    # null at 13.3.
    cells, _, _ = swept(robot_of([[0, 0, 0]]), Probe(), [[0.02, 0.01, 0.3]], [[1.0]])
    shown = cells["count"] > 0
    off, amplitude = np.rad2deg(np.abs(cells["off_axis"][shown])), cells["amplitude"][shown]
    # Between the steps of half a degree the pattern is taken to be straight.
    assert amplitude[np.argmin(off)] == pytest.approx(1.0, abs=2e-3)
    for degrees, decibel in ((5.57, -3.0), (7.64, -6.0)):
        nearest = np.argsort(np.abs(off - degrees))[:2]
        assert np.all(np.abs(off[nearest] - degrees) < 0.5)
        np.testing.assert_allclose(20 * np.log10(amplitude[nearest]), decibel, atol=0.9)
    assert 0 < amplitude[np.argmax(off)] < 0.1


@settings(max_examples=150)
@given(
    st.floats(1.0, 180.0),
    st.floats(1.0, 150.0),
    st.floats(0.01, 0.5),
    st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    st.floats(-pi, pi),
)
def test_the_square_holds_every_cell_of_the_cone_however_it_is_turned(width_deg, reach, resolution, at, axis):
    robot = robot_of([[0, 0, 0]], beam_width_deg=width_deg)
    side = square_side(robot, Probe(reach * resolution), resolution)
    # It lies round the middle of the axis as well as whole cells allow.
    middle = np.array(at) + reach / 2 * np.array([np.cos(axis), np.sin(axis)])
    first = np.rint(middle - side / 2)
    span = np.arange(-int(reach) - 2, int(reach) + 3)
    distance, off = seen_from((*at, axis), span[None, :] + 0.5, span[:, None] + 0.5)
    row, col = np.nonzero((distance <= reach) & (np.abs(off) <= np.deg2rad(width_deg) / 2))
    if not len(row):
        return
    assert first[1] <= span[row].min()
    assert span[row].max() < first[1] + side
    assert first[0] <= span[col].min()
    assert span[col].max() < first[0] + side


def test_no_square_leaves_its_window_or_cuts_a_cone():
    # Frames at the corners of the largest way that one window takes, looking all round: a square that did not fit
    # would be pushed back into the window, and its cells would be told of things elsewhere. Of wide cones the corners
    # of the arc reach farthest.
    robot = robot_of([[0.31, 0.22, 0.0], [-0.4, 0.1, 2.5]], beam_width_deg=80)
    corners = [(x, y) for x in (0.0, 0.999 * WINDOW_M) for y in (0.0, 0.999 * WINDOW_M)]
    poses = [(0.456 + x, -0.789 + y, turn) for turn in np.arange(16) * pi / 8 + 0.1 for x, y in corners]
    *_, grid = build_map([frame(*pose, [1.0, 1.5]) for pose in poses], robot, Probe(), CELL_M)
    x, y = np.moveaxis(grid.centre_of(np.moveaxis(np.indices(grid.shape), 0, -1)), -1, 0)
    count, rim = np.zeros(grid.shape), np.zeros(grid.shape, dtype=bool)
    for pose in poses:
        for sonar in sonars_of(robot, pose):
            distance, off = seen_from(sonar, x, y)
            edge = np.deg2rad(40) - np.abs(off)
            count += (edge >= 0) & (distance <= 2.0)
            rim |= ((np.abs(edge) < 1e-4) & (distance < 2.001)) | ((np.abs(distance - 2.0) < 1e-4) & (edge > -1e-3))
    assert rim.mean() < 0.01
    np.testing.assert_array_equal(grid.log_odds[~rim], count[~rim])
    # The map itself holds all of the cones: as many cells as they have area.
    area = len(poses) * 2 * np.deg2rad(40) * 2.0**2 / CELL_M**2
    assert count.sum() == pytest.approx(area, rel=0.01)
