"""Figure 5 of the paper: a rotary Polaroid 7000 before a rough wall, at two distances.

    python -m experiments.paper.figure_5

In place of the paper's recording of a granulated paint wall, echogrid's simulator before a wall of 2 mm rms: without
noise (line) and with all disturbances of a ranging module (dots). Beside it the range to the wall along the axis,
d / cos(i), which an ideal sensor would read; the range to the near edge of a beam as wide as its two-way -3 dB
points, d / cos(max(0, |i| - theta)) (closed form); and what a smooth wall gives: an arc about its normal and, near,
those of the side lobes.

Writes docs/paper/figure_5.png and figure_5.json: how far the simulator is from the two formulas.
"""

import numpy as np
from matplotlib.figure import Figure

from echogrid.simulation.acoustics import Physics, acoustics
from echogrid.simulation.simulate import rotary_scan
from echogrid.simulation.world import ROUGH_M, SMOOTH_M, World, polyline
from experiments.common.report import draw_key, record, rounded, save
from experiments.paper.rotary import BEARING, HEAD, MAX_RANGE, disturbed_scan

DISTANCES = (0.7, 1.7)
INCIDENCE = np.deg2rad(np.arange(-60.0, 61.0))
WITHIN = np.deg2rad(45.5)
"""Incidences over which the numbers are taken, rad."""

SCANS = 20


def wall(distance, roughness):
    """A long wall across the x axis."""
    return World("wall", polyline([[distance, -20.0], [distance, 20.0]]), np.array([roughness]), np.zeros((0, 3)))


def facing(ranges):
    """The readings at INCIDENCE of a scan all round."""
    return ranges[np.rint(np.rad2deg(INCIDENCE)).astype(int) % len(ranges)]


def quiet(distance, roughness, physics):
    return facing(rotary_scan(wall(distance, roughness), HEAD, MAX_RANGE, (0.0, 0.0), physics, len(BEARING))[1])


def formula(distance, theta):
    """Range to the near edge of a beam of half width theta (rad) on a wall that sends everything back, m."""
    return distance / np.cos(np.maximum(0.0, np.abs(INCIDENCE) - theta))


def difference(ranges, expected):
    """Of readings with echo within WITHIN: bias, rms and largest difference, m."""
    part = (np.abs(INCIDENCE) <= WITHIN) & np.isfinite(ranges)
    off = (ranges - expected)[part]
    return {"mean_m": off.mean(), "rms_m": np.sqrt(np.mean(off**2)), "max_m": np.abs(off).max()}


def best_width(distance, ranges):
    """The half width for which the formula fits the readings best, rad."""
    widths = np.deg2rad(np.arange(0.0, 25.0, 0.1))
    rms = [difference(ranges, formula(distance, width))["rms_m"] for width in widths]
    return widths[int(np.argmin(rms))]


def heard_up_to(ranges):
    """The largest incidence up to which every reading has an echo, rad; 0 if none has."""
    silent = np.abs(INCIDENCE)[~np.isfinite(ranges)]
    steps = np.abs(INCIDENCE)[np.abs(INCIDENCE) < np.min(silent, initial=np.inf) - 1e-9]
    return np.max(steps, initial=0.0)


def main():
    theta = acoustics(HEAD, Physics()).patch_rad
    label = f"closed form, d / cos(max(0, |i| - {np.rad2deg(theta):.1f}°))"
    numbers = {"transducer": HEAD.name, "roughness_m": ROUGH_M, "theta_deg": np.rad2deg(theta), "distances": {}}
    figure = Figure(figsize=(9.5, 5.2), layout="constrained")
    panels = figure.subplots(1, 2)
    degrees = np.rad2deg(INCIDENCE)
    for axes, distance in zip(panels, DISTANCES, strict=True):
        rough, smooth = (quiet(distance, roughness, Physics()) for roughness in (ROUGH_M, SMOOTH_M))
        early = quiet(distance, ROUGH_M, Physics(walk_error=0.0))
        noisy = [facing(disturbed_scan(wall(distance, ROUGH_M), (0.0, 0.0), seed)) for seed in range(SCANS)]
        closed, ideal = formula(distance, theta), formula(distance, 0.0)
        numbers["distances"][f"{distance:g} m"] = {
            "noise_free_beside_closed_form": difference(rough, closed),
            "noise_free_beside_ideal": difference(rough, ideal),
            "without_walk_error_beside_closed_form": difference(early, closed),
            "disturbed_beside_closed_form": pooled(noisy, closed),
            "disturbed_beside_ideal": pooled(noisy, ideal),
            "half_width_that_fits_best_deg": np.rad2deg(best_width(distance, rough)),
            "half_width_that_fits_best_without_walk_error_deg": np.rad2deg(best_width(distance, early)),
            "rough_heard_up_to_deg": np.rad2deg(heard_up_to(rough)),
            "smooth_heard_up_to_deg": np.rad2deg(heard_up_to(smooth)),
        }
        axes.plot(degrees, ideal, ":", color="0.3", lw=1.4, label="ideal sensor, d / cos i")
        axes.plot(degrees, closed, "--", color="tab:blue", lw=1.4, label=label)
        axes.plot(degrees, rough, "-", color="tab:red", lw=1.2, label="rough wall, without noise")
        axes.plot(degrees, noisy[0], ".", ms=4, color="black", label="rough wall, with noise")
        silent = degrees[~np.isfinite(noisy[0])]
        top = np.full(len(silent), distance + 1.04 * (ideal.max() - distance))
        axes.plot(silent, top, "|", ms=6, color="0.5", label="rough wall, with noise: no echo")
        axes.plot(
            degrees, smooth, "s", ms=3, mfc="none", mew=0.8, color="tab:green", label="smooth wall, without noise"
        )
        axes.set(
            xlabel="orientation from the wall's normal, i (degrees)", title=f"d = {distance:g} m", xlim=(-62, 62)
        )
        axes.set_xticks(range(-60, 61, 15))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("range (m)")
    figure.suptitle("Figure 5. A rough wall (2 mm rms), simulated in place of the recording")
    draw_key(figure, panels[1], columns=3)
    save(figure, "figure_5")
    record("figure_5", rounded(numbers))


def pooled(scans, expected):
    """``difference`` over the readings of several scans: rms of all, largest of all."""
    each = [difference(ranges, expected) for ranges in scans]
    return {
        "mean_m": np.mean([d["mean_m"] for d in each]),
        "rms_m": np.sqrt(np.mean([d["rms_m"] ** 2 for d in each])),
        "max_m": max(d["max_m"] for d in each),
    }


if __name__ == "__main__":
    main()
