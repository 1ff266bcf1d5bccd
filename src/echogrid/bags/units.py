"""Ranges and limits as the beginning of a bag has them, where they cannot be m: told, and kept from the map."""

from collections.abc import Iterable
from math import inf
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import nan_to_num, ndarray

from echogrid.bags.survey import Survey
from echogrid.errors import InputError
from echogrid.ros.messages import Sonar, few

_MOST = 0.6
"""A share of the readings that is most of them."""

_FEWEST = 10
"""Ranges of a sonar of which nothing is said."""

_MAX_M, _MIN_M, _NONE_M = 100.0, 5.0, 1e5
"""A max_range and a min_range beyond the first two are no sonar's in m; beyond the last they are meant as none."""

_LONG_M, _SHORT_M = 20.0, 0.3
"""Sonars that hear as far as the first, and no farther than the second, there are none."""

_CODE = 0.3
"""The share of ranges past the limit that one value has which means no echo."""

_OTHER_UNIT = 5.0
"""Ranges that lie so many times past the limit are of another unit."""

_NAMES = {100.0: "cm", 1000.0: "mm"}

_REMEDY = "mend the driver: ranges and limits in m (REP 117)"
_ROBOT = "or give --robot with the true limits"


class Units(NamedTuple):
    """What is to be done about the units of sonars."""

    left_out: list[Sonar]
    scales: dict[Sonar, float]
    """By what the limits in some sonars' messages are to be divided; inf: they count for nothing."""
    notes: dict[str, int]


def units(survey: Survey, sonars: list[Sonar]) -> Units:
    """Judge the ranges and limits of sonars.

    Raises:
        InputError: none of them can be used.
    """
    own = survey.robot is not None
    void: list[Sonar] = []
    odd: list[Sonar] = []
    scales: dict[Sonar, float] = {}
    notes: dict[str, int] = {}
    for group in _groups(survey, sonars):
        said = _said(survey, group)
        if said.void:
            void += group
        elif scale := _scale(said):
            scales |= dict.fromkeys(group, scale)
            notes |= _scaled_note(survey, group, said, scale)
        else:
            amiss = _other_unit(survey, group, said)
            odd += amiss
            notes |= _limits_note(survey, [sonar for sonar in group if sonar not in amiss])
    left_out = [*odd, *([] if own else void)]
    if left_out and not any(survey.heard[sonar].finite for sonar in sonars if sonar not in left_out):
        found, more = (_odd(survey, odd), "") if odd else (_void(survey, void), f", {_ROBOT}")
        raise InputError(survey.name, found, f"ranges and limits in m (REP 117){more}")
    if odd:
        notes[f"{_odd(survey, odd)}; left out ({_REMEDY})"] = 0
    if void:
        done = "those of the robot file taken" if own else f"left out ({_REMEDY}, {_ROBOT})"
        notes[f"{_void(survey, void)}; {done}"] = 0
    return Units(left_out, dict.fromkeys([*scales, *void], inf) if own else scales, notes)


def _groups(survey: Survey, sonars: list[Sonar]) -> list[list[Sonar]]:
    """Sonars of the same limits together."""
    groups: dict[tuple[float, float], list[Sonar]] = {}
    for sonar in sonars:
        low, high = survey.heard[sonar].limits
        groups.setdefault((nan_to_num(low), nan_to_num(high)), []).append(sonar)
    return list(groups.values())


class _Said(NamedTuple):
    """What some sonars of the same limits say."""

    low: float
    high: float
    ranges: Float[ndarray, "n"]
    """Without a value that means no echo."""
    below: float
    """The share of all readings that lie below the minimum."""

    @property
    def void(self) -> bool:
        """Whether no range lies between the limits."""
        return 0 < self.high <= self.low

    @property
    def vast(self) -> bool:
        """Whether the limits are no sonar's."""
        return _MAX_M < self.high < _NONE_M or _MIN_M < self.low < _NONE_M

    @property
    def end(self) -> float:
        """What ranges lie past that mean no echo, m."""
        return self.high if 0 < self.high <= _MAX_M else _LONG_M

    @property
    def far_past(self) -> bool:
        """Whether most ranges lie far past the limit, or past any sonar's."""
        most = self.high * _OTHER_UNIT if 0 < self.high <= _MAX_M else _LONG_M
        return self.quantile(1 - _MOST) > most

    def quantile(self, share: float) -> float:
        """Of the ranges, m; 0 if they are too few."""
        return float(np.quantile(self.ranges, share)) if len(self.ranges) >= _FEWEST else 0.0


