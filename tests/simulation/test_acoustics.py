import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from echogrid.robot import TRANSDUCERS, Transducer
from echogrid.simulation.acoustics import (
    BEAM_ENTRIES,
    CHORD_STEP,
    FLOOR_DB,
    Physics,
    absorption,
    acoustics,
    speed_of_sound,
)
from echogrid.simulation.beam_patterns import BEAMS, bessel_beam, gaussian_beam, impulse_beam

HEAD_600, HEAD_7000 = TRANSDUCERS["polaroid-600"], TRANSDUCERS["polaroid-7000"]
C = 343.2
TABLE_ANGLES = 2 * np.arcsin(np.arange(BEAM_ENTRIES) * CHORD_STEP / 2)


def level_db(beam, head, degrees):
    return 20 * np.log10(beam(head, C, np.deg2rad(np.atleast_1d(np.asarray(degrees, dtype=float)))))


def falls_to(beam, head, level):
    """The angle (degrees) at which the one-way level first falls to ``level`` dB."""
    degrees = np.arange(0, 60, 0.005)
    return degrees[np.argmax(level_db(beam, head, degrees) <= level)]


@pytest.mark.parametrize(("celsius", "c"), [(0, 331.3), (15, 340.3), (20, 343.2), (25, 346.1), (30, 349.0)])
def test_the_speed_of_sound_is_that_of_the_notes(celsius, c):
    assert speed_of_sound(celsius) == pytest.approx(c, abs=0.06)


@pytest.mark.parametrize(
    ("khz", "celsius", "percent", "db_per_m"),
    [
        (49.4, 15, 50, 1.33),
        (49.4, 20, 20, 0.93),
        (49.4, 20, 50, 1.64),
        (49.4, 20, 80, 1.68),
        (49.4, 25, 50, 1.83),
        (52, 20, 50, 1.73),
    ],
)
def test_absorption_is_that_of_the_notes(khz, celsius, percent, db_per_m):
    assert absorption(khz * 1e3, celsius, percent) == pytest.approx(db_per_m, abs=0.006)


@pytest.mark.parametrize(("octave", "db_per_km"), [(-2, 1.31), (-1, 2.73), (0, 4.66), (1, 9.86), (2, 29.4), (3, 104)])
def test_absorption_is_that_of_the_tables_of_the_standard(octave, db_per_km):
    assert absorption(1000 * 10 ** (0.3 * octave), 20, 50) * 1000 == pytest.approx(db_per_km, rel=0.01)


@given(st.floats(1e3, 1e6), st.floats(1.01, 3), st.floats(0, 40), st.floats(5, 100))
def test_absorption_grows_with_frequency(frequency, factor, celsius, percent):
    assert absorption(frequency * factor, celsius, percent) > absorption(frequency, celsius, percent) > 0


@pytest.mark.parametrize(
    ("head", "half_3", "half_6", "null", "lobe"),
    [(HEAD_600, 5.57, 7.64, 13.3, 18.0), (HEAD_7000, 7.55, 10.4, 18.2, 24.7)],
    ids=["600", "7000"],
)
def test_the_piston_has_the_angles_of_the_notes(head, half_3, half_6, null, lobe):
    assert falls_to(bessel_beam, head, -3) == pytest.approx(half_3, abs=0.03)
    assert falls_to(bessel_beam, head, -6) == pytest.approx(half_6, abs=0.06)
    assert falls_to(bessel_beam, head, -55) == pytest.approx(null, abs=0.06)
    degrees = np.arange(null + 1, null + 8, 0.01)
    levels = level_db(bessel_beam, head, degrees)
    assert degrees[np.argmax(levels)] == pytest.approx(lobe, abs=0.06)
    assert levels.max() == pytest.approx(-17.57, abs=0.01)


@pytest.mark.parametrize(
    ("head", "null", "lobe"), [(HEAD_600, 24.9, 30.4), (HEAD_7000, 34.8, 43.3)], ids=["600", "7000"]
)
def test_the_piston_has_a_second_null_and_a_second_side_lobe(head, null, lobe):
    assert level_db(bessel_beam, head, null)[0] < -45
    degrees = np.arange(null, null + 14, 0.01)
    levels = level_db(bessel_beam, head, degrees)
    assert degrees[np.argmax(levels)] == pytest.approx(lobe, abs=0.06)
    assert levels.max() == pytest.approx(-23.8, abs=0.05)


