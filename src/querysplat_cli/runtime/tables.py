"""Frozen dataclasses from the tables of a TOML or JSON file, with every type and bound checked by pydantic."""

import difflib
import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

from annotated_types import Ge, Le
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


def from_values(kind: type[T], values: Mapping[str, Any], *, what: str) -> T:
    """The dataclass `kind` made of Python values: text may stand for a path, and a list for a tuple.

    Raises QuerySplatError for an unknown name, a wrong type or a value out of its bounds. `what` is the function that
    the user called.
    """
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            meant = f"Did you mean {near[0]}?" if near else f"The settings are: {', '.join(names)}."
            raise QuerySplatError(f"{what} has no setting '{name}'", meant)
    hints = get_type_hints(kind, include_extras=True)
    return kind(**{name: _checked(name, value, hints[name], what) for name, value in values.items()})


def _checked(name: str, value: Any, hint: Any, what: str) -> Any:
    """The value as its type has it, within the bounds of `annotated_types`, which hold for numbers alone."""
    plain, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    try:
        found = TypeAdapter(plain).validate_python(value)
    except ValidationError as error:
        raise _in_words({**error.errors()[0], "loc": (name,)}, what, "docs/cli.md") from error
    for bound in extras if isinstance(found, int | float) else ():
        if isinstance(bound, Ge) and not found >= bound.ge:
            raise QuerySplatError(f"{name} cannot be {found}", f"It must be at least {bound.ge}. See docs/cli.md.")
        if isinstance(bound, Le) and not found <= bound.le:
            raise QuerySplatError(f"{name} cannot be {found}", f"It must be at most {bound.le}. See docs/cli.md.")
    return found


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
