"""Ultrasound in air and the transducer: propagation, roughness, the detection threshold.

Levels are in dB of amplitude relative to the echo of a smooth plane on the axis at the same range. Formulas
and their sources: docs/method.md.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from echogrid.robot import Transducer
from echogrid.simulation.beam_patterns import BEAMS

FLOOR_DB = -60.0
"""One-way beam level below which a pattern is not followed (a null is a null)."""

CHORD_STEP, BEAM_ENTRIES = 2e-3, 708
"""Beam patterns are tabulated against the chord 2 sin(angle / 2), which costs no inverse sine, up to 90 degrees."""

_TABLE_ANGLES = 2 * np.arcsin(np.arange(BEAM_ENTRIES) * CHORD_STEP / 2)


@dataclass(frozen=True)
class Physics:
    """How sound and the ranging module behave. The defaults describe a Polaroid 6500 module at room climate."""

    beam: str = "bessel"
    """Beam pattern: ``bessel`` (circular piston, side lobes), ``gaussian``, ``impulse`` or ``cone``."""
    temperature_c: float = 20.0
    """Temperature of the air, degrees Celsius."""
    humidity_percent: float = 50.0
    """Relative humidity of the air."""
    level_db: float = 34.0
    """Level of a smooth plane on the axis at 1 m above the detection threshold. The first side lobe (35.1 dB
    down) is heard where the level exceeds 35.1 dB, so 34 dB keeps side lobes within 0.9 m."""
    gain_ramp_db: float = 20.0
    """What the time-varying gain adds from 1 m to 10.7 m, linear in range."""
    reflection_loss_db: float = 1.0
    """Loss at each bounce, besides what roughness scatters away."""
    edge_db: float = -30.0
    """Echo of a convex edge relative to a plane, both at 1 m; it falls with sqrt(range) besides. A sharp
    rigid wedge has -37 dB, a rounded door frame (5 mm) -23 dB."""
    diffuse_db: float = 0.0
    """Added to the Lambert echo of rough walls."""
    facet_db: float = -60.0
    """Echo that walls which are not quite even send straight back, beside a plane's; -60 is none. With it the
    long ways over several walls come back from many directions instead of a few."""
    facet_slope_deg: float = 5.0
    """Root mean square slope of such walls: how far from the normal they send echoes back."""
    axis_ray: bool = False
    """Leonard's rule for a sonar that hears nothing: it reads the length of the specular way along its axis, up to
    the first wall that is met within 12.5 degrees of its normal, or 60 if it is rough."""
    level_noise_db: float = 1.5
    """Standard deviation of the level of each reading."""
    walk_error: float = 0.5
    """Share of the detector's walk error that is left: a weak echo crosses the threshold late in the burst."""
    range_noise: float = 0.004
    """White range error, share of the range (at least 1 mm)."""
    range_scale: float = 0.005
    """Standard deviation of the scale error that all readings of a run share (a wrong temperature)."""
    lost: float = 0.01
    """Probability that a reading that had an echo loses it."""
    cross_talk: float = 0.0
    """Probability that a reading is another sonar's pulse: a range anywhere below the true one."""
    stale: float = 0.0
    """Probability that a sonar was not refreshed and repeats its reading."""


class Acoustics(NamedTuple):
    """Physics and a transducer turned into the numbers that the simulator reads; a JAX pytree."""

    beam_db: Float[ndarray, "*n 708"]
    """One-way beam level against the chord of the angle off the axis, in steps of CHORD_STEP."""
    wavelength: Float[ndarray, "*n"] | float
    absorption: Float[ndarray, "*n"] | float
    """One-way absorption, dB/m."""
    level_db: Float[ndarray, "*n"] | float
    gain_ramp_db: Float[ndarray, "*n"] | float
    reflection_loss_db: Float[ndarray, "*n"] | float
    edge_db: Float[ndarray, "*n"] | float
    patch_db: Float[ndarray, "*n"] | float
    """Level of a Lambert wall that fills the beam at normal incidence."""
    facet_db: Float[ndarray, "*n"] | float
    facet_slope: Float[ndarray, "*n"] | float
    """Tangent."""
    axis_ray: Bool[ndarray, "*n"] | bool
    patch_rad: Float[ndarray, "*n"] | float
    """Two-way -3 dB half angle of the beam."""
    pulse: Float[ndarray, "*n"] | float
    """Half the length of the burst in air, c tau / 2, m."""
    walk: Float[ndarray, "*n"] | float
    """Range error of an echo that just reaches the threshold, m."""


def speed_of_sound(temperature_c: float) -> float:
    """Speed of sound in air, m/s."""
    return 331.3 * np.sqrt(1.0 + temperature_c / 273.15)


def absorption(frequency_hz: float, temperature_c: float, humidity_percent: float) -> float:
    """Atmospheric absorption at sea-level pressure, dB/m one way (ISO 9613-1, eqs. 3 to 5)."""
    T = temperature_c + 273.15
    ratio = T / 293.15
    vapour = humidity_percent * 10 ** (4.6151 - 6.8346 * (273.16 / T) ** 1.261)
    oxygen = 24 + 4.04e4 * vapour * (0.02 + vapour) / (0.391 + vapour)
    nitrogen = ratio**-0.5 * (9 + 280 * vapour * np.exp(-4.170 * (ratio ** (-1 / 3) - 1)))
    f2 = frequency_hz**2
    relaxation = 0.01275 * np.exp(-2239.1 / T) / (oxygen + f2 / oxygen)
    relaxation += 0.1068 * np.exp(-3352.0 / T) / (nitrogen + f2 / nitrogen)
    return 8.686 * f2 * (1.84e-11 * ratio**0.5 + ratio**-2.5 * relaxation)


def acoustics(transducer: Transducer, physics: Physics) -> Acoustics:
    """Work out what the simulator needs of a transducer under given physics.

    Raises:
        KeyError: an unknown beam pattern.
    """
    c = speed_of_sound(physics.temperature_c)
    amplitude = BEAMS[physics.beam](transducer, c, _TABLE_ANGLES)
    beam_db = np.maximum(20 * np.log10(np.maximum(amplitude, 1e-9)), FLOOR_DB)
    patch_rad = float(np.interp(1.5, np.maximum.accumulate(-beam_db), _TABLE_ANGLES))
    pulse = c * transducer.cycles / transducer.frequency_hz / 2
    return Acoustics(
        beam_db=beam_db.astype(np.float32),
        wavelength=c / transducer.frequency_hz,
        absorption=absorption(transducer.frequency_hz, physics.temperature_c, physics.humidity_percent),
        level_db=physics.level_db,
        gain_ramp_db=physics.gain_ramp_db,
        reflection_loss_db=physics.reflection_loss_db,
        edge_db=physics.edge_db,
        patch_db=10 * np.log10(4 * patch_rad**2) + physics.diffuse_db,
        facet_db=physics.facet_db,
        facet_slope=np.tan(np.deg2rad(physics.facet_slope_deg)),
        axis_ray=physics.axis_ray,
        patch_rad=patch_rad,
        pulse=pulse,
        walk=physics.walk_error * pulse,
    )
