"""The table of docs/benchmarks.md on the paper's protocol, from what `querysplat eval` wrote.

python benchmarks/eval_table.py evaluation/summary.json
"""

import json
import sys
from pathlib import Path
from typing import Any

GROUPS = {"input": "input", "interp": "interpolation", "extrap": "extrapolation"}
HEAD = ("views", "row", *GROUPS.values(), "views scored", "cases failed", "seconds", "Gaussians", "GiB")


def score(cell: dict[str, Any] | None) -> str:
    """PSNR / SSIM, or what of it there is."""
    if cell is None or cell["psnr"] is None:
        return ""
    return f"{cell['psnr']:.2f}" + ("" if cell["ssim"] is None else f" / {cell['ssim']:.3f}")


def line(views: int, row: str, cells: dict[str, dict[str, Any]]) -> list[str]:
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
    lines = [list(HEAD), ["---"] * len(HEAD)]
    for views in sorted({row["views"] for row in summary["averages"]}):
        chosen = [row for row in summary["averages"] if row["views"] == views]
        for name in dict.fromkeys(row["row"] for row in chosen):
            lines.append(line(views, name, {row["group"]: row for row in chosen if row["row"] == name}))
        for row in summary["quoted"]["rows"]:
            if row["views"] == views:
                cells = [score(row) if row["group"] == group else "" for group in GROUPS]
                lines.append([str(views), f"*quoted: {row['method']}*", *cells, *[""] * 5])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text())))
