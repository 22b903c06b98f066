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
    return found


def _label(value: Any) -> str:
    text = "auto" if value is None else str(value)
    return Path(text).stem if "/" in text else text
