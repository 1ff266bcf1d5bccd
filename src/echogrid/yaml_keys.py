"""Typed access to what YAML files hold: every failure names the file and the key."""

import re
import reprlib
from collections.abc import Mapping
from itertools import chain
from math import inf
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray

from echogrid.errors import InputError


def parse_yaml(text: str, where: str) -> dict[Any, Any]:
    """Parse YAML whose top level is a mapping; a key may be of any kind.

    Raises:
        InputError: not YAML, or not such a mapping; the message carries the line.
    """
    try:
        refuse_bomb(text, where)
        loader = yaml.SafeLoader(text)
        node = loader.get_single_node()
        _refuse_twice(node, set())
        data = None if node is None else loader.construct_document(node)
    except InputError:
        raise
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f":{mark.line + 1}" if mark else ""
        problem = str(getattr(error, "problem", None) or "text that is not YAML").removeprefix("found ")
        raise InputError(f"{where}{line}", problem, "YAML") from None
    except Exception:  # PyYAML lets out errors of many kinds for tags whose value does not fit
        raise InputError(where, "a value that does not fit its tag, or nested too deep", "YAML") from None
    if not isinstance(data, dict):
        raise InputError(where, shown(data), "a mapping of keys to values")
    return data


MAX_NODES = 200_000
"""Values that a file may hold, those counted again that it names again (``*name``, ``<<``)."""

_LONGEST_NUMBER = 400
"""Characters of a number: to make out one of many takes long."""


def refuse_bomb(text: str, where: str) -> None:
    """Refuse YAML that becomes far more than is written, before it does.

    Raises:
        InputError: it becomes more than MAX_NODES values, or has a number of far too many digits.
        yaml.YAMLError: it is no YAML, where that had to be found out.
    """
    if "*" in text and (node := yaml.compose(text, yaml.SafeLoader)) is not None and _weight(node, {}) > MAX_NODES:
        raise InputError(where, f"anchors that become more than {MAX_NODES} values", "YAML that holds what it says")
    if re.search(rf"[\d:_.]{{{_LONGEST_NUMBER}}}", text):
        raise InputError(where, f"a number of more than {_LONGEST_NUMBER} characters", "numbers")


def _refuse_twice(node: yaml.Node | None, known: set[int]) -> None:
    """Refuse a key that a mapping has twice, of which YAML would take the last without a word."""
    if not isinstance(node, yaml.CollectionNode) or id(node) in known:
        return
    known.add(id(node))
    keys: set[tuple[str, str]] = set()
    for each in node.value:
        for part in each if isinstance(each, tuple) else (each,):
            _refuse_twice(part, known)
        if isinstance(each, tuple) and isinstance(key := each[0], yaml.ScalarNode):
            if (key.tag, key.value) in keys:
                raise yaml.MarkedYAMLError(problem=f"the key {shown(key.value)} twice", problem_mark=key.start_mark)
            keys.add((key.tag, key.value))


def _weight(node: yaml.Node, known: dict[int, float]) -> float:
    """How many values a node becomes; one that holds itself becomes any number."""
    if id(node) not in known:
        known[id(node)] = inf
        children = node.value if isinstance(node, yaml.CollectionNode) else ()
        parts = chain.from_iterable(children) if isinstance(node, yaml.MappingNode) else children
        known[id(node)] = 1 + sum(_weight(each, known) for each in parts)
    return known[id(node)]


class Keys:
    """Typed access to a parsed mapping; every failure names the file and the key."""

    def __init__(self, where: str, data: object, prefix: str = "", allowed: frozenset[str] | None = None):
        if not isinstance(data, Mapping):
            raise InputError(f"{where}: {prefix}".removesuffix(": "), shown(data), "a mapping")
        self.where, self.data, self.prefix = where, data, prefix
        unknown = [key for key in data if allowed is not None and key not in allowed]
        if unknown:
            raise InputError(self.at(str(unknown[0])), "an unknown key", f"one of {', '.join(sorted(allowed or ()))}")

    def at(self, key: str) -> str:
        """The place of a key, for a message."""
        return f"{self.where}: {self.prefix}.{key}" if self.prefix else f"{self.where}: {key}"

    def take(self, key: str) -> Any:
        """The value of a key that must be there."""
        if key not in self.data:
            raise InputError(self.at(key), "nothing", "this key")
        return self.data[key]

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float:
        """A number in [low, high]."""
        if default is not None and key not in self.data:
            return default
        return as_number(self.take(key), low, high, self.at(key))

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self.take(key)
        if not isinstance(value, str) or not value or not value.isprintable():
            raise InputError(self.at(key), shown(value), "a printable text")
        return value

    def rows(self, key: str, width: int, low: float, high: float, least: int = 1) -> Float[ndarray, "n width"]:
        """A list of at least ``least`` rows of ``width`` numbers in [low, high]."""
        value = self.take(key)
        if not isinstance(value, list) or len(value) < least:
            raise InputError(self.at(key), shown(value), f"a list of {least} or more rows")
        for i, row in enumerate(value):
            if not isinstance(row, list) or len(row) != width:
                raise InputError(f"{self.at(key)}[{i}]", shown(row), f"{width} numbers")
        return np.array(
            [[as_number(v, low, high, f"{self.at(key)}[{i}]") for v in row] for i, row in enumerate(value)]
        )


def as_number(value: object, low: float, high: float, where: str) -> float:
    """A finite number in [low, high], or an InputError that names the place."""
    if isinstance(value, str) and re.fullmatch(r"[-+]?\d+[eE][-+]?\d+", value):
        value = float(value)  # YAML 1.1 takes 1e-1 for a text
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(where, shown(value), "a number")
    if not low <= value <= high:
        raise InputError(where, shown(value), f"a number from {low:g} to {high:g}")
    return float(value)


def shown(value: object) -> str:
    """A value from a file as a short text for a message."""
    return "nothing" if value is None else reprlib.repr(value)
