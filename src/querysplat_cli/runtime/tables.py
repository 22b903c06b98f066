"""Frozen dataclasses from the tables of a TOML or JSON file, with every type and bound checked by pydantic."""

import json
from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown

T = TypeVar("T")
STRICT = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
"""The `__pydantic_config__` of such a dataclass: no unknown names, and no text or truth value in place of a number."""


def from_tables(kind: type[T], values: Mapping[str, Any], *, what: str, docs: str) -> T:
    """The dataclass `kind` made of `values`; raises QuerySplatError that names the first wrong key.

    `what` is what the user calls the whole ("training"), and `docs` the page that lists its settings.
    """
    try:
        # As JSON, because pydantic's strict mode takes a list for a tuple only from there.
        made: T = TypeAdapter(kind).validate_json(json.dumps(values, default=_not_json))
    except ValidationError as error:
        raise _in_words(error.errors()[0], what, docs) from error
    except (RecursionError, ValueError) as error:
        raise QuerySplatError(f"the {what} cannot be read: {error}", f"See {docs}.") from error
    return made


def _not_json(value: object) -> dict[str, str]:
    """A stand-in for a date of TOML, which is of the wrong type for every setting."""
    return {type(value).__name__: str(value)}


def _in_words(error: ErrorDetails, what: str, docs: str) -> QuerySplatError:
    name = ".".join(map(str, error["loc"])) or f"the {what}"
    match error["type"]:
        case "unexpected_keyword_argument":
            return QuerySplatError(f"unknown setting: {name}", f"See {docs} for the names.")
        case "missing":
            return QuerySplatError(f"the {what} lacks {name}", f"See {docs}.")
    rule = error["msg"].replace("Input should", "It should")
    return QuerySplatError(f"{name} cannot be {shown(error['input'])}", f"{rule}. See {docs}.")
