"""`querysplat train`: the model's weights from scenes."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge

from querysplat_cli.cli.verb import Printing
from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.options import Cluster, Device, Force, LpipsWeights, Option


@dataclass(frozen=True)
class TrainOptions:
    """The options of `querysplat train`; the training itself is described by its TOML file."""

    config: Annotated[
        str, Option("The training: a TOML file, or one that comes with the package.", metavar="FILE.toml|NAME")
    ] = "compact"
    changes: Annotated[
        tuple[str, ...],
        Option("Change one setting. May be repeated.", ("--set",), "NAME=VALUE", default="no change", repeated=True),
    ] = ()
    output: Annotated[
        Path, Option("A folder for weights, state, log and curves.", ("--output", "-o"), metavar="DIR")
    ] = Path("training")
    resume: Annotated[bool, Option("Go on with the training in the folder.")] = False
    dry_run: Annotated[bool, Option("State the batch, samples, disk, memory and time of it, and write nothing.")] = (
        False
    )
    samples_only: Annotated[bool, Option("Make the samples of the cache, and train nothing.")] = False
    workers: Annotated[
        int | None,
        Ge(1),
        Option("Processes that make the samples of the cache.", metavar="N", default="one for each core"),
    ] = None
    cluster: Cluster = None
    lpips: LpipsWeights = None
    tensorboard: Annotated[bool, Option("Write TensorBoard's files, too.")] = False
    device: Device = "auto"
    force: Force = False


def train(options: TrainOptions, printing: Printing) -> None:
    """Train a model on procedural or captured scenes, alone or under torchrun."""
    from querysplat_cli.cli.print_training import print_samples, print_training, print_training_plan
    from querysplat_cli.cli.terminal import showing_stages
    from querysplat_cli.splat.lpips import find_lpips, load_lpips
    from querysplat_cli.training.config import load_config
    from querysplat_cli.training.plan import plan
    from querysplat_cli.training.run import TrainRequest
    from querysplat_cli.training.run import train as run
    from querysplat_cli.training.trainer import TrainReport

    config = load_config(options.config, options.changes)
    perceptual = None
    if config.needs_lpips and not options.dry_run and not options.samples_only:
        found = find_lpips(options.lpips)
        if isinstance(found, str):
            raise MissingPart(found, "Give --lpips DIR, or leave it out with --set losses.lpips=0.")
        perceptual = load_lpips(found)
    request = TrainRequest(
        config,
        options.output,
        options.resume,
        options.force,
        options.device,
        options.tensorboard,
        perceptual,
        options.workers,
        options.samples_only,
        options.cluster,
    )
    if os.environ.get("RANK", "0") != "0":  # torchrun starts several processes; the first one reports for all
        printing = Printing(quiet=True)
    with showing_stages(printing) as stages:
        if options.dry_run:
            print_training_plan(plan(request, stages), printing)
            return
        report = run(request, stages)
    if isinstance(report, TrainReport):
        print_training(report, printing)
    elif report:
        print_samples(report, printing)
