"""Figures 2, 3 and 4 of the paper: a rotary Polaroid 7000 in a room with smooth walls, far from them and close.

    python experiments/figures_2_3_4.py

The paper's plan 1 and its recordings are lost. The plan is our own (the world ``lab``: a corner, an edge and a
recess, all of smooth veneered wood), and so are positions A (walls 2 to 4 m away) and C (walls at 0.5 and 0.7 m). In
place of the recordings, figures 2 and 3 show echogrid's simulator with all disturbances of a ranging module. Figure 4
is the paper's model without noise: Leonard's targets by their closed forms (eqs. 1 and 2), visible within a fixed
angle, with side lobes at short range, and the specular way along the axis where no target is heard. Marked are
regions of constant depth, readings longer than the wall ahead (multiple reflections) and readings from a wall in a
side lobe.

Writes docs/paper/figure_2, figure_3 and figure_4 (PNG and SVG) and figures_2_3_4.json.
"""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from echogrid.geometry import wrap
from echogrid.output.picture import draw_regions
from echogrid.robot import TRANSDUCERS, Robot
from echogrid.simulation.acoustics import Physics, bessel_beam, speed_of_sound
from echogrid.simulation.regions import regions_of_constant_depth
from echogrid.simulation.simulate import RAYS, Simulator, disturb, rotary_scan
from echogrid.simulation.world import World
from paper import record, save

PLAN = World.load("lab")
HEAD = TRANSDUCERS["polaroid-7000"]
MAX_RANGE = 10.0
POSITIONS = {"A": (4.4, 2.9), "C": (6.4, 3.1)}
BEARING = np.deg2rad(np.arange(360.0))
SCANS = 20
"""Scans that the shares and errors of the disturbed simulator are taken over; the first is drawn."""

OVER_LONG = 0.2
"""A reading this much longer than the wall ahead came round over another wall, m."""

NOISY = {"delta_share": 0.02, "bridge": 1}
"""Regions of disturbed scans: their ranges may differ by five standard deviations of the ranging noise (2 cm are
too few beyond 1 m), and one lost echo does not end them."""

_KA = 2 * np.pi * HEAD.frequency_hz / speed_of_sound(Physics().temperature_c) * HEAD.aperture_radius_m
NULLS = np.arcsin(np.array([3.832, 7.016]) / _KA)
SIDE_LOBE = np.arcsin(np.array([4.35, 5.95]) / _KA)
"""Off the axis: the first two nulls of the piston, and where its side lobe is within 3 dB of its peak, rad."""

SIDE_LOBE_REACH = 0.9
"""Walls beyond this are not heard in the side lobe, m (see Physics.level_db)."""

EDGE_REACH, EDGE_HALF = 1.3, np.deg2rad(5.0)
"""Leonard's edges are weak: heard only so near, m, and so close to the axis, rad."""


def half_visibility():
    """Angle off the axis up to which a wall at 1 m is heard: the visibility angle of the geometric model, rad."""
    angle = np.linspace(0, NULLS[0], 1000)
    beam = bessel_beam(HEAD, speed_of_sound(Physics().temperature_c), angle)
    return angle[np.flatnonzero(40 * np.log10(beam + 1e-9) + Physics().level_db >= 0)[-1]]


@dataclass(frozen=True)
class Target:
    """One of Leonard's targets as seen from a position, by its closed form."""

    kind: str
    r: float
    bearing: float


def visible_targets(world, at):
    """The planes, corners and edges that a position has in sight: range m, bearing rad."""
    at = np.array(at)
    found = {}

    def take(kind, target):
        r, bearing = target.range_bearing(at)
        if r > 0 and world.sight(at[None], np.array([bearing]))[0] > r - 1e-3:
            found[kind, round(r, 6), round(float(wrap(bearing)), 6)] = Target(kind, r, float(wrap(bearing)))

    for plane in world.planes():
        r, bearing = plane.range_bearing(at)
        # The foot of the perpendicular must lie on a wall, not only on its line.
        if abs(world.sight(at[None], np.array([bearing]))[0] - r) < 1e-6:
            take("plane", plane)
    corners, edges, hidden = world.vertices
    for edge, (ax, ay, bx, by) in zip(edges, hidden, strict=True):
        x, y = at - (edge.x, edge.y)
        take("corner" if ax * y - ay * x > 0 and x * by - y * bx > 0 else "edge", edge)
    ends = {(edge.x, edge.y) for edge in edges}
    for corner in corners:
        if (corner.x, corner.y) not in ends:
            take("corner", corner)
    return list(found.values())


