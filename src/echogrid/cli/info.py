"""The command that says what is in a log: info."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from echogrid.bags.recognising import recognises
from echogrid.cli.arguments import Ros, print_notes, robot_arg
from echogrid.errors import escaped
from echogrid.logs.contents import LogInfo, describe
from echogrid.logs.formats import load_log
from echogrid.robot import Robot
from echogrid.ros.messages import few

if TYPE_CHECKING:
    from echogrid.bags.survey import Survey


@dataclass(frozen=True)
class Info:
    """Say what is in a log."""

    log: Annotated[Positional[Path], arg(metavar="LOG")]
    """CSV or CARMEN log, or a bag of ROS."""
    robot: Annotated[
        str | None,
        robot_arg(
            ", for its range limits (and places, where a bag has none). Without it, readings count as they are"
        ),
    ] = None
    ros: Annotated[Ros, OmitArgPrefixes] = field(default_factory=Ros)

    def run(self) -> None:
        """Print what is in the log."""
        robot = Robot.load(self.robot) if self.robot else None
        if recognises(self.log):
            from echogrid.bags.reader import survey

            _print_bag(survey(self.log, robot, self.ros.choice()))
        log = load_log(self.log, robot, self.ros.choice())
        _print_contents(describe(log))
        print_notes(log)


def _print_bag(survey: "Survey") -> None:
    """What is in a bag: its topics, and each sonar with what the bag says of it."""
    from echogrid.bags.clocks import APART_S, apart

    print("topic                            messages  type")
    for topic in survey.topics:
        print(escaped(f"{topic.name:32} {topic.messages:8}  {topic.type}"))
    head = "\nsonar (topic, frame)                       rate   x, y, axis on the robot     beam   limits      "
    print(f"{head}no echo  not valid")
    for sonar in sorted(survey.heard, key=lambda each: each.order):
        heard = survey.heard[sonar]
        place = heard.amiss or "of the robot file"
        if heard.mount is not None:
            x, y, axis = heard.mount
            place = f"{x:5.2f} {y:5.2f} m {np.rad2deg(axis):6.1f} deg"
        low, high = heard.limits
        beam = f"{np.rad2deg(heard.field_of_view):4.0f} deg"
        limits = f"{low:.2f}-{high:.2f} m"
        name = escaped(f"{sonar.topic} {sonar.frame}")
        shares = f"{heard.no_echo / heard.readings:6.1%}  {heard.not_valid / heard.readings:6.1%}"
        print(f"{name:40} {heard.rate:5.1f} Hz  {place:25} {beam}  {limits:11} {shares}")
    print("\n" + escaped(f"poses         of {survey.base} in {survey.fixed}"))
    offsets = apart(survey.clocks.offsets())
    for off, topics in offsets.items():
        print(escaped(f"clocks        {few(topics)}: {off} the time of recording"))
    if not offsets:
        print(f"clocks        all stamps within {APART_S:g} s of the time of recording")
    print()


def _print_contents(info: LogInfo) -> None:
    x0, y0, x1, y1 = info.box_m
    print(escaped(f"log           {info.name}"))
    print(f"frames        {info.frames}")
    print(f"sonars        {info.sonars}")
    rate = f", {(info.frames - 1) / info.span_s:.1f} Hz" if info.span_s > 0 else ""
    print(f"span          {info.span_s:.2f} s{rate}")
    print(f"drive         {info.length_m:.2f} m within x {x0:.2f} .. {x1:.2f}, y {y0:.2f} .. {y1:.2f} m")
    print(f"fastest       {info.fastest_m_s:.2f} m/s, {np.rad2deg(info.fastest_rad_s):.0f} degrees/s")
    print(f"no echo       {info.no_echo:.1%}")
    print(f"not valid     {info.not_fired:.1%}, or not fired")
    print(f"stale         {info.stale:.1%} of the finite readings repeat the one before")
    ranges = f"{info.nearest_m:.3f} .. {info.farthest_m:.3f} m, median {info.median_m:.2f} m"
    print(f"ranges        {'none' if np.isnan(info.median_m) else ranges}")
    print("no echo of    " + " ".join(f"r{i} {v:.0%}" for i, v in enumerate(info.no_echo_by_sonar)))
