"""How well `echogrid calibrate` knows a robot from one log.

    python -m experiments.studies.calibration simulated [--trials 20] [--simulators cone default leonard varied]
        [--walls smooth mixed] [--robots b21 p3dx uneven11] [--seed N]
    python -m experiments.studies.calibration summary FILE...
    python -m experiments.studies.calibration recordings [--data ../shared/data]

simulated: a robot tours a random room that nothing was chosen on; trial after trial it is another of the robots. Its
file is wrong: each mount by 2 cm (standard deviation in x and y) and 3 degrees, the beam says 35 degrees, all ranges
read up to 3 % too much or little, two sonars have changed places and one is dead. Simulators: echogrid's own with a
transducer that hears in a cone (so that the beam is known), with its default one, with a physics drawn for each room
(varied), and that of Leonard's model, written apart. A row a trial, as JSON: how far mounts are off (root mean
square), beam, scale, whether the truth lies in the intervals of 95 %, and whether just the swapped and the dead were
found. summary: a table of such rows.

recordings: corridor8; scitos24, which has no poses but those that its commands would make, as it is, with its mounts
mirrored, and numbered backwards; crazyflie4 with all 24 orders of its sonars: the place of the right order among all.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from echogrid import Frame, Robot, load_log
from echogrid.calibration.calibrate import SURE, calibrate
from echogrid.calibration.readings import gather
from echogrid.calibration.variants import AS_GIVEN, Ranked, ranked
from echogrid.errors import EchogridError
from echogrid.geometry import wrap
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.rooms import random_physics
from echogrid.simulation.simulate import Simulator
from experiments.common import corridor8 as corridor
from experiments.common.leonard import CONE, leonard_ranges
from experiments.common.rooms import rooms
from experiments.studies.position.simulated import robot_of

SEED = 41_000_000
DATA = Path(__file__).parents[4] / "shared" / "data"
HEAD = (
    *("simulator", "walls", "robots", "logs", "told", "axis, deg", "place, cm", "beam, deg", "scale, %"),
    *("axes held", "places", "scale", "beam", "swapped", "dead"),
)
SIMULATORS = ("cone", "default", "leonard", "varied")


def wrong(robot: Robot, rng: np.random.Generator) -> Robot:
    """A robot file that is a little wrong; how far out all sonars sit in the mean no log tells, and is kept."""
    off = np.column_stack([rng.normal(0, 0.02, (robot.sonars, 2)), np.deg2rad(rng.normal(0, 3, robot.sonars))])
    out = np.stack([np.cos(robot.mounts[:, 2]), np.sin(robot.mounts[:, 2])], axis=1)
    off[:, :2] -= np.mean(np.sum(off[:, :2] * out, axis=1)) * out
    return replace(robot, mounts=robot.mounts + off, beam_width_rad=np.deg2rad(35.0))


def driven(simulator: str, walls: str, robot: Robot, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Poses, ranges (m, right in scale) and beam width (rad; nan where it has no edge) of a drive in a room."""
    world, poses = next(rooms(walls, 1, robot, seed))
    rng = np.random.default_rng(seed)
    head = robot.transducer
    if simulator == "leonard":
        return poses, leonard_ranges(world, robot, poses, rng), 2 * CONE
    physics = {"cone": Physics(beam="cone"), "default": Physics()}.get(simulator) or random_physics(rng)
    frames = Simulator(world, robot, replace(physics, range_scale=0.0)).frames(poses, seed)
    null = 2 * float(np.arcsin(0.61 * 343.0 / head.frequency_hz / head.aperture_radius_m))
    return poses, np.array([frame.ranges for frame in frames]), null if physics.beam == "cone" else np.nan


