"""What `querysplat train` prints."""

from dataclasses import asdict

from querysplat_cli.cli.terminal import print_json, rows_table, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.training.run import TrainPlan
from querysplat_cli.training.trainer import TrainReport


def print_training_plan(plan: TrainPlan, printing: Printing) -> None:
    """What a training would take."""
    print_json(plan.as_dict(), printing)
    rows = [
        ("parameters", f"{plan.parameters:,}, of which {plan.trained:,} are trained"),
        ("steps", f"{plan.steps:,}"),
        ("samples", f"{plan.samples:,}, of which {plan.ready:,} are in the cache"),
        ("weights, gradients, moments, average", f"{plan.state_gib:.2f} GiB"),
    ]
    measured = (
        ("peak memory", plan.peak_memory_gib, "GiB"),
        ("a sample", plan.seconds_per_sample, "s"),
        ("a step's sample", plan.seconds_per_step, "s"),
        ("all of it, in one process", plan.hours, "h"),
    )
    rows += [(name, f"{value:.2f} {unit}") for name, value, unit in measured if value is not None]
    if plan.unmeasured:
        rows.append(("not measured", plan.unmeasured))
    say(rows_table("dry run", rows), printing)


def print_training(report: TrainReport, printing: Printing) -> None:
    """What a training did, and where its weights are."""
    print_json(asdict(report), printing)
    say(
        f"{report.steps:,} steps, loss {report.loss:.4f}, {report.psnr:.2f} dB on targets; "
        f"{report.steps_per_second:.2f} steps a second, {100 * report.waiting:.0f} % of the time waiting for data, "
        f"{report.peak_memory_gib:.2f} GiB",
        printing,
    )
    for reason, count in report.skipped.items():
        say(f"{count} samples gave no gradient: {reason}", printing)
    say(f"{report.model}   (for --preset; state, log and curve are beside it)", printing)
