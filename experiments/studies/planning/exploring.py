"""Explorations of buildings that nothing was tuned on: what is seen, by what way, and what is touched."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, cast

import numpy as np

from echogrid import Mapper, Robot
from echogrid.errors import EchogridError
from echogrid.grid import FREE_THRESH, OCCUPIED_THRESH
from echogrid.planning.choice import Level, Preferences
from echogrid.planning.explore import Exploration
from echogrid.planning.explorer import Explorer
from experiments.common.report import record, rounded, table
from experiments.studies.planning.sight import Sight
from experiments.studies.planning.tours import tour_m
from experiments.studies.position.buildings import WALLS, building

BUILDINGS = (
    *(("flat", number) for number in range(100, 106)),
    ("ring", 100),
    ("ring", 101),
    ("hall", 100),
    ("hall", 101),
)
"""Held out: the explorer was made on flats 0, 1 and 3, and on 30 to 37; others up to 95 showed what was mended."""

ROBOTS = ("b21", "p3dx")
PARTS = {"exploring": "echogrid", "slam": "echogrid, poses found", "peer": "nearest frontier, nav2",
         "ideal": "echogrid, all in sight known"}  # fmt: skip
LEAST_SEEN = {"exploring": 0.99, "slam": 0.97, "peer": 0.99, "ideal": 0.99}


def explored(kind: str, number: int, walls: str, robot_name: str, part: str = "exploring") -> dict[str, Any]:
    """One exploration, with its key, of a PART.

    A peer maps by Nav2's range layer and goes to the nearest frontier. The ideal map costs an explorer what it has to
    pay for not knowing the building, and nothing for what sonar does not hear.
    """
    key: dict[str, Any] = {"building": f"{kind}-{number}", "walls": walls, "robot": robot_name, "part": part}
    place, robot = building(kind, walls, number), Robot.load(robot_name)
    start = np.array([*place.way[0], 0.0])
    chooser = Explorer(robot)
    mapper: Callable[[Robot], Mapper] = Mapper
    if part == "peer":
        nearest = Preferences((Level(OCCUPIED_THRESH, FREE_THRESH, 4),), gain_m=0.0, turn_m=0.0, faith_m=0.0)
        chooser = Explorer(robot, preferences=nearest)
        mapper = partial(Mapper, model="nav2", resolution=0.05)
    elif part == "ideal":
        mapper = cast("Callable[[Robot], Mapper]", lambda _: Sight(place.world))
    try:
        exploration = Exploration(
            place.world, robot, start, number, mapper=mapper, slam=part == "slam", explorer=chooser
        )
        found = exploration.run()
        return key | found.told() | {"tour_m": tour_m(place.world, robot, start[:2], 0.95)}
    except EchogridError as error:
        return key | {"failed": str(error)}


def ratio(one: dict[str, Any], share: str = "95%") -> float | None:
    """The way until a share was seen, by that of the tour."""
    reached = one["until"][share]
    return reached["way_m"] / one["tour_m"] if reached else None


def summary(found: list[dict[str, Any]]) -> str:
    """A row for each kind of walls and robot."""
    rows = []
    for part, name in PARTS.items():
        for walls in WALLS:
            for robot in ROBOTS:
                some = [one for one in found if (one["walls"], one["robot"], one["part"]) == (walls, robot, part)]
                done = [one for one in some if "failed" not in one]
                if not done:
                    continue
                seen = np.array([one["seen"] for one in done])
                ratios = [value for one in done if (value := ratio(one)) is not None]
                rows.append([
                    name, walls, robot, str(len(done)),
                    f"{np.mean(seen):.3f}", f"{np.median(seen):.4f}", f"{np.min(seen):.3f}",
                    f"{np.count_nonzero(seen >= LEAST_SEEN[part])}", f"{np.median(ratios):.2f}" if ratios else "-",
                    str(sum(one["collisions"] for one in done)),
                    f"{min(one['least_clearance_m'] for one in done):.3f}",
                    f"{max(one['home_m'] for one in done):.2f}", f"{np.median([one['way_m'] for one in done]):.0f}",
                    f"{np.median([one['decision_ms']['median'] for one in done]):.0f}",
                ])  # fmt: skip
    header = ("explorer", "walls", "robot", "runs", "seen", "median", "least", "enough", "95 % / tour", "collisions",
              "least clearance, m", "from home, m", "way, m", "decision, ms")  # fmt: skip
    return table(header, rows)


def told(found: Iterable[dict[str, Any]], name: str) -> None:
    """Show and keep what was found."""
    kept = list(found)
    print(summary(kept))
    record(name, {"found": rounded(kept)})
