"""JSON files, whoever wrote them."""

import json
from pathlib import Path
from typing import Any

from querysplat_cli.runtime.errors import QuerySplatError

SHOWN = 60
"""The most letters of a text from a file that a message repeats."""


def read_json(path: Path, hint: str = "Export the file again.") -> Any:
    """What the file holds, with every text in it valid Unicode.

    Raises QuerySplatError with `hint` where the file cannot be read, is no JSON, is nested too deeply, or has a number
    of too many digits.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # with or without the mark that Windows puts before it
        content = json.loads(text)
        if "\\u" in text:
            # A lone surrogate in a file's name crashes native libraries.
            json.dumps(content, ensure_ascii=False).encode()
    except RecursionError:
        raise QuerySplatError(f"{path}: cannot be read as JSON: it is nested too deeply", hint) from None
    except UnicodeEncodeError:
        raise QuerySplatError(
            f"{path}: cannot be read as JSON: it has half a letter (a lone surrogate)", hint
        ) from None
    except (OSError, ValueError) as error:
        raise QuerySplatError(f"{path}: cannot be read as JSON: {error}", hint) from None
    return content


def shown(value: object) -> str:
    """`value` in quotes, on one line, cut where it is long."""
    text = ascii(value) if isinstance(value, str) and not value.isprintable() else repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}…"
