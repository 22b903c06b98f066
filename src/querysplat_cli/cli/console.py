"""What the user sees: progress and tables on standard error, results for programs on standard output."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from querysplat_cli.commands.render import Rendered
from querysplat_cli.commands.weights import Found
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.errors import ExitCode
from querysplat_cli.runtime.progress import Stages

console = Console(stderr=True, highlight=False)


@contextmanager
def showing_stages(*, quiet: bool, started: float | None = None) -> Iterator[Stages]:
    """Stages whose progress is drawn on a terminal, printed line by line elsewhere, or kept quiet.

    `started` is when the command did, if not now.
    """
    if quiet:
        yield Stages(started=started)
    elif not console.is_terminal:
        yield Stages(
            lambda stage, text, fraction: console.print(stage) if fraction == 0.0 and not text else None, started
        )
    else:
        columns = (SpinnerColumn(), TextColumn("{task.description:<16}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, TextColumn("{task.fields[text]}"), console=console) as bars:
            tasks: dict[str, TaskID] = {}

            def show(stage: str, text: str, fraction: float) -> None:
                if stage not in tasks:
                    tasks[stage] = bars.add_task(stage, total=1.0, text=text)
                bars.update(tasks[stage], completed=fraction, text=text)

            yield Stages(show, started)


def print_report(report: Report, *, quiet: bool, as_json: bool) -> None:
    """One JSON object on standard output, and a table of the same for people on standard error."""
    if as_json:
        print(report.json())
    if not quiet:
        console.print(_table(asdict(report)))


def exit_if_interrupted(report: Report) -> None:
    """What Ctrl-C left is written; the exit code still says that there could have been more."""
    if report.interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)


def _table(report: dict[str, Any]) -> Table:
    """Seconds by stage, photos, Gaussians, quality, and everything left out."""
    table = Table(title=f"{report['ply']}", title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 0))
    for stage, seconds in report["seconds"].items():
        table.add_row(stage, f"{seconds:.1f} s")
    used = report["views"]["used"]
    table.add_row("photos used", f"{len(used)}")
    for photo in report["views"]["left_out"]:
        table.add_row("photo left out", f"{photo['name']}: {photo['why']}")
    table.add_row("Gaussians", f"{report['gaussians']:,}")
    estimate = report["memory_estimate_gib"]
    said = f" ({estimate:.2f} GiB expected)" if estimate else ""
    table.add_row("peak memory", f"{report['peak_memory_gib']:.2f} GiB{said}")
    for group, quality in report["quality"].items():
        if quality:
            table.add_row(f"{group} views", _quality_text(quality))
    for run in report["tto"]:
        table.add_row("tto", _tto_text(run))
    for part in report["left_out"]:
        table.add_row("left out", _saving_text(part))
    for warning in report["warnings"]:
        table.add_row("[yellow]warning[/yellow]", warning)
    return table


def _saving_text(part: dict[str, Any]) -> str:
    text = f"{part['what']}: {part['why']}; saved {part['saved']}"
    if part["bytes"]:
        text += f", {part['bytes'] / 2**20:.1f} MiB"
    if part["seconds"] is not None:
        text += f", {part['seconds']:.1f} s" if part["seconds"] >= 0 else f"; took {-part['seconds']:.1f} s more"
    if part["psnr_lost"] is not None:
        text += f"; cost {part['psnr_lost']:.2f} dB on the photos"
        text += " before optimisation went on" if part["what"] == "Gaussians" and part["seconds"] is not None else ""
    return text


def _quality_text(quality: dict[str, Any]) -> str:
    text = f"PSNR {quality['psnr']:.2f} dB, SSIM {quality['ssim']:.3f}"
    if "cameras" not in quality:
        return text
    other = "joint" if quality["cameras"] == "isolated" else "isolated"
    text += f" ({quality['cameras']} cameras)"
    if quality.get(other):
        text += f"; {quality[other]['psnr']:.2f} dB with {other} cameras"
    if quality["pose_difference"]:
        difference = quality["pose_difference"]
        text += f"; the two differ by {difference['degrees']:.2f}°"
        if difference["pixels"] is not None:
            text += f", {difference['pixels']:.1f} px"
    return text


def _tto_text(run: dict[str, Any]) -> str:
    taken = len(run["curve"]) + run["undone"]
    steps = f"{taken} steps in {run['seconds']:.0f} s" if run["seconds"] else f"{run['steps']} steps"
    text = f"{steps} on {run['space']}, loss {run['loss_before']:.4f} → {run['loss_after']:.4f}"
    if run["cameras"]:
        text += f", cameras turned by {run['cameras']['degrees']:.3f}°"
    if run["added"]:
        text += f", {run['added']:,} Gaussians added"
    if run["undone"]:
        text += f", {run['undone']} undone"
    if run["interrupted"]:
        text += f", stopped by Ctrl-C after {len(run['curve'])}"
    kept = run["steps"] and run["loss_after"] == run["loss_before"]
    return f"{text}, no better: the state before was kept" if kept else text


def print_weights(found: Sequence[Found], *, quiet: bool, as_json: bool) -> None:
    """A paragraph for each file."""
    if as_json:
        print(json.dumps([each.as_dict() for each in found], indent=2))
    for each in () if quiet else found:
        wanted = each.wanted
        gate = ", gated: ask for access there" if wanted.gated else ""
        rows = [
            ("needed by", each.needed_by),
            ("from", f"https://huggingface.co/{wanted.repository}{gate}"),
            ("licence", wanted.licence),
            ("holds", f"{wanted.tensors:,} tensors of {wanted.values:,} numbers, {wanted.gib:.2f} GiB in float32"),
            ("is", str(each.path) if each.path else f"not here: {each.absent}"),
            ("sha256", each.sha256 or wanted.sha256 or "not published; the tensors are checked one by one"),
            ("fault", f"[red]{each.fault}[/red]" if each.fault else ""),
        ]
        table = Table(title=wanted.file, title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 2))
        table.add_column()
        table.add_column(overflow="fold")
        for name, text in rows:
            if text:
                table.add_row(name, text)
        console.print(table)


def print_rendered(rendered: Rendered, *, quiet: bool, as_json: bool) -> None:
    """Where the pictures are."""
    if as_json:
        print(json.dumps(rendered.as_dict(), indent=2))
    if not quiet:
        seconds = sum(rendered.seconds.values())
        console.print(
            f"{rendered.frames} frames of {rendered.gaussians:,} Gaussians in {seconds:.1f} s: {rendered.output}"
        )


def print_evaluation(summary: dict[str, Any], output: Path, *, quiet: bool, as_json: bool) -> None:
    """The summary as JSON, and for people the averages and where the rest is."""
    if as_json:
        print(json.dumps(summary, indent=2))
    if quiet or "averages" not in summary:
        return
    for views in sorted({row["views"] for row in summary["averages"]}):
        table = Table(title=f"{views} views", title_justify="left", box=None, padding=(0, 2, 0, 0))
        for column in ("row", "group", "PSNR", "SSIM", "LPIPS", "scored", "failed", "seconds", "Gaussians"):
            table.add_column(column)
        for row in summary["averages"]:
            if row["views"] == views:
                table.add_row(*_evaluation_cells(row))
        for row in summary["quoted"]["rows"]:
            if row["views"] == views:
                table.add_row(f"quoted: {row['method']}", row["group"], *_metrics(row), style="dim")
        console.print(table)
    for text in summary["lpips"]:
        console.print(f"LPIPS: {text}")
    if summary["failures"]:
        console.print(f"{len(summary['failures'])} failures, listed in {output / 'summary.md'}")
    console.print(f"{output / 'summary.md'}, .csv and .json; a folder for each case")


def _evaluation_cells(row: dict[str, Any]) -> tuple[str, ...]:
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


def print_poses(summary: dict[str, Any], first: str, second: str, *, quiet: bool, as_json: bool) -> None:
    """The errors of the first set of cameras against the second."""
    if as_json:
        print(json.dumps(summary, indent=2))
    if quiet:
        return
    table = Table(title=f"{first} against {second}", title_justify="left", show_header=False, box=None)
    table.add_row("photos in both", f"{summary['photos']}")
    for side, names in ((first, summary["only_a"]), (second, summary["only_b"])):
        if names:
            table.add_row(f"only in {side}", f"{len(names)}: {', '.join(names[:3])}{', …' if names[3:] else ''}")
    rotation, centre, focal = (summary[key] for key in ("rotation_degrees", "centre", "focal_error"))
    table.add_row("rotation", f"median {rotation['median']:.3f}°, worst {rotation['max']:.3f}°")
    table.add_row("centre", f"median {centre['median']:.4g}, worst {centre['max']:.4g} units of {second}")
    table.add_row("ATE", f"{summary['ate']:.4g}, {100 * summary['ate_of_extent']:.2f} % of the extent")
    for name in ("rra", "rta", "auc"):
        cells = (f"{summary[f'{name}_{t}']:.1f} %" for t in (5, 15, 30))
        table.add_row(f"{name.upper()} at 5, 15, 30°", ", ".join(cells))
    table.add_row("focal length", f"median {100 * focal['median']:+.2f} %, worst {100 * focal['max_abs']:.2f} %")
    console.print(table)


def print_conversion(result: dict[str, Any], *, quiet: bool, as_json: bool) -> None:
    """What was written."""
    if as_json:
        print(json.dumps(result, indent=2))
    if quiet:
        return
    if "cameras" in result:
        console.print(f"{result['cameras']} cameras: {result['target']}")
        for each in result.get("left_out", ()):
            console.print(f"left out: {each['name']}, {each['why']}")
        return
    sizes = result["bytes"]
    left_out = f", {result['left_out']:,} left out" if result["left_out"] else ""
    console.print(
        f"{result['gaussians']:,} Gaussians{left_out}, {sizes['target'] / 2**20:.2f} MiB "
        f"(source {sizes['source'] / 2**20:.2f} MiB): {result['target']}"
    )
