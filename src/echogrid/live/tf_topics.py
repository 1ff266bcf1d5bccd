"""Which topics of transforms are listened to: those of the robot whose sonars are heard, in whatever namespace."""

from collections.abc import Collection

from echogrid.ros.messages import few

MAX_TOPICS = 64
"""Topics of transforms that are kept apart; more are of no robot."""


class TfTopics:
    """The topics of transforms that have a writer."""

    def __init__(self) -> None:
        self._volatile: dict[str, bool] = {}

    def add(self, topic: str, volatile: bool) -> bool:
        """Take a topic of type TFMessage that has a writer; whether it is new.

        Args:
            topic: as ROS 2 names it.
            volatile: whether the writer keeps nothing for who comes late.
        """
        if topic.rsplit("/", 1)[-1] not in ("tf", "tf_static") or len(self._volatile) >= MAX_TOPICS:
            return False
        new = topic not in self._volatile
        self._volatile[topic] = self._volatile.get(topic, False) or volatile
        return new

    def wanted(self, ranges: Collection[str]) -> list[str]:
        """Those to be listened to beside these topics of ranges.

        They are those of the only robot there is, or those in the namespace of all sonars, or above it.
        """
        if not ranges:
            return []
        spaces = {_space(topic) for topic in self._volatile}
        return [
            topic
            for topic in self._volatile
            if len(spaces) == 1 or all(name.startswith(_space(topic)) for name in ranges)
        ]

    def lack(self, ranges: Collection[str]) -> list[str]:
        """Why transforms may be missing, where they are: what is to be said of it."""
        said = []
        wanted = self.wanted(ranges)
        elsewhere = sorted(set(self._volatile).difference(wanted))
        if ranges and elsewhere:
            space = _space(elsewhere[0])
            said.append(
                f"transforms on {few(elsewhere)} are not taken, for not all sonars ({few(sorted(ranges))}) are in "
                f"that namespace: choose those of one robot, as by --topics '{space}*'"
            )
        late = sorted(topic for topic in wanted if topic.endswith("/tf_static") and self._volatile[topic])
        if late:
            said.append(
                f"{few(late)} has durability volatile (a bridge, or a bag played back): what was sent before it was "
                "heard is lost; start echogrid live first, or send it transient local"
            )
        return said


def _space(topic: str) -> str:
    """The namespace of a topic, with the slash behind it."""
    return topic.rsplit("/", 1)[0] + "/"
