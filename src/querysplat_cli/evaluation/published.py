"""The figures of the paper's tables: quoted beside ours, never measured here.

`published.json` is written by `benchmarks/paper_tables.py` from the paper's source.
"""

import json
from collections.abc import Collection, Iterable
from functools import cache
from importlib.resources import files
from statistics import fmean
from typing import Any

from querysplat_cli.evaluation.metrics import METRICS

AVERAGE = "average"
"""The `scale` of figures that are means of the three scales."""
LEAST_TOLERANCE = 1e-4
"""Means of figures with four digits may differ from a mean with four digits by so much through rounding alone."""
OWN = "QuerySplat"
"""The paper's method. Names of its variants begin with it."""


@cache
def _content() -> dict[str, Any]:
    content: dict[str, Any] = json.loads((files("querysplat_cli.evaluation") / "published.json").read_text())
    return content


def tables() -> list[dict[str, Any]]:
    """Every table: `label`, `section`, `caption` and `rows`."""
    found: list[dict[str, Any]] = _content()["tables"]
    return found


def rows(scales: Collection[str] = (), views: int | None = None) -> list[dict[str, Any]]:
    """The paper's figures of these scales and of one number of views, with `where` they stand.

    Of several scales, the figure is their mean. Without scales, or with all three, the main table's rows stand for
    interpolation. Rows have `method`, `pose_free`, `views`, `scale`, `group`, `psnr`, `ssim`, `lpips` and `where`.
    """
    wanted = set(scales) & {"small", "medium", "large"} or {"small", "medium", "large"}
    whole = len(wanted) == 3
    every = [row for row in _scored_rows() if views is None or row["views"] == views]
    chosen = [row for row in every if row["scale"] == AVERAGE] if whole else []
    quoted = {_key(row) for row in chosen}
    parts = [row for row in every if row["scale"] in wanted]
    if len(wanted) > 1:
        parts = _means(parts, AVERAGE if whole else ", ".join(sorted(wanted)))
    found = [*chosen, *(row for row in parts if _key(row) not in quoted)]
    return sorted(found, key=lambda row: (row["views"], row["method"].startswith(OWN), _order(row)))


def about() -> dict[str, str]:
    """`source` and `note` of the figures."""
    return {key: _content()[key] for key in ("source", "note")}


def disagreements(tolerance: float = LEAST_TOLERANCE) -> list[str]:
    """Where the mean of the appendix over scales is not the main table's figure, one sentence each."""
    averages = {_key(row): row for row in _means([row for row in _scored_rows() if row["scale"] != AVERAGE], AVERAGE)}
    found = []
    for row in _scored_rows():
        if row["scale"] != AVERAGE or row["where"] != "Comparisons":
            continue
        other = averages[_key(row)]
        kind = "pose-free" if row["pose_free"] else "posed"
        found += [
            f"{row['method']} ({kind}), {row['views']} views, {metric}: the main table has {row[metric]:.4f}, "
            f"the mean of the appendix is {other[metric]:.4f}"
            for metric in METRICS
            if abs(other[metric] - row[metric]) > tolerance
        ]
    return found


def _scored_rows() -> list[dict[str, Any]]:
    return [row | {"where": table["section"]} for table in tables() for row in table["rows"] if "scale" in row]


def _means(parts: Iterable[dict[str, Any]], scale: str) -> list[dict[str, Any]]:
    """The mean over scales of each method, number of views and group."""
    together: dict[Any, list[dict[str, Any]]] = {}
    for row in parts:
        together.setdefault(_key(row), []).append(row)
    return [
        group[0] | {"scale": scale} | {metric: fmean(row[metric] for row in group) for metric in METRICS}
        for group in together.values()
    ]


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["method"], row["pose_free"], row["views"], row["group"]


@cache
def _methods() -> list[tuple[str, bool]]:
    """Methods in the order of the main table."""
    return list(dict.fromkeys((row["method"], row["pose_free"]) for row in _scored_rows()))


def _order(row: dict[str, Any]) -> int:
    return _methods().index((row["method"], row["pose_free"]))
