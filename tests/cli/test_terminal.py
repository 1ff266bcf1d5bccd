"""Names that come out of a file never control the terminal."""

import re

import pytest

from bag_samples import DRIVE
from bag_writers import write
from commands import call
from echogrid.cli import live
from echogrid.errors import EchogridError, escaped

EVIL = "\x1b]0;owned\x07\x1b[31m\r\n\u202e"


def poisoned(value):
    """What a message holds, with every name of a frame poisoned but that of odom, which is known by its name."""
    if isinstance(value, dict):
        return {key: poisoned(part) for key, part in value.items()}
    if isinstance(value, str) and value != "odom":
        return value + EVIL
    return [poisoned(each) for each in value] if isinstance(value, list) else value


@pytest.mark.parametrize(("command", "form"), [("info", "bag"), ("info", "mcap"), ("map", "mcap")])
@pytest.mark.parametrize("whole", [True, False])
def test_nothing_of_a_bag_controls_the_terminal(tmp_path, capsys, form, command, whole):
    messages = [said._replace(content=poisoned(said.content)) for said in DRIVE]
    messages = [said._replace(topic=said.topic + EVIL) if "sonar" in said.topic else said for said in messages]
    if not whole:  # refused, for want of the places of the sonars
        messages = [said for said in messages if said.topic != "/tf_static"]
    path = write(tmp_path / ("drive.bag" if form == "bag" else "drive"), sorted(messages, key=lambda m: m.time), form)
    out = [] if command == "info" else ["--out", tmp_path / "out"]
    status = call(command, path, *out)
    written = capsys.readouterr()
    text = written.out + written.err
    assert status == (0 if whole else 2)
    assert re.sub(r"\n", "", text).isprintable(), [c for c in text if not c.isprintable() and c != "\n"]
    if command == "info" and status == 0:
        assert r"\x1b]0;owned\x07" in written.out


def test_what_live_says_does_not_control_the_terminal(capsys):
    live._say("sonar" + EVIL)
    assert capsys.readouterr().err == "live: sonar" + escaped(EVIL) + "\n"


def test_escaping_leaves_what_can_be_shown_as_it_is():
    assert escaped("Sonär 声纳 °") == "Sonär 声纳 °"
    assert str(EchogridError(EVIL)) == escaped(EVIL) == r"\x1b]0;owned\x07\x1b[31m\r\n\u202e"
