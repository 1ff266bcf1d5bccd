"""Which topics of a bag are read: those of its sonars, and the odometry and transforms of the robot that has them."""

from fnmatch import fnmatchcase
from typing import NamedTuple

from echogrid.bags.bag_file import Topic
from echogrid.errors import InputError
from echogrid.ros.messages import CLOUD2, ODOMETRY, RANGE, SONARS, TF, TF_OLD, Choice, few, short


class Chosen(NamedTuple):
    """The topics that are read."""

    sonars: list[Topic]
    """All of one type."""
    odometry: list[Topic]
    tf: list[Topic]


def choose(name: str, topics: list[Topic], choice: Choice) -> Chosen:
    """The topics to be read, of all that a bag has; messages call it ``name``.

    Raises:
        InputError: no topic of sonars, none that fits a pattern of the choice, or several between which nothing
            decides.
    """
    odometry = [topic for topic in topics if topic.type == ODOMETRY]
    sonars = _sonars(name, topics, odometry, choice)
    odometry = [topic for topic in odometry if choice.takes(topic.name)] or odometry
    return Chosen(sonars, _beside(odometry, sonars) or odometry, _tf(name, topics, sonars))


def _sonars(name: str, topics: list[Topic], odometry: list[Topic], choice: Choice) -> list[Topic]:
    """The topics of sonars: of the best type that is there."""
    there = [topic for topic in topics if topic.type in SONARS and topic.messages]
    for pattern in choice.topics:
        if not any(fnmatchcase(topic.name, pattern) for topic in (*there, *odometry)):
            wanted = f"one of {few((*there, *odometry))}" if there else f"one of {', '.join(SONARS)}"
            raise InputError(name, f"no topic of sonars or odometry that fits {short(pattern)}", wanted)
    taken = [topic for topic in there if choice.takes(topic.name)]
    if not (taken and choice.topics):  # no topic was named, or odometry alone
        # Point clouds are seldom sonars.
        taken = [topic for topic in there if topic.type != CLOUD2 or "sonar" in topic.name.lower()]
    if not taken:
        raise _no_sonars(name, topics, there)
    best = min((topic.type for topic in taken), key=SONARS.index)
    taken = [topic for topic in taken if topic.type == best]
    if best != RANGE and len(taken) > 1:
        raise InputError(name, f"{len(taken)} topics of {best}", f"--topics with one of {few(taken)}")
    return taken


def _no_sonars(name: str, topics: list[Topic], clouds: list[Topic]) -> InputError:
    if clouds:
        return InputError(name, "only point clouds that may not be sonars", f"--topics with one of {few(clouds)}")
    found = f"no topic of sonars among {few(topics)}"
    if not any(topic.messages for topic in topics):
        found = "a bag without messages"
    return InputError(name, found, f"one of {', '.join(SONARS)}")


def _tf(name: str, topics: list[Topic], sonars: list[Topic]) -> list[Topic]:
    """The topics of transforms: of one robot, where each has its own."""
    there = [topic for topic in topics if topic.type in (TF, TF_OLD)]
    spaces = {_space(topic) for topic in there}
    if len(spaces) < 2:
        return there
    near = _beside(there, sonars)
    if not near:
        names = few(sorted(topic.name for topic in there))
        raise InputError(name, f"transforms of {len(spaces)} robots ({names})", "sonars of one, by --topics")
    return near


def _beside(topics: list[Topic], sonars: list[Topic]) -> list[Topic]:
    """Those in the namespace of all sonars, or above it."""
    return [topic for topic in topics if all(sonar.name.startswith(_space(topic)) for sonar in sonars)]


def _space(topic: Topic) -> str:
    """The namespace of a topic, with the slash behind it."""
    return topic.name.rsplit("/", 1)[0] + "/"