def trial(simulator: str, walls: str, name: str, number: int, seed: int) -> dict[str, Any]:
    """One drive."""
    robot, rng = robot_of(name), np.random.default_rng([seed, number])
    poses, ranges, width = driven(simulator, walls, robot, seed + number)
    scale, given = 1 + rng.uniform(-0.03, 0.03), wrong(robot, rng)
    one, two, dead = (int(each) for each in rng.choice(robot.sonars, 3, replace=False))
    ranges = robot.clean(scale * ranges)
    ranges[:, [one, two]] = ranges[:, [two, one]]
    ranges[:, dead] = np.inf
    frames = [Frame(i / 5, pose, row) for i, (pose, row) in enumerate(zip(poses, ranges, strict=True))]
    row: dict[str, Any] = {"simulator": simulator, "walls": walls, "robot": name, "number": number}
    row["way_m"] = round(float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()), 1)
    try:
        found = calibrate(frames, given)
    except EchogridError as error:
        return row | {"error": str(error)}
    off = np.delete(found.given.mounts + found.moved - robot.mounts[found.seats], dead, axis=0)
    off[:, 2] = wrap(off[:, 2])
    within = np.abs(off) < SURE * np.delete(found.moved_sd, dead, axis=0)
    beam, ratio = 2 * found.beams.half - width, found.places.scale / scale - 1
    return row | {
        "place_cm": 100 * float(np.sqrt(np.mean(off[:, :2] ** 2))),
        "axis_deg": float(np.rad2deg(np.sqrt(np.mean(off[:, 2] ** 2)))),
        "axis_within_1_deg": float(np.mean(np.abs(off[:, 2]) < np.deg2rad(1))),
        "place_within_2_cm": float(np.mean(np.abs(off[:, :2]) < 0.02)),
        "beam_deg": float(np.rad2deg(beam)),
        "scale_percent": 100 * float(ratio),
        "place_held": float(np.mean(within[:, :2])),
        "axis_held": float(np.mean(within[:, 2])),
        "scale_held": bool(abs(ratio) < SURE * found.scale_sd),
        "beam_held": bool(abs(beam) < SURE * 2 * found.beams.half_sd),
        "swapped": sorted(found.swapped) == sorted([(one, two), (two, one)]),
        "dead": found.health.useless == [dead],
        "as_given_first": found.ranks[0].variant.name == AS_GIVEN,
        "told": not found.unsure,
        "unsure": found.unsure,
        "soft": found.soft,
        "share": found.share,
        "soft_deg": float(np.rad2deg(found.beams.soft)),
        "inflation": found.inflation,
    }


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    """A table: medians and, behind a slash, the worst but one in ten, of the logs that tell."""
    yield "| " + " | ".join(HEAD) + " |"
    yield "|" + "---|" * len(HEAD)
    for kind in dict.fromkeys((row["simulator"], row["walls"]) for row in rows):
        mine = [row for row in rows if (row["simulator"], row["walls"]) == kind]
        names = ", ".join(dict.fromkeys(row["robot"] for row in mine))
        whole = [row for row in mine if "error" not in row]
        told = [row for row in whole if row["told"]]
        if not told:
            yield f"| {kind[0]} | {kind[1]} | {names} | {len(mine)} | 0 |"
            continue

        def spread(key: str, told: list[dict[str, Any]] = told) -> str:
            values = np.abs([row[key] for row in told])
            if np.isnan(values).all():
                return "-"
            return f"{np.nanmedian(values):.2f} / {np.nanquantile(values, 0.9):.2f}"

        def share(key: str, told: list[dict[str, Any]] = told) -> str:
            return f"{np.mean([row[key] for row in told]):.0%}"

        found = [f"{sum(row[key] for row in whole)}" for key in ("swapped", "dead")]
        numbers = [spread(key) for key in ("axis_deg", "place_cm", "beam_deg", "scale_percent")]
        held = [share(key) for key in ("axis_held", "place_held", "scale_held")]
        held.append("-" if np.isnan([row["beam_deg"] for row in told]).all() else share("beam_held"))
        cells = [*kind, names, str(len(mine)), str(len(told)), *numbers, *held, *found]
        yield "| " + " | ".join(cells) + " |"


