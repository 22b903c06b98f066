"""The rows of a table: every combination of the values that are compared."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation.axes import Axis
from querysplat_cli.evaluation.case import Row
from querysplat_cli.runtime.choices import CameraSource
from querysplat_cli.runtime.errors import QuerySplatError


def rows(axes: Sequence[Axis], cameras: Sequence[CameraSource]) -> list[Row]:
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
    named = [row.name for row in found]
    twice = next((name for name in named if named.count(name) > 1), None)
    if twice:
        raise QuerySplatError(f"--sweep: two rows would be called {twice}", "Rename a file, or a folder that has one.")
    return found


def _label(value: Any) -> str:
    text = "auto" if value is None else str(value)
    return "-".join(Path(text.lstrip("/")).with_suffix("").parts[-2:]) if "/" in text else text
