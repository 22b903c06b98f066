"""The tables of `querysplat eval`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.table import Table

from querysplat_cli.cli.terminal import print_json, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.evaluation.published import OWN

COLUMNS = {
    "group": 13, "PSNR": 5, "SSIM": 5, "LPIPS": 5, "scored": 10, "failed": 6, "seconds": 7, "Gaussians": 9,
}  # fmt: skip
"""The columns of the tables, and how many letters each has at least. Together they fit 80 letters."""


def print_evaluation(summary: dict[str, Any], output: Path, printing: Printing) -> None:
    """The summary as JSON for programs; for people the averages, and where the rest is."""
    print_json(summary, printing)
    if "averages" not in summary:
        return
    for views in sorted({row["views"] for row in summary["averages"]}):
        say(f"{views} views", printing)
        for table in _tables(summary, views):
            say(table, printing)
    for text in summary["lpips"]:
        say(text, printing)
    if summary["failures"]:
        say(f"{len(summary['failures'])} failures, listed in {output / 'summary.md'}", printing)
    say(f"{output / 'summary.md'}, .csv and .json; a folder for each case", printing)


def _tables(summary: dict[str, Any], views: int) -> Iterator[Table]:
    """The averages of splits with `views` inputs, row by row, and then the paper's own figures for as many views.

    The name of a row stands above its figures, whole: names of a sweep are long, and differ at their ends.
    """
    blocks: dict[str, list[tuple[str, ...]]] = {}
    for row in summary["averages"]:
        if row["views"] == views:
            blocks.setdefault(row["row"], []).append(_cells(row))
    for row in summary["quoted"]["rows"]:
        if row["views"] == views and row["method"].startswith(OWN):
            blocks.setdefault(f"quoted: {row['method']}", []).append((row["group"], *_metrics(row)))
    for number, (name, rows) in enumerate(blocks.items()):
        table = Table(title=name, title_justify="left", show_header=number == 0, box=None, padding=(0, 2, 0, 0))
        for column, width in COLUMNS.items():
            table.add_column(column, min_width=width, no_wrap=True)
        for cells in rows:
            table.add_row(*cells)
        yield table


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    seconds, gaussians = row["seconds_median"], row["gaussians_median"]
    return (
        row["group"],
        *_metrics(row),
        f"{row['scored']} of {row['asked']}",
        str(row["failed"]),
        "–" if seconds is None else f"{seconds:.1f}",
        "–" if gaussians is None else f"{gaussians:,.0f}",
    )


def _metrics(row: dict[str, Any]) -> tuple[str, ...]:
    return tuple(
        "–" if row[metric] is None else format(row[metric], form)
        for metric, form in (("psnr", ".2f"), ("ssim", ".3f"), ("lpips", ".3f"))
    )