def recordings(data: Path) -> None:
    """The right order of recorded drives among all."""
    robot = Robot.load(corridor.ROBOT)
    frames = list(corridor.frames(data / "corridor8", robot))
    print("corridor8", place_of_right(ranked(gather(frames, robot), robot)))
    of_scitos24(data)
    robot = Robot.load(data / "crazyflie4" / "crazyflie4.yaml")
    for file in sorted((data / "crazyflie4").glob("*.csv")):
        print(file.stem, place_of_right(ranked(gather(load_log(file, robot), robot), robot)), flush=True)


COMMANDS = {
    "Move-Forward": (0.145, 0.0),
    "Slight-Left-Turn": (0.13, 2.8),
    "Slight-Right-Turn": (0.06, -0.7),
    "Sharp-Right-Turn": (0.0, -10.3),
}
"""Metres and degrees a second of scitos24's commands: how fast ranges ahead and astern change, and its scan turns."""


def scitos24(folder: Path, robot: Robot) -> list[Frame]:
    """The drive that scitos24's commands would make: it has no poses, but names what the robot was told to do."""
    rows = [line.split(",") for line in (folder / "sensor_readings_24.data").read_text().splitlines()[1:]]
    pose, out = np.zeros(3), []
    for i, row in enumerate(rows):
        ranges = np.array(row[:24], dtype=float)
        out.append(Frame(i / 9, pose.copy(), robot.clean(np.where(ranges < 5.0, ranges, np.inf))))
        speed, turn = COMMANDS[row[24].strip()]
        pose += np.array([speed * np.cos(pose[2]), speed * np.sin(pose[2]), np.deg2rad(turn)]) / 9
    return out


def of_scitos24(data: Path) -> None:
    """Which mounts come first if they are given mirrored, and numbered backwards."""
    right = Robot.load("scitos-g5")
    ring, axis = right.mounts, right.mounts[:, 2]
    readings = gather(scitos24(data / "scitos24", right), right)
    for name, mounts in (("as it is", ring), ("mirrored", ring * [1, -1, -1]), ("backwards", ring[::-1])):
        ranks = ranked(readings, replace(right, mounts=mounts))
        off = [np.rad2deg(wrap(each.variant.mounts[0, 2] - axis[0])) for each in ranks]
        turns = [int(np.sign(wrap(each.variant.mounts[1, 2] - each.variant.mounts[0, 2]))) for each in ranks]
        place = next(i for i, each in enumerate(zip(off, turns, strict=True)) if abs(each[0]) < 1 and each[1] > 0)
        first = f"first {ranks[0].share:.3f}, {off[0]:.0f} degrees off and {'right' if turns[0] > 0 else 'backwards'}"
        print(f"scitos24 {name}: right at place {place + 1} of {len(ranks)}; {first}", flush=True)


def place_of_right(ranks: list[Ranked]) -> str:
    """Where what was given, which is right, stands."""
    place = next(i for i, each in enumerate(ranks) if each.variant.name == AS_GIVEN)
    over = f"{ranks[0].share:.3f} over {ranks[1].share:.3f} ({ranks[0].over(ranks[1]):.1f} standard deviations)"
    return f"right at place {place + 1} of {len(ranks)}; first {over}: {ranks[1].variant.name}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulated", "summary", "recordings"))
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--simulators", nargs="+", default=SIMULATORS, choices=SIMULATORS)
    parser.add_argument("--walls", nargs="+", default=["smooth", "mixed"])
    parser.add_argument("--robots", nargs="+", default=["b21", "p3dx", "uneven11"])
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--data", type=Path, default=DATA)
    args = parser.parse_args()
    if args.what == "recordings":
        recordings(args.data)
    elif args.what == "summary":
        rows = [json.loads(line) for file in args.files for line in file.read_text().splitlines()]
        print("\n".join(summary(rows)))
    else:
        for number in range(args.trials):
            for walls in args.walls:
                for simulator in args.simulators:
                    name = args.robots[number % len(args.robots)]
                    print(json.dumps(trial(simulator, walls, name, number, args.seed)), flush=True)


if __name__ == "__main__":
    main()
