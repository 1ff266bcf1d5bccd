"""Robots and their transducers: what they are, and the YAML files that describe them."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError
from echogrid.files import shipped_names, shipped_or_file
from echogrid.yaml_keys import Keys, as_number, parse_yaml, shown

MAX_SONARS = 512

_SINGLE = 1 - 1e-6
"""A limit in single precision is at least this share of the limit."""

_LEAST_M = 1e-6
"""0 m is no range, whatever the minimum."""


@dataclass(frozen=True)
class Transducer:
    """An ultrasonic transducer as a circular piston driven with a tone burst."""

    name: str
    frequency_hz: float
    aperture_radius_m: float
    """Radius of the radiating disc."""
    cycles: int = 16
    """Length of the burst in periods (Polaroid 6500 module: 16)."""


TRANSDUCERS = {
    # a = 18.4 mm reproduces both published beam widths of the 600 (12 deg at -3 dB, 15 deg at -6 dB).
    "polaroid-600": Transducer("polaroid-600", 49_400.0, 0.0184),
    # The aperture of the 7000 is not published; 12.9 mm is assumed (it is a smaller head with a wider beam).
    "polaroid-7000": Transducer("polaroid-7000", 52_000.0, 0.0129),
}


@dataclass(frozen=True)
class Robot:
    """A robot as the mapper needs it: where its sonars sit and what they can say."""

    name: str
    footprint_radius_m: float
    """Radius of the disc round the origin that the robot covers."""
    transducer: Transducer
    min_range_m: float
    """Shorter readings are not valid."""
    max_range_m: float
    """A reading at or past this is no echo; where the sonars differ, that of the sonar that hears farthest."""
    beam_width_rad: float
    """Full width of the cone in which a sonar is taken to see."""
    mounts: Float[ndarray, "sonars 3"]
    """x forward (m), y left (m), axis (rad, counter-clockwise from forward), in the robot's frame."""
    own_max_ranges_m: Float[ndarray, "sonars"] | None = None
    """The maximum range of each sonar; None: of all the same."""

    @property
    def max_ranges_m(self) -> Float[ndarray, "sonars"]:
        """The maximum range of each sonar."""
        own = self.own_max_ranges_m
        return np.full(self.sonars, float(self.max_range_m)) if own is None else own

    @property
    def sonars(self) -> int:
        """Number of sonars."""
        return len(self.mounts)

    @property
    def deaf_m(self) -> float:
        """How far from its footprint, m, a robot hears nothing: within the shortest range of its sonars."""
        inside = self.footprint_radius_m - np.linalg.norm(self.mounts[:, :2], axis=1)
        return max(0.0, self.min_range_m - float(np.min(inside)))

    def clean(self, ranges: Float[ndarray, "*n"]) -> Float[ndarray, "*n"]:
        """Apply the no-echo rule: at or past the maximum range -> +inf, below the minimum range or 0 -> nan.

        A reading may have been of single precision. What is clean already stays as it is. The last axis is that of
        the sonars, where these differ in their maximum.
        """
        longest = self.max_range_m if self.own_max_ranges_m is None else self.own_max_ranges_m
        ranges = np.where(ranges >= longest * _SINGLE, np.inf, ranges)
        return np.where(ranges < max(self.min_range_m * _SINGLE, _LEAST_M), np.nan, ranges)

    def clean_one(self, range_m: float, sonar: int = 0) -> float:
        """``clean`` for a single reading of a sonar."""
        least, longest = self.bounds
        if range_m >= longest[sonar]:
            return np.inf
        return np.nan if range_m < least else range_m

    @cached_property
    def bounds(self) -> tuple[float, list[float]]:
        """What a single reading is compared with: the minimum range, and the maximum of each sonar, m."""
        return max(self.min_range_m * _SINGLE, _LEAST_M), (self.max_ranges_m * _SINGLE).tolist()

    def __repr__(self) -> str:
        beam = np.rad2deg(self.beam_width_rad)
        least = "" if self.own_max_ranges_m is None else f"{np.min(self.own_max_ranges_m):g}.."
        limits = f"{self.min_range_m:g} to {least}{self.max_range_m:g} m"
        return f"Robot({self.name!r}, {self.sonars} sonars of {limits}, beam {beam:.3g} deg)"

    @staticmethod
    def load(name_or_file: str | Path) -> "Robot":
        """A preset by name, or a robot file.

        Raises:
            InputError: the file is wrong; the message names the key.
            UsageError: neither a preset nor a file.
        """
        return parse_robot(shipped_or_file(name_or_file, "robots", "robot"), str(Path(name_or_file)))


def surrounded(mounts: Float[ndarray, "sonars 3"]) -> float:
    """A radius (m) that a robot surely covers whose mounts (m, m, rad) are all that is known of it.

    That of the largest disc round the origin that the mounts surround; else the distance of the nearest, at
    most 0.1 m.
    """
    bearing = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    farthest = np.max(np.stack([np.cos(bearing), np.sin(bearing)], axis=1) @ mounts[:, :2].T, axis=1)
    return float(max(np.min(farthest), min(0.1, np.min(np.hypot(*mounts[:, :2].T)))))


