"""What `querysplat train` tells the user; apart, since no other verb needs the trainer."""

import json
from dataclasses import asdict

from rich.table import Table

from querysplat_cli.cli.console import console
from querysplat_cli.training.run import TrainPlan
from querysplat_cli.training.trainer import TrainReport


def print_training_plan(plan: TrainPlan, *, quiet: bool, as_json: bool) -> None:
    """What a training would take."""
    if as_json:
        print(json.dumps(plan.as_dict(), indent=2))
    if quiet:
        return
    table = Table(title="dry run", title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_row("parameters", f"{plan.parameters:,}, of which {plan.trained:,} learn")
    table.add_row("steps", f"{plan.steps:,}")
    table.add_row("samples", f"{plan.samples:,}, of which {plan.ready:,} are in the cache")
    table.add_row("weights, gradients, moments, average", f"{plan.state_gib:.2f} GiB")
    rows = (
        ("peak memory", plan.peak_memory_gib, "GiB"),
        ("a sample", plan.seconds_per_sample, "s"),
        ("a step's sample", plan.seconds_per_step, "s"),
        ("all of it, in one process", plan.hours, "h"),
    )
    for name, value, unit in rows:
        if value is not None:
            table.add_row(name, f"{value:.2f} {unit}")
    if plan.unmeasured:
        table.add_row("not measured", plan.unmeasured)
    console.print(table)


def print_training(report: TrainReport, *, quiet: bool, as_json: bool) -> None:
    """What a training did, and where its weights are."""
    if as_json:
        print(json.dumps(asdict(report), indent=2))
    if quiet:
        return
    console.print(
        f"{report.steps:,} steps, loss {report.loss:.4f}, {report.psnr:.2f} dB on targets; "
        f"{report.steps_per_second:.2f} steps a second, {100 * report.waiting:.0f} % of the time waiting for data, "
        f"{report.peak_memory_gib:.2f} GiB"
    )
    for reason, count in report.skipped.items():
        console.print(f"{count} samples gave no gradient: {reason}")
    console.print(f"{report.model}   (for --preset; state, log and curve are beside it)")
