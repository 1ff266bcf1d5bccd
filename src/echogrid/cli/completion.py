"""Completion by tab: a script for the shell that knows commands, options, presets, models and worlds.

tyro's own knows nothing of names that stand beside files, and completes no LOG.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args, get_origin

from echogrid.errors import UsageError
from echogrid.robot import TRANSDUCERS, preset_names
from echogrid.simulation.beam_patterns import BEAMS
from echogrid.simulation.world import world_names

_SCRIPT = """\
_echogrid() {
  local word=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} words= options=
  case "${COMP_WORDS[1]} $before" in
%(values)s
    *) case "${COMP_WORDS[1]}" in
%(options)s
      *) words="%(commands)s" ;;
    esac
    [[ $word == -* ]] && words=$options ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "$word"))
}
complete -o default -F _echogrid echogrid
"""
"""For bash; what has no word that fits is completed as a file."""

_ZSH = "autoload -U +X compinit bashcompinit && compinit && bashcompinit\n"


def completion(shell: list[str], commands: Mapping[str, Any]) -> str:
    """The script.

    Args:
        shell: its name, bash or zsh.
        commands: by name.

    Raises:
        UsageError: another shell.
    """
    if shell not in (["bash"], ["zsh"]):
        raise UsageError(f"--tyro-print-completion: found {' '.join(shell) or 'nothing'}, expected bash or zsh")
    values, options = [], []
    for command, kind in commands.items():
        found = _options(kind)
        values += [f'    "{command} {name}") words="{" ".join(words)}" ;;' for name, words in found.items() if words]
        first = " ".join(world_names()) if command in ("simulate", "scan", "explore", "robot") else ""
        options.append(f'      {command}) options="{" ".join([*found, "--help"])}" words="{first}" ;;')
    filled = _SCRIPT % {"values": "\n".join(values), "options": "\n".join(options), "commands": " ".join(commands)}
    return (_ZSH if shell == ["zsh"] else "") + filled


def _options(kind: Any, prefix: str = "") -> dict[str, list[str]]:
    """The options of a command, each with the words that may follow it; none where any may."""
    found: dict[str, list[str]] = {}
    for field in dataclasses.fields(kind):
        type_, marks = _stripped(field.type)
        name = prefix + field.name.rstrip("_").replace("_", "-")
        if dataclasses.is_dataclass(type_):
            found |= _options(type_, "" if "OmitArgPrefixes" in marks else f"{name}.")
        elif "Positional" not in marks:
            words = list(get_args(type_)) if get_origin(type_) is Literal else _named(kind.__name__, name)
            found[f"--{name}"] = words
            if type_ is bool:
                found[f"--{name.replace('physics.', 'physics.no-') if prefix else f'no-{name}'}"] = []
    return found


def _stripped(type_: Any) -> tuple[Any, str]:
    """A type without what annotates it, and that as a text."""
    marks = [str(mark) for mark in getattr(type_, "__metadata__", ())]
    while hasattr(type_, "__metadata__"):
        type_ = type_.__origin__
    return type_, " ".join(marks)


def _named(command: str, option: str) -> list[str]:
    """Names that are known of what an option of a command takes, beside files."""
    from echogrid.mapping.registry import MODELS

    names = {
        "robot": preset_names(),
        "interpreter": ["set-network"] if command in ("Live", "Export") else sorted(MODELS),
        "transducer": TRANSDUCERS,
        "physics.beam": BEAMS,
    }
    return list(names.get(option, []))