def preset_names() -> list[str]:
    """Names of the robots that ship with the package."""
    return shipped_names("robots")


def presets_with(sonars: int) -> str:
    """The presets with so many sonars, as a message names them in brackets; empty if there is none."""
    fits = [name for name in preset_names() if Robot.load(name).sonars == sonars]
    return f" (presets with {sonars}: {', '.join(fits)})" if fits else ""


def parse_robot(text: str, where: str) -> Robot:
    """Read a robot from YAML text (the format is in docs/formats.md).

    Raises:
        InputError: the message names the key.
    """
    allowed = frozenset({"name", "description", "footprint_radius_m", "sonar", "mounts"})
    top = Keys(where, parse_yaml(text, where), allowed=allowed)
    sonar = Keys(
        where,
        top.take("sonar"),
        "sonar",
        frozenset(
            {
                "transducer",
                "frequency_hz",
                "aperture_radius_m",
                "cycles",
                "min_range_m",
                "max_range_m",
                "beam_width_deg",
            }
        ),
    )
    min_range = sonar.number("min_range_m", 0.0, 10.0)
    mounts = top.rows("mounts", 3, -1000.0, 1000.0)
    max_range, own = _max_range(sonar, min_range, len(mounts))
    if len(mounts) > MAX_SONARS:
        raise InputError(top.at("mounts"), f"{len(mounts)} rows", f"at most {MAX_SONARS}")
    far = np.flatnonzero(np.max(np.abs(mounts[:, :2]), axis=1) > 10.0)
    if far.size:
        raise InputError(f"{top.at('mounts')}[{far[0]}]", shown(mounts[far[0]].tolist()), "x and y within 10 m")
    mounts[:, 2] = np.deg2rad(mounts[:, 2])
    return Robot(
        name=top.text("name"),
        footprint_radius_m=top.number("footprint_radius_m", 0.0, 10.0),
        transducer=_transducer(sonar),
        min_range_m=min_range,
        max_range_m=max_range,
        beam_width_rad=float(np.deg2rad(sonar.number("beam_width_deg", 1.0, 180.0))),
        mounts=mounts,
        own_max_ranges_m=own,
    )


def _max_range(sonar: Keys, min_range: float, sonars: int) -> tuple[float, Float[ndarray, "sonars"] | None]:
    """The largest maximum range, and that of each sonar where a list gives them."""
    given, where = sonar.take("max_range_m"), sonar.at("max_range_m")
    if isinstance(given, list) and len(given) != sonars:
        raise InputError(where, f"{len(given)} numbers", f"a number, or one for each of {sonars} mounts")
    each = [as_number(value, 0.0, 100.0, where) for value in (given if isinstance(given, list) else [given])]
    if min(each) <= min_range:
        raise InputError(where, f"{min(each):g}", f"more than min_range_m ({min_range:g})")
    return max(each), np.array(each) if isinstance(given, list) and min(each) < max(each) else None


def _transducer(sonar: Keys) -> Transducer:
    if "transducer" in sonar.data:
        name = sonar.text("transducer")
        if name not in TRANSDUCERS:
            raise InputError(sonar.at("transducer"), name, f"one of {', '.join(TRANSDUCERS)}")
        for key in ("frequency_hz", "aperture_radius_m", "cycles"):
            if key in sonar.data:
                raise InputError(sonar.at(key), "this key beside transducer", "one or the other")
        return TRANSDUCERS[name]
    return Transducer(
        "custom",
        sonar.number("frequency_hz", 1e3, 1e6),
        sonar.number("aperture_radius_m", 1e-3, 0.5),
        int(sonar.number("cycles", 1, 1000, default=16)),
    )


def robot_yaml(robot: Robot) -> str:
    """The robot as the text of a robot file; ``parse_robot`` reads the same robot back (to 1e-6)."""
    transducer = robot.transducer
    sonar: dict[str, Any] = (
        {"transducer": transducer.name}
        if TRANSDUCERS.get(transducer.name) == transducer
        else {
            "frequency_hz": transducer.frequency_hz,
            "aperture_radius_m": transducer.aperture_radius_m,
            "cycles": transducer.cycles,
        }
    )
    sonar |= {
        "min_range_m": robot.min_range_m,
        "max_range_m": robot.max_range_m if robot.own_max_ranges_m is None else robot.own_max_ranges_m.tolist(),
        "beam_width_deg": round(float(np.rad2deg(robot.beam_width_rad)), 6),
    }
    mounts = [
        [round(float(x), 6), round(float(y), 6), round(float(np.rad2deg(axis)), 6)] for x, y, axis in robot.mounts
    ]
    top = {
        "name": robot.name,
        "footprint_radius_m": robot.footprint_radius_m,
        "sonar": sonar,
        "mounts": mounts,
    }
    return yaml.safe_dump(top, sort_keys=False, default_flow_style=None, width=100)
