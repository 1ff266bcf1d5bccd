"""Three beam models on the same scans: circular piston, Gaussian and impulse response.

    python -m experiments.paper.beams

McKerrow and Hallam's piston (``bessel``), Kuc and Viard's Gaussian and Kuc and Siegel's impulse model, each the beam
of one Polaroid 7000 that scans the room of figures 2 to 4 from its positions A and C, without noise. The Gaussian has
no side lobes, so near a wall it reads the wall ahead, or nothing, where the others read the wall beside.

Writes docs/paper/beams.png and beams.json: how many readings differ from the piston's, and where.
"""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from echogrid.geometry import wrap
from echogrid.simulation.acoustics import Physics, absorption, speed_of_sound
from echogrid.simulation.beam_patterns import BEAMS
from echogrid.simulation.simulate import rotary_scan
from experiments.common.report import record, rounded, save
from experiments.paper.rotary import BEARING, HEAD, MAX_RANGE, NULLS, PLAN, POSITIONS, Judged, where

MODELS: dict[str, tuple[str, dict[str, Any]]] = {
    "bessel": ("circular piston (bessel)", {"color": "tab:blue", "ls": "-", "marker": "o", "ms": 6.5, "mfc": "none"}),
    "gaussian": ("Gaussian", {"color": "tab:orange", "ls": "--", "marker": "s", "ms": 4, "mfc": "none"}),
    "impulse": ("impulse response", {"color": "black", "ls": ":", "marker": ".", "ms": 3}),
}
"""Names and looks; marks of three sizes, so that none hides another."""

DIFFERS = 0.02
"""Readings differ if their ranges do by more than this, m, or if only one has an echo."""


def two_way_db(name, angle):
    """Two-way level against the angle off the axis (rad), dB."""
    amplitude = BEAMS[name](HEAD, speed_of_sound(Physics().temperature_c), angle)
    return 40 * np.log10(np.maximum(amplitude, 1e-6))


def wall_level_db(distance):
    """Level above the threshold of a smooth wall on the axis, dB (the simulator's)."""
    physics = Physics()
    loss = absorption(HEAD.frequency_hz, physics.temperature_c, physics.humidity_percent)
    ramp = physics.gain_ramp_db * np.clip((distance - 1.0) / 9.7, 0.0, 1.0)
    return physics.level_db - 20 * np.log10(distance) - 2 * loss * (distance - 1.0) + ramp


def half_width(name, down_db):
    """Angle off the axis at which the two-way level is first so much down, rad."""
    angle = np.linspace(0, np.pi / 2, 20_000)
    return angle[np.argmax(two_way_db(name, angle) <= -down_db)]


def side_lobe_peak(name):
    """The highest two-way level between the piston's first two nulls to which a pattern rises again, dB, or None."""
    angle = np.linspace(NULLS[0], NULLS[1], 4000)
    level = two_way_db(name, angle)
    rising = np.flatnonzero(np.diff(level) > 0)
    return float(level[rising].max()) if rising.size else None


def differs(ranges, others):
    """Which readings are not the same."""
    one = np.isfinite(ranges) != np.isfinite(others)
    return one | ~(np.isclose(ranges, others, rtol=0, atol=DIFFERS) | one)


def measure(judged, reference):
    """Where a model's scan departs from the piston's."""
    different = differs(judged.ranges, reference.ranges)
    return {
        "readings_with_echo": judged.heard.mean(),
        "differ_from_bessel": different.mean(),
        "only_bessel_hears": (different & reference.heard & ~judged.heard).mean(),
        "only_this_hears": (different & ~reference.heard & judged.heard).mean(),
        "both_hear_different_ranges": (different & reference.heard & judged.heard).mean(),
        "side_lobe_readings": int(judged.side_lobe.sum()),
        "differ_where_bessel_reads_a_side_lobe": int((different & reference.side_lobe).sum()),
        "regions": len(judged.regions),
        "median_region_width_deg": np.rad2deg(np.median([region.width for region in judged.regions])),
    }


def draw_patterns(axes):
    """Two-way level of each model, and how far down the walls of the scans are still heard."""
    angle = np.deg2rad(np.linspace(0, 50, 1000))
    for name, (_, style) in MODELS.items():
        line = {"color": style["color"], "ls": style["ls"]}
        axes.plot(np.rad2deg(angle), two_way_db(name, angle), lw=1.5, **line)
    for distance in (0.54, 0.9, 2.44):
        level = -wall_level_db(distance)
        axes.axhline(level, color="0.5", lw=0.8)
        axes.text(0.5, level + 0.7, f"{distance:g} m", size="small", color="0.3")
    axes.set(xlabel="angle off the axis (degrees)", ylabel="two-way level (dB)", xlim=(0, 50), ylim=(-80, 3))
    axes.set_title("Beam patterns; grey: the threshold for a smooth wall so far away", fontsize="medium")
    axes.grid(alpha=0.3)


def draw_ranges(axes, scans, title, centred=False):
    """Range against orientation of all models."""
    degrees = np.rad2deg(wrap(BEARING) if centred else BEARING)
    for model, (_, style) in MODELS.items():
        axes.plot(degrees, scans[model].ranges, **(style | {"ls": ""}))
    axes.set(xlabel="orientation (degrees)", ylabel="range (m)")
    axes.set_title(title, fontsize="medium")
    axes.grid(alpha=0.3)


def main():
    scans = {
        position: {
            model: Judged(PLAN, at, rotary_scan(PLAN, HEAD, MAX_RANGE, at, Physics(beam=model))[1])
            for model in MODELS
        }
        for position, at in POSITIONS.items()
    }
    figure = Figure(figsize=(10, 7), layout="constrained")
    (patterns, far), (near, close) = figure.subplots(2, 2)
    draw_patterns(patterns)
    for axes, position in ((far, "A"), (near, "C")):
        draw_ranges(axes, scans[position], where(position))
        axes.set(xlim=(0, 360), ylim=(0, None))
        axes.set_xticks(range(0, 361, 45))
    draw_ranges(close, scans["C"], "Position C, the near walls enlarged", centred=True)
    close.set(xlim=(-45, 135), ylim=(0.45, 1.0))
    close.set_xticks(range(-45, 136, 15))
    figure.suptitle("Three beam models of a Polaroid 7000, scans simulated without noise (missing marks: no echo)")
    handles = [Line2D([], [], **style) for _, style in MODELS.values()]
    figure.legend(
        handles, [label for label, _ in MODELS.values()], loc="outside lower center", ncols=3, frameon=False
    )
    save(figure, "beams")

    numbers = {
        "transducer": HEAD.name,
        "differs_beyond_m": DIFFERS,
        "patterns": {
            name: {
                "half_width_3_db_two_way_deg": np.rad2deg(half_width(name, 3)),
                "half_width_34_db_two_way_deg": np.rad2deg(half_width(name, 34)),
                "first_side_lobe_two_way_db": side_lobe_peak(name),
            }
            for name in MODELS
        },
    }
    for position, one in scans.items():
        numbers[position] = {model: measure(scan, one["bessel"]) for model, scan in one.items()}
    record("beams", rounded(numbers))


if __name__ == "__main__":
    main()
