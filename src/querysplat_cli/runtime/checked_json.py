"""The types of a JSON file, checked by pydantic before anything uses its content."""

import json
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown

STRICT_TYPES = {"extra": "ignore", "strict": True}
"""The `__pydantic_config__` of such content and the dataclasses in it: other entries are kept, and not looked at."""


def check_types(path: Path, content: Any, kind: type, hint: str) -> None:
    """Raise QuerySplatError, with `hint`, where the `content` of `path` is no dataclass `kind`."""
    try:
        TypeAdapter(kind).validate_json(json.dumps(content))
    except (ValidationError, RecursionError) as error:
        why = "it is nested too deeply"
        if isinstance(error, ValidationError):
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "the whole"
            why = f"{where}: {first['msg']}, found {shown(first['input'])}"
        raise QuerySplatError(f"{path} is damaged: {why}", hint) from error
