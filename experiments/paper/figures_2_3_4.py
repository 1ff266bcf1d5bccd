"""Figures 2, 3 and 4 of the paper: a rotary Polaroid 7000 in a room with smooth walls, far from them and close.

    python -m experiments.paper.figures_2_3_4

The paper's plan and recordings are lost; rotary.py says what stands in for the plan. In place of the recordings,
figures 2 and 3 show echogrid's simulator with all disturbances of a ranging module. Figure 4 is the paper's model
without noise: Leonard's targets by their closed forms (eqs. 1 and 2), visible within a fixed angle, with side lobes
at short range, and the specular way along the axis where no target is heard. Marked are regions of constant depth,
readings longer than the wall ahead (multiple reflections) and readings from a wall in a side lobe.

Writes docs/paper/figure_2.png, figure_3.png, figure_4.png and figures_2_3_4.json.
"""

import numpy as np
from matplotlib.figure import Figure

from echogrid.geometry import wrap
from echogrid.output.scan_picture import draw_regions
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.regions import regions_of_constant_depth
from echogrid.simulation.simulate import rotary_scan
from experiments.common.report import draw_key, record, rounded, save
from experiments.paper.rotary import (
    BEARING,
    HEAD,
    MAX_RANGE,
    NULLS,
    OVER_LONG,
    PLAN,
    POSITIONS,
    SIDE_LOBE_REACH,
    Judged,
    disturbed_scan,
    geometric_scan,
    half_visibility,
    where,
)

SCANS = 20
"""Scans that the shares and errors of the disturbed simulator are taken over; the first is drawn."""

NOISY = {"delta_share": 0.02, "bridge": 1}
"""Regions of disturbed scans: their ranges may differ by five standard deviations of the ranging noise (2 cm are
too few beyond 1 m), and one lost echo does not end them."""


def measure(scans):
    """The numbers of one position; counts are means over the scans."""
    heard = np.array([s.heard for s in scans])
    over_long = np.array([s.over_long for s in scans])
    corner = np.array([s.at_a_corner() for s in scans]) & over_long
    incidence = np.rad2deg(scans[0].incidence)
    numbers = {
        "scans": len(scans),
        "regions": np.mean([len(s.regions) for s in scans]),
        "readings_with_echo": heard.mean(),
        "share_of_echoes_in_regions": sum(len(r.readings) for s in scans for r in s.regions) / heard.sum(),
        "side_lobe_readings": np.mean([s.side_lobe.sum() for s in scans]),
        "over_long_readings": over_long.sum() / len(scans),
        "over_long_readings_of_a_corner": corner.sum() / len(scans),
        "by_incidence": {},
    }
    for name, part in {
        "below_25_deg": incidence < 25,
        "25_to_45_deg": (incidence >= 25) & (incidence <= 45),
        "above_45_deg": incidence > 45,
    }.items():
        numbers["by_incidence"][name] = {
            "bearings": int(part.sum()),
            "no_echo": 1 - heard[:, part].mean(),
            "over_long": over_long[:, part].mean(),
            "over_long_of_those_with_echo": over_long[:, part].sum() / heard[:, part].sum(),
        }
    found = [s.matches() for s in scans]
    numbers["regions_that_are_no_target"] = np.mean([strange for _, strange in found])
    errors = [m for matched, _ in found for m in matched]
    for kind in ("plane", "corner", "edge"):
        bearing = np.rad2deg([abs(b) for k, b, _ in errors if k == kind])
        r = np.array([r for k, _, r in errors if k == kind])
        if len(r):
            numbers[kind] = {
                "regions": len(r) / len(scans),
                "bearing_error_median_deg": np.median(bearing),
                "bearing_error_max_deg": bearing.max(),
                "range_error_median_m": np.median(r),
                "range_error_abs_max_m": np.abs(r).max(),
            }
    return numbers


def compare(model, recorded):
    """How far the model's readings are those of the disturbed scans."""
    both = np.array([model.heard & s.heard for s in recorded])
    close = np.array([np.isclose(model.ranges, s.ranges, rtol=0, atol=0.1) for s in recorded]) & both
    return {
        "readings_with_echo_in_both": both.mean(),
        "of_these_within_10_cm": close.sum() / both.sum(),
        "echo_in_the_model_only": np.mean([model.heard & ~s.heard for s in recorded]),
    }


KINDS = {
    "over_long": ("^", "tab:orange", f"longer than the wall ahead by over {OVER_LONG:g} m: multiple reflection"),
    "side_lobe": ("s", "tab:green", "wall or corner in the first side lobe"),
    "other": (".", "black", "other echo"),
}


def draw_readings(axes, judged, x, y):
    """The readings, each kind with a mark of its own, at coordinates of any kind."""
    masks = {"over_long": judged.over_long, "side_lobe": judged.side_lobe}
    masks["other"] = judged.heard & ~judged.over_long & ~judged.side_lobe
    for kind, mask in masks.items():
        mark, colour, label = KINDS[kind]
        size = 3.5 if mark == "." else 3
        if not mask.any():
            continue
        axes.plot(x[mask], y[mask], mark, ms=size, color=colour, mew=0, label=label, zorder=3)


