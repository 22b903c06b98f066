"""The report of a scene, as `reconstruct`, `tto` and `demo` print it."""

from dataclasses import asdict
from typing import Any

import typer
from rich.table import Table

from querysplat_cli.cli.terminal import rows_table, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.reporting.report import Report
from querysplat_cli.runtime.errors import ExitCode


def print_report(report: Report, printing: Printing) -> None:
    """The report as JSON for programs, and its main figures as a table for people."""
    if printing.json:
        print(report.json())
    say(_table(asdict(report)), printing)


def exit_if_interrupted(report: Report) -> None:
    """Exit with the code of Ctrl-C after an optimisation that it ended early, although the scene was written."""
    if report.interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)


def _table(report: dict[str, Any]) -> Table:
    """Seconds by stage, photos, Gaussians, quality, and everything left out."""
    rows = [(stage, f"{seconds:.1f} s") for stage, seconds in report["seconds"].items()]
    rows.append(("photos used", f"{len(report['views']['used'])}"))
    rows += [("photo left out", f"{photo['name']}: {photo['why']}") for photo in report["views"]["left_out"]]
    rows.append(("Gaussians", f"{report['gaussians']:,}"))
    estimate = report["memory_estimate_gib"]
    expected = f" ({estimate:.2f} GiB expected)" if estimate else ""
    rows.append(("peak memory", f"{report['peak_memory_gib']:.2f} GiB{expected}"))
    quality, large = report["quality"], report["quality"].get("full_size")
    rows += [(f"{group} views", _quality_text(quality[group])) for group in ("input", "heldout") if quality[group]]
    if large:
        named = [(f"{group} views at {large['max_size']} px", large[group]) for group in ("input", "heldout")]
        rows += [(name, f"{_quality_text(found)} on grey") for name, found in named if found]
    if report["unseen"]:
        rows.append(("unseen", f"{report['unseen']['share']:.0%} of a film around the scene shows what no photo saw"))
    rows += [("tto", _tto_text(run)) for run in report["tto"]]
    if report["exposure"] and report["exposure"]["corrected"]:
        differ = report["exposure"]["disagreement"]
        rows.append(("exposure", f"differs by {differ:.1%} between neighbouring photos; each has a colour transform"))
    if report["full_size"]:
        rows.append((f"quality {report['full_size']['level']}", f"ended because {report['full_size']['ended']}"))
    rows += [("left out", _omission_text(part)) for part in report["left_out"]]
    rows += [("[yellow]warning[/yellow]", warning) for warning in report["warnings"]]
    return rows_table(report["ply"], rows)


def _omission_text(part: dict[str, Any]) -> str:
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
    text = f"PSNR {quality['psnr']:.2f} dB, {quality['psnr_grey']:.2f} dB on grey, SSIM {quality['ssim']:.3f}"
    if "psnr_cc" in quality:  # reports of older versions lack it
        text += f", {quality['psnr_cc']:.2f} dB colour-corrected"
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
    where = run["space"] + (f" at {run['max_size']} px" if "max_size" in run else "")
    text = f"{steps} on {where}, loss {run['loss_before']:.4f} → {run['loss_after']:.4f}"
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
