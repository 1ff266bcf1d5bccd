"""What each choice in the network is worth: small variants, trained alike, on the same held-out rooms.

    python -m experiments.paper.ablation

The baseline is the network that ships (four sonars, 32 and 16 hidden units, cross-entropy, trained through the fused
map, the prior subtracted, eq. 4 on probabilities), trained on a quarter of the drives for half of the epochs. Each
variant changes the choices that its name says; all are trained on the same drives with the same seed. Two more
baselines with other seeds show how much is chance. "Single looks" are trained without the map, as in the paper. Of
the prior the paper says nothing: if its contours had as many surface as free points ("even shares") there was none
to subtract, else it was left in. The rooms and the simulator (default physics) are those of held_out.py, the robot
is the b21, cells have 0.12 m.

Writes docs/paper/ablation (PNG, JSON; means over the rooms with 95 % bootstrap intervals) and prints the table.
Takes about 7 minutes on 2 cores.
"""

import tempfile
from dataclasses import astuple, dataclass, fields, replace
from unittest.mock import patch

import jax
import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from echogrid import Robot, build_map
from echogrid.grid import Grid
from echogrid.mapping.registry import sensor_model
from echogrid.metrics import Scores, score
from echogrid.models.networks import local_map
from echogrid.models.networks.paper_network import Network
from echogrid.simulation.drive import truth_of
from echogrid.training import paper_training
from echogrid.training.paper_examples import Examples, generate
from echogrid.training.paper_training import PaperRecipe, fit
from experiments.common.bootstrap import interval
from experiments.common.report import draw_key, record, save, table
from experiments.common.rooms import KINDS, SEED, frames, rooms

ROOMS = 12
"""Rooms of each kind."""

BASE = PaperRecipe(drives=1500, epochs=12)
WIDEST = 8
"""Sonars of the widest zone; the narrower ones are cut out of its examples."""

RESOLUTION = 0.12
SHOWN = ("found", "wiped", "false", "auc", "nll", "ece")

LEVEL = 5.0
"""Log-odds beyond those of any look."""


@dataclass(frozen=True)
class Variant:
    """One row of the table."""

    name: str
    recipe: PaperRecipe | None = BASE
    """None: the weights that ship."""
    even_shares: bool = False
    """Trained as if surface and free points were equally many: the prior is 0.5, nothing is left to subtract."""
    prior_left_in: bool = False
    on_log_odds: bool = False
    """Eq. 4 takes the mean of log-odds in place of probabilities."""


SINGLE = replace(BASE, through_map=False)
SINGLE_SQUARED = replace(SINGLE, squared_error=True)

GROUPS = [
    [
        Variant("baseline"),
        Variant("baseline, seed 2", replace(BASE, seed=2)),
        Variant("baseline, seed 3", replace(BASE, seed=3)),
    ],
    [Variant(f"{zone} sonars", replace(BASE, zone=zone)) for zone in (2, 6, 8)],
    [
        Variant(f"{first} and {second} hidden units", replace(BASE, hidden=(first, second)))
        for first, second in ((8, 4), (16, 8), (64, 32))
    ],
    [
        Variant("least squares", replace(BASE, squared_error=True)),
        Variant("eq. 4 on log-odds", on_log_odds=True),
        Variant("prior left in", prior_left_in=True),
    ],
    [
        Variant("single looks", SINGLE),
        Variant("single looks, least squares", SINGLE_SQUARED),
        Variant("single looks, eq. 4 on log-odds", SINGLE, on_log_odds=True),
        Variant("single looks, prior left in", SINGLE, prior_left_in=True),
        Variant("single looks, least squares, prior left in", SINGLE_SQUARED, prior_left_in=True),
        Variant("single looks, least squares, even shares", SINGLE_SQUARED, even_shares=True),
    ],
    [Variant("shipped weights", None)],
]
VARIANTS = [variant for group in GROUPS for variant in group]


def narrowed(examples: Examples, zone: int) -> Examples:
    """The same examples for a network that reads fewer sonars: those nearest in bearing, in their order."""
    near = np.sort(np.argsort(np.abs(examples.off_axis), axis=-1)[..., :zone], axis=-1)
    cut = {
        name: np.take_along_axis(getattr(examples, name), near, axis=-1) for name in ("sonar", "off_axis", "distance")
    }
    return examples._replace(**cut)


def trained() -> list[Network]:
    """The network of each variant."""
    shipped = sensor_model("network")
    assert isinstance(shipped, Network)
    examples = generate(None, BASE.drives, BASE.seed, progress=True, zone=WIDEST)
    networks = {(None, False): shipped}
    for variant in tqdm(VARIANTS, "networks", disable=None):
        how = variant.recipe, variant.even_shares
        if how not in networks:
            with patch.object(paper_training, "PRIOR", 0.5 if variant.even_shares else paper_training.PRIOR):
                networks[how] = fit(narrowed(examples, variant.recipe.zone), variant.recipe)
    return [networks[variant.recipe, variant.even_shares] for variant in VARIANTS]


