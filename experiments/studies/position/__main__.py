"""How far positions are off, over cases of drives by dead reckoning.

    python -m experiments.studies.position CASES [--out FOLDER] [--method NAME|MODULE:FUNCTION] [--only WORD ...]
        [--errors odometry|twice|true] [--maps]

CASES is a folder of cases (``cases.py``) or one of them; ``simulated`` and ``recordings`` make such. A method is
``odometry``, which leaves the poses as they are, ``slam``, or a function ``(log, robot) -> poses`` of shape
(frames, 3), m, m and rad, found as MODULE:FUNCTION; where it raises an ``EchogridError``, the poses that it was given
count.

One row a case: ATE is the root mean square of the distances to the true positions after the whole trajectory was laid
onto the true one (as ``evo_ape -a``), ``first`` the same with the first pose laid onto the true first; ``worst`` is
the largest aligned distance, ``entropy`` that of the hits (``measures.py``). --maps adds the scores of maps by the
default model from the poses given, those found and the true ones, each laid onto the true ones as for ATE.
With --out position_METHOD_ERRORS.json goes there, and each case's trajectory as TUM file.
"""

import argparse
import importlib
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from tqdm import tqdm

from echogrid import Log, Robot, build_map, slam
from echogrid.errors import EchogridError
from echogrid.mapping.registry import DEFAULT, sensor_model
from echogrid.metrics import laid_onto, score, trajectory_error
from echogrid.output.map_file import read_truth
from echogrid.output.trajectory import read_tum, write_tum
from experiments.common import report
from experiments.studies.position.cases import ODOMETRY, Case, cases_of, posed
from experiments.studies.position.measures import entropy_of_hits, poses_of

Method = Callable[[Log, Robot], Float[ndarray, "frames 3"]]
HEADER = ("case", "m", "scans", "odometry ATE", "first", "ATE", "worst", "first", "first worst", "heading (deg)",
          "entropy before", "after", "s", "x real time")  # fmt: skip


def method_of(name: str) -> Method:
    """A method by its name.

    Raises:
        ValueError: there is none.
    """
    if name == "odometry":
        return lambda log, _: poses_of(log)
    if name == "slam":
        return lambda log, robot: slam(log, robot).poses
    module, _, function = name.partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"--method: found {name} ({error}), expected odometry, slam or MODULE:FUNCTION") from None


def judged(case: Case, method: Method, errors: str, out: Path | None, maps: bool) -> dict[str, Any]:
    """What a method makes of a case: errors, entropy and time, and the errors of the poses that it was given."""
    log = case.log(errors)
    frames = list(log)
    given = poses_of(frames)
    begin = time.perf_counter()
    poses, failed = given, None
    try:
        poses = np.asarray(method(log, case.robot), dtype=float)
    except EchogridError as error:  # it keeps its row: no case is left out
        failed = str(error)
    seconds = time.perf_counter() - begin
    stamps = np.array([frame.stamp for frame in frames])
    if poses.shape != given.shape:
        raise SystemExit(f"{case.name}: found poses of shape {poses.shape}, expected {given.shape}")
    if out:
        write_tum(out / f"{case.name}{'' if errors == 'odometry' else f'-{errors}'}.tum", stamps, poses)
    found: dict[str, Any] = {"case": case.name} | asdict(case.facts) | {"errors": errors, "scans": len(frames)}
    found |= {"failed": failed} if failed else {}
    if case.has_truth:
        truth = case.truth()
        found |= {"given": asdict(trajectory_error(given, truth)), "found": asdict(trajectory_error(poses, truth))}
        if maps and (case.folder / "truth.npz").is_file():
            laid = {"given": given, "found": poses, "true": truth}
            found["maps"] = map_scores(case, {name: laid_onto(some, truth) for name, some in laid.items()})
        peer = case.folder / "authors.tum"
        if peer.is_file():
            found["authors"] = asdict(trajectory_error(read_tum(peer)[1], truth))
    found["entropy"] = [entropy_of_hits(frames, case.robot, some) for some in (given, poses)]
    return found | {"seconds": seconds, "times": float((stamps[-1] - stamps[0]) / max(seconds, 1e-9))}


