"""What mkdocs does to the pages of the documentation before it reads them (mkdocs.yml, `hooks`)."""

import re
from typing import Any


def on_page_markdown(markdown: str, **rest: Any) -> str:
    """Fences such as "python slow", whose second word is for the tests, lose that word: mkdocs would take no such fence
    for code.
    """
    return re.sub(r"^```(\w+) [\w-]+$", r"```\1", markdown, flags=re.MULTILINE)
