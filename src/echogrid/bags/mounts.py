"""Where the sonars of a bag sit, as its transforms tell, and the robot that they make."""

from collections.abc import Mapping
from math import degrees

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from echogrid.bags.survey import Heard, Survey
from echogrid.errors import InputError
from echogrid.robot import Robot
from echogrid.ros.messages import Sonar, few
from echogrid.ros.sonars import BEAM_WIDTH_RAD, beam_width, mount, robot_of
from echogrid.ros.transforms import Transforms

_TURNED_M, _TURNED_RAD = 0.01, np.deg2rad(1.0)
"""A mount that changes more than this is one that moves."""


def placed(survey: Survey, sonars: list[Sonar], base: str) -> tuple[list[Sonar], dict[str, int]]:
    """Find the mounts of sonars on the robot whose frame is ``base``.

    Returns:
        Those sonars that have one, and notes on the others; the survey is told either.

    Raises:
        InputError: none has one, or two share a frame.
    """
    frames: dict[str, Sonar] = {}
    amiss: dict[str, list[Sonar]] = {}
    for sonar in sonars:
        heard = survey.heard[sonar]
        heard.mount, heard.amiss = _mount(survey.transforms, base, sonar, heard)
        other = frames.setdefault(sonar.frame, sonar)
        if other != sonar and heard.mount is not None:
            raise _one_frame(survey.name, sonars, other, sonar)
        if heard.amiss:
            amiss.setdefault(heard.amiss, []).append(sonar)
    found = [sonar for sonar in sonars if survey.heard[sonar].mount is not None]
    if not found:
        raise InputError(
            survey.name,
            f"no sonar with a place: {few(sonars)}: {survey.heard[sonars[0]].amiss}",
            "tf, or --robot with the places of the sonars",
        )
    return found, {f"{few(left)} left out: {reason}": 0 for reason, left in amiss.items()}


def _one_frame(name: str, sonars: list[Sonar], first: Sonar, second: Sonar) -> InputError:
    """Two topics in one frame: one sonar twice, as raw and filtered, or sonars without frames of their own."""
    together: dict[str, list[str]] = {}
    for sonar in sonars:
        together.setdefault(sonar.frame, []).append(sonar.topic)
    twice = [topics for topics in together.values() if len(topics) > 1]
    either = [few(topics) for topics in zip(*twice, strict=False)]
    choice = (
        f"--topics with one of {', '.join(either[:3])} where they are one sonar's, or " if len(either) < 4 else ""
    )
    return InputError(
        name,
        f"{first.topic} and {second.topic} in one frame, {first.frame}",
        f"{choice}a frame for each sonar, or --robot with their places in the order of the topics",
    )


def _mount(
    transforms: Transforms, base: str, sonar: Sonar, heard: Heard
) -> tuple[Float[ndarray, "3"] | None, str | None]:
    """The mount of a sonar (m, m, rad), or why it has none."""
    if not sonar.frame:
        return None, "no name of a frame"
    first, last = (mount(transforms, base, sonar.frame, stamp) for stamp in (heard.first, heard.last))
    if first is None or last is None:
        return None, f"no transform to {base}"
    if isinstance(first, str) or isinstance(last, str):
        return None, str(first if isinstance(first, str) else last)
    if turned(first, last):
        return None, "one that moves on the robot"
    return last, None


def turned(first: Float[ndarray, "3"], last: Float[ndarray, "3"]) -> bool:
    """Whether a mount (m, m, rad) has changed."""
    apart = np.abs(first - last)
    return bool(max(apart[:2]) > _TURNED_M or _TURNED_RAD < apart[2] < 2 * np.pi - _TURNED_RAD)


def described(
    survey: Survey, sonars: list[Sonar], base: str, scales: Mapping[Sonar, float]
) -> tuple[Robot, dict[str, int]]:
    """The robot whose frame is ``base``, from what is told of its sonars, which have mounts; a note if a beam width
    had to be assumed. ``scales``: by what the limits of some are to be divided.
    """
    told = [survey.heard[sonar] for sonar in sonars]
    widths = [width for heard in told if (width := beam_width(heard.field_of_view)) is not None]
    notes: dict[str, int] = {}
    if len(widths) < len(told):
        odd = next(sonar for sonar in sonars if beam_width(survey.heard[sonar].field_of_view) is None)
        width = degrees(np.median(widths) if widths else BEAM_WIDTH_RAD)
        more = f" and {len(told) - len(widths) - 1} more" if len(told) - len(widths) > 1 else ""
        field = f"field_of_view {survey.heard[odd].field_of_view:g} of {odd}{more}"
        notes[f"{field}: no beam width, {width:.0f} degrees taken"] = 0
    mounts = np.array([heard.mount for heard in told], dtype=float)
    limits = [tuple(limit / scales.get(sonar, 1.0) for limit in survey.heard[sonar].limits) for sonar in sonars]
    return robot_of(base, mounts, widths, [(low, high) for low, high in limits]), notes
