"""How a bag is to be read: the frames of the robot and of the map, its topics, and what is left out or assumed."""

from dataclasses import dataclass

from echogrid.bags.bag_file import Topic
from echogrid.bags.clocks import Fix, Judgement, Source
from echogrid.bags.clocks import judged as judged_clocks
from echogrid.bags.floor import without_floor
from echogrid.bags.mounts import described, placed
from echogrid.bags.survey import Survey
from echogrid.bags.units import units
from echogrid.doubts import LEAST_READINGS, ZEROS
from echogrid.errors import InputError
from echogrid.robot import Robot, presets_with
from echogrid.ros.messages import ODOMETRY, RANGE, TF, TF_OLD, Sonar, few, short
from echogrid.ros.sonars import base_of, fixed_of
from echogrid.ros.transforms import Transforms, stands_still


@dataclass(frozen=True)
class Plan:
    """How a bag is to be read."""

    robot: Robot
    numbers: dict[Sonar, int]
    """Place of each sonar among the robot's mounts."""
    topics: frozenset[str]
    """To be read."""
    base: str
    fixed: str
    transforms: Transforms
    """Of the survey; those that are static hold throughout."""
    unstamped: frozenset[str]
    """Topics whose messages never say a time, or poses none that can be: theirs is when they were recorded."""
    from_zero: bool
    """Whether 0 is a time as any other, as where a simulation begins."""
    fixes: dict[Source, Fix]
    """What makes good stamps of those of sonars whose clock is not that of the poses."""
    scales: dict[int, float]
    """By what the limits in the messages of some sonars are to be divided, by their numbers."""
    left_out: frozenset[Sonar]
    """What is known beforehand not to be used, though it has a place."""
    frames: dict[int, str]
    """The frame of each sonar whose mount the bag tells, by its number."""
    free: bool
    """Whether the frame to map in was found, not asked for."""
    notes: dict[str, int]
    """What is known beforehand to be left out or assumed, and how often."""


def planned(survey: Survey) -> Plan:
    """How to read the bag; the survey is told the frames and mounts that are found.

    Raises:
        InputError: no readings or no pose of the robot, more than one robot, or places that are not known.
    """
    if not survey.heard:
        because = "".join(f": {reason} ({n} times)" for reason, n in survey.refused.most_common(1))
        raise InputError(survey.name, f"nothing to read in {few(survey.read.sonars)}{because}", "readings of sonars")
    sonars = sorted(survey.heard, key=lambda sonar: sonar.order)
    if survey.robot is None and survey.read.sonars[0].type != RANGE:
        raise _no_places(survey)
    base = _base(survey, sonars)
    fixed = _fixed(survey, base)
    odometry = _odometry(survey, base, fixed)
    survey.base, survey.fixed = base, fixed
    judged = units(survey, sonars)
    if survey.robot is None:
        sonars, unplaced = placed(survey, sonars, base)
        level, floored = without_floor(survey, [each for each in sonars if each not in judged.left_out], base)
        unused = frozenset(sonars).difference(level)
        sonars = level
        robot, assumed = described(survey, sonars, base, judged.scales)
        notes, frames = unplaced | floored | assumed, dict(enumerate(sonar.frame for sonar in sonars))
    else:
        unused = frozenset(judged.left_out)
        robot, notes, frames = survey.robot, {}, {}
        if len(sonars) != robot.sonars:
            found = f"{len(sonars)} sonars ({few(sonars)})"
            raise InputError(survey.name, found, f"{robot.sonars}, as robot {robot.name} has")
    clocks = _clocks(survey, sonars, odometry)
    numbers = {sonar: number for number, sonar in enumerate(sonars) if sonar not in unused}
    return Plan(
        robot=robot,
        numbers=numbers,
        topics=frozenset(topic.name for topic in (*survey.read.sonars, *odometry, *survey.read.tf)),
        base=base,
        fixed=fixed,
        transforms=survey.transforms,
        unstamped=survey.unstamped | clocks.recorded,
        from_zero=survey.from_zero,
        fixes=clocks.fixes,
        scales={numbers[sonar]: scale for sonar, scale in judged.scales.items() if sonar in numbers},
        left_out=unused,
        frames=frames,
        free=survey.choice.fixed is None and not survey.choice.odometry,
        notes=notes | _zeros(survey, sonars) | clocks.notes | judged.notes,
    )


def _no_places(survey: Survey) -> InputError:
    count, topic = len(survey.heard), survey.read.sonars[0]
    found = f"{count} sonars in {topic}, which does not say where they sit"
    return InputError(survey.name, found, f"--robot with their places{presets_with(count)}")


def _base(survey: Survey, sonars: list[Sonar]) -> str:
    """The frame of the robot that carries the sonars."""
    if survey.choice.base:
        return survey.choice.base.lstrip("/")
    carried: dict[str, list[Sonar]] = {}
    for sonar in sonars:
        if sonar.frame.lstrip("/") in survey.transforms:
            carried.setdefault(base_of(survey.transforms, sonar.frame), []).append(sonar)
    moving = _moving(survey.transforms)
    bases = [base for base in carried if base in moving] or (sorted(moving) if survey.robot else list(carried))
    if len(bases) > 1:
        found = "; ".join(f"{base} ({few(carried.get(base, []))})" for base in sorted(bases))
        raise InputError(survey.name, f"{len(bases)} robots: {found}", "one, by --topics or --base-frame")
    if bases:
        return bases[0]
    if moving and not survey.robot:
        frames = few(dict.fromkeys(sonar.frame or "without a name" for sonar in sonars))
        raise InputError(
            survey.name,
            f"no transform from the robot ({few(sorted(moving))}) to the frames of the sonars ({frames})",
            "tf, or --robot with the places of the sonars",
        )
    raise _no_pose(survey, "the robot", None)


