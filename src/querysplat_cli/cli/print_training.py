"""What `querysplat train` prints."""

from dataclasses import asdict

from querysplat_cli.cli.terminal import print_json, rows_table, say
from querysplat_cli.cli.verb import Printing
from querysplat_cli.training.data import PreparedSamples
from querysplat_cli.training.plan import TrainPlan
from querysplat_cli.training.trainer import TrainReport


def print_training_plan(plan: TrainPlan, printing: Printing) -> None:
    """What a training would take."""
    print_json(asdict(plan), printing)
    rows = [
        ("parameters", f"{plan.parameters:,}, of which {plan.trained:,} are trained"),
        ("steps", f"{plan.steps:,}"),
        ("batch", f"{plan.batch} samples: {_counted(plan.processes)} × {plan.in_turn} in turn"),
        ("scenes", f"{plan.scenes:,}" + (f" (assumed: {plan.assumed})" if plan.assumed else "")),
    ]
    for number, stage in enumerate(plan.stages, 1):
        fewest, most = stage.inputs
        inputs = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        distinct = "every draw of other photos" if plan.online else f"{stage.distinct:,} distinct samples"
        rows.append((f"stage {number}", f"{stage.drawn:,} samples of {inputs} inputs, {distinct}"))
    if plan.online:
        rows.append(("cache", "none: samples are made in each step"))
    else:
        rows.append(("cache", f"{plan.samples:,} samples, {_size(plan.disk_gib)} on disk; {plan.ready:,} are there"))
    rows.append(("weights, gradients, moments, average", f"{plan.state_gib:.2f} GiB in each process"))
    measured = (
        ("peak memory", plan.peak_memory_gib, "GiB"),
        ("a sample", plan.seconds_per_sample, "s"),
        ("a step", plan.seconds_per_step, "s"),
        (f"all of it, in {_counted(plan.processes)}", plan.hours, "h"),
    )
    rows += [(name, f"{value:.2f} {unit}") for name, value, unit in measured if value is not None]
    if plan.unmeasured:
        rows.append(("not measured", plan.unmeasured))
    say(rows_table("dry run", rows), printing)


def _counted(processes: int) -> str:
    return f"{processes} process{'es' if processes > 1 else ''}"


def _size(gib: float) -> str:
    """In GB, or in TB from one on."""
    gigabytes = gib * 2**30 / 1e9
    return f"{gigabytes / 1000:.1f} TB" if gigabytes >= 1000 else f"{gigabytes:.2f} GB"


def print_samples(samples: PreparedSamples, printing: Printing) -> None:
    """How many samples are in the cache, and why others could not be made."""
    print_json(asdict(samples), printing)
    say(f"{samples.ready:,} samples are ready, {len(samples.failed):,} could not be made", printing)


def print_training(report: TrainReport, printing: Printing) -> None:
    """What a training did, and where its weights are."""
    print_json(asdict(report), printing)
    each = report.batch // report.processes
    figures = ""
    if report.loss is not None and report.psnr is not None:
        figures = f"loss {report.loss:.4f}, {report.psnr:.2f} dB on targets; "
    say(
        f"{report.steps:,} steps of {report.batch} samples ({_counted(report.processes)} × {each} in "
        f"turn), {figures}{report.steps_per_second:.2f} steps a second, "
        f"{100 * report.waiting:.0f} % of the time waiting for data, "
        f"{report.peak_memory_gib:.2f} GiB",
        printing,
    )
    for reason, count in report.skipped.items():
        say(f"{count} samples gave no gradient: {reason}", printing)
    if report.redrawn:
        say(f"{report.redrawn} scenes gave no sample, and others were drawn", printing)
    say(f"{report.model}   (for --preset; state, log and curve are beside it)", printing)
