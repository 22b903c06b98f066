"""The rows of a table: every combination of the values that the user wants compared."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from querysplat_cli.evaluation.case import Row
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import CaseCameras
from querysplat_cli.runtime.errors import QuerySplatError

FIXED = {"inputs", "ply", "holdout_every", "holdout_cameras", "poses", "force", "seed", "device", "max_views", "fit"}
FIXED |= {"budget", "refine_cameras"}
"""Fields that do not say how a scene is made, or that the protocol decides."""
Axis = tuple[str, tuple[Any, ...]]


def axes() -> dict[str, Any]:
    """Fields of ReconstructSettings that can be varied, with their types."""
    hints = get_type_hints(ReconstructSettings)
    return {name: kind for name, kind in hints.items() if name not in FIXED}


def read_axis(text: str) -> Axis:
    """`field=value,value,…` as a field of ReconstructSettings and its values.

    `auto` (or `none`) is None where the field allows it. Raises QuerySplatError for an unknown field or a value
    of another kind.
    """
    name, equals, values = text.partition("=")
    name = name.strip().replace("-", "_")
    known = axes()
    if name not in known or not equals or not values:
        raise QuerySplatError(f"--sweep {text}: not FIELD=VALUE,VALUE", f"Fields: {', '.join(sorted(known))}.")
    try:
        return name, tuple(dict.fromkeys(_value(part.strip(), known[name]) for part in values.split(",")))
    except ValueError:
        raise QuerySplatError(
            f"--sweep {text}: {name} takes {_words(known[name])}", "Separate values by commas."
        ) from None


def rows(axes: Sequence[Axis], cameras: Sequence[CaseCameras]) -> list[Row]:
    """One row for each combination of values and each source of cameras, and one of splatted depth for each source."""
    names = [name for name, _ in axes]
    if len(set(names)) < len(names):
        raise QuerySplatError("--sweep: a field is given twice", "Give all its values in one --sweep.")
    found = []
    for source in cameras:
        found.append(Row(f"{source}_depth", "depth", source))
        for values in product(*(values for _, values in axes)):
            overrides = tuple(zip(names, values, strict=True))
            label = "_".join([source, *(f"{name}={_label(value)}" for name, value in overrides)])
            found.append(Row(label, "querysplat", source, overrides))
    return found


def _value(text: str, kind: Any) -> Any:
    options = get_args(kind) or (kind,)
    if get_origin(kind) is Literal:
        if text not in options:
            raise ValueError(text)
        return text
    if NoneType in options and text in ("auto", "none"):
        return None
    for option in options:
        if get_origin(option) is Literal and text in get_args(option):
            return text
        if option is bool and text in ("true", "false"):
            return text == "true"
        if option in (int, float) and option is not bool:
            try:
                return option(text)
            except ValueError:
                continue
        if option in (str, Path):
            return option(text)
    raise ValueError(text)


def _words(kind: Any) -> str:
    return str(getattr(kind, "__name__", kind)).replace("None", "auto").replace(" | ", " or ")


def _label(value: Any) -> str:
    text = "auto" if value is None else str(value)
    return Path(text).stem if "/" in text else text
