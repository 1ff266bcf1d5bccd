"""Cases on which positions are judged, as folders of files: the log of a drive by dead reckoning, and the truth."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid import Frame, Log, Robot, load_log
from echogrid.errors import InputError
from echogrid.files import read_text
from echogrid.geometry import wrapped
from echogrid.logs.csv_log import write_csv
from echogrid.output.trajectory import read_tum, write_tum
from echogrid.robot import robot_yaml

ODOMETRY = {"odometry": "log.csv", "twice": "log-twice.csv"}
"""Logs by the errors of their poses; recordings have the first alone."""


@dataclass(frozen=True)
class Facts:
    """What a table says of a case."""

    kind: str
    walls: str
    robot: str
    length_m: float
    simulator: str
    """``default``, or what else the readings come from; ``recorded``."""
    start: tuple[float, float, float] | None = None
    """Where the origin of dead reckoning lies in ``plan.yaml``, about; m, m, rad. None where there is no plan."""


@dataclass(frozen=True)
class Case:
    """A folder: ``case.json``, ``robot.yaml``, ``log.csv``, and where it is known ``truth.tum``."""

    folder: Path

    @property
    def name(self) -> str:
        """The folder's own name."""
        return self.folder.name

    @cached_property
    def facts(self) -> Facts:
        """What it is."""
        path = self.folder / "case.json"
        try:
            told: dict[str, Any] = json.loads(read_text(path, "a case"))
            return Facts(**told)
        except (ValueError, TypeError) as error:
            raise InputError(path, str(error), "what a case is") from None

    @cached_property
    def robot(self) -> Robot:
        """Its robot."""
        return Robot.load(self.folder / "robot.yaml")

    def log(self, errors: str = "odometry") -> Log:
        """The drive with poses by one of ODOMETRY, or ``true`` ones."""
        if errors == "true":
            return Log.of(posed(list(self.log()), self.truth()), f"{self.name}, true poses")
        return load_log(self.folder / ODOMETRY[errors], self.robot)

    def has(self, errors: str) -> bool:
        """Whether there is a log with poses by one of ODOMETRY, or ``true`` ones."""
        return self.has_truth if errors == "true" else (self.folder / ODOMETRY[errors]).is_file()

    @property
    def has_truth(self) -> bool:
        """Whether the true poses are known."""
        return (self.folder / "truth.tum").is_file()

    def truth(self) -> Float[ndarray, "frames 3"]:
        """The true pose of each frame, m, m, rad."""
        stamps, poses = read_tum(self.folder / "truth.tum")
        own = np.array([frame.stamp for frame in self.log()])
        if not np.array_equal(stamps, own):
            raise InputError(self.folder / "truth.tum", "other stamps than in the log", "the same, line by line")
        return poses


def posed(frames: list[Frame], poses: Float[ndarray, "frames 3"]) -> list[Frame]:
    """Frames with other poses (m, m, rad)."""
    return [Frame(frame.stamp, pose, frame.ranges) for frame, pose in zip(frames, poses, strict=True)]


def write_case(
    folder: Path,
    facts: Facts,
    robot: Robot,
    frames: list[Frame],
    odometry: dict[str, Float[ndarray, "frames 3"]],
    truth: Float[ndarray, "frames 3"] | None,
) -> None:
    """Write a case: frames with poses of dead reckoning (m, m, rad), and the truth; ``case.json`` comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.yaml").write_text(robot_yaml(robot), encoding="utf-8")
    for errors, poses in odometry.items():
        level = wrapped(poses)
        write_csv(folder / ODOMETRY[errors], posed(frames, level), robot.sonars)
    if truth is not None:
        write_tum(folder / "truth.tum", np.array([frame.stamp for frame in frames]), truth)
    (folder / "case.json").write_text(json.dumps(asdict(facts), indent=1) + "\n", encoding="utf-8")


def picked(names: Iterable[str], words: Sequence[str]) -> list[str]:
    """Those of some names that are one of the words, or hold a word that is no name itself; all if there is none."""
    there = list(names)
    parts = [word for word in words if word not in there]
    return [name for name in there if not words or name in words or any(part in name for part in parts)]


def cases_of(folder: Path, wanted: Sequence[str] = ()) -> list[Case]:
    """The finished cases in a folder, or the folder itself; those that are ``picked``.

    Raises:
        InputError: there is none.
    """
    files = [folder / "case.json"] if (folder / "case.json").is_file() else sorted(folder.glob("*/case.json"))
    names = picked([path.parent.name for path in files], wanted)
    cases = [Case(path.parent) for path in files if path.parent.name in names]
    if not cases:
        raise InputError(folder, "no case", "folders with a case.json")
    return cases
