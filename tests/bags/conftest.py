from collections.abc import Iterable
from pathlib import Path

import pytest

from bag_writers import Said, in_order, write


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bags")


@pytest.fixture
def put(tmp_path):
    """Write a bag of ROS 1."""

    def bag_of(messages: Iterable[Said], form: str = "bag") -> Path:
        name = f"drive{len(list(tmp_path.iterdir()))}"
        return write(tmp_path / (f"{name}.bag" if form == "bag" else name), in_order(messages), form)

    return bag_of