def _moving(transforms: Transforms) -> set[str]:
    """The frames of robots; what stands still in the room, such as a dock, is none."""
    bases = {base_of(transforms, child) for child in transforms.children()}
    above = {base: fixed_of(transforms, base) for base in bases}
    return {base for base, fixed in above.items() if fixed and transforms.moves(fixed, base)}


def _fixed(survey: Survey, base: str) -> str:
    """The frame to map in, in which the pose of the robot is known."""
    choice, transforms = survey.choice, survey.transforms
    fixed = choice.fixed.lstrip("/") if choice.fixed else fixed_of(transforms, base, choice.odometry)
    if fixed is None or transforms.known(fixed, base) is None:
        raise _no_pose(survey, base, fixed)
    if base in transforms.line(fixed):
        above = few(transforms.line(base)[1:])
        wanted = f"--fixed-frame with {above}" if above != "nothing" else "--base-frame with the robot's own"
        raise InputError(survey.name, f"{fixed} to map in, which moves with {base}", wanted)
    return fixed


def _no_pose(survey: Survey, base: str, fixed: str | None) -> InputError:
    transforms, choice = survey.transforms, survey.choice
    roots = {transforms.line(child)[-1] for child in transforms.children()}
    frames = sorted({*transforms.children(), *roots})
    for option, name in (("--base-frame", choice.base), ("--fixed-frame", choice.fixed)):
        if name and name.lstrip("/") not in frames:
            return InputError(survey.name, f"no frame {short(name)}", f"{option} with one of {few(frames)}")
    posing = [topic for topic in survey.topics if topic.type in (TF, TF_OLD, ODOMETRY)]
    there = f" in {few(posing)} (frames: {few(frames)})" if posing else ": neither tf nor odometry"
    return InputError(
        survey.name,
        f"no pose of {base}{f' in {fixed}' if fixed else ''}{there}",
        f"tf from map or odom to the robot, or nav_msgs/Odometry (or --base-frame, if {base} is not the robot)",
    )


def _odometry(survey: Survey, base: str, fixed: str) -> list[Topic]:
    """The topics of odometry to be read: none where tf has the pose of the robot."""
    line = survey.transforms.line(base)
    above = line[: line.index(fixed)] if fixed in line else []
    weak = [child for child in above if survey.transforms.is_weak(child)]
    topics = {topic for child in weak for topic in survey.posing.get(child, ())}
    # Else it is of frames that hang on the robot's.
    topics = topics or {
        topic
        for frame, those in survey.posing.items()
        for topic in those
        if any(not survey.transforms.moves(child, frame) for child in weak)
    }
    if len(topics) > 1:
        found = f"the pose of {base} in {len(topics)} topics"
        raise InputError(survey.name, found, f"--topics with one of {few(sorted(topics))}")
    return [topic for topic in survey.read.odometry if topic.name in topics]


def _clocks(survey: Survey, sonars: list[Sonar], odometry: list[Topic]) -> Judgement:
    """What the clocks of the sonars are beside that of the robot's pose."""
    transforms, topics = survey.transforms, {topic.name for topic in odometry}
    line = transforms.line(survey.base)
    above = line[: line.index(survey.fixed)] if survey.fixed in line else line
    moving = (name for name in above if not stands_still(name) and name in transforms.children())
    child = next((name for name in moving if transforms.moves(name, transforms.line(name)[1])), survey.base)
    tf = {topic.name for topic in survey.read.tf}
    poses = [
        source
        for source in survey.clocks.sources()
        if source[0] in topics or (source[0] in tf and source[1] == child)
    ]
    said = {(sonar.topic, sonar.frame if survey.read.sonars[0].type == RANGE else "") for sonar in sonars}
    return judged_clocks(survey.clocks, sorted(said), poses, survey.unstamped)


def _zeros(survey: Survey, sonars: list[Sonar]) -> dict[str, int]:
    """Notes on the sonars that said nothing but 0, and on those that said it often."""
    heard = {sonar: survey.heard[sonar] for sonar in sonars}
    zeros = [sonar for sonar in sonars if heard[sonar].zeros == heard[sonar].readings]
    count = sum(heard[sonar].zeros for sonar in zeros)
    notes = (
        {f"nothing but 0 m or less, which is no range, from {few(zeros)} in the beginning": count} if zeros else {}
    )
    often = [each for each in sonars if each not in zeros and heard[each].zeros > ZEROS * heard[each].readings]
    count, readings = (sum(getattr(heard[each], name) for each in often) for name in ("zeros", "readings"))
    if readings >= LEAST_READINGS:
        share = f"{count / readings:.0%} of the readings on {few(dict.fromkeys(each.topic for each in often))}"
        notes[
            f"{share} are 0 m or less, which is no range: if that is how the sensor says no echo, it has to be +inf"
        ] = 0
    return notes
