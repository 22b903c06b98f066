"""The tables of `querysplat eval`."""

from pathlib import Path
from typing import Any

from rich.table import Table

from querysplat_cli.cli.terminal import print_json, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.evaluation.published import OWN


def print_evaluation(summary: dict[str, Any], output: Path, printing: Printing) -> None:
    """The summary as JSON for programs; for people the averages, and where the rest is."""
    print_json(summary, printing)
    if "averages" not in summary:
        return
    for views in sorted({row["views"] for row in summary["averages"]}):
        say(_table(summary, views), printing)
    for text in summary["lpips"]:
        say(f"LPIPS: {text}", printing)
    if summary["failures"]:
        say(f"{len(summary['failures'])} failures, listed in {output / 'summary.md'}", printing)
    say(f"{output / 'summary.md'}, .csv and .json, with all methods of the paper; a folder for each case", printing)


def _table(summary: dict[str, Any], views: int) -> Table:
    """The averages of splits with `views` inputs, and the paper's own figures for the same splits."""
    table = Table(title=f"{views} views", title_justify="left", box=None, padding=(0, 2, 0, 0))
    # The names of rows differ at their ends, so they are never cut.
    table.add_column("row", overflow="fold")
    for column in ("group", "PSNR", "SSIM", "LPIPS", "scored", "failed", "seconds", "Gaussians"):
        table.add_column(column)
    for row in summary["averages"]:
        if row["views"] == views:
            table.add_row(*_cells(row))
    for row in summary["quoted"]["rows"]:
        if row["views"] == views and row["method"].startswith(OWN):
            method = row["method"].replace(OWN, "paper").replace(" + ", ", ")
            table.add_row(method, row["group"], *_metrics(row), style="dim")
    return table


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    seconds, gaussians = row["seconds_median"], row["gaussians_median"]
    return (
        row["row"],
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
