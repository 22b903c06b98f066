"""The table of docs/benchmarks.md on the paper's protocol, from what `querysplat eval` wrote.

    python benchmarks/eval_table.py evaluation/summary.json fox

The names after the file are those of the sets that were evaluated.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from common.output import markdown
from common.photo_sets import PHOTO_SETS
from querysplat_cli.evaluation.published import OWN

GROUPS = {"input": "input", "interp": "interpolation", "extrap": "extrapolation"}
HEAD = ("views", "row", *GROUPS.values(), "views scored", "cases failed", "seconds", "Gaussians", "GiB")


def score(cell: dict[str, Any] | None) -> str:
    """PSNR / SSIM, without what was not measured."""
    if cell is None or cell["psnr"] is None:
        return ""
    return f"{cell['psnr']:.2f}" + ("" if cell["ssim"] is None else f" / {cell['ssim']:.3f}")


def cells_of(views: int, row: str, cells: dict[str, dict[str, Any]]) -> list[str]:
    some = next(iter(cells.values()))
    scored, asked = (sum(cell[key] for cell in cells.values()) for key in ("scored", "asked"))
    costs = zip(("seconds_median", "gaussians_median", "peak_memory_gib"), (".1f", ",.0f", ".2f"), strict=True)
    return [
        str(views),
        row,
        *(score(cells.get(group)) for group in GROUPS),
        f"{scored} of {asked}",
        f"{some['failed']} of {some['failed'] + some['cases']}",
        *("" if some[key] is None else format(some[key], form) for key, form in costs),
    ]


def table(summary: dict[str, Any]) -> str:
    """Means of the splits' figures, and the quoted rows below those of as many views."""
    rows = []
    for views in sorted({row["views"] for row in summary["averages"]}):
        chosen = [row for row in summary["averages"] if row["views"] == views]
        for name in dict.fromkeys(row["row"] for row in chosen):
            rows.append(cells_of(views, name, {row["group"]: row for row in chosen if row["row"] == name}))
        theirs = [row for row in summary["quoted"]["rows"] if row["views"] == views and row["method"].startswith(OWN)]
        for method in dict.fromkeys(row["method"] for row in theirs):
            groups = {row["group"]: row for row in theirs if row["method"] == method}
            scores = [score(groups.get(group)) for group in GROUPS]
            rows.append([str(views), f"*quoted: {method}*", *scores, *[""] * 5])
    return markdown(HEAD, rows)


def uses(names: list[str]) -> str:
    """A sentence for below the table. Nothing was chosen by sets that are not among the project's."""
    said = (f"{name} ({PHOTO_SETS[name].use if name in PHOTO_SETS else 'only reported'})" for name in names)
    return f"Photo sets: {', '.join(said)}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("summary", type=Path, help="summary.json")
    parser.add_argument("sets", nargs="+", metavar="SET")
    options = parser.parse_args()
    print(table(json.loads(options.summary.read_text())), uses(options.sets), sep="\n\n")


if __name__ == "__main__":
    main()