def draw_scan(flat, plan, judged, top=None):
    """Range against orientation, and the scan over the plan."""
    degrees = np.rad2deg(BEARING)
    top = top or float(np.max(judged.ranges[judged.heard])) * 1.12
    flat.plot(degrees, judged.ahead, "-", color="0.65", lw=1, label="distance to the wall ahead", zorder=2)
    draw_readings(flat, judged, degrees, judged.ranges)
    silent = ~judged.heard
    flat.plot(degrees[silent], np.full(silent.sum(), top * 0.97), "|", ms=5, color="0.5", label="no echo")
    flat.set(xlabel="orientation (degrees)", ylabel="range (m)", xlim=(0, 360), ylim=(0, top))
    flat.set_xticks(range(0, 361, 45))
    flat.grid(alpha=0.3)
    for x0, y0, x1, y1 in PLAN.walls:
        plan.plot([x0, x1], [y0, y1], color="k", lw=1.2)
    u = np.array([np.cos(BEARING), np.sin(BEARING)])
    x, y = np.array(judged.at)[:, None] + np.where(judged.heard, judged.ranges, np.nan) * u
    draw_readings(plan, judged, x, y)
    plan.plot([], [], "k-", lw=1.2, label="smooth wall")
    plan.plot(*judged.at, "*", color="tab:red", ms=11, mec="white", mew=0.5, label="transducer", zorder=4)
    draw_regions(flat, plan, judged.at, judged.regions)
    plan.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")


def draw_close(axes, judged):
    """The readings of the near walls enlarged, with the walls' ranges and the nulls of the beam about them."""
    degrees = np.rad2deg(wrap(BEARING))
    order = np.argsort(degrees)
    axes.plot(degrees[order], judged.ahead[order], "-", color="0.65", lw=1, zorder=2)
    draw_readings(axes, judged, degrees, judged.ranges)
    for target in judged.targets:
        if target.r < SIDE_LOBE_REACH and target.kind == "plane":
            middle, nulls = np.rad2deg(target.bearing), np.rad2deg(NULLS)
            axes.plot([middle - nulls[1], middle + nulls[1]], [target.r] * 2, "--", color="tab:purple", lw=1)
            for null in (-nulls[0], nulls[0]):
                axes.plot([middle + null] * 2, [target.r - 0.05, target.r + 0.1], ":", color="tab:purple", lw=1.2)
    axes.plot([], [], "--", color="tab:purple", lw=1, label="near wall, eq. 1")
    axes.plot([], [], ":", color="tab:purple", lw=1.2, label="first null of the beam about its normal")
    axes.set(xlabel="orientation (degrees)", ylabel="range (m)", xlim=(-45, 135), ylim=(0.45, 1.0))
    axes.set_xticks(range(-45, 136, 15))
    axes.grid(alpha=0.3)


def legend(figure, *panels):
    """One key for all panels, at the foot."""
    draw_key(figure, *panels, columns=3, fontsize="small")


def draw_figure_2(recorded):
    figure = Figure(figsize=(11, 5), layout="constrained")
    flat, plan = figure.subplots(1, 2, width_ratios=[1.25, 1])
    draw_scan(flat, plan, recorded)
    figure.suptitle(f"Figure 2. {where('A')}: simulated with noise, in place of the recording; the plan is our own")
    legend(figure, flat, plan)
    save(figure, "figure_2")


def draw_figure_3(recorded):
    figure = Figure(figsize=(11, 6.6), layout="constrained")
    (flat, plan), (close, blank) = figure.subplots(2, 2, width_ratios=[1.25, 1])
    blank.remove()
    plan.set_subplotspec(plan.get_gridspec()[:, 1])
    draw_scan(flat, plan, recorded)
    draw_close(close, recorded)
    close.set_title("the near walls, enlarged", fontsize="medium")
    figure.suptitle(f"Figure 3. {where('C')}: simulated with noise, in place of the recording; the plan is our own")
    legend(figure, flat, plan, close)
    save(figure, "figure_3")


def draw_figure_4(model):
    figure = Figure(figsize=(11, 9), layout="constrained")
    panels = figure.subplots(2, 2, width_ratios=[1.25, 1])
    for (flat, plan), letter, name in zip(panels, "ab", POSITIONS, strict=True):
        draw_scan(flat, plan, model[name])
        flat.set_title(f"{letter}) {where(name)}", fontsize="medium")
    figure.suptitle(
        "Figure 4. The geometric model with side lobes at short range, without noise; the plan is our own"
    )
    legend(figure, *panels.ravel())
    save(figure, "figure_4")


def main():
    recorded = {
        name: [Judged(PLAN, at, disturbed_scan(PLAN, at, seed), **NOISY) for seed in range(SCANS)]
        for name, at in POSITIONS.items()
    }
    model = {name: Judged(PLAN, at, geometric_scan(PLAN, at)) for name, at in POSITIONS.items()}
    quiet = {
        name: Judged(PLAN, at, rotary_scan(PLAN, HEAD, MAX_RANGE, at, Physics())[1]) for name, at in POSITIONS.items()
    }
    draw_figure_2(recorded["A"][0])
    draw_figure_3(recorded["C"][0])
    draw_figure_4(model)
    numbers = {
        "world": "lab (our own plan)",
        "transducer": HEAD.name,
        "positions_m": {name: list(at) for name, at in POSITIONS.items()},
        "half_visibility_deg": np.rad2deg(half_visibility()),
        "first_null_deg": np.rad2deg(NULLS[0]),
    }
    for name in POSITIONS:
        strict = [len(regions_of_constant_depth(BEARING, s.ranges)) for s in recorded[name]]
        numbers[name] = {
            "regions_of_disturbed_within_2_cm": np.mean(strict),
            "disturbed": measure(recorded[name]),
            "model": measure([model[name]]),
            "noise_free": measure([quiet[name]]),
            "model_beside_disturbed": compare(model[name], recorded[name]),
        }
    record("figures_2_3_4", rounded(numbers))


if __name__ == "__main__":
    main()
