"""Beam patterns of a transducer: one-way amplitude against the angle off its axis. Formulas: docs/method.md."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.robot import Transducer


def bessel_beam(transducer: Transducer, c: float, angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Amplitude of a circular piston, 2 J1(x)/x with x = k a sin(angle) (McKerrow and Hallam)."""
    from scipy import special  # takes a tenth of a second, which reading a log should not cost

    x = 2 * np.pi * transducer.frequency_hz / c * transducer.aperture_radius_m * np.sin(angle)
    x = np.maximum(np.abs(x), 1e-9)
    return np.abs(2 * special.j1(x) / x)


def gaussian_beam(transducer: Transducer, c: float, angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Gaussian with the piston's one-way -3 dB point, no side lobes (Kuc and Viard)."""
    half = np.arcsin(min(1.0, 1.614 * c / (2 * np.pi * transducer.frequency_hz * transducer.aperture_radius_m)))
    sigma = half / np.sqrt(np.log(2.0))
    return np.exp(-(angle**2) / (2 * sigma**2))


def impulse_beam(transducer: Transducer, c: float, angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Peak of the burst convolved with the impulse response of sending and receiving (Kuc and Siegel).

    Off the axis each response is half an ellipse of duration 2 a sin(angle) / c. The burst is rounded off as
    the transducer's bandwidth does it; unlike the steady piston it has no true nulls. Returned is the square
    root of the two-way peak, so that two passes give it back.
    """
    per_cycle = 24
    dt = 1.0 / (transducer.frequency_hz * per_cycle)
    t = np.arange(transducer.cycles * per_cycle) * dt
    burst = np.exp(2j * np.pi * transducer.frequency_hz * t) * np.sin(np.pi * t / t[-1])
    peak = np.ones_like(angle)
    for i, sin in enumerate(np.abs(np.sin(angle))):
        half = transducer.aperture_radius_m * sin / c
        if half < dt:
            continue
        tau = np.arange(-np.floor(half / dt), np.floor(half / dt) + 1) * dt
        response = np.sqrt(np.maximum(0.0, 1.0 - (tau / half) ** 2))
        two_way = np.convolve(response, response) / response.sum() ** 2
        peak[i] = np.sqrt(np.max(np.abs(np.convolve(burst, two_way))))
    return peak


def cone_beam(transducer: Transducer, c: float, angle: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """All or nothing: full strength up to the piston's first null, nothing beyond (Leonard's visibility angle)."""
    null = np.arcsin(min(1.0, 0.61 * c / transducer.frequency_hz / transducer.aperture_radius_m))
    return (np.abs(angle) <= null).astype(float)


BEAMS: dict[str, Callable[[Transducer, float, Float[ndarray, "n"]], Float[ndarray, "n"]]] = {
    "bessel": bessel_beam,
    "gaussian": gaussian_beam,
    "impulse": impulse_beam,
    "cone": cone_beam,
}
"""Beam patterns by name: one-way amplitude against the angle off the axis (rad), 1 on the axis."""