def map_of(drive: list, robot: Robot, variant: Variant, network: Network) -> Grid:
    """The map of a drive by a variant."""
    if variant.prior_left_in:
        # To the mapper 0.5 is the prior of which nothing is left to subtract.
        network = replace(network, prior=0.5)
    with patch.object(local_map, "ON_LOG_ODDS", variant.on_log_odds):
        *_, grid = build_map(drive, robot, network, RESOLUTION)
    return grid


def study(networks: list[Network]) -> np.ndarray:
    """Scores [kind, variant, room, score]."""
    robot = Robot.load("b21")
    names = [field.name for field in fields(Scores)]
    found = np.full((len(KINDS), len(VARIANTS), ROOMS, len(SHOWN)), np.nan)
    for k, kind in enumerate(KINDS):
        for n, (world, poses) in enumerate(
            tqdm(rooms(kind, ROOMS, robot, SEED), total=ROOMS, desc=kind, disable=None)
        ):
            truth, drive = truth_of(world, poses), frames("default", world, poses, robot, n, SEED)
            for v, (variant, network) in enumerate(zip(VARIANTS, networks, strict=True)):
                scores = astuple(score(map_of(drive, robot, variant, network), truth))
                found[k, v, n] = [scores[names.index(name)] for name in SHOWN]
    return found


def summary(found: np.ndarray) -> dict:
    """Per kind of wall, variant and score: the mean over the rooms, and how much it is above the baseline's."""
    rng = np.random.default_rng(SEED)
    return {
        kind: {
            variant.name: {
                name: {
                    "mean": interval(found[k, v, :, s], rng),
                    "above baseline": interval(found[k, v, :, s] - found[k, 0, :, s], rng),
                }
                for s, name in enumerate(SHOWN)
            }
            for v, variant in enumerate(VARIANTS)
        }
        for k, kind in enumerate(KINDS)
    }


def means_table(means: dict) -> str:
    """The means as a table."""
    return table(
        ["walls", "variant", *SHOWN],
        (
            [kind, name, *(f"{scores[s]['mean'][0]:.3f}" for s in SHOWN)]
            for kind, variants in means.items()
            for name, scores in variants.items()
        ),
    )


PANELS = {
    "nll": {
        "xlabel": "nll: mean negative log-likelihood, nat\n(0.69 for a map that knows nothing)",
        "xlim": (0.13, 2.2),
        "xticks": (0.15, 0.2, 0.3, 0.5, 1, 2),
    },
    "wiped": {
        "xlabel": "wiped: walls that the map shows as free,\n% of their cells",
        "xlim": (-0.1, 130),
        "xticks": (0, 0.5, 1, 2, 5, 10, 25, 50, 100),
    },
}


def drawn(means: dict) -> Figure:
    """Nll and wiped of each variant in each kind of room."""
    places = np.concatenate([np.arange(len(group)) + 0.6 * i for i, group in enumerate(GROUPS)])
    places += np.repeat(np.cumsum([0, *map(len, GROUPS[:-1])]), [len(group) for group in GROUPS])
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    # Small differences and lost maps are to be seen in one picture.
    panels[0].set_xscale("log")
    panels[1].set_xscale("symlog", linthresh=1.0)
    for axes, (name, look) in zip(panels, PANELS.items(), strict=True):
        factor = 100 if name == "wiped" else 1
        for k, (kind, colour) in enumerate(zip(KINDS, ("tab:blue", "tab:orange", "tab:green"), strict=True)):
            mean, low, high = factor * np.transpose([scores[name]["mean"] for scores in means[kind].values()])
            bars = np.maximum([mean - low, high - mean], 0)
            y = places + 0.22 * (k - 1)
            axes.errorbar(mean, y, xerr=bars, fmt="o", ms=4, lw=1.2, color=colour, label=f"{kind} walls")
            axes.axvline(mean[0], color=colour, lw=0.8, ls=":")
        axes.set(**look)
        axes.minorticks_off()
        axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(axis="x", alpha=0.3)
    panels[0].set_yticks(places, [variant.name for variant in VARIANTS])
    panels[0].invert_yaxis()
    draw_key(figure, panels[0])
    figure.suptitle(
        f"What each choice is worth (less is better): {BASE.drives} training drives, {BASE.epochs} epochs\n"
        f"mean of {ROOMS} rooms of each kind with 95 % interval; dotted: the baseline; "
        "single looks: trained without the map"
    )
    return figure


def main() -> None:
    with tempfile.TemporaryDirectory() as compiled:
        # A variant's map is the same program in every room.
        jax.config.update("jax_compilation_cache_dir", compiled)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        means = summary(study(trained()))
    setting = {"robot": "b21", "resolution": RESOLUTION, "rooms": ROOMS, "drives": BASE.drives, "epochs": BASE.epochs}
    told = "[mean over the rooms, low, high]: 95 % bootstrap interval; above baseline: differences room by room"
    record("ablation", setting | {"numbers": told, "scores": means})
    save(drawn(means), "ablation")
    print(means_table(means))


if __name__ == "__main__":
    main()