SCORES = ("found", "wiped", "auc", "nll")


def map_scores(case: Case, poses: dict[str, Float[ndarray, "frames 3"]]) -> dict[str, dict[str, float]]:
    """Scores of the maps that the default model makes from poses by what they are called; the truth is the case's."""
    truth, frames = read_truth(case.folder / "truth.npz"), list(case.log())
    found = {}
    for name, some in poses.items():
        *_, grid = build_map(posed(frames, some), case.robot, sensor_model(DEFAULT), None)
        scores = score(grid, truth)
        found[name] = {column: getattr(scores, column) for column in SCORES}
    return found


def row(found: dict[str, Any]) -> list[str]:
    """A judged case as the table shows it."""
    errors = ["-"] * 7
    if "found" in found:
        given, then = found["given"], found["found"]
        errors = [given["aligned_rms_m"], given["first_rms_m"], then["aligned_rms_m"], then["aligned_worst_m"],
                  then["first_rms_m"], then["first_worst_m"]]  # fmt: skip
        errors = [f"{value:.3f}" for value in errors] + [f"{then['heading_rms_deg']:.2f}"]
    if "failed" in found:
        print(f"{found['case']}: counted with the poses that it was given, for it failed: {found['failed']}")
    name = found["case"] if found["errors"] == "odometry" else f"{found['case']} ({found['errors']})"
    before, after = found["entropy"]
    return [name, f"{found['length_m']:.0f}", str(found["scans"]), *errors, f"{before:.3f}", f"{after:.3f}",
            f"{found['seconds']:.1f}", f"{found['times']:.0f}" if found["seconds"] > 0.5 else "-"]  # fmt: skip


def means(found: list[dict[str, Any]]) -> list[list[str]]:
    """Of each kind the mean and the largest ATE, and how many cases there are."""
    rows = []
    for kind in dict.fromkeys(one["kind"] for one in found):
        some = [(one["given"]["aligned_rms_m"], one["found"]["aligned_rms_m"]) for one in found
                if one["kind"] == kind and "found" in one]  # fmt: skip
        if some:
            (before, after), worst = np.mean(some, axis=0), max(some, key=lambda pair: pair[1])[1]
            rows.append([kind, str(len(some)), f"{before:.3f}", f"{after:.3f}", f"{worst:.3f}"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, metavar="CASES", help="a folder of cases, or one")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where numbers and trajectories go")
    parser.add_argument("--method", default="odometry", metavar="NAME", help="odometry, slam, or MODULE:FUNCTION")
    parser.add_argument("--only", nargs="+", default=(), metavar="WORD", help="cases whose names hold one of these")
    parser.add_argument("--errors", default="odometry", choices=[*ODOMETRY, "true"], help="of the poses it is given")
    parser.add_argument("--maps", action="store_true", help="score maps from given, found and true poses too")
    args = parser.parse_args()
    try:
        method, cases = method_of(args.method), cases_of(args.cases, args.only)
        cases = [case for case in cases if case.has(args.errors)]
        if not cases:
            parser.error(f"{args.cases}: found no case with poses of {args.errors}, expected one at least")
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
        found = [
            judged(case, method, args.errors, args.out, args.maps) for case in tqdm(cases, "cases", disable=None)
        ]
    except (EchogridError, ValueError) as error:
        parser.error(str(error))
    print(report.table(HEADER, map(row, found)))
    print("\n" + report.table(("kind", "cases", "odometry ATE", "ATE", "largest ATE"), means(found)))
    if mapped := [one for one in found if "maps" in one]:
        body = [[one["case"], *(" / ".join(f"{some[name]:.3f}" for some in one["maps"].values()) for name in SCORES)]
                for one in mapped]  # fmt: skip
        print("\nMaps from poses given / found / true\n\n" + report.table(("case", *SCORES), body))
    if args.out:
        report.FOLDER = args.out
        name = args.method.replace(":", "_").replace(".", "_")
        report.record(f"position_{name}_{args.errors}", {"found": report.rounded(found)})


if __name__ == "__main__":
    main()
