"""docs/results.md from the measured numbers: ``python -m experiments.paper.results``.

Fills results.md.in beside this file from docs/paper/*.json.
"""

import re
from pathlib import Path

from matplotlib.figure import Figure

from experiments.common.maps import SHOWN
from experiments.common.report import recorded, save, table
from experiments.common.rooms import PLACES
from experiments.common.trials import DECIDING
from experiments.paper.held_out import SIMULATORS

TEMPLATE, OUT = Path(__file__).with_name("results.md.in"), Path(__file__).parents[2] / "docs" / "results.md"


def score_table(means):
    """Every model with every score, the 95 % interval below each mean; the best of each score in bold."""
    best = {}
    for name in SHOWN[:8]:
        values = [scores[name][0] for scores in means.values() if scores[name]]
        best[name] = (max if name in ("found", "free", "auc") else min)(values) if values else None
    body = []
    for model, scores in means.items():
        row = [f"`{model}`"]
        for name in SHOWN:
            if scores[name] is None:
                row.append("-")
                continue
            mean, low, high = scores[name]
            shown = f"**{mean:.3f}**" if mean == best.get(name) else f"{mean:.3f}"
            row.append(f"{shown}<br><sub>{low:.3f}-{high:.3f}</sub>")
        body.append(row)
    return table(["model", *SHOWN], body)


def short_table(means):
    """The scores that decide, without intervals."""
    names = ("found", "wiped", "free", "false", "auc", "nll", "ece", "collides", "blocked", "lost")
    body = [
        [f"`{model}`", *("-" if scores[name] is None else f"{scores[name][0]:.3f}" for name in names)]
        for model, scores in means.items()
    ]
    return table(["model", *names], body)


def spread(values, digits):
    """A value with its interval below; what a number cannot say is a dash or the sign of infinity."""
    if values is None:
        return "-"
    mean, low, high = ("∞" if v is None else f"{v:.{digits}f}" for v in values)
    return f"{mean}<br><sub>{low} to {high}</sub>"


def ratio_table(found):
    """The network against the best classical model of each place under each simulator."""
    body = []
    for simulator in SIMULATORS:
        for place in PLACES:
            row = [simulator, place]
            for name in DECIDING:
                entry = found["ratios"][simulator][place][name]
                best, means = entry["best classical"], found["means"][simulator][place]
                network, other = (means[m][name][0] for m in ("network", best))
                row += [f"`{best}`", f"{network:.3f} / {other:.3f}", spread(entry["ratio"], 2)]
                row.append(spread(entry["difference"], 3))
            body.append(row)
    header = ["simulator", "walls"]
    for name in DECIDING:
        header += [f"least `{name}` of the classical", "network / it", "ratio", "difference"]
    return table(header, body)


def worst_table(means):
    """Each model in the kind of place where it is worst, by each simulator; the best of each column in bold."""
    models = list(means[SIMULATORS[0]][PLACES[0]])
    columns = [(simulator, name) for simulator in SIMULATORS for name in DECIDING]
    worst = {
        model: [max(means[s][place][model][name][0] for place in PLACES) for s, name in columns] for model in models
    }
    least = [min(column) for column in zip(*worst.values(), strict=True)]
    body = [
        [f"`{model}`", *(f"**{v:.3f}**" if v == low else f"{v:.3f}" for v, low in zip(values, least, strict=True))]
        for model, values in worst.items()
    ]
    return table(["model", *(f"{simulator}: {name}" for simulator, name in columns)], body)


def draw_models(means, rooms):
    """Likelihood and wiped of every model in every place, with intervals."""
    models = list(means[PLACES[0]])
    figure = Figure(figsize=(12, 8.2), layout="constrained")
    axes = figure.subplots(len(DECIDING), len(PLACES), sharey=True, sharex="row")
    for line, name in zip(axes, DECIDING, strict=True):
        for panel, place in zip(line, PLACES, strict=True):
            for y, model in enumerate(models):
                mean, low, high = means[place][model][name]
                colour = "tab:red" if model == "network" else "0.25"
                panel.plot([low, high], [y, y], color=colour, lw=1.5)
                panel.plot(mean, y, "o", color=colour, ms=5)
            panel.axvline(means[place]["network"][name][0], color="tab:red", lw=0.6, ls=":")
            panel.set_title(f"{place} walls" if place != "corridor" else "corridors, mixed walls", fontsize="medium")
            panel.set_xlabel(f"{name} (lower is better)")
            panel.set_yticks(range(len(models)), models)
            panel.grid(axis="x", alpha=0.3)
            if name == "nll":
                panel.set_xscale("log")
                panel.set_xticks([0.2, 0.3, 0.5, 1, 2], ["0.2", "0.3", "0.5", "1", "2"])
                panel.minorticks_off()
            else:
                panel.set_xscale("symlog", linthresh=0.01)
                panel.set_xticks([0, 0.01, 0.1, 1], ["0", "0.01", "0.1", "1"])
                panel.set_xlim(-0.001, 1.1)
    axes[0, 0].invert_yaxis()
    figure.suptitle(f"Every model on the same held-out drives: means over {rooms} rooms and 95 % intervals")
    save(figure, "models")


