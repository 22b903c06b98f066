"""The settings of `reconstruct` that an evaluation can vary, and how their values are read."""

from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown

FIXED = {"inputs", "ply", "holdout_every", "holdout_cameras", "poses", "force", "seed", "device", "max_views", "fit"}
FIXED |= {"budget", "refine_cameras", "regions", "cluster", "film_frames", "lens", "frame", "metres_by", "lpips"}
FIXED |= {"overlays", "depth_maps"}
"""Fields that do not change how the scene of a case is made, or that the protocol or another option decides."""
Axis = tuple[str, tuple[Any, ...]]
"""The name of a field of ReconstructSettings, and its values."""


def axes() -> dict[str, Any]:
    """The fields of ReconstructSettings that can be varied, with their types."""
    hints = get_type_hints(ReconstructSettings)
    return {name: kind for name, kind in hints.items() if name not in FIXED}


def read_axis(text: str) -> Axis:
    """The field and the values of "field=value,value,…".

    `auto` (or `none`) is None where the field allows it. Raises QuerySplatError for an unknown field or a value
    of another type.
    """
    name, equals, values = text.partition("=")
    name = name.strip().replace("-", "_")
    known = axes()
    if name not in known or not equals or not values:
        raise QuerySplatError(f"--sweep {shown(text)}: not FIELD=VALUE,VALUE", f"Fields: {', '.join(sorted(known))}.")
    try:
        found = tuple(dict.fromkeys(_value(part.strip(), known[name]) for part in values.split(",")))
    except ValueError:
        raise QuerySplatError(
            f"--sweep {shown(text)}: {name} takes {_type_name(known[name])}", "Separate values by commas."
        ) from None
    # Imported here, because pydantic would slow `--help`.
    from querysplat_cli.runtime.tables import from_values

    for value in found:
        from_values(ReconstructSettings, {"inputs": (), name: value}, what="--sweep")
    return name, found


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


def _type_name(kind: Any) -> str:
    return str(getattr(kind, "__name__", kind)).replace("None", "auto").replace(" | ", " or ")
