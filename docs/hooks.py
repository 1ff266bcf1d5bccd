"""What the pages need to be read by mkdocs as well as on GitHub."""

import re
from typing import Any


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Give a block of code that names a file (```` ```yaml robot.yaml ````) the name as its title."""
    return re.sub(r"^```(\w+) (\S+)$", r'```\1 title="\2"', markdown, flags=re.MULTILINE)