def maps_table(maps):
    """Scores of the maps of figures 6 to 9."""
    labels = {
        "figure_6": "Plant 2, smooth",
        "figure_7": "Plant 3, rough",
        "figure_8": "Corridor 1, paint and tiles",
        "figure_9": "Corridor 2, wood",
    }
    names = ("found", "wiped", "free", "false", "auc", "nll", "ece")
    body = []
    for key, scores in maps.items():
        figure, robot, *refined = key.split()
        label = {"b21": "B21", "robuter2": "Robuter II"}[robot]
        body.append([labels[figure], label, *(refined or ["as fused"]), *(f"{scores[name]:.3f}" for name in names)])
    return table(["place", "robot", "map", *names], body)


def corridor_table(corridor):
    """Shares measured on the recorded corridor."""
    names = list(next(iter(corridor.values())))
    body = ([f"`{m}`", *(f"{100 * v[n]:.1f} %" for n in names)] for m, v in corridor.items())
    return table(["model", *names], body)


def tune_table(tuned):
    """What the search chose."""
    body = []
    for model, found in tuned.items():
        setting = ", ".join(f"{key} {value}" for key, value in found["setting"].items())
        body.append([f"`{model}`", setting, f"{found['nll']:.3f}"])
    return table(["model", "setting", "mean nll on the training rooms"], body)


def speed_table(speed):
    """Scans a second."""
    return table(["model", "scans/s"], [[f"`{model}`", f"{rate:,}"] for model, rate in speed["scans/s"].items()])


def ablation_table(ablation):
    """What each variant scores."""
    kinds = list(ablation["scores"])
    body = []
    for variant in ablation["scores"][kinds[0]]:
        row = [variant]
        for kind in kinds:
            for name in DECIDING:
                mean, low, high = ablation["scores"][kind][variant][name]["mean"]
                row.append(f"{mean:.3f}<br><sub>{low:.3f}-{high:.3f}</sub>")
        body.append(row)
    return table(["variant", *(f"{kind}: {name}" for kind in kinds for name in DECIDING)], body)


def value(path):
    """A number of docs/paper by its way in: file, then keys; three digits of a fraction."""
    file, *keys = path.split("/")
    found = recorded(file)
    for key in keys:
        found = found[int(key)] if isinstance(found, list) else found[key]
    return f"{found:.3g}" if isinstance(found, float) else str(found)


def simulators(found):
    """The tables of the simulators that are not in the main page."""
    parts = ["# Every model under two more simulators", "", "Written by `make paper`; see [Results](../results.md)."]
    for simulator, title in (("varied", "A physics drawn for each room"), ("leonard", "The second simulator")):
        parts += ["", f"## {title} (`{simulator}`)"]
        for place in PLACES:
            parts += ["", f"### {place}", "", score_table(found["means"][simulator][place])]
    return "\n".join(parts) + "\n"


def main():
    found = recorded("held_out")
    blocks = {f"scores of {place}": score_table(found["means"]["default"][place]) for place in PLACES}
    second = recorded("held_out_p3dx")
    blocks |= {f"p3dx scores of {place}": short_table(second["means"]["default"][place]) for place in PLACES}
    blocks |= {
        "ratios": ratio_table(found),
        "worst": worst_table(found["means"]),
        "maps": maps_table(recorded("figures_6_to_9")),
        "corridor": corridor_table(recorded("corridor8")),
        "tuned": tune_table(recorded("tune")),
        "ablation": ablation_table(recorded("ablation")),
        "speed": speed_table(recorded("speed")),
    }
    draw_models(found["means"]["default"], found["rooms"])
    text = re.sub(
        r"\$\{([^}]+)\}",
        lambda token: blocks[token[1]] if token[1] in blocks else value(token[1]),
        TEMPLATE.read_text(encoding="utf-8"),
    )
    OUT.write_text(text, encoding="utf-8")
    (OUT.parent / "paper" / "simulators.md").write_text(simulators(found), encoding="utf-8")
    print(f"wrote {OUT}")


if __name__ == "__main__":
    main()
