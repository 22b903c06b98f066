"""The tables on the paper's protocol, one for each set, from what `querysplat eval` wrote.

    python benchmarks/eval_table.py evaluation/results [--rows NAME ...] [--csv DIR]

Figures are PSNR in dB / SSIM, as `querysplat eval` summarises them, of the cases of one set alone. Targets *apart*
share nothing with the inputs: they have no verified matches with any of them. The paper's figures stand in the last
table; they are its means over small, medium and large splits. --csv writes every split of every set.
docs/benchmarks.md has the rows of all sets in two tables: between the inputs, and the default's beyond them.
"""

import argparse
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from common.output import markdown
from common.photo_sets import PHOTO_SETS
from querysplat_cli.evaluation import published
from querysplat_cli.evaluation.published import OWN
from querysplat_cli.evaluation.results import row_folders
from querysplat_cli.evaluation.summary import summarise

GROUPS = {"input": "input", "interp": "interpolation", "extrap": "extrapolation"}
HEAD = ("views", "row", *GROUPS.values(), "views scored", "targets apart", "cases failed", "Gaussians", "GiB")
Cell = dict[str, Any]


def sets_of(results: Path) -> list[str]:
    """Names of the sets whose cases `results` holds."""
    cases = (case for row in row_folders(results) for case in row.path.iterdir() if case.is_dir())
    return sorted({set_of(case) for case in cases})


def set_of(case: Path) -> str:
    return case.name.rpartition("_")[0]


def summary_of(results: Path, name: str, csv: Path | None = None) -> dict[str, Any]:
    """The summary of the cases of one set; `csv` is a folder for its table of splits."""

    def others(folder: str, names: list[str]) -> list[str]:
        return [each for each in names if (Path(folder) / each).is_dir() and set_of(Path(each)) != name]

    with TemporaryDirectory() as scratch:
        for row in row_folders(results):
            shutil.copytree(row.path, Path(scratch) / row.row / row.split, ignore=others)
        summary = summarise(Path(scratch))
        if csv:
            csv.mkdir(parents=True, exist_ok=True)
            shutil.copy(Path(scratch) / "summary.csv", csv / f"eval_{name}.csv")
    return summary


def score(cell: Cell | None) -> str:
    """PSNR / SSIM, without what was not measured."""
    if cell is None or cell["psnr"] is None:
        return ""
    return f"{cell['psnr']:.2f}" + ("" if cell["ssim"] is None else f" / {cell['ssim']:.3f}")


def cells_of(views: int, row: str, cells: dict[str, Cell]) -> list[str]:
    some = next(iter(cells.values()))
    targets = [cell for group, cell in cells.items() if group != "input"]
    scored, asked = (sum(cell[key] for cell in cells.values()) for key in ("scored", "asked"))
    apart, of_targets = (sum(cell[key] for cell in targets) for key in ("apart", "asked"))
    costs = zip(("gaussians_median", "peak_memory_gib"), (",.0f", ".2f"), strict=True)
    return [
        str(views),
        row,
        *(score(cells.get(group)) for group in GROUPS),
        f"{scored} of {asked}",
        f"{apart} of {of_targets}",
        f"{some['failed']} of {some['failed'] + some['cases']}",
        *("" if some[key] is None else format(some[key], form) for key, form in costs),
    ]


def table(averages: list[Cell], chosen: list[str] | None = None) -> str:
    """Means of the splits' figures, by the number of views; of the rows whose names end in those of `chosen`."""
    rows = []
    for views in sorted({cell["views"] for cell in averages}):
        of_views = [cell for cell in averages if cell["views"] == views]
        for name in dict.fromkeys(cell["row"] for cell in of_views):
            if chosen is None or name.partition("_")[2] in chosen:
                rows.append(cells_of(views, name, {cell["group"]: cell for cell in of_views if cell["row"] == name}))
    return markdown(HEAD, rows)


def quoted(rows: list[Cell]) -> str:
    """The paper's figures of its own method."""
    own = [row for row in rows if row["method"].startswith(OWN)]
    found = []
    for views, method in dict.fromkeys((row["views"], row["method"]) for row in own):
        groups = {row["group"]: row for row in own if (row["views"], row["method"]) == (views, method)}
        found.append([str(views), method, *(score(groups.get(group)) for group in GROUPS)])
    return markdown(("views", "quoted", *GROUPS.values()), found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, help="the folder that `querysplat eval` wrote")
    parser.add_argument("--rows", nargs="*", metavar="NAME", help="such as depth or tto=auto; by default all")
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write eval_SET.csv with every split into this folder")
    options = parser.parse_args()
    for name in sets_of(options.results):
        summary = summary_of(options.results, name, options.csv)
        use = PHOTO_SETS[name].use if name in PHOTO_SETS else "only reported"
        print(f"{name} ({use})", table(summary["averages"], options.rows), sep="\n\n", end="\n\n")
    print(quoted(published.rows()))


if __name__ == "__main__":
    main()
