"""What the pages need to be read by mkdocs as well as on GitHub."""

import re
from typing import Any

WIDE = {"results.md", "set-network.md", "paper/simulators.md"}
"""Pages whose tables need the room of the table of contents."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Give a block of code that names a file (```` ```yaml robot.yaml ````) the name as its title."""
    if page.file.src_uri in WIDE:
        page.meta["hide"] = ["toc"]
    return re.sub(r"^```(\w+) (\S+)$", r'```\1 title="\2"', markdown, flags=re.MULTILINE)
