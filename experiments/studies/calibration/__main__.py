"""How well `echogrid calibrate` knows a robot from one log.

    python -m experiments.studies.calibration simulated [--trials 20] [--walls smooth mixed rough] [--robots b21 p3dx]
    python -m experiments.studies.calibration recordings [--data ../shared/data]

simulated: a robot tours a random room that nothing was chosen on. Its file is wrong: each mount by 2 cm (standard
deviation in x and y) and 3 degrees, the beam says 35 degrees, all ranges read up to 3 % too much or little, two
sonars have changed places and one is dead. The transducer hears in a cone, so that the beam is known. A row a
trial: how far mounts that the log tells are off (root mean square, and share within 2 cm and 1 degree), beam, scale,
and whether just the swapped and the dead were found. Mirrored: whether the right mounts come first of all variants if
mirrored ones are given.

recordings: corridor8, and crazyflie4 with all 24 orders of its sonars: the place of the right order among all.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from echogrid import Frame, Robot, load_log
from echogrid.calibration.calibrate import calibrate
from echogrid.calibration.readings import gather
from echogrid.calibration.variants import AS_GIVEN, Ranked, ranked
from echogrid.errors import EchogridError
from echogrid.geometry import wrap
from echogrid.simulation.acoustics import Physics
from echogrid.simulation.simulate import Simulator
from experiments.common import corridor8 as corridor
from experiments.common.rooms import robots, rooms

SEED = 41_000_000
DATA = Path(__file__).parents[4] / "shared" / "data"
PHYSICS = Physics(beam="cone", range_scale=0.0)


def wrong(robot: Robot, rng: np.random.Generator) -> Robot:
    """A robot file that is a little wrong; how far out all sonars sit in the mean no log tells, and is kept."""
    off = np.column_stack([rng.normal(0, 0.02, (robot.sonars, 2)), np.deg2rad(rng.normal(0, 3, robot.sonars))])
    out = np.stack([np.cos(robot.mounts[:, 2]), np.sin(robot.mounts[:, 2])], axis=1)
    off[:, :2] -= np.mean(np.sum(off[:, :2] * out, axis=1)) * out
    return replace(robot, mounts=robot.mounts + off, beam_width_rad=np.deg2rad(35.0))


def trial(name: str, walls: str, number: int) -> str:
    """One drive, as a row."""
    robot, rng = robots()[name], np.random.default_rng([SEED, number])
    world, poses = next(rooms(walls, 1, robot, SEED + number))
    frames = list(Simulator(world, robot, PHYSICS).frames(poses, number))
    null = np.rad2deg(
        2 * np.arcsin(0.61 * 343.0 / robot.transducer.frequency_hz / robot.transducer.aperture_radius_m)
    )
    scale, given = 1 + rng.uniform(-0.03, 0.03), wrong(robot, rng)
    one, two, dead = rng.choice(robot.sonars, 3, replace=False)
    ranges = robot.clean(scale * np.array([frame.ranges for frame in frames]))
    mirrored = replace(given, mounts=given.mounts * [1, -1, -1])
    whole = [Frame(frame.stamp, frame.pose, row.copy()) for frame, row in zip(frames, ranges, strict=True)]
    off = ranked(gather(whole, robot), mirrored)[0].variant.mounts - given.mounts
    # Of an even ring the mirror image and the numbers run backwards are the same but for what is wrong of each mount.
    first = np.abs(off[:, :2]).max() < 0.15 and np.abs(np.rad2deg(wrap(off[:, 2]))).max() < 15.0
    ranges[:, [one, two]] = ranges[:, [two, one]]
    ranges[:, dead] = np.inf
    frames = [Frame(frame.stamp, frame.pose, row) for frame, row in zip(frames, ranges, strict=True)]
    head = f"{name:6} {walls:6} {number:3}"
    try:
        found = calibrate(frames, given)
    except EchogridError as error:
        return f"{head} {error}"
    true = robot.mounts[found.seats]
    off = np.delete((found.given.mounts + found.moved - true), dead, axis=0)
    off[:, 2] = np.rad2deg(wrap(off[:, 2]))
    swaps = sorted(found.swapped) == sorted([(one, two), (two, one)])
    place, axis = np.sqrt(np.mean(off[:, :2] ** 2)), np.sqrt(np.mean(off[:, 2] ** 2))
    within = f"{np.mean(np.abs(off[:, :2]) < 0.02):.2f} {np.mean(np.abs(off[:, 2]) < 1.0):.2f}"
    beam, ratio = np.rad2deg(2 * found.beams.half) - null, found.places.scale / scale - 1
    told = f"place {place:.4f} m axis {axis:.2f} deg within {within} beam {beam:+.1f} deg scale {ratio:+.4f}"
    health = found.health.useless == [dead]
    return f"{head} {told} swapped {swaps} dead {health} mirrored first {first} told {not found.unsure}"


def recordings(data: Path) -> None:
    """The right order of recorded drives among all."""
    robot = Robot.load(corridor.ROBOT)
    frames = list(corridor.frames(data / "corridor8", robot))
    print("corridor8", place_of_right(ranked(gather(frames, robot), robot)))
    robot = Robot.load(data / "crazyflie4" / "crazyflie4.yaml")
    for file in sorted((data / "crazyflie4").glob("*.csv")):
        print(file.stem, place_of_right(ranked(gather(load_log(file, robot), robot), robot)), flush=True)


def place_of_right(ranks: list[Ranked]) -> str:
    """Where what was given, which is right, stands."""
    place = next(i for i, each in enumerate(ranks) if each.variant.name == AS_GIVEN)
    over = f"{ranks[0].share:.3f} over {ranks[1].share:.3f} ({ranks[0].over(ranks[1]):.1f} standard deviations)"
    return f"right at place {place + 1} of {len(ranks)}; first {over}: {ranks[1].variant.name}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulated", "recordings"))
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--walls", nargs="+", default=["smooth", "mixed", "rough"])
    parser.add_argument("--robots", nargs="+", default=["b21", "p3dx"])
    parser.add_argument("--data", type=Path, default=DATA)
    args = parser.parse_args()
    if args.what == "recordings":
        recordings(args.data)
        return
    for name in args.robots:
        for walls in args.walls:
            for number in range(args.trials):
                print(trial(name, walls, number), flush=True)


if __name__ == "__main__":
    main()