def geometric_scan(world, at):
    """The paper's model: the nearest visible target, side lobes at short range, else the way along the axis, m."""
    main = half_visibility()
    nearest = np.full(len(BEARING), np.inf)
    for target in visible_targets(world, at):
        off = np.abs(wrap(BEARING - target.bearing))
        if target.kind == "edge":
            heard = (off <= EDGE_HALF) & (target.r < EDGE_REACH)
        else:
            beside = (SIDE_LOBE[0] <= off) & (off <= SIDE_LOBE[1])
            heard = (off <= main) | (beside & (target.r < SIDE_LOBE_REACH))
        nearest = np.where(heard, np.minimum(nearest, target.r), nearest)
    deaf = Physics(level_db=-300.0, axis_ray=True)
    way = rotary_scan(world, HEAD, MAX_RANGE, at, deaf, len(BEARING))[1]
    return np.where(np.isfinite(nearest), nearest, way)


def disturbed_scan(world, at, seed):
    """A scan with all that a real module adds: fluctuating levels, range errors, lost echoes; m."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack([np.tile(at, (len(BEARING), 1)), BEARING])
    rotary = Robot("rotary", 0.0, HEAD, 0.0, MAX_RANGE, np.deg2rad(25.0), np.zeros((1, 3)))
    ranges = Simulator(world, rotary, Physics()).ranges(poses, rng, rays=4 * RAYS - 1)
    return rotary.clean(disturb(ranges, Physics(), MAX_RANGE, rng))[:, 0]


def wall_ahead(world, at):
    """Distance along each axis to the wall that it meets, m, and the incidence there, rad. Plain geometry."""
    u = np.column_stack([np.cos(BEARING), np.sin(BEARING)])
    ahead = world.sight(np.tile(at, (len(BEARING), 1)), BEARING)
    normal, offset = world.hessian()
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    end = (np.array(at) + ahead[:, None] * u)[:, None]
    middle = (world.walls[:, :2] + world.walls[:, 2:]) / 2
    half = np.linalg.norm(world.walls[:, 2:] - world.walls[:, :2], axis=1) / 2
    away = np.abs(np.sum(end * normal, axis=2) - offset)
    past = np.maximum(np.abs(np.sum((end - middle) * along, axis=2)) - half, 0)
    wall = np.argmin(away + past, axis=1)
    return ahead, np.arccos(np.minimum(np.abs(np.sum(u * normal[wall], axis=1)), 1))


def from_side_lobe(ranges, ahead, targets):
    """Which readings are of a plane or corner that lies in the first side lobe.

    Such a reading is within 4 cm of the target's range, nearer to it than to the wall ahead, and not within 4 cm of
    a target in the main lobe.
    """
    main, side = np.zeros(len(ranges), dtype=bool), np.zeros(len(ranges), dtype=bool)
    for target in targets:
        off = np.abs(wrap(BEARING - target.bearing))
        miss = np.abs(np.where(np.isfinite(ranges), ranges, 1e9) - target.r)
        main |= (off <= NULLS[0]) & (miss < 0.04)
        if target.kind != "edge":
            side |= (off > NULLS[0]) & (off < NULLS[1]) & (miss < 0.04) & (miss < np.abs(ranges - ahead))
    return side & ~main


class Judged:
    """A scan with its readings told apart."""

    def __init__(self, world, at, ranges, **rule):
        self.at, self.ranges = at, ranges
        self.targets = visible_targets(world, at)
        self.ahead, self.incidence = wall_ahead(world, at)
        self.heard = np.isfinite(ranges)
        self.over_long = self.heard & (ranges > self.ahead + OVER_LONG)
        self.side_lobe = from_side_lobe(ranges, self.ahead, self.targets)
        self.regions = regions_of_constant_depth(BEARING, ranges, **rule)

    def at_a_corner(self):
        """Readings of a corner in the main lobe: sound that two walls sent straight back."""
        out = np.zeros(len(self.ranges), dtype=bool)
        for target in self.targets:
            if target.kind == "corner":
                off = np.abs(wrap(BEARING - target.bearing))
                out |= (off <= NULLS[0]) & (np.abs(self.ranges - target.r) < 0.05 + 0.02 * target.r)
        return out

    def matches(self):
        """Kind, bearing error (rad) and range error (m) of each region that is a target's, and how many are not."""
        matched, strange = [], 0
        for region in self.regions:
            near = [t for t in self.targets if abs(wrap(region.bearing - t.bearing)) < np.deg2rad(12)]
            near = [t for t in near if abs(region.mean_range - t.r) < 0.05 + 0.02 * t.r]
            if near:
                target = min(near, key=lambda t: abs(region.mean_range - t.r))
                error = wrap(region.bearing - target.bearing)
                matched.append((target.kind, float(error), region.mean_range - target.r))
            else:
                strange += 1
        return matched, strange


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
    return rounded(numbers)


