"""`querysplat train`: the model's weights from scenes."""

import os
from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import Device, Force, Json, Quiet
from querysplat_cli.runtime.errors import MissingPart


def train(
    config: Annotated[
        str, typer.Option(metavar="FILE.toml|NAME", help="The training: a file, or one that comes with the package.")
    ] = "compact",
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="Change a setting; may be repeated.")
    ] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="A folder for weights, state, log and curves.")] = Path(
        "training"
    ),
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the training in the folder.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what it takes, and stop.")] = False,
    lpips: Annotated[Path | None, typer.Option(help="A folder with LPIPS weights; see docs/cli.md.")] = None,
    tensorboard: Annotated[bool, typer.Option("--tensorboard", help="Write TensorBoard's files as well.")] = False,
    device: Device = "auto",
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Train a model on procedural or captured scenes, alone or under torchrun."""
    from querysplat_cli.cli.console import showing_stages
    from querysplat_cli.cli.train_console import print_training, print_training_plan
    from querysplat_cli.evaluation.lpips import find_lpips, load_lpips
    from querysplat_cli.training.config import load_config
    from querysplat_cli.training.run import TrainRequest, plan
    from querysplat_cli.training.run import train as run

    settings = load_config(config, changes or ())
    perceptual = None
    if settings.needs_lpips and not dry_run:
        found = find_lpips(lpips)
        if isinstance(found, str):
            raise MissingPart(found, "Give --lpips DIR, or leave it out with --set losses.lpips=0.")
        perceptual = load_lpips(found)
    request = TrainRequest(settings, output, resume, force, device, tensorboard, perceptual)
    # Under torchrun one process speaks for all.
    with showing_stages(quiet=quiet or os.environ.get("RANK", "0") != "0") as stages:
        if dry_run:
            print_training_plan(plan(request, stages), quiet=quiet, as_json=json)
            return
        report = run(request, stages)
    if report:
        print_training(report, quiet=quiet, as_json=json)