def _said(survey: Survey, sonars: Iterable[Sonar]) -> _Said:
    heard = [survey.heard[sonar] for sonar in sonars]
    ranges = np.concatenate([each.ranges.array() for each in heard])
    readings = max(sum(each.readings for each in heard), 1)
    low, high = heard[0].limits
    said = _Said(low, high, ranges, sum(each.below for each in heard) / readings)
    values, counts = np.unique(ranges[ranges >= said.end], return_counts=True)
    codes = values[counts > _CODE * counts.sum()]
    return said._replace(ranges=ranges[~np.isin(ranges, codes)])


def _scale(said: _Said) -> float | None:
    """By what limits are to be divided to be m as the ranges are; None if they are m."""
    if not (said.vast or said.below > _MOST) or len(said.ranges) < _FEWEST:
        return None
    near, far = said.quantile(0.05), said.quantile(0.95)
    fits = (
        scale
        for scale in _NAMES
        if _SHORT_M <= said.high / scale <= _LONG_M and said.low / scale <= near and far <= 1.01 * said.high / scale
    )
    return next(fits, None)


def _other_unit(survey: Survey, group: list[Sonar], said: _Said) -> list[Sonar]:
    """Those of a group whose ranges are no m."""
    each = {sonar: _said(survey, [sonar]) for sonar in group}
    if said.far_past:  # where the robot stands, one alone may say one value all the time
        return [sonar for sonar, own in each.items() if len(own.ranges) < _FEWEST or own.far_past]
    return [sonar for sonar, own in each.items() if own.far_past]


def _about(survey: Survey, sonars: Iterable[Sonar]) -> str:
    return f"ranges of about {_m(_said(survey, sonars).quantile(0.5))} m"


def _limits(survey: Survey, sonars: Iterable[Sonar], scale: float = 1.0) -> str:
    low, high = survey.heard[next(iter(sonars))].limits
    return f"{_m(low / scale)} to {_m(high / scale)} m"


def _m(value: float) -> str:
    return f"{value:.4g}"


def _topics(sonars: Iterable[Sonar]) -> str:
    return few(dict.fromkeys(sonar.topic for sonar in sonars))


def _odd(survey: Survey, sonars: list[Sonar]) -> str:
    limits = _limits(survey, sonars)
    return f"{_about(survey, sonars)} on {_topics(sonars)}, whose limits are {limits}: cm or mm for m?"


def _void(survey: Survey, sonars: list[Sonar]) -> str:
    low, high = (_m(limit) for limit in survey.heard[sonars[0]].limits)
    return f"max_range {high} m on {_topics(sonars)}, not above min_range {low} m, so that no range is valid"


def _scaled_note(survey: Survey, sonars: list[Sonar], said: _Said, scale: float) -> dict[str, int]:
    done = f"taken for {_NAMES[scale]}, {_limits(survey, sonars, scale)} ({_REMEDY}, {_ROBOT})"
    done = done if survey.robot is None else "those of the robot file taken"
    told = f"limits of {_limits(survey, sonars)} on {_topics(sonars)}, with {_about(survey, sonars)}"
    return {f"{told}: {'no sonar has these' if said.vast else 'nearly all are below'}; {done}": 0}


def _limits_note(survey: Survey, sonars: list[Sonar]) -> dict[str, int]:
    """A note on sonars of the same limits, where these do not fit what they say."""
    if not sonars:
        return {}
    said, where = _said(survey, sonars), _topics(sonars)
    told = f"ranges of about {_m(said.quantile(0.5))} m on {where}"
    limits, remedy = _limits(survey, sonars), f"({_REMEDY}, {_ROBOT})"
    if said.vast:
        return {f"limits of {limits} on {where}: no sonar has these, cm or mm for m? {remedy}": 0}
    if said.quantile(1 - _MOST) > said.end:
        why = "most of them past the limits of"
        return {
            f"{told}, {why} {limits}, so that they are no echo: max_range too small, or another unit? {remedy}": 0
        }
    near = [sonar for sonar in sonars if _said(survey, [sonar]).below > 0.9 and survey.heard[sonar].finite >= _FEWEST]
    if near:
        told = f"{_about(survey, near)} on {_topics(near)} in the beginning, below the limits of {limits}"
        return {f"{told}, so that none is valid: something right before them, or another unit? {remedy}": 0}
    return {}