@given(st.floats(20e3, 100e3), st.floats(5e-3, 25e-3), st.floats(0.01, 1.5))
def test_the_piston_is_the_bessel_quotient(frequency, aperture, angle):
    head = Transducer("any", frequency, aperture)
    x = 2 * np.pi * frequency / C * aperture * np.sin(angle)
    assert bessel_beam(head, C, np.array([angle]))[0] == pytest.approx(abs(2 * special.jv(1, x) / x), abs=1e-9)


@pytest.mark.parametrize("head", [HEAD_600, HEAD_7000], ids=["600", "7000"])
def test_the_gaussian_falls_to_3_db_where_the_piston_does_and_has_no_side_lobes(head):
    assert falls_to(gaussian_beam, head, -3.01) == pytest.approx(falls_to(bessel_beam, head, -3.01), abs=0.02)
    assert np.all(np.diff(level_db(gaussian_beam, head, np.arange(0, 60, 0.5))) < 0)


def test_the_gaussian_of_the_600_has_a_width_of_6_7_degrees():
    assert level_db(gaussian_beam, HEAD_600, 6.7)[0] == pytest.approx(20 * np.log10(np.exp(-0.5)), abs=0.06)


@pytest.mark.parametrize("head", [HEAD_600, HEAD_7000], ids=["600", "7000"])
def test_the_impulse_model_fills_the_null_and_agrees_in_the_main_lobe(head):
    null = falls_to(bessel_beam, head, -55)
    assert level_db(bessel_beam, head, null)[0] < -50
    assert -30 < level_db(impulse_beam, head, null)[0] < -15
    near = np.arange(0, null / 2, 0.25)
    np.testing.assert_allclose(level_db(impulse_beam, head, near), level_db(bessel_beam, head, near), atol=0.5)


@pytest.mark.parametrize("name", BEAMS)
@pytest.mark.parametrize("head", [HEAD_600, HEAD_7000], ids=["600", "7000"])
def test_a_beam_is_strongest_on_its_axis_and_the_same_to_both_sides(name, head):
    angle = np.linspace(0, np.pi / 2, 40)
    beam = BEAMS[name](head, C, angle)
    assert beam[0] == pytest.approx(1, abs=0.01)
    assert np.all(beam <= beam[0] + 1e-9)
    np.testing.assert_allclose(BEAMS[name](head, C, -angle), beam, atol=1e-12)


@pytest.mark.parametrize("name", BEAMS)
def test_the_table_holds_the_beam_against_the_chord(name):
    physics = Physics(beam=name)
    table = acoustics(HEAD_600, physics).beam_db
    exact = 20 * np.log10(np.maximum(BEAMS[name](HEAD_600, speed_of_sound(20), TABLE_ANGLES), 1e-9))
    np.testing.assert_allclose(table, np.maximum(exact, FLOOR_DB), atol=1e-3)
    assert TABLE_ANGLES[-1] == pytest.approx(np.pi / 2, abs=2e-3)


def test_a_rough_wall_that_fills_the_beam_is_17_1_db_below_a_plane():
    ac = acoustics(HEAD_600, Physics())
    assert np.rad2deg(ac.patch_rad) == pytest.approx(3.99, abs=0.01)
    assert ac.patch_db == pytest.approx(-17.1, abs=0.05)
    assert acoustics(HEAD_600, Physics(diffuse_db=4)).patch_db == pytest.approx(ac.patch_db + 4)


def test_half_the_burst_is_55_6_mm_long():
    ac = acoustics(HEAD_600, Physics(walk_error=0.25))
    assert ac.pulse == pytest.approx(55.6e-3, abs=0.05e-3)
    assert ac.walk == pytest.approx(ac.pulse / 4)
    assert ac.wavelength == pytest.approx(6.95e-3, abs=0.01e-3)
    short = Transducer("short", HEAD_600.frequency_hz, HEAD_600.aperture_radius_m, cycles=8)
    assert acoustics(short, Physics()).pulse == pytest.approx(ac.pulse / 2)


def test_a_beam_of_no_known_name_is_refused():
    with pytest.raises(KeyError, match="laser"):
        acoustics(HEAD_600, Physics(beam="laser"))