def rounded(value):
    """The same with floats to four places."""
    if isinstance(value, dict):
        return {key: rounded(v) for key, v in value.items()}
    return value if value is None or isinstance(value, int | str) else round(float(value), 4) + 0.0  # no minus zero


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
    handles = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=3, frameon=False, fontsize="small")


def where(name):
    x, y = POSITIONS[name]
    return f"Position {name} (x {x:g} m, y {y:g} m)"


def main():
    recorded = {
        name: [Judged(PLAN, at, disturbed_scan(PLAN, at, seed), **NOISY) for seed in range(SCANS)]
        for name, at in POSITIONS.items()
    }
    model = {name: Judged(PLAN, at, geometric_scan(PLAN, at)) for name, at in POSITIONS.items()}
    quiet = {
        name: Judged(PLAN, at, rotary_scan(PLAN, HEAD, MAX_RANGE, at, Physics())[1]) for name, at in POSITIONS.items()
    }

    figure = Figure(figsize=(11, 5), layout="constrained")
    flat, plan = figure.subplots(1, 2, width_ratios=[1.25, 1])
    draw_scan(flat, plan, recorded["A"][0])
    figure.suptitle(f"Figure 2. {where('A')}: simulated with noise, in place of the recording; the plan is our own")
    legend(figure, flat, plan)
    save(figure, "figure_2")

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    (flat, plan), (close, blank) = figure.subplots(2, 2, width_ratios=[1.25, 1])
    blank.remove()
    plan.set_subplotspec(plan.get_gridspec()[:, 1])
    draw_scan(flat, plan, recorded["C"][0])
    draw_close(close, recorded["C"][0])
    close.set_title("the near walls, enlarged", fontsize="medium")
    figure.suptitle(f"Figure 3. {where('C')}: simulated with noise, in place of the recording; the plan is our own")
    legend(figure, flat, plan, close)
    save(figure, "figure_3")

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

    numbers = {
        "world": "lab (our own plan)",
        "transducer": HEAD.name,
        "positions_m": {name: list(at) for name, at in POSITIONS.items()},
        "half_visibility_deg": rounded(np.rad2deg(half_visibility())),
        "first_null_deg": rounded(np.rad2deg(NULLS[0])),
    }
    for name in POSITIONS:
        strict = [len(regions_of_constant_depth(BEARING, s.ranges)) for s in recorded[name]]
        numbers[name] = {
            "regions_of_disturbed_within_2_cm": rounded(np.mean(strict)),
            "disturbed": measure(recorded[name]),
            "model": measure([model[name]]),
            "noise_free": measure([quiet[name]]),
            "model_beside_disturbed": compare(model[name], recorded[name]),
        }
    record("figures_2_3_4", numbers)


def compare(model, recorded):
    """How far the model's readings are those of the disturbed scans."""
    both = np.array([model.heard & s.heard for s in recorded])
    close = np.array([np.isclose(model.ranges, s.ranges, rtol=0, atol=0.1) for s in recorded]) & both
    return rounded(
        {
            "readings_with_echo_in_both": both.mean(),
            "of_these_within_10_cm": close.sum() / both.sum(),
            "echo_in_the_model_only": np.mean([model.heard & ~s.heard for s in recorded]),
        }
    )


if __name__ == "__main__":
    main()
